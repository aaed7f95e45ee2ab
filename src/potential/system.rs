//! The sparse linear system of a Newton step: block pattern, elimination order, assembly, and which particles are fixed.
//!
//! Unknowns are those of active particles, ordered by nested dissection of the mesh, which keeps the Cholesky factor sparse. The
//! pattern belongs to a mesh; fixed particles keep their rows as identity, so pinning and grabbing never change it.

use super::{
    ghosted::{Combined, Ghosted},
    order,
};
use crate::{
    batch::{Batches, SHEAR_PAIRS, TRIPLE_PAIRS},
    grid::{Elements, Grid},
    math::{Mat3, Vec3, pack::WIDTH},
};
use std::{ops::Range, sync::Arc};

/// Where the 3 × 3 block of a pair of particles lies in the values.
#[derive(Clone, Copy, Debug, Default)]
pub struct Slot {
    /// Entry of its first column; the particle's place in the elimination order if it pairs with itself.
    base: u32,
    /// Block count × 3 of its column.
    stride: u16,
    lie: Lie,
}

/// How a pair's block lies in the lower triangle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Lie {
    /// The first particle of the pair is eliminated later.
    #[default]
    Straight,
    /// The second one is: the transpose is kept.
    Transposed,
    /// Both are one particle (the centre of a triple at the border): block and transpose go to its diagonal.
    Diagonal,
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
    /// Slots of the pairs of edges that name no ghost, batch by batch.
    pub edges: Vec<[Slot; WIDTH]>,
    /// The same of triples.
    pub triples: Vec<[[Slot; WIDTH]; 10]>,
    /// The same of cells.
    pub shears: Vec<[[Slot; WIDTH]; 6]>,
    /// Stencils of the elements that name ghosts.
    pub ghosted: Ghosted,
    /// Entries of the three columns of each active particle's diagonal block, by node.
    diagonals: Vec<[u32; 3]>,
    /// First of the neighbours of each place in the order, and the neighbours, each with the slot of the pair (neighbour, particle).
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

    /// Slot of the pair of particles with these ranks.
    fn slot(&self, first: u32, second: u32) -> Slot {
        let (row, column) = (first.max(second), first.min(second));
        if row == column {
            return Slot { base: row, stride: 0, lie: Lie::Diagonal };
        }
        let rows = self.column(column as usize);
        let place = rows.binary_search(&row).expect("a pair of the pattern") as u32;
        Slot {
            base: self.start(column as usize) + 3 + 3 * place,
            stride: 3 * rows.len() as u16,
            lie: if first == row { Lie::Straight } else { Lie::Transposed },
        }
    }
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
        let slot = |m: u32, n: u32| blocks.slot(rank[m as usize], rank[n as usize]);
        let lanes = |m: &[u32; WIDTH], n: &[u32; WIDTH]| -> [Slot; WIDTH] {
            std::array::from_fn(|l| slot(m[l], n[l]))
        };
        let batches = Batches::of_regular(elements);
        let edges = batches.edges.iter().map(|b| lanes(&b.nodes[0], &b.nodes[1])).collect();
        let triples =
            batches.triples.iter().map(|b| TRIPLE_PAIRS.map(|[m, n]| lanes(&b.nodes[m], &b.nodes[n])));
        let shears = batches.shears.iter().map(|b| SHEAR_PAIRS.map(|[m, n]| lanes(&b.nodes[m], &b.nodes[n])));
        let (triples, shears) = (triples.collect(), shears.collect());
        let ghosted = combined.place(slot);
        let (columns, rows) = scalar_pattern(&blocks, particles.len());
        let mut diagonals = vec![[0; 3]; rank.len()];
        for (place, &n) in particles.iter().enumerate() {
            diagonals[n as usize] = [0, 1, 2].map(|k| columns[3 * place + k]);
        }
        let mut around = vec![Vec::new(); particles.len()];
        for &(column, row) in &pairs {
            let (m, n) = (particles[row as usize], particles[column as usize]);
            around[column as usize].push((m, slot(m, n)));
            around[row as usize].push((n, slot(n, m)));
        }
        let mut starts = vec![0];
        for list in &around {
            starts.push(starts[starts.len() - 1] + list.len() as u32);
        }
        let neighbours = around.concat();
        Pattern {
            rank,
            particles,
            regions,
            columns,
            rows,
            edges,
            triples,
            shears,
            ghosted,
            diagonals,
            starts,
            neighbours,
            blocks,
        }
    }

    /// Entry of each of the nine numbers of the diagonal block at a place of the order.
    pub fn diagonal_entries(&self, place: usize) -> [u32; 9] {
        let [a, b, c] = self.diagonals[self.particles[place] as usize];
        [a, a + 1, a + 2, a + 1, b, b + 1, a + 2, b + 1, c]
    }

    /// The particles that the row at a place of the order names, each with the slot of the pair (neighbour, particle).
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

/// The lower triangle's values while elements add to them.
pub struct Values<'a> {
    /// Values.
    pub entries: &'a mut [f64],
    /// Where they lie.
    pub pattern: &'a Pattern,
}

