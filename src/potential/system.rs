//! The sparse linear system of a Newton step: block pattern, elimination order, assembly, and which particles are fixed.
//!
//! Unknowns are those of active particles, ordered by nested dissection of the mesh, which keeps the Cholesky factor sparse. The
//! pattern belongs to a mesh; fixed particles keep their rows as identity, so pinning and grabbing never change it.

use super::{
    ghosted::{Combined, Ghosted, Nine},
    order,
    product::Apply,
};
use crate::{
    batch::{Batches, Planes, SHEAR_PAIRS, TRIPLE_PAIRS},
    grid::{Elements, Grid},
    math::{
        Mat3, Vec3,
        pack::{Block, WIDTH, dispatch},
    },
};
use pulp::Simd;
use std::{collections::HashMap, ops::Range, sync::Arc};

/// Where the 3 × 3 block of a pair of particles lies in each plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Slot {
    at: u32,
    lie: Lie,
}

/// How a pair's block lies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Lie {
    /// The first particle of the pair comes first in the order.
    #[default]
    Straight,
    /// The second one does: the transpose is kept.
    Transposed,
    /// Both are one particle (the centre of a triple at the border): block and transpose go to its diagonal.
    Diagonal,
}

/// Where the blocks of a batch's pairs lie: one behind the other, or each in a place of its own.
#[derive(Clone, Copy, Debug)]
pub struct Slots {
    /// The first lane's place; of lanes on their own the place in the pattern's list.
    at: u32,
    lie: Lie,
    is_run: bool,
}

/// Pairs one behind the other in the planes, whose particles are so too. Behind long ones there are zeros for whole registers.
#[derive(Clone, Copy, Debug)]
pub struct Run {
    /// Place of the first block.
    pub at: usize,
    /// Place of the first pair's first particle, and of its second.
    pub first: usize,
    pub second: usize,
    /// Pairs.
    pub len: usize,
    /// Whether there are zeros behind.
    pub is_padded: bool,
}

/// Particles that are eliminated together: a leaf or a separator of the dissection.
#[derive(Clone, Debug)]
pub struct Region {
    /// Their places in the elimination order.
    pub ranks: Range<u32>,
    /// The separator that parts this region's rectangle from its sibling's, as a place in the list of regions.
    pub parent: Option<u32>,
}

/// Sparsity of a mesh's Hessian.
#[derive(Debug)]
pub struct Pattern {
    /// Place of each node in the elimination order; `ABSENT` for what is not active.
    pub rank: Vec<u32>,
    /// Active particles in elimination order.
    pub particles: Vec<u32>,
    /// Regions of the dissection, children before parents.
    pub regions: Vec<Region>,
    /// Scalar column starts of the lower triangle, compressed by columns.
    pub columns: Vec<u32>,
    /// Scalar row of each value.
    pub rows: Vec<u32>,
    /// Active particles in the order of the lattice: that of the blocks, and of the vectors of iterative solves.
    pub order: Vec<u32>,
    /// Place of each node in that order; `ABSENT` for what is not active.
    pub place: Vec<u32>,
    /// The pairs of different particles.
    pub runs: Vec<Run>,
    /// Length of a plane of blocks.
    pub stride: usize,
    /// Nodes that elements name.
    pub(crate) named: usize,
    /// Length of a plane of a vector in this order: all x, all y and all z, with zeros behind each.
    pub plane: usize,
    /// Slots of the diagonals and pairs of edges that name no ghost, batch by batch.
    pub edges: Vec<[Slots; 3]>,
    /// The same of triples.
    pub triples: Vec<[Slots; 15]>,
    /// The same of cells.
    pub shears: Vec<[Slots; 10]>,
    /// Stencils of the elements that name ghosts.
    pub ghosted: Ghosted,
    /// Places of the blocks that those add to.
    sums: Vec<u32>,
    /// Slots of the batches that are no run, lane by lane.
    lanes: Vec<[Slot; WIDTH]>,
    /// Place in the blocks of each value of the lower triangle.
    sources: Vec<u32>,
    /// First of the neighbours of each place of `order`, and the neighbours, each with the slot of the pair (neighbour, particle).
    starts: Vec<u32>,
    neighbours: Vec<(u32, Slot)>,
    blocks: Blocks,
}

