//! The sparse linear system of a Newton step: block pattern, elimination order, assembly, and which particles are fixed.
//!
//! Unknowns are those of active particles, ordered by nested dissection of the mesh, which keeps the Cholesky factor sparse. The
//! pattern belongs to a mesh; fixed particles keep their rows as identity, so pinning and grabbing never change it.

use super::{
    ghosted::{Combined, Ghosted},
    order, shear, triple,
};
use crate::{
    grid::{Elements, Grid, Triple},
    math::{Mat3, Vec3},
};
use std::{ops::Range, sync::Arc};

/// Where a 3 × 3 off-diagonal block lies in the values: entry of its first column, and the column's block count × 3.
#[derive(Clone, Copy, Debug, Default)]
pub struct Slot {
    base: u32,
    stride: u32,
}

/// An element's nodes in elimination order, its weights in that order, and a slot per pair of nodes.
#[derive(Clone, Copy, Debug)]
pub struct Stencil<W, const N: usize, const P: usize> {
    /// Particle indices, latest eliminated last.
    pub nodes: [u32; N],
    /// Weights, in the order of `nodes`.
    pub weights: W,
    /// Slots of the pairs (m, n), m > n, row by row.
    pub slots: [Slot; P],
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
    /// Slot and nodes of each edge.
    pub edges: Vec<([u32; 2], Slot)>,
    /// Bending stencils.
    pub triples: Vec<Stencil<triple::Weights, 5, 10>>,
    /// Shear stencils.
    pub shears: Vec<Stencil<shear::Weights, 4, 6>>,
    /// Stencils of the elements that name ghosts.
    pub ghosted: Ghosted,
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

    fn slot(&self, row: u32, column: u32) -> Slot {
        let rows = self.column(column as usize);
        let place = rows.binary_search(&row).expect("a pair of the pattern") as u32;
        Slot { base: self.start(column as usize) + 3 + 3 * place, stride: 3 * rows.len() as u32 }
    }
}

impl Pattern {
    /// The pattern of a mesh.
    pub fn new(grid: &Grid, elements: &Elements) -> Pattern {
        Pattern::with(grid, elements, &elements.triples, 2)
    }

    /// The pattern without bending's long reach: neighbours in a cell only. Its factor is some six times cheaper.
    pub fn near(grid: &Grid, elements: &Elements) -> Pattern {
        Pattern::with(grid, elements, &[], 1)
    }