impl Values<'_> {
    /// Adds a symmetric block, given entry by entry, to a particle's diagonal.
    #[inline(always)]
    pub fn add_diagonal(&mut self, particle: u32, block: impl Fn(usize, usize) -> f64) {
        let [first, second, third] = self.pattern.diagonals[particle as usize].map(|at| at as usize);
        (0..3).for_each(|row| self.entries[first + row] += block(row, 0));
        (0..2).for_each(|row| self.entries[second + row] += block(row + 1, 1));
        self.entries[third] += block(2, 2);
    }

    /// Adds a block, given entry by entry, to the pair of a slot.
    #[inline(always)]
    pub fn add_pair(&mut self, slot: Slot, block: impl Fn(usize, usize) -> f64) {
        match slot.lie {
            Lie::Straight => self.add_lower(slot, block),
            Lie::Transposed => self.add_lower(slot, |row, column| block(column, row)),
            Lie::Diagonal => {
                let column = 3 * slot.base as usize;
                for k in 0..3 {
                    let at = self.pattern.columns[column + k] as usize;
                    (k..3).for_each(|row| self.entries[at + row - k] += block(row, k) + block(k, row));
                }
            }
        }
    }

    /// Adds a block to two particles that share an element, once for both orders, or to a particle's diagonal.
    pub fn add_block(&mut self, row: u32, column: u32, block: &Mat3) {
        if row == column {
            return self.add_diagonal(row, |r, c| block[(r, c)]);
        }
        let place = self.pattern.rank[column as usize] as usize;
        let found = self.pattern.neighbours(place).iter().find(|(n, _)| *n == row);
        let slot = found.expect("particles of one cell share an element").1;
        self.add_pair(slot, |r, c| block[(r, c)]);
    }

    #[inline(always)]
    fn add_lower(&mut self, slot: Slot, block: impl Fn(usize, usize) -> f64) {
        for (k, at) in slot.columns().into_iter().enumerate() {
            let column = &mut self.entries[at..at + 3];
            (0..3).for_each(|row| column[row] += block(row, k));
        }
    }
}

impl Slot {
    /// Entries at which the kept block's columns begin; a pair of one particle with itself has none.
    #[inline(always)]
    fn columns(self) -> [usize; 3] {
        let (at, stride) = (self.base as usize, self.stride as usize);
        [at, at + stride + 2, at + 2 * stride + 3]
    }

    /// Entry of each of the block's nine numbers, row by row, for the pair as asked for.
    pub fn entries(self) -> [u32; 9] {
        let columns = self.columns();
        std::array::from_fn(|k| {
            let (row, column) = if self.lie == Lie::Transposed { (k % 3, k / 3) } else { (k / 3, k % 3) };
            (columns[column] + row) as u32
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

/// A Hessian and a right-hand side, with fixed particles and the hand's coupling kept apart.
pub struct System {
    /// Pattern of the mesh.
    pub pattern: Arc<Pattern>,
    /// Values of the lower triangle.
    pub values: Vec<f64>,
    /// Gradient, plus what fixed particles' prescribed displacements add [N].
    pub rhs: Vec<Vec3>,
    /// Particles without degrees of freedom.
    pub fixed: Vec<bool>,
    /// Prescribed displacement of fixed particles in this step [m].
    pub shift: Vec<Vec3>,
    /// The hand's particle, if any; it is fixed.
    pub hand: Option<u32>,
    /// Columns that couple each particle to the hand [N/m].
    pub coupling: Vec<Mat3>,
    /// The hand's own block [N/m].
    pub handle: Mat3,
}

impl System {
    /// An empty system over a pattern.
    pub fn new(pattern: Arc<Pattern>) -> System {
        let n = pattern.rank.len();
        System {
            values: vec![0.0; pattern.rows.len()],
            rhs: vec![Vec3::zeros(); n],
            fixed: vec![false; n],
            shift: vec![Vec3::zeros(); n],
            hand: None,
            coupling: vec![Mat3::zeros(); n],
            handle: Mat3::zeros(),
            pattern,
        }
    }

    /// Empties the matrix.
    pub fn clear(&mut self) {
        self.values.fill(0.0);
        self.coupling.fill(Mat3::zeros());
        self.handle = Mat3::zeros();
    }

    /// The values, to add to.
    pub fn entries(&mut self) -> Values<'_> {
        Values { entries: &mut self.values, pattern: &self.pattern }
    }

    /// Takes the fixed particles out once all is added: what their prescribed displacements pull goes to the right-hand side, the
    /// hand's columns to `coupling`, and their rows become the identity.
    pub fn close(&mut self) {
        for (place, f) in self.pattern.particles.iter().map(|&n| n as usize).enumerate() {
            if !self.fixed[f] {
                continue;
            }
            let (is_hand, shift) = (self.hand == Some(f as u32), self.shift[f]);
            let pattern = &self.pattern;
            for &(n, slot) in pattern.neighbours(place) {
                let entries = slot.entries();
                if !self.fixed[n as usize] {
                    let block = Mat3::from_fn(|row, column| self.values[entries[3 * row + column] as usize]);
                    self.rhs[n as usize] += block * shift;
                    if is_hand {
                        self.coupling[n as usize] += block;
                    }
                }
                entries.iter().for_each(|&at| self.values[at as usize] = 0.0);
            }
            let [first, second, third] = pattern.diagonals[f].map(|at| at as usize);
            let v = &mut self.values;
            if is_hand {
                self.handle = Mat3::new(
                    v[first],
                    v[first + 1],
                    v[first + 2],
                    v[first + 1],
                    v[second],
                    v[second + 1],
                    v[first + 2],
                    v[second + 1],
                    v[third],
                );
            }
            (0..3).for_each(|k| v[first + k] = 0.0);
            (0..2).for_each(|k| v[second + k] = 0.0);
            [first, second, third].iter().for_each(|&at| v[at] = 1.0);
        }
    }

    /// Makes every diagonal entry larger by a part of itself: enough of it makes up for rounding in a factor, wherever the entries are
    /// large.
    pub fn stiffen(&mut self, part: f64) {
        for n in self.pattern.particles.iter() {
            for at in self.pattern.diagonals[*n as usize] {
                self.values[at as usize] *= 1.0 + part;
            }
        }
    }

    /// The matrix times a vector, both with three numbers per particle in elimination order.
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