/// Rank of what is not active.
pub const ABSENT: u32 = u32::MAX;

#[derive(Debug)]
struct Blocks {
    /// First off-diagonal block of each block column.
    starts: Vec<u32>,
    /// Block rows, sorted within a column.
    rows: Vec<u32>,
}

impl Blocks {
    /// From sorted pairs (column, row).
    fn new(n: usize, pairs: &[(u32, u32)]) -> Blocks {
        let mut starts = vec![0; n + 1];
        for &(column, _) in pairs {
            starts[column as usize + 1] += 1;
        }
        for c in 0..n {
            starts[c + 1] += starts[c];
        }
        Blocks { starts, rows: pairs.iter().map(|&(_, row)| row).collect() }
    }

    fn column(&self, c: usize) -> &[u32] {
        &self.rows[self.starts[c] as usize..self.starts[c + 1] as usize]
    }

    /// Scalar start of block column `c`: 6 values of the diagonal block's triangle and 9 per block for each column before.
    fn start(&self, c: usize) -> u32 {
        6 * c as u32 + 9 * self.starts[c]
    }
}

/// Places of the blocks of pairs: pairs of one distance in the order lie together, as far apart as their first particles where that
/// wastes less than half, so that neighbouring elements find them one behind the other.
struct Layout {
    /// Pairs of each distance: distance, its first place, first particles in order, whether they leave gaps.
    groups: Vec<(u32, u32, Vec<u32>, bool)>,
    /// Places in all.
    len: usize,
}

impl Layout {
    /// From pairs (first, second) of places in the order, the diagonals in front of all.
    fn new(n: usize, mut pairs: Vec<(u32, u32)>) -> Layout {
        pairs.sort_unstable_by_key(|&(first, second)| (second - first, first));
        let mut layout = Layout { groups: vec![(0, 0, (0..n as u32).collect(), true)], len: n + PADDING };
        for group in pairs.chunk_by(|a, b| a.1 - a.0 == b.1 - b.0) {
            let firsts: Vec<u32> = group.iter().map(|pair| pair.0).collect();
            let is_spread = 2 * firsts.len() > n;
            let from = layout.len as u32;
            layout.len += if is_spread { n + PADDING } else { firsts.len() };
            layout.groups.push((group[0].1 - group[0].0, from, firsts, is_spread));
        }
        layout
    }

    /// Slot of a pair of places.
    fn slot(&self, first: u32, second: u32) -> Slot {
        let (low, high) = (first.min(second), first.max(second));
        let group = self.groups.binary_search_by_key(&(high - low), |group| group.0);
        let (_, from, firsts, is_spread) = &self.groups[group.expect("a pair of the pattern")];
        let place =
            if *is_spread { low } else { firsts.binary_search(&low).expect("a pair of the pattern") as u32 };
        let lie = match first.cmp(&second) {
            std::cmp::Ordering::Less => Lie::Straight,
            std::cmp::Ordering::Greater => Lie::Transposed,
            std::cmp::Ordering::Equal => Lie::Diagonal,
        };
        Slot { at: from + place, lie }
    }

    /// The pairs of different particles. What lies in a gap is zero and does no harm in a product.
    fn runs(&self, n: usize) -> Vec<Run> {
        let mut runs: Vec<Run> = Vec::new();
        for (distance, from, firsts, is_spread) in &self.groups[1..] {
            let (distance, from) = (*distance as usize, *from as usize);
            if *is_spread {
                runs.push(Run { at: from, first: 0, second: distance, len: n - distance, is_padded: true });
                continue;
            }
            for (place, first) in firsts.iter().map(|&f| f as usize).enumerate() {
                match runs.last_mut() {
                    Some(run) if run.at + run.len == from + place && run.first + run.len == first => {
                        run.len += 1;
                    }
                    _ => runs.push(Run {
                        at: from + place,
                        first,
                        second: first + distance,
                        len: 1,
                        is_padded: false,
                    }),
                }
            }
        }
        runs
    }
}

/// Zeros behind what is read and written a register at a time: the widest holds 16 numbers of single precision.
const PADDING: usize = 16;

/// Length of a plane of a vector of so many particles: whole registers, from wherever they are read.
fn plane(n: usize) -> usize {
    n.next_multiple_of(PADDING) + PADDING
}

