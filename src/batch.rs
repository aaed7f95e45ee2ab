//! Elements in batches of eight, as kernels take them: one number per lane, everything of an element in one place.
//!
//! A batch that is not full repeats its first element with size 0, which then adds zeros.

use crate::{
    grid::{Edge, Elements, Shear, Triple},
    math::pack::WIDTH,
};
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
        for direction in 0..2 {
            let ids = lanes(edges.clone(), |k| edge(k).direction == direction);
            self.edges.extend(ids.into_iter().map(|(ids, full)| EdgeBatch::new(ids, full, edge)));
            let ids = lanes(triples.clone(), |k| triple(k).direction == direction);
            self.triples.extend(ids.into_iter().map(|(ids, full)| TripleBatch::new(ids, full, triple)));
        }
        let ids = lanes(shears, |_| true);
        self.shears.extend(ids.into_iter().map(|(ids, full)| ShearBatch::new(ids, full, shear)));
    }
}

/// The elements of a range that are wanted, in batches, each with how many of it count.
fn lanes(range: Range<usize>, wanted: impl Fn(u32) -> bool) -> Vec<([u32; WIDTH], usize)> {
    let ids: Vec<u32> = range.map(|k| k as u32).filter(|&k| wanted(k)).collect();
    let batch = |ids: &[u32]| (std::array::from_fn(|lane| *ids.get(lane).unwrap_or(&ids[0])), ids.len());
    ids.chunks(WIDTH).map(batch).collect()
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
}

impl Measures {
    /// Room for a mesh's elements.
    pub fn new(elements: &Elements) -> Measures {
        Measures {
            edges: vec![[0.0; 2]; elements.edges.len()],
            triples: vec![[0.0; 2]; elements.triples.len()],
            shears: vec![[0.0; 2]; elements.shears.len()],
            twists: vec![0.0; elements.shears.len()],
        }
    }
}

/// Eight edges of one direction.
#[derive(Clone, Debug)]
pub struct EdgeBatch {
    /// Line they lie on.
    pub direction: usize,
    /// Numbers of the elements.
    pub ids: [u32; WIDTH],
    /// Start and end.
    pub nodes: [[u32; WIDTH]; 2],
    /// 1/rest length [1/m].
    pub inverse: [f64; WIDTH],
    /// Width times rest length [m²]; 0 in lanes that do not count.
    pub size: [f64; WIDTH],
}

impl EdgeBatch {
    fn new<'a>(ids: [u32; WIDTH], full: usize, edge: impl Fn(u32) -> &'a Edge) -> EdgeBatch {
        let edges = ids.map(edge);
        EdgeBatch {
            direction: edges[0].direction,
            ids,
            nodes: [0, 1].map(|n| edges.map(|e| e.nodes[n])),
            inverse: edges.map(|e| 1.0 / e.length),
            size: std::array::from_fn(|l| if l < full { edges[l].width * edges[l].length } else { 0.0 }),
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
    /// Numbers of the elements.
    pub ids: [u32; WIDTH],
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
    /// Area [m²]; 0 in lanes that do not count.
    pub size: [f64; WIDTH],
}

impl TripleBatch {
    fn new<'a>(ids: [u32; WIDTH], full: usize, triple: impl Fn(u32) -> &'a Triple) -> TripleBatch {
        let triples = ids.map(triple);
        let sign = if triples[0].direction == 0 { 1.0 } else { -1.0 };
        TripleBatch {
            direction: triples[0].direction,
            ids,
            nodes: std::array::from_fn(|n| triples.map(|t| t.nodes[n])),
            inverses: [0, 1].map(|k| triples.map(|t| 1.0 / t.lengths[k])),
            shares: [0, 1].map(|k| triples.map(|t| t.lengths[k] / (t.lengths[0] + t.lengths[1]))),
            across: triples.map(|t| sign / t.span),
            sharpness: triples.map(|t| 1.0 / t.reach),
            size: std::array::from_fn(|l| if l < full { triples[l].area } else { 0.0 }),
        }
    }
}

/// Pairs of corners, in the order of a batch's slots.
pub const SHEAR_PAIRS: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

/// Eight cells.
#[derive(Clone, Debug)]
pub struct ShearBatch {
    /// Numbers of the elements.
    pub ids: [u32; WIDTH],
    /// Corners (0,0), (1,0), (0,1), (1,1).
    pub nodes: [[u32; WIDTH]; 4],
    /// The same as bending sees them.
    pub bent: [[u32; WIDTH]; 4],
    /// Half of 1/side, along warp and weft [1/m].
    pub halves: [[f64; WIDTH]; 2],
    /// Area [m²]; 0 in lanes that do not count.
    pub size: [f64; WIDTH],
}

impl ShearBatch {
    fn new<'a>(ids: [u32; WIDTH], full: usize, shear: impl Fn(u32) -> &'a Shear) -> ShearBatch {
        let shears = ids.map(shear);
        ShearBatch {
            ids,
            nodes: std::array::from_fn(|n| shears.map(|s| s.nodes[n])),
            bent: std::array::from_fn(|n| shears.map(|s| s.bent[n])),
            halves: [0, 1].map(|d| shears.map(|s| 0.5 / s.lengths[d])),
            size: std::array::from_fn(|l| if l < full { shears[l].area } else { 0.0 }),
        }
    }
}