    fn with(grid: &Grid, elements: &Elements, triples: &[Triple], reach: usize) -> Pattern {
        let [edge_count, triple_count, shear_count] = elements.regular;
        let (triples, bending) = triples.split_at(triple_count.min(triples.len()));
        let combined = Combined::new(elements, bending);
        let mut coupled: Vec<&[u32]> = Vec::new();
        coupled.extend(elements.edges[..edge_count].iter().map(|e| &e.nodes[..]));
        coupled.extend(triples.iter().map(|t| &t.nodes[..]));
        coupled.extend(elements.shears[..shear_count].iter().map(|s| &s.nodes[..]));
        coupled.extend(combined.nodes());
        let (particles, regions) = order::dissection(grid, reach, &coupled);
        let mut rank = vec![ABSENT; elements.nodes()];
        particles.iter().zip(0..).for_each(|(&n, k)| rank[n as usize] = k);
        let blocks = Blocks::new(particles.len(), &pairs(&coupled, &rank));
        let by_rank = |a: &u32, b: &u32| rank[*a as usize].cmp(&rank[*b as usize]);
        let slot = |m: u32, n: u32| {
            let (row, column) = (rank[m as usize], rank[n as usize]);
            // A triple at the border names its centre twice; the second has no weight, so any slot serves its zeros.
            if row == column { Slot::default() } else { blocks.slot(row.max(column), row.min(column)) }
        };
        let edges = elements.edges[..edge_count].iter();
        let edges = edges.map(|e| (e.nodes, slot(e.nodes[0], e.nodes[1]))).collect();
        let triples = triples.iter().map(|t| {
            let order = sorted(t.nodes, by_rank);
            let nodes = order.map(|k| t.nodes[k]);
            Stencil { nodes, weights: triple::Weights::new(t).permuted(order), slots: pairs_of(nodes, slot) }
        });
        let shears = elements.shears[..shear_count].iter().map(|s| {
            let order = sorted(s.nodes, by_rank);
            let nodes = order.map(|k| s.nodes[k]);
            Stencil { nodes, weights: shear::Weights::new(s).permuted(order), slots: pairs_of(nodes, slot) }
        });
        let (triples, shears) = (triples.collect(), shears.collect());
        let ghosted = combined.place(&rank, slot);
        let (columns, rows) = scalar_pattern(&blocks, particles.len());
        Pattern { rank, particles, regions, columns, rows, edges, triples, shears, ghosted, blocks }
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

fn sorted<const N: usize>(nodes: [u32; N], by_rank: impl Fn(&u32, &u32) -> std::cmp::Ordering) -> [usize; N] {
    let mut order: [usize; N] = std::array::from_fn(|k| k);
    order.sort_by(|&a, &b| by_rank(&nodes[a], &nodes[b]));
    order
}

fn pairs_of<const N: usize, const P: usize>(nodes: [u32; N], slot: impl Fn(u32, u32) -> Slot) -> [Slot; P] {
    let mut slots = [Slot::default(); P];
    let pairs = (0..N).flat_map(|m| (0..m).map(move |n| (m, n)));
    for (place, (m, n)) in slots.iter_mut().zip(pairs) {
        *place = slot(nodes[m], nodes[n]);
    }
    slots
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

    /// Empties the matrix; fixed particles get their identity.
    pub fn clear(&mut self) {
        self.values.fill(0.0);
        self.coupling.fill(Mat3::zeros());
        self.handle = Mat3::zeros();
        for n in 0..self.fixed.len() {
            if self.fixed[n] {
                self.put_diagonal(n as u32, &Mat3::identity());
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

    #[inline(always)]
    fn put_diagonal(&mut self, node: u32, block: &Mat3) {
        let c = self.pattern.rank[node as usize] as usize;
        let stride = 3 * self.pattern.blocks.column(c).len();
        let first = self.pattern.blocks.start(c) as usize;
        let second = first + 3 + stride;
        let third = second + 2 + stride;
        self.values[first] += block[(0, 0)];
        self.values[first + 1] += block[(1, 0)];
        self.values[first + 2] += block[(2, 0)];
        self.values[second] += block[(1, 1)];
        self.values[second + 1] += block[(2, 1)];
        self.values[third] += block[(2, 2)];
    }

    /// Adds a block on the diagonal.
    #[inline(always)]
    pub fn add_diagonal(&mut self, node: u32, block: &Mat3) {
        if !self.fixed[node as usize] {
            self.put_diagonal(node, block);
        } else if self.hand == Some(node) {
            self.handle += block;
        }
    }

    /// Adds the block of rows `row` and columns `column`; `row` is eliminated later.
    #[inline(always)]
    pub(super) fn add_pair(&mut self, row: u32, column: u32, slot: Slot, block: &Mat3) {
        match (self.fixed[row as usize], self.fixed[column as usize]) {
            (false, false) => {
                let mut at = slot.base as usize;
                for k in 0..3 {
                    let values = &mut self.values[at..at + 3];
                    values[0] += block[(0, k)];
                    values[1] += block[(1, k)];
                    values[2] += block[(2, k)];
                    at += (slot.stride + 2 - k as u32) as usize;
                }
            }
            (false, true) => self.couple(row, column, block),
            (true, false) => self.couple(column, row, &block.transpose()),
            (true, true) => {}
        }
    }

    /// A free particle's block against a fixed one: what its prescribed displacement pulls, and the hand's column.
    fn couple(&mut self, free: u32, fixed: u32, block: &Mat3) {
        self.rhs[free as usize] += block * self.shift[fixed as usize];
        if self.hand == Some(fixed) {
            self.coupling[free as usize] += block;
        }
    }

    /// Adds an edge's block (+ on the diagonal, − between) and its extra gradient in the end node.
    pub fn add_edge(&mut self, edge: usize, block: &Mat3, extra: Vec3) {
        let ([from, to], slot) = self.pattern.edges[edge];
        self.rhs[from as usize] -= extra;
        self.rhs[to as usize] += extra;
        self.add_diagonal(from, block);
        self.add_diagonal(to, block);
        let (row, column) = if self.pattern.rank[from as usize] > self.pattern.rank[to as usize] {
            (from, to)
        } else {
            (to, from)
        };
        self.add_pair(row, column, slot, &-block);
    }

    /// Adds an element whose block for nodes m ≥ n (in elimination order) is `block(m, n)`.
    #[inline(always)]
    pub fn add_element<const N: usize, const P: usize>(
        &mut self,
        nodes: &[u32; N],
        slots: &[Slot; P],
        block: impl Fn(usize, usize) -> Mat3,
    ) {
        let mut place = 0;
        for m in 0..N {
            for n in 0..m {
                // The border's second mention of a centre carries no weight: its block is zero.
                if nodes[m] != nodes[n] {
                    self.add_pair(nodes[m], nodes[n], slots[place], &block(m, n));
                }
                place += 1;
            }
            self.add_diagonal(nodes[m], &block(m, m));
        }
    }
}
