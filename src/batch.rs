//! Elements in batches of eight, as kernels take them: one number per lane, everything of an element in one place.
//!
//! Neighbours on a line share a batch where there are enough of them: what they read and write then lies one behind the other, on
//! coarse cells too, as only nodes that elements name are numbered. A batch that is not full repeats its first element with size 0, which
//! then adds zeros.

use crate::{
    grid::Elements,
    math::{
        Vec3,
        pack::{Pack, Pack3, WIDTH},
    },
};
use pulp::Simd;
use std::ops::Range;

/// All elements of a mesh in batches.
#[derive(Clone, Debug, Default)]
pub struct Batches {
    /// Stretch elements.
    pub edges: Vec<EdgeBatch>,
    /// Bending elements.
    pub triples: Vec<TripleBatch>,
    /// Shear elements.
    pub shears: Vec<ShearBatch>,
}

impl Batches {
    /// The batches of a mesh's elements: those that name no ghost come first.
    pub fn new(elements: &Elements) -> Batches {
        let mut batches = Batches::of_regular(elements);
        let count = [elements.edges.len(), elements.triples.len(), elements.shears.len()];
        batches.extend(elements, [0, 1, 2].map(|k| elements.regular[k]..count[k]));
        batches
    }

    /// The batches of the elements that name no ghost.
    pub fn of_regular(elements: &Elements) -> Batches {
        let mut batches = Batches::default();
        batches.extend(elements, elements.regular.map(|count| 0..count));
        batches
    }

    fn extend(&mut self, elements: &Elements, [edges, triples, shears]: [Range<usize>; 3]) {
        let edge = |k: u32| &elements.edges[k as usize];
        let triple = |k: u32| &elements.triples[k as usize];
        let shear = |k: u32| &elements.shears[k as usize];
        let number = |n: u32| elements.number(n);
        for direction in 0..2 {
            let ids = lanes(edges.clone().filter(|&k| edge(k as u32).direction == direction), |k| {
                edge(k).nodes.map(number)
            });
            self.edges.extend(ids.into_iter().map(|ids| EdgeBatch::new(elements, ids)));
            let ids = lanes(triples.clone().filter(|&k| triple(k as u32).direction == direction), |k| {
                triple(k).nodes.map(number)
            });
            self.triples.extend(ids.into_iter().map(|ids| TripleBatch::new(elements, ids)));
        }
        let ids = lanes(shears, |k| shear(k).nodes.map(number));
        self.shears.extend(ids.into_iter().map(|ids| ShearBatch::new(elements, ids)));
    }
}

/// Fewest neighbours that have a batch of their own.
const FEWEST: usize = 5;

/// Elements in batches: first those whose nodes are each one beyond their predecessor's, then the others.
fn lanes<const N: usize>(wanted: impl Iterator<Item = usize>, nodes: impl Fn(u32) -> [u32; N]) -> Vec<Ids> {
    let mut ids: Vec<u32> = wanted.map(|k| k as u32).collect();
    let elements = ids.iter().max().map_or(0, |last| *last as usize + 1);
    ids.sort_by_key(|&k| nodes(k)[0]);
    let follows = |a: &u32, b: &u32| nodes(*a).map(|n| n + 1) == nodes(*b);
    let (mut batches, mut others): (Vec<&[u32]>, Vec<u32>) = (Vec::new(), Vec::new());
    for batch in ids.chunk_by(follows).flat_map(|line| line.chunks(WIDTH)) {
        if batch.len() >= FEWEST {
            batches.push(batch);
        } else {
            others.extend(batch);
        }
    }
    let batch = |ids: &[u32]| Ids::new(ids, elements);
    batches.into_iter().chain(others.chunks(WIDTH)).map(batch).collect()
}

/// Whether every node of a batch's elements is one beyond its predecessor's.
fn is_run<const N: usize>(nodes: &[[u32; WIDTH]; N], full: usize) -> bool {
    nodes.iter().all(|lanes| (1..full).all(|l| lanes[l] == lanes[0] + l as u32))
}

/// Numbers of a batch's elements.
#[derive(Clone, Debug)]
pub struct Ids {
    /// One per lane; those that do not count repeat the first.
    pub lanes: [u32; WIDTH],
    /// Lanes that count.
    pub full: usize,
    /// Whether each is one more than that of the lane before, and as many elements as lanes come from the first on: what is kept of
    /// elements can then be read whole registers at a time.
    pub is_run: bool,
}

impl Ids {
    /// Of eight elements at the most of so many.
    fn new(ids: &[u32], elements: usize) -> Ids {
        let (first, full) = (ids[0], ids.len());
        let follow = ids.iter().zip(first..).all(|(id, next)| *id == next);
        Ids {
            lanes: std::array::from_fn(|lane| *ids.get(lane).unwrap_or(&first)),
            full,
            is_run: follow && first as usize + WIDTH <= elements,
        }
    }