/// Length of a plane of so many blocks: room behind for the lanes of a batch that do not count, whole registers, and not a power of two,
/// so that planes do not fall on each other in the cache.
fn stride(blocks: usize) -> usize {
    let registers = (blocks + WIDTH).div_ceil(WIDTH);
    WIDTH * (registers + (5 + 16 - registers % 16) % 16)
}

impl Pattern {
    /// The pattern of a mesh.
    pub fn new(grid: &Grid, elements: &Elements) -> Pattern {
        let [edge_count, triple_count, shear_count] = elements.regular;
        let combined = Combined::new(elements);
        let mut coupled: Vec<&[u32]> = Vec::new();
        coupled.extend(elements.edges[..edge_count].iter().map(|e| &e.nodes[..]));
        coupled.extend(elements.triples[..triple_count].iter().map(|t| &t.nodes[..]));
        coupled.extend(elements.shears[..shear_count].iter().map(|s| &s.nodes[..]));
        coupled.extend(combined.nodes());
        let (particles, regions) = order::dissection(grid, &coupled);
        let mut rank = vec![ABSENT; elements.nodes()];
        particles.iter().zip(0..).for_each(|(&n, k)| rank[n as usize] = k);
        let pairs = pairs(&coupled, &rank);
        let blocks = Blocks::new(particles.len(), &pairs);
        let (columns, rows) = scalar_pattern(&blocks, particles.len());
        let mut order = particles.clone();
        order.sort_unstable();
        let mut place = vec![ABSENT; elements.nodes()];
        order.iter().zip(0..).for_each(|(&n, k)| place[n as usize] = k);
        let couples = pairs.iter().map(|&(column, row)| {
            let [a, b] = [column, row].map(|rank| place[particles[rank as usize] as usize]);
            (a.min(b), a.max(b))
        });
        let layout = Layout::new(order.len(), couples.collect());
        let stride = stride(layout.len);
        let slot = |m: u32, n: u32| layout.slot(place[m as usize], place[n as usize]);
        let mut lanes = Vec::new();
        let mut look_up = |m: &[u32; WIDTH], n: &[u32; WIDTH], full: usize, is_own: bool| -> Slots {
            let mut own = [Slot::default(); WIDTH];
            let node = |number: u32| elements.named[number as usize];
            (0..full).for_each(|l| own[l] = slot(node(m[l]), node(n[l])));
            let Slot { at, lie } = own[0];
            let is_run = (0..full).all(|l| own[l] == Slot { at: at + l as u32, lie });
            let is_run = is_run && (is_own || lie != Lie::Diagonal);
            // Lanes that do not count add zeros, wherever that is.
            (full..WIDTH).for_each(|l| own[l] = own[0]);
            if is_run {
                return Slots { at, lie, is_run };
            }
            lanes.push(own);
            Slots { at: lanes.len() as u32 - 1, lie, is_run }
        };
        let batches = Batches::of_regular(elements);
        let edges = batches.edges.iter().map(|b| {
            [[0, 0], [1, 1], [0, 1]].map(|[m, n]| look_up(&b.nodes[m], &b.nodes[n], b.full, m == n))
        });
        let edges = edges.collect();
        let own = |n: usize| [n, n];
        let triples = batches.triples.iter().map(|b| {
            std::array::from_fn(|k| {
                let [m, n] = if k < 5 { own(k) } else { TRIPLE_PAIRS[k - 5] };
                look_up(&b.nodes[m], &b.nodes[n], b.full, k < 5)
            })
        });
        let triples = triples.collect();
        let shears = batches.shears.iter().map(|b| {
            std::array::from_fn(|k| {
                let [m, n] = if k < 4 { own(k) } else { SHEAR_PAIRS[k - 4] };
                look_up(&b.nodes[m], &b.nodes[n], b.full, k < 4)
            })
        });
        let shears = shears.collect();
        let (mut sums, mut known) = (Vec::new(), HashMap::new());
        let ghosted = combined.place(|m, n| {
            let at = slot(m, n).at;
            *known.entry(at).or_insert_with(|| {
                sums.push(at);
                sums.len() as u32 - 1
            })
        });
        let mut around = vec![Vec::new(); order.len()];
        for &(column, row) in &pairs {
            let (m, n) = (particles[row as usize], particles[column as usize]);
            around[place[n as usize] as usize].push((m, slot(m, n)));
            around[place[m as usize] as usize].push((n, slot(n, m)));
        }
        let mut starts = vec![0];
        for list in &around {
            starts.push(starts[starts.len() - 1] + list.len() as u32);
        }
        let neighbours = around.concat();
        let mut sources = Vec::with_capacity(rows.len());
        for (c, &n) in particles.iter().enumerate() {
            for k in 0..3 {
                let own = slot(n, n).entries(stride);
                sources.extend((k..3).map(|r| own[3 * r + k]));
                for &b in blocks.column(c) {
                    let entries = slot(particles[b as usize], n).entries(stride);
                    sources.extend((0..3).map(|r| entries[3 * r + k]));
                }
            }
        }
        Pattern {
            runs: layout.runs(order.len()),
            plane: plane(order.len()),
            order,
            place,
            stride,
            named: elements.named.len(),
            lanes,
            sources,
            rank,
            particles,
            regions,
            columns,
            rows,
            edges,
            triples,
            shears,
            ghosted,
            sums,
            starts,
            neighbours,
            blocks,
        }
    }

