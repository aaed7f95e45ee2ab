//! Sparsity of a mesh's Hessian: which particles share elements, in which order they are eliminated, and where their blocks lie.
//!
//! Unknowns are those of active particles, ordered by nested dissection of the mesh, which keeps the Cholesky factor sparse.

use super::{
    ghosted::{Combined, Ghosted, Nine},
    halves::{FEWEST_ASSEMBLED_IN_HALVES, Part},
    order,
};
use crate::{
    batch::{Batches, SHEAR_PAIRS, TRIPLE_PAIRS},
    grid::{Elements, Grid},
    math::pack::WIDTH,
};
use std::{collections::HashMap, ops::Range, sync::Arc};

/// Where the 3 × 3 block of a pair of particles lies in each plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Slot {
    pub(super) at: u32,
    pub(super) lie: Lie,
}

/// How a pair's block lies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Lie {
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
    pub(super) at: u32,
    pub(super) lie: Lie,
    pub(super) is_run: bool,
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

/// How the blocks of a matrix and the numbers of its vectors lie in planes.
#[derive(Clone, Debug)]
pub struct Lines {
    /// Particles: their diagonal blocks come first.
    pub particles: usize,
    /// The pairs of different particles.
    pub runs: Vec<Run>,
    /// Length of a plane of blocks.
    pub stride: usize,
    /// Length of a plane of a vector: all x, all y and all z, with zeros behind each.
    pub plane: usize,
}

impl Lines {
    /// From the number of particles and the pairs (first, second) of different ones.
    pub fn new(particles: usize, pairs: Vec<(u32, u32)>) -> Lines {
        Lines::of(particles, &Layout::new(particles, pairs))
    }

    fn of(particles: usize, layout: &Layout) -> Lines {
        Lines { particles, runs: layout.runs(particles), stride: stride(layout.len), plane: plane(particles) }
    }

    /// Whether most pairs lie so that whole registers go at once.
    pub fn are_long(&self) -> bool {
        let pairs = |is_padded: bool| -> usize {
            self.runs.iter().filter(|run| run.is_padded == is_padded).map(|run| run.len).sum()
        };
        pairs(true) > pairs(false)
    }
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
    /// Active particles line by line: the order of the blocks, and of the vectors of iterative solves.
    pub order: Vec<u32>,
    /// Place of each node in that order; `ABSENT` for what is not active.
    pub place: Vec<u32>,
    /// How blocks and vectors lie in that order.
    pub lines: Arc<Lines>,
    /// Nodes that elements name.
    pub(crate) named: usize,
    /// Which thread adds a batch of triples, and one of cells, that name no ghost.
    pub(super) parts: [Vec<Part>; 2],
    /// Slots of the diagonals and pairs of edges that name no ghost, batch by batch.
    pub edges: Vec<[Slots; 3]>,
    /// The same of triples.
    pub triples: Vec<[Slots; 15]>,
    /// The same of cells.
    pub shears: Vec<[Slots; 10]>,
    /// Stencils of the elements that name ghosts.
    pub ghosted: Ghosted,
    /// Places of the blocks that those add to.
    pub(super) sums: Vec<u32>,
    /// Slots of the batches that are no run, lane by lane.
    pub(super) lanes: Vec<[Slot; WIDTH]>,
    /// Place in the blocks of each value of the lower triangle.
    pub(super) sources: Vec<u32>,
    /// First of the neighbours of each place of `order`, and the neighbours, each with the slot of the pair (neighbour, particle).
    starts: Vec<u32>,
    neighbours: Vec<(u32, Slot)>,
    pub(super) blocks: Blocks,
}

/// Rank of what is not active.
pub const ABSENT: u32 = u32::MAX;

#[derive(Debug)]
pub(super) struct Blocks {
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

    pub fn column(&self, c: usize) -> &[u32] {
        &self.rows[self.starts[c] as usize..self.starts[c + 1] as usize]
    }