    /// Those of the lanes from `from` on, so many at the most, that count.
    #[inline(always)]
    pub fn counting(&self, from: usize, lanes: usize) -> &[u32] {
        &self.lanes[from..self.full.clamp(from, from + lanes)]
    }
}

/// A vector per node that elements name in planes, all x, all y, all z, with room behind for the lanes of a batch that do not count.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Planes {
    /// Numbers.
    pub list: Vec<f64>,
    /// Length of a plane.
    pub stride: usize,
}

impl Planes {
    /// Zeros for so many nodes.
    pub fn new(nodes: usize) -> Planes {
        // Not a power of two, so that planes do not fall on each other in the cache.
        let stride = (nodes + WIDTH).next_multiple_of(16 * WIDTH) + 5 * WIDTH;
        Planes { list: vec![0.0; 3 * stride], stride }
    }

    /// Takes over the vectors of the nodes named.
    pub fn set(&mut self, vectors: &[Vec3], named: &[u32]) {
        self.set_from(named, |n| vectors[n]);
    }

    /// Takes over a vector of each node named.
    pub fn set_from(&mut self, named: &[u32], vector: impl Fn(usize) -> Vec3) {
        let (x, rest) = self.list.split_at_mut(self.stride);
        let (y, z) = rest.split_at_mut(self.stride);
        for (((x, y), z), &n) in x.iter_mut().zip(y).zip(z).zip(named) {
            let v = vector(n as usize);
            (*x, *y, *z) = (v.x, v.y, v.z);
        }
    }

    /// Vectors of nodes one behind the other, from one on: as many as lanes.
    #[inline(always)]
    pub fn load<S: Simd>(&self, simd: S, at: usize) -> Pack3<S> {
        let Planes { list, stride } = self;
        assert!(at + 2 * stride + S::F64_LANES <= list.len(), "within the planes");
        let place = list.as_ptr();
        // SAFETY: all three registers lie within the list.
        unsafe {
            [
                Pack::load_from(simd, place.add(at)),
                Pack::load_from(simd, place.add(stride + at)),
                Pack::load_from(simd, place.add(2 * stride + at)),
            ]
        }
    }

    /// Adds to the vectors of such nodes.
    #[inline(always)]
    pub fn add<S: Simd>(&mut self, at: usize, value: Pack3<S>) {
        let Planes { list, stride } = self;
        assert!(at + 2 * *stride + S::F64_LANES <= list.len(), "within the planes");
        let (place, stride) = (list.as_mut_ptr(), *stride);
        for (k, value) in value.into_iter().enumerate() {
            // SAFETY: all three registers lie within the list.
            unsafe { value.add_at(place.add(k * stride + at)) };
        }
    }

    /// Makes all zero.
    pub fn clear(&mut self) {
        self.list.fill(0.0);
    }

    /// Adds its vectors to those of the nodes named.
    pub fn add_to(&self, vectors: &mut [Vec3], named: &[u32]) {
        let (x, rest) = self.list.split_at(self.stride);
        let (y, z) = rest.split_at(self.stride);
        for (((x, y), z), &n) in x.iter().zip(y).zip(z).zip(named) {
            vectors[n as usize] += Vec3::new(*x, *y, *z);
        }
    }
}

/// Strains, curvatures and shear angles of a shape, and the forces the laws answer with.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Measures {
    /// Per edge: strain [1] and tension per width [N/m].
    pub edges: Vec<[f64; 2]>,
    /// Per triple: curvature [1/m] and moment per width [N].
    pub triples: Vec<[f64; 2]>,
    /// Per cell: shear angle [rad] and shear force per width [N/m].
    pub shears: Vec<[f64; 2]>,
    /// Per cell: twist [1/m]; all zero in a fabric without twist rigidity.
    pub twists: Vec<f64>,
    /// The shape [m]; and the forces on its nodes [N] of triples, and of all other elements.
    pub(crate) shape: Planes,
    pub(crate) forces: [Planes; 2],
}

impl Measures {
    /// Room for a mesh's elements.
    pub fn new(elements: &Elements) -> Measures {
        Measures {
            edges: vec![[0.0; 2]; elements.edges.len()],
            triples: vec![[0.0; 2]; elements.triples.len()],
            shears: vec![[0.0; 2]; elements.shears.len()],
            twists: vec![0.0; elements.shears.len()],
            shape: Planes::new(elements.named.len()),
            forces: [0, 1].map(|_| Planes::new(elements.named.len())),
        }
    }
}

/// Eight edges of one direction.
#[derive(Clone, Debug)]
pub struct EdgeBatch {
    /// Line they lie on.
    pub direction: usize,
    /// Whether each node is one beyond that of the lane before.
    pub is_run: bool,
    /// Numbers of the elements.
    pub ids: Ids,
    /// Start and end, by their numbers, as all nodes of batches.
    pub nodes: [[u32; WIDTH]; 2],
    /// 1/rest length [1/m].
    pub inverse: [f64; WIDTH],
    /// Strain that counts as none [1].
    pub rest: [f64; WIDTH],
    /// Width times rest length [m²]; 0 in lanes that do not count.
    pub size: [f64; WIDTH],
}