    /// Where the nine numbers of the diagonal block at a place of `order` lie, of which those below and on the diagonal count.
    pub fn diagonal_entries(&self, place: usize) -> [u32; 9] {
        std::array::from_fn(|k| ((3 * (k / 3).max(k % 3) + (k / 3).min(k % 3)) * self.stride + place) as u32)
    }

    /// The particles that the row at a place of `order` names, each with the slot of the pair (neighbour, particle).
    pub fn neighbours(&self, place: usize) -> &[(u32, Slot)] {
        &self.neighbours[self.starts[place] as usize..self.starts[place + 1] as usize]
    }
}

/// The pairs (column, row) of different particles that share an element, sorted.
fn pairs(coupled: &[&[u32]], rank: &[u32]) -> Vec<(u32, u32)> {
    let mut pairs = Vec::with_capacity(coupled.iter().map(|nodes| nodes.len() * (nodes.len() - 1) / 2).sum());
    for nodes in coupled {
        for (k, &m) in nodes.iter().enumerate() {
            for &n in &nodes[..k] {
                let (a, b) = (rank[m as usize], rank[n as usize]);
                if a != b {
                    pairs.push((a.min(b), a.max(b)));
                }
            }
        }
    }
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// The blocks while elements add to them: nine planes, one per number of a block.
pub struct Values<'a> {
    /// Planes.
    pub entries: &'a mut [f64],
    /// Where blocks lie.
    pub pattern: &'a Pattern,
    /// Blocks of the elements that name ghosts, each in one place: many meet in few.
    pub sums: &'a mut [Nine],
}

