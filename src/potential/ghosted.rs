//! Stencils of the elements that name ghosts, over their masters.
//!
//! An element sees its nodes only through a few vectors (an edge vector; two mean sides; two tangents and a transverse one), each a
//! sum and difference of nodes. With ghosts replaced by their masters the sums run over active particles, and energy, gradient and
//! Hessian in the vectors stay what they are.

#![expect(clippy::needless_range_loop, reason = "components read best by their numbers")]

use crate::{
    grid::{Edge, Elements, Shear, Triple},
    math::{block::Block, pack::WIDTH},
};
use pulp::{Simd, WithSimd};

/// An element over active particles that sees them through `V` vectors.
#[derive(Clone, Debug)]
pub struct Stencil<const V: usize> {
    /// Active particles, in the order of the blocks.
    nodes: Vec<u32>,
    /// Weights of each in the vectors.
    weights: Vec<[f64; V]>,
    /// Which of the sums each pair (m, n), m ≤ n, adds to, row by row.
    sums: Vec<u32>,
}

/// A 3 × 3 matrix, row by row.
pub type Nine = [f64; 9];

/// Stencils of one kind of elements, in their order.
#[derive(Debug)]
pub struct Stencils<const V: usize> {
    /// Number of the first element that names a ghost.
    first: u32,
    list: Vec<Stencil<V>>,
}

/// Stencils of all elements that name ghosts.
#[derive(Debug)]
pub struct Ghosted {
    /// Edges: the edge vector.
    pub edges: Stencils<1>,
    /// Triples: e1, e2, b.
    pub triples: Stencils<3>,
    /// Shear cells: a, b.
    pub shears: Stencils<2>,
    /// The same cells' twist: a, b, D.
    pub twists: Stencils<3>,
    /// Triples by e1 and e2, and twist by D alone.
    pub lines: Stencils<2>,
    pub mixed: Stencils<1>,
}

/// The same before the elimination order is known.
pub(super) struct Combined(Ghosted);

impl<const V: usize> Stencil<V> {
    /// Of an element over these nodes, the weight of each in the vectors given; `place` is where each node is in the order of the blocks.
    fn new(elements: &Elements, place: &[u32], nodes: &[u32], weights: &[[f64; V]]) -> Stencil<V> {
        let mut sum: Vec<(u32, [f64; V])> = Vec::new();
        for (&node, weights) in nodes.iter().zip(weights) {
            let own = [(node, 1.0)];
            for &(master, share) in elements.ghost(node).map_or(&own[..], |ghost| &ghost.masters) {
                let known = sum.iter().position(|(n, _)| *n == master).unwrap_or_else(|| {
                    sum.push((master, [0.0; V]));
                    sum.len() - 1
                });
                sum[known].1.iter_mut().zip(weights).for_each(|(sum, w)| *sum += share * w);
            }
        }
        sum.sort_unstable_by_key(|(n, _)| place[*n as usize]);
        let (nodes, weights) = sum.into_iter().unzip();
        Stencil { nodes, weights, sums: Vec::new() }
    }

    fn place(&mut self, sum: &mut dyn FnMut(u32, u32) -> u32) {
        for (k, &m) in self.nodes.iter().enumerate() {
            self.sums.extend(self.nodes[k..].iter().map(|&n| sum(m, n)));
        }
    }

    /// Adds an element with this Hessian in its vectors, block by block of the upper triangle.
    #[inline(always)]
    fn add<const N: usize>(&self, upper: &[Nine; N], sums: &mut [Nine]) {
        let mut hessian = [[[0.0; 9]; V]; V];
        let mut block = upper.iter();
        for u in 0..V {
            for v in u..V {
                let block = block.next().expect("V (V + 1) / 2 blocks");
                hessian[u][v] = *block;
                hessian[v][u] = std::array::from_fn(|k| block[3 * (k % 3) + k / 3]);
            }
        }
        let mut places = self.sums.iter();
        for (m, of_m) in self.weights.iter().enumerate() {
            let mut row = [[0.0; 9]; V];
            for v in 0..V {
                for u in 0..V {
                    for k in 0..9 {
                        row[v][k] += of_m[u] * hessian[u][v][k];
                    }
                }
            }
            for (of_n, &place) in self.weights[m..].iter().zip(places.by_ref()) {
                let sum = &mut sums[place as usize];
                for v in 0..V {
                    for k in 0..9 {
                        sum[k] += row[v][k] * of_n[v];
                    }
                }
            }
        }
    }
}

impl<const V: usize> Stencils<V> {
    fn place(&mut self, mut sum: impl FnMut(u32, u32) -> u32) {
        self.list.iter_mut().for_each(|stencil| stencil.place(&mut sum));
    }