    /// Scalar start of block column `c`: 6 values of the diagonal block's triangle and 9 per block for each column before.
    pub fn start(&self, c: usize) -> u32 {
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
        let mut layout = Layout { groups: vec![(0, 0, (0..n as u32).collect(), true)], len: plane(n) };
        for group in pairs.chunk_by(|a, b| a.1 - a.0 == b.1 - b.0) {
            let firsts: Vec<u32> = group.iter().map(|pair| pair.0).collect();
            let is_spread = 2 * firsts.len() > n;
            if is_spread {
                layout.len = layout.len.next_multiple_of(PADDING);
            }
            let from = layout.len as u32;
            layout.len += if is_spread { plane(n) } else { firsts.len() };
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

    /// Whose each place is, if the order is halved before `middle`.
    fn parts(&self, n: usize, middle: usize) -> Vec<Part> {
        let mut parts = vec![Part::Across; self.len + WIDTH];
        for (distance, from, firsts, is_spread) in &self.groups {
            let count = if *is_spread { n } else { firsts.len() };
            for k in 0..count {
                let low = if *is_spread { k } else { firsts[k] as usize };
                parts[*from as usize + k] = Part::of_pair(low, low + *distance as usize, middle);
            }
        }
        parts
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
                match runs.last_mut().filter(|_| place > 0) {
                    Some(run) if run.first + run.len == first => run.len += 1,
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
pub const PADDING: usize = 16;

/// Length of a plane of a vector of so many particles: whole registers, from wherever they are read.
pub fn plane(n: usize) -> usize {
    n.next_multiple_of(PADDING) + PADDING
}

/// Length of a plane of so many blocks: room behind for the lanes of a batch that do not count, whole registers, and not a power of two,
/// so that planes do not fall on each other in the cache.
fn stride(blocks: usize) -> usize {
    let registers = (blocks + WIDTH).div_ceil(WIDTH);
    WIDTH * (registers + (6 + 16 - registers % 16) % 16)
}

impl Pattern {
    /// The pattern of a mesh.
    pub fn new(grid: &Grid, elements: &Elements) -> Pattern {
        let [edge_count, triple_count, shear_count] = elements.regular;
        let order = lines_first(grid);
        let mut place = vec![ABSENT; elements.nodes()];
        order.iter().zip(0..).for_each(|(&n, k)| place[n as usize] = k);
        let combined = Combined::new(elements, &place);
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
        let couples = pairs.iter().map(|&(column, row)| {
            let [a, b] = [column, row].map(|rank| place[particles[rank as usize] as usize]);
            (a.min(b), a.max(b))
        });
        let layout = Layout::new(order.len(), couples.collect());
        let lines = Arc::new(Lines::of(order.len(), &layout));
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
            [[0, 0], [1, 1], [0, 1]].map(|[m, n]| look_up(&b.nodes[m], &b.nodes[n], b.ids.full, m == n))
        });
        let edges = edges.collect();
        let own = |n: usize| [n, n];
        let triples = batches.triples.iter().map(|b| {
            std::array::from_fn(|k| {
                let [m, n] = if k < 5 { own(k) } else { TRIPLE_PAIRS[k - 5] };
                look_up(&b.nodes[m], &b.nodes[n], b.ids.full, k < 5)
            })
        });
        let triples: Vec<[Slots; 15]> = triples.collect();
        let shears = batches.shears.iter().map(|b| {
            std::array::from_fn(|k| {
                let [m, n] = if k < 4 { own(k) } else { SHEAR_PAIRS[k - 4] };
                look_up(&b.nodes[m], &b.nodes[n], b.ids.full, k < 4)
            })
        });
        let shears: Vec<[Slots; 10]> = shears.collect();
        let middle = if order.len() >= FEWEST_ASSEMBLED_IN_HALVES { order.len() / 2 } else { order.len() };
        let whose = layout.parts(order.len(), middle);
        let part = |slots: &[Slots]| Part::of_slots(slots, &lanes, &whose);
        let parts = [
            triples.iter().map(|slots| part(slots)).collect(),
            shears.iter().map(|slots| part(slots)).collect(),
        ];
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
                let own = slot(n, n).entries(lines.stride);
                sources.extend((k..3).map(|r| own[3 * r + k]));
                for &b in blocks.column(c) {
                    let entries = slot(particles[b as usize], n).entries(lines.stride);
                    sources.extend((0..3).map(|r| entries[3 * r + k]));
                }
            }
        }
        Pattern {
            order,
            place,
            lines,
            named: elements.named.len(),
            lanes,
            sources,
            rank,
            particles,
            regions,
            columns,
            rows,
            parts,
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
        std::array::from_fn(|k| {
            ((3 * (k / 3).max(k % 3) + (k / 3).min(k % 3)) * self.lines.stride + place) as u32
        })
    }

    /// The particles that the row at a place of `order` names, each with the slot of the pair (neighbour, particle).
    pub fn neighbours(&self, place: usize) -> &[(u32, Slot)] {
        &self.neighbours[self.starts[place] as usize..self.starts[place + 1] as usize]
    }
}

/// Active particles line by line. Where nearly all cells are of one size, their corners come first, so that the few other particles shift
/// nobody's neighbours.
fn lines_first(grid: &Grid) -> Vec<u32> {
    let size = grid.main_size().unwrap_or([1; 2]);
    let mut order: Vec<u32> = grid.active().map(|n| n as u32).collect();
    order.sort_by_key(|&n| !grid.is_on_lines(n as usize, size));
    order
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_of_different_distances_are_no_run_though_their_first_particles_follow() {
        let pairs = vec![(0, 1), (1, 3), (2, 4), (5, 8)];
        let runs = Lines::new(9, pairs.clone()).runs;
        let found: Vec<(u32, u32)> = runs
            .iter()
            .flat_map(|run| (0..run.len).map(|k| ((run.first + k) as u32, (run.second + k) as u32)))
            .collect();
        assert_eq!((found, runs.len()), (pairs, 3));
    }
}