impl Values<'_> {
    /// Adds what the elements that name ghosts summed up.
    pub fn add_sums(&mut self) {
        let diagonals = self.pattern.order.len();
        for (&at, sum) in self.pattern.sums.iter().zip(&mut *self.sums) {
            for (k, value) in std::mem::replace(sum, [0.0; 9]).into_iter().enumerate() {
                // Of the diagonals only what lies on and below theirs counts.
                if at as usize >= diagonals || k % 3 <= k / 3 {
                    self.entries[k * self.pattern.stride + at as usize] += value;
                }
            }
        }
    }

    /// Adds a symmetric block, given entry by entry, to a particle's diagonal.
    #[inline(always)]
    pub fn add_diagonal(&mut self, particle: u32, block: impl Fn(usize, usize) -> f64) {
        let at = self.pattern.place[particle as usize] as usize;
        for row in 0..3 {
            (0..=row).for_each(|column| *self.entry(row, column, at) += block(row, column));
        }
    }

    /// Adds a block, given entry by entry, to the pair of a slot.
    #[inline(always)]
    pub fn add_pair(&mut self, Slot { at, lie }: Slot, block: impl Fn(usize, usize) -> f64) {
        let at = at as usize;
        for row in 0..3 {
            for column in 0..3 {
                let value = block(row, column);
                match lie {
                    Lie::Straight => *self.entry(row, column, at) += value,
                    Lie::Transposed => *self.entry(column, row, at) += value,
                    Lie::Diagonal if column < row => {
                        *self.entry(row, column, at) += value + block(column, row);
                    }
                    Lie::Diagonal if column == row => *self.entry(row, column, at) += value + value,
                    Lie::Diagonal => {}
                }
            }
        }
    }

    #[inline(always)]
    fn entry(&mut self, row: usize, column: usize, at: usize) -> &mut f64 {
        &mut self.entries[(3 * row + column) * self.pattern.stride + at]
    }

    /// Adds a block to two particles that share an element, once for both orders, or to a particle's diagonal.
    pub fn add_block(&mut self, row: u32, column: u32, block: &Mat3) {
        if row == column {
            return self.add_diagonal(row, |r, c| block[(r, c)]);
        }
        let place = self.pattern.place[column as usize] as usize;
        let found = self.pattern.neighbours(place).iter().find(|(n, _)| *n == row);
        let slot = found.expect("particles of one cell share an element").1;
        self.add_pair(slot, |r, c| block[(r, c)]);
    }

    /// Adds a block per lane to the pairs of a batch, from lane `from` on.
    #[inline(always)]
    pub fn add_lanes<S: Simd>(&mut self, slots: Slots, from: usize, block: &Block<S>) {
        if !slots.is_run {
            return self.add_each(slots, from, block, false);
        }
        // One code for both lies: kernels should fit the cache for instructions.
        let stride = self.pattern.stride;
        let (down, along) =
            if slots.lie == Lie::Straight { (3 * stride, stride) } else { (stride, 3 * stride) };
        let at = slots.at as usize + from;
        for row in 0..3 {
            for column in 0..3 {
                block.0[row][column].add_to(self.entries, at + row * down + column * along);
            }
        }
    }

    /// Adds a symmetric block per lane to the diagonals of a batch, from lane `from` on.
    #[inline(always)]
    pub fn add_own<S: Simd>(&mut self, slots: Slots, from: usize, block: &Block<S>) {
        if !slots.is_run {
            return self.add_each(slots, from, block, true);
        }
        let at = slots.at as usize + from;
        for row in 0..3 {
            for column in 0..=row {
                block.0[row][column].add_to(self.entries, (3 * row + column) * self.pattern.stride + at);
            }
        }
    }

    #[inline(always)]
    fn add_each<S: Simd>(&mut self, slots: Slots, from: usize, block: &Block<S>, own: bool) {
        let mut lanes = [[0.0; WIDTH]; 9];
        for row in 0..3 {
            for column in 0..3 {
                block.0[row][column].store(&mut lanes[3 * row + column], 0);
            }
        }
        self.add_numbers(slots, from..from + S::F64_LANES, &lanes, own);
    }

    /// Apart from the kernels, which it would make longer than the cache for instructions.
    #[inline(never)]
    fn add_numbers(&mut self, slots: Slots, lanes_of: Range<usize>, lanes: &[[f64; WIDTH]; 9], own: bool) {
        let places = &self.pattern.lanes[slots.at as usize];
        for (lane, place) in lanes_of.enumerate() {
            let slot = places[place];
            for row in 0..3 {
                for column in 0..3 {
                    let (value, mirrored) = (lanes[3 * row + column][lane], lanes[3 * column + row][lane]);
                    let (row, column, value) = match slot.lie {
                        Lie::Straight => (row, column, value),
                        Lie::Transposed => (column, row, value),
                        Lie::Diagonal if column > row => continue,
                        Lie::Diagonal => (row, column, if own { value } else { value + mirrored }),
                    };
                    *self.entry(row, column, slot.at as usize) += value;
                }
            }
        }
    }
}

impl Slot {
    /// Where each of the block's nine numbers lies, row by row, for the pair as asked for, in planes of this length.
    pub fn entries(self, stride: usize) -> [u32; 9] {
        std::array::from_fn(|k| {
            let (row, column) = (k / 3, k % 3);
            let (row, column) = match self.lie {
                Lie::Straight => (row, column),
                Lie::Transposed => (column, row),
                Lie::Diagonal => (row.max(column), row.min(column)),
            };
            ((3 * row + column) * stride) as u32 + self.at
        })
    }
}