impl EdgeBatch {
    fn new(elements: &Elements, ids: Ids) -> EdgeBatch {
        let edges = ids.lanes.map(|k| &elements.edges[k as usize]);
        let number = |n: u32| elements.number(n);
        let nodes = [0, 1].map(|n| edges.map(|e| number(e.nodes[n])));
        EdgeBatch {
            is_run: is_run(&nodes, ids.full),
            direction: edges[0].direction,
            nodes,
            inverse: edges.map(|e| 1.0 / e.length),
            rest: edges.map(|e| e.rest),
            size: std::array::from_fn(|l| if l < ids.full { edges[l].width * edges[l].length } else { 0.0 }),
            ids,
        }
    }
}

/// Pairs of nodes (previous, centre, next, transverse previous, transverse next), in the order of a batch's slots.
pub const TRIPLE_PAIRS: [[usize; 2]; 10] =
    [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]];

/// Eight triples of one direction.
#[derive(Clone, Debug)]
pub struct TripleBatch {
    /// Line they lie on.
    pub direction: usize,
    /// Whether each node is one beyond that of the lane before.
    pub is_run: bool,
    /// Numbers of the elements.
    pub ids: Ids,
    /// Previous, centre, next, transverse previous, transverse next; the centre stands in where the sheet ends.
    pub nodes: [[u32; WIDTH]; 5],
    /// 1/rest length of both edges [1/m].
    pub inverses: [[f64; WIDTH]; 2],
    /// Shares of both edges in a.
    pub shares: [[f64; WIDTH]; 2],
    /// 1/span, signed by direction [1/m].
    pub across: [f64; WIDTH],
    /// 1/reach [1/m].
    pub sharpness: [f64; WIDTH],
    /// Curvature that counts as none [1/m].
    pub rest: [f64; WIDTH],
    /// Area [m²]; 0 in lanes that do not count.
    pub size: [f64; WIDTH],
}

impl TripleBatch {
    fn new(elements: &Elements, ids: Ids) -> TripleBatch {
        let triples = ids.lanes.map(|k| &elements.triples[k as usize]);
        let number = |n: u32| elements.number(n);
        let sign = if triples[0].direction == 0 { 1.0 } else { -1.0 };
        let nodes = std::array::from_fn(|n| triples.map(|t| number(t.nodes[n])));
        TripleBatch {
            is_run: is_run(&nodes, ids.full),
            direction: triples[0].direction,
            nodes,
            inverses: [0, 1].map(|k| triples.map(|t| 1.0 / t.lengths[k])),
            shares: [0, 1].map(|k| triples.map(|t| t.lengths[k] / (t.lengths[0] + t.lengths[1]))),
            across: triples.map(|t| sign / t.span),
            sharpness: triples.map(|t| 1.0 / t.reach),
            rest: triples.map(|t| t.rest),
            size: std::array::from_fn(|l| if l < ids.full { triples[l].area } else { 0.0 }),
            ids,
        }
    }
}

/// Pairs of corners, in the order of a batch's slots.
pub const SHEAR_PAIRS: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

/// Eight cells.
#[derive(Clone, Debug)]
pub struct ShearBatch {
    /// Whether each node is one beyond that of the lane before.
    pub is_run: bool,
    /// Numbers of the elements.
    pub ids: Ids,
    /// Corners (0,0), (1,0), (0,1), (1,1).
    pub nodes: [[u32; WIDTH]; 4],
    /// The same as bending sees them.
    pub bent: [[u32; WIDTH]; 4],
    /// Whether each of these is one beyond that of the lane before.
    pub is_bent_run: bool,
    /// Half of 1/side, along warp and weft [1/m].
    pub halves: [[f64; WIDTH]; 2],
    /// Angle that counts as none [rad].
    pub rest: [f64; WIDTH],
    /// Area [m²]; 0 in lanes that do not count.
    pub size: [f64; WIDTH],
}

impl ShearBatch {
    fn new(elements: &Elements, ids: Ids) -> ShearBatch {
        let shears = ids.lanes.map(|k| &elements.shears[k as usize]);
        let number = |n: u32| elements.number(n);
        let nodes = std::array::from_fn(|n| shears.map(|s| number(s.nodes[n])));
        let bent = std::array::from_fn(|n| shears.map(|s| number(s.bent[n])));
        ShearBatch {
            is_run: is_run(&nodes, ids.full),
            is_bent_run: is_run(&bent, ids.full),
            nodes,
            bent,
            halves: [0, 1].map(|d| shears.map(|s| 0.5 / s.lengths[d])),
            rest: shears.map(|s| s.rest),
            size: std::array::from_fn(|l| if l < ids.full { shears[l].area } else { 0.0 }),
            ids,
        }
    }
}