    fn nodes(&self) -> impl Iterator<Item = &[u32]> {
        self.list.iter().map(|stencil| &stencil.nodes[..])
    }

    /// Adds the elements of these numbers, a lane each: `blocks` are their Hessians in their vectors, as in `Stencil::add`.
    #[inline(always)]
    pub fn add<S: Simd, const N: usize>(
        &self,
        simd: S,
        ids: &[u32],
        blocks: &[Block<S>; N],
        sums: &mut [Nine],
    ) {
        let mut lanes = [[[0.0; WIDTH]; 9]; N];
        for n in 0..N {
            for k in 0..9 {
                blocks[n].0[k / 3][k % 3].store(&mut lanes[n][k], 0);
            }
        }
        simd.vectorize(Add { stencils: self, ids, lanes: &lanes, sums });
    }
}

/// Apart from the kernels, which it would make longer than the cache for instructions.
struct Add<'a, const V: usize, const N: usize> {
    stencils: &'a Stencils<V>,
    ids: &'a [u32],
    lanes: &'a [[[f64; WIDTH]; 9]; N],
    sums: &'a mut [Nine],
}

impl<const V: usize, const N: usize> WithSimd for Add<'_, V, N> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (lane, &id) in self.ids.iter().enumerate() {
            let mut upper = [[0.0; 9]; N];
            for n in 0..N {
                for k in 0..9 {
                    upper[n][k] = self.lanes[n][k][lane];
                }
            }
            self.stencils.list[(id - self.stencils.first) as usize].add(&upper, self.sums);
        }
    }
}

/// What the nodes of an element are in the vectors that kernels differentiate by: −e, e;
const EDGE: [[f64; 1]; 2] = [[-1.0], [1.0]];
/// −e1, e1 − e2, e2, −b, b;
const TRIPLE: [[f64; 3]; 5] =
    [[-1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]];
/// −a − b, a − b, b − a, a + b;
const SHEAR: [[f64; 2]; 4] = [[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]];
/// −a − b + D, a − b − D, b − a − D, a + b + D.
const TWIST: [[f64; 3]; 4] = [[-1.0, -1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [1.0, 1.0, 1.0]];
/// −e1, e1 − e2, e2;
const LINE: [[f64; 2]; 3] = [[-1.0, 0.0], [1.0, -1.0], [0.0, 1.0]];
/// D, −D, −D, D.
const MIXED: [[f64; 1]; 4] = [[1.0], [-1.0], [-1.0], [1.0]];

impl Combined {
    /// Combines the weights of the elements that name ghosts; `place` is where each node is in the order of the blocks.
    pub fn new(elements: &Elements, place: &[u32]) -> Combined {
        let [edges, triples, shears] = elements.regular;
        let cells = &elements.shears[shears..];
        let edge = |e: &Edge| Stencil::new(elements, place, &e.nodes, &EDGE);
        let triple = |t: &Triple| Stencil::new(elements, place, &t.nodes, &TRIPLE);
        let shear = |s: &Shear| Stencil::new(elements, place, &s.nodes, &SHEAR);
        let twist = |s: &Shear| Stencil::new(elements, place, &s.bent, &TWIST);
        let line = |t: &Triple| Stencil::new(elements, place, &t.nodes[..3], &LINE);
        let mixed = |s: &Shear| Stencil::new(elements, place, &s.bent, &MIXED);
        let bent = &elements.triples[triples..];
        Combined(Ghosted {
            edges: Stencils { first: edges as u32, list: elements.edges[edges..].iter().map(edge).collect() },
            triples: Stencils { first: triples as u32, list: bent.iter().map(triple).collect() },
            shears: Stencils { first: shears as u32, list: cells.iter().map(shear).collect() },
            twists: Stencils { first: shears as u32, list: cells.iter().map(twist).collect() },
            lines: Stencils { first: triples as u32, list: bent.iter().map(line).collect() },
            mixed: Stencils { first: shears as u32, list: cells.iter().map(mixed).collect() },
        })
    }

    /// The active particles of each element.
    pub fn nodes(&self) -> impl Iterator<Item = &[u32]> {
        let Ghosted { edges, triples, shears, twists, .. } = &self.0;
        edges.nodes().chain(triples.nodes()).chain(shears.nodes()).chain(twists.nodes())
    }

    /// Looks up which of the sums the blocks of each element add to.
    pub fn place(self, mut sum: impl FnMut(u32, u32) -> u32) -> Ghosted {
        let Combined(mut ghosted) = self;
        ghosted.edges.place(&mut sum);
        ghosted.triples.place(&mut sum);
        ghosted.shears.place(&mut sum);
        ghosted.twists.place(&mut sum);
        ghosted.lines.place(&mut sum);
        ghosted.mixed.place(&mut sum);
        ghosted
    }
}