fn scalar_pattern(blocks: &Blocks, particles: usize) -> (Vec<u32>, Vec<u32>) {
    let (mut columns, mut rows) = (vec![0], Vec::new());
    for c in 0..particles {
        for k in 0..3 {
            rows.extend((k..3).map(|r| 3 * c as u32 + r));
            rows.extend(blocks.column(c).iter().flat_map(|b| (0..3).map(move |r| 3 * b + r)));
            columns.push(rows.len() as u32);
        }
    }
    (columns, rows)
}

/// Memory for what elements that name ghosts add to the blocks of a pattern.
pub fn no_sums(pattern: &Pattern) -> Vec<Nine> {
    vec![[0.0; 9]; pattern.sums.len()]
}

/// A Hessian and a right-hand side, with fixed particles and the hand's coupling kept apart.
pub struct System {
    /// Pattern of the mesh.
    pub pattern: Arc<Pattern>,
    /// Blocks of the pairs, plane by plane; of the diagonals what is on and below them.
    pub blocks: Vec<f64>,
    /// Memory for what elements that name ghosts add.
    sums: Vec<Nine>,
    /// Values of the lower triangle, in elimination order: those of the blocks at the last `compress`.
    pub values: Vec<f64>,
    /// Gradient, plus what fixed particles' prescribed displacements add [N].
    pub rhs: Vec<Vec3>,
    /// Particles without degrees of freedom.
    pub fixed: Vec<bool>,
    /// Prescribed displacement of fixed particles in this step [m].
    pub shift: Vec<Vec3>,
    /// The hand's particle, if any; it is fixed.
    pub hand: Option<u32>,
    /// Columns that couple each particle to the hand [N/m]; zero but for the particles that are coupled.
    pub coupling: Vec<Mat3>,
    /// Free particles that are coupled to the hand.
    pub coupled: Vec<u32>,
    /// The hand's own block [N/m].
    pub handle: Mat3,
    /// The shape it was assembled at [m], and what linearized tensions exceed the true ones [N].
    pub(crate) shape: Planes,
    pub(crate) excess: Planes,
}

impl System {
    /// An empty system over a pattern.
    pub fn new(pattern: Arc<Pattern>) -> System {
        let n = pattern.rank.len();
        System {
            blocks: vec![0.0; 9 * pattern.stride],
            sums: no_sums(&pattern),
            values: vec![0.0; pattern.rows.len()],
            rhs: vec![Vec3::zeros(); n],
            fixed: vec![false; n],
            shift: vec![Vec3::zeros(); n],
            hand: None,
            coupling: vec![Mat3::zeros(); n],
            coupled: Vec::new(),
            handle: Mat3::zeros(),
            shape: Planes::new(pattern.named),
            excess: Planes::new(pattern.named),
            pattern,
        }
    }

    /// The shape to assemble at: positions of the nodes that elements name [m].
    pub fn set_shape(&mut self, x: &[Vec3], named: &[u32]) {
        self.shape.set(x, named);
    }

    /// Empties the matrix.
    pub fn clear(&mut self) {
        self.blocks.fill(0.0);
        self.forget_hand();
    }

    /// Forgets what couples to the hand.
    pub fn forget_hand(&mut self) {
        self.coupled.drain(..).for_each(|n| self.coupling[n as usize] = Mat3::zeros());
        self.handle = Mat3::zeros();
    }

    /// The blocks, to add to, the shape and what linearized tensions exceed the true ones.
    pub(super) fn parts(&mut self) -> (Values<'_>, &Planes, &mut Planes) {
        let System { blocks, pattern, sums, shape, excess, .. } = self;
        (Values { entries: blocks, pattern, sums }, shape, excess)
    }

    /// Brings the blocks into the lower triangle, as direct factors want it.
    pub fn compress(&mut self) {
        for (value, &source) in self.values.iter_mut().zip(&self.pattern.sources) {
            *value = self.blocks[source as usize];
        }
    }

    /// The diagonal block at a place of the pattern's order [N/m].
    pub fn diagonal(&self, place: usize) -> Mat3 {
        Mat3::from_row_slice(&self.pattern.diagonal_entries(place).map(|at| self.blocks[at as usize]))
    }

