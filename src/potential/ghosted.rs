//! Stencils of the elements that name ghosts, over their masters.
//!
//! An element sees its nodes only through a few vectors (an edge vector; two mean sides; two tangents and a transverse one), each a
//! weighted sum of nodes. With ghosts replaced by their masters the sums run over active particles, and energy, gradient and
//! Hessian in the vectors stay what they are.

use super::{
    shear,
    system::{Slot, Values},
    triple, twist,
};
use crate::{
    grid::Elements,
    math::{Mat3, Vec3},
};

/// An element over active particles that sees them through `V` vectors.
#[derive(Clone, Debug)]
pub struct Stencil<const V: usize> {
    /// Active particles.
    nodes: Vec<u32>,
    /// Weights of each in the vectors.
    weights: Vec<[f64; V]>,
    /// Slots of the pairs (m, n), m > n, row by row.
    slots: Vec<Slot>,
}

/// Stencils of all elements that name ghosts, in the order of the elements.
#[derive(Debug)]
pub struct Ghosted {
    /// Edges: the edge vector.
    pub edges: Vec<Stencil<1>>,
    /// Triples: e1, e2, b.
    pub triples: Vec<Stencil<3>>,
    /// Shear cells: a, b.
    pub shears: Vec<Stencil<2>>,
    /// The same cells' twist: a, b, D.
    pub twists: Vec<Stencil<3>>,
}

/// The same before the elimination order is known.
pub(super) struct Combined(Ghosted);

impl<const V: usize> Stencil<V> {
    fn new(elements: &Elements, nodes: &[u32], weights: impl Fn(usize) -> [f64; V]) -> Stencil<V> {
        let mut stencil = Stencil { nodes: Vec::new(), weights: Vec::new(), slots: Vec::new() };
        for (k, &node) in nodes.iter().enumerate() {
            let own = [(node, 1.0)];
            for &(master, share) in elements.ghost(node).map_or(&own[..], |ghost| &ghost.masters) {
                let place = stencil.nodes.iter().position(|&n| n == master).unwrap_or_else(|| {
                    stencil.nodes.push(master);
                    stencil.weights.push([0.0; V]);
                    stencil.nodes.len() - 1
                });
                stencil.weights[place].iter_mut().zip(weights(k)).for_each(|(sum, w)| *sum += share * w);
            }
        }
        stencil
    }

    fn place(&mut self, slot: impl Fn(u32, u32) -> Slot) {
        let pairs = (0..self.nodes.len()).flat_map(|m| (0..m).map(move |n| (m, n)));
        self.slots = pairs.map(|(m, n)| slot(self.nodes[m], self.nodes[n])).collect();
    }

    /// Adds to the matrix an element with this Hessian in its vectors; `hessian[u][v]` is the transpose of `hessian[v][u]`.
    pub fn add(&self, hessian: &[[Mat3; V]; V], values: &mut Values) {
        let mut place = 0;
        for (m, wm) in self.weights.iter().enumerate() {
            let row: [Mat3; V] = std::array::from_fn(|v| (0..V).map(|u| hessian[u][v] * wm[u]).sum());
            let block = |wn: &[f64; V]| (0..V).map(|v| row[v] * wn[v]).sum::<Mat3>();
            for wn in &self.weights[..m] {
                let block = block(wn);
                values.add_pair(self.slots[place], |row, column| block[(row, column)]);
                place += 1;
            }
            let block = block(wm);
            values.add_diagonal(self.nodes[m], |row, column| block[(row, column)]);
        }
    }

    /// Adds to a right-hand side an element with this gradient in its vectors.
    pub fn push(&self, gradient: &[Vec3; V], rhs: &mut [Vec3]) {
        for (&n, w) in self.nodes.iter().zip(&self.weights) {
            rhs[n as usize] += gradient.iter().zip(w).map(|(g, w)| g * *w).sum::<Vec3>();
        }
    }
}

impl Combined {
    /// Combines the weights of the elements that name ghosts.
    pub fn new(elements: &Elements) -> Combined {
        let [edges, triples, shears] = elements.regular;
        let edges = elements.edges[edges..].iter();
        let triples = elements.triples[triples..].iter();
        let cells = &elements.shears[shears..];
        Combined(Ghosted {
            edges: edges.map(|e| Stencil::new(elements, &e.nodes, |n| [2.0 * n as f64 - 1.0])).collect(),
            triples: triples
                .map(|t| {
                    let weights = triple::Weights::new(t);
                    Stencil::new(elements, &t.nodes, |n| weights.of(n))
                })
                .collect(),
            shears: cells
                .iter()
                .map(|s| {
                    let weights = shear::Weights::new(s);
                    Stencil::new(elements, &s.nodes, |n| [weights.0[0][n], weights.0[1][n]])
                })
                .collect(),
            twists: cells
                .iter()
                .map(|s| {
                    let weights = twist::Weights::new(s);
                    Stencil::new(elements, &s.bent, |n| weights.of(n))
                })
                .collect(),
        })
    }

    /// The active particles of each element.
    pub fn nodes(&self) -> impl Iterator<Item = &[u32]> {
        let Ghosted { edges, triples, shears, twists } = &self.0;
        let edges = edges.iter().map(|s| &s.nodes[..]);
        let cells = shears.iter().map(|s| &s.nodes[..]).chain(twists.iter().map(|s| &s.nodes[..]));
        edges.chain(triples.iter().map(|s| &s.nodes[..])).chain(cells)
    }

    /// Looks up where the blocks of each element lie.
    pub fn place(self, slot: impl Fn(u32, u32) -> Slot + Copy) -> Ghosted {
        let Combined(mut ghosted) = self;
        ghosted.edges.iter_mut().for_each(|s| s.place(slot));
        ghosted.triples.iter_mut().for_each(|s| s.place(slot));
        ghosted.shears.iter_mut().for_each(|s| s.place(slot));
        ghosted.twists.iter_mut().for_each(|s| s.place(slot));
        ghosted
    }
}