    /// Takes the fixed particles out once all is added: what their prescribed displacements pull goes to the right-hand side, the
    /// hand's columns to `coupling`, and their rows become the identity.
    pub fn close(&mut self) {
        let pattern = &self.pattern;
        for (place, f) in pattern.order.iter().map(|&n| n as usize).enumerate() {
            if !self.fixed[f] {
                continue;
            }
            let (is_hand, shift) = (self.hand == Some(f as u32), self.shift[f]);
            for &(n, slot) in pattern.neighbours(place) {
                let entries = slot.entries(pattern.stride).map(|at| at as usize);
                if !self.fixed[n as usize] {
                    let block = Mat3::from_fn(|row, column| self.blocks[entries[3 * row + column]]);
                    self.rhs[n as usize] += block * shift;
                    if is_hand {
                        self.coupling[n as usize] += block;
                        self.coupled.push(n);
                    }
                }
                entries.iter().for_each(|&at| self.blocks[at] = 0.0);
            }
            if is_hand {
                self.handle = self.diagonal(place);
            }
            for (k, at) in pattern.diagonal_entries(place).into_iter().enumerate() {
                self.blocks[at as usize] = if k % 4 == 0 { 1.0 } else { 0.0 };
            }
        }
    }

    /// Makes every diagonal entry larger by a part of itself: enough of it makes up for rounding in a factor, wherever the entries are
    /// large.
    pub fn stiffen(&mut self, part: f64) {
        for k in [0, 4, 8] {
            let from = k * self.pattern.stride;
            self.blocks[from..from + self.pattern.order.len()].iter_mut().for_each(|v| *v *= 1.0 + part);
        }
    }

    /// The blocks times a vector, both in planes in the order of the lattice.
    pub fn apply(&self, x: &[f64], out: &mut [f64]) {
        dispatch(Apply { pattern: &self.pattern, blocks: &self.blocks, x, out });
    }

    /// The lower triangle, mirrored, times a vector, both with three numbers per particle in elimination order.
    pub fn multiply(&self, x: &[f64], out: &mut [f64]) {
        out.fill(0.0);
        let blocks = &self.pattern.blocks;
        for c in 0..self.pattern.particles.len() {
            let rows = blocks.column(c);
            let stride = 3 * rows.len();
            let first = blocks.start(c) as usize;
            let (second, third) = (first + 3 + stride, first + 5 + 2 * stride);
            let v = &self.values;
            let [x0, x1, x2] = [x[3 * c], x[3 * c + 1], x[3 * c + 2]];
            let mut sum = [
                v[first] * x0 + v[first + 1] * x1 + v[first + 2] * x2,
                v[first + 1] * x0 + v[second] * x1 + v[second + 1] * x2,
                v[first + 2] * x0 + v[second + 1] * x1 + v[third] * x2,
            ];
            let columns = [&v[first + 3..][..stride], &v[second + 2..][..stride], &v[third + 1..][..stride]];
            for (t, &row) in rows.iter().enumerate() {
                let at = 3 * row as usize;
                let (below, target) = (&x[at..at + 3], &mut out[at..at + 3]);
                let [a, b, d] = columns.map(|column| &column[3 * t..3 * t + 3]);
                for k in 0..3 {
                    target[k] += a[k] * x0 + b[k] * x1 + d[k] * x2;
                }
                sum[0] += a[0] * below[0] + a[1] * below[1] + a[2] * below[2];
                sum[1] += b[0] * below[0] + b[1] * below[1] + b[2] * below[2];
                sum[2] += d[0] * below[0] + d[1] * below[1] + d[2] * below[2];
            }
            (0..3).for_each(|k| out[3 * c + k] += sum[k]);
        }
    }

    /// The matrix times a vector per node; fixed particles' rows are their identity, ghosts' are zero.
    pub fn product(&self, v: &[Vec3]) -> Vec<Vec3> {
        let particles = &self.pattern.particles;
        let by_rank: Vec<f64> = particles.iter().flat_map(|&n| v[n as usize].iter().copied()).collect();
        let mut out = vec![0.0; by_rank.len()];
        self.multiply(&by_rank, &mut out);
        let mut product = vec![Vec3::zeros(); v.len()];
        for (&n, value) in particles.iter().zip(out.chunks_exact(3)) {
            product[n as usize] = Vec3::from_column_slice(value);
        }
        product
    }
}
