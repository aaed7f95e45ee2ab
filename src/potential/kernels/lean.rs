//! What soft elements bring to a matrix that may lag: of bending and twist what goes along the normal alone, of shear all.
//!
//! Bending's moment turns with the cloth, and its normal with the threads across: both are smaller than what stands here by the angle that
//! neighbouring edges make, and both vanish on a flat sheet (tested). A step's matrix of a moment ago errs by as much, and leaving them out
//! spares most of the arithmetic and more than half of the stores.

use super::{
    Given, answer, gather_all, pick,
    shears::{self, Angle, angle_of},
    triples::{self, Bend, bend_of},
};
use crate::{
    fabric::law::Law,
    math::pack::{Block, Pack, WIDTH, cross, dot, scale},
    potential::{
        Curvature, ghosted::Stencils, halves::Part, made::Making, pattern::Slots, twist::ROUNDING,
        values::Values,
    },
};
use pulp::{Simd, WithSimd};

/// Adds what the triples bring.
pub struct Triples<'a, 'v> {
    /// Shape.
    pub given: Given<'a>,
    /// How laws answer.
    pub kind: Curvature,
    /// Of which batches.
    pub part: Part,
    /// Which of them.
    pub making: Making<'a, 5>,
    /// Slots of each batch's diagonals and of its pairs, in the order of `TRIPLE_PAIRS`, as far as batches name no ghost.
    pub slots: &'a [[Slots; 15]],
    /// The triples of the other batches, by their edges.
    pub stencils: &'a Stencils<2>,
    /// Where the blocks go.
    pub values: &'a mut Values<'v>,
}

impl WithSimd for Triples<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let Given { batches, fabric, history, x, .. } = self.given;
        let mut laws = fabric.bending.each_ref().map(Law::lanes);
        let mut next = 0;
        for (k, batch) in batches.triples.iter().enumerate() {
            if Part::of(&self.values.pattern.parts[0], k) != self.part {
                continue;
            }
            let replaces = self.making.replaces();
            let (is_due, mut shape) = self.making.of(next);
            next += 1;
            if !is_due {
                continue;
            }
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let now = (
                    gather_all(simd, x, batch.is_run, &batch.nodes, from),
                    pick(simd, &history.triples, &batch.ids, from),
                );
                let size = Pack::load(simd, &batch.size, from);
                let mut blocks = [Block::diagonal(size.like(0.0)); 3];
                // What they were is taken off first.
                for takes_off in (0..1 + usize::from(replaces)).rev() {
                    let (nodes, p) = match &shape {
                        Some(shape) if takes_off > 0 => shape.load(simd, from),
                        _ => now,
                    };
                    let kappa = bend_of(simd, batch, from, self.given, nodes);
                    let [_, stiffness] = answer(&mut laws[batch.direction], simd, kappa.value, p, self.kind);
                    let own = bent(&kappa, stiffness * size);
                    for b in 0..3 {
                        blocks[b] = own[b].minus(blocks[b]);
                    }
                }
                if let Some(shape) = &mut shape {
                    shape.store(from, now);
                }
                let Some(slots) = self.slots.get(k) else {
                    let ids = batch.ids.counting(from, S::F64_LANES);
                    self.stencils.add(simd, ids, &blocks, self.values.sums);
                    continue;
                };
                triples::add_line(self.values, slots, from, &blocks);
            }
        }
    }
}

/// Second derivatives 11, 12, 22 along the normal N: an edge turns by its part along N over its length.
#[inline(always)]
fn bent<S: Simd>(kappa: &Bend<S>, stiffness: Pack<S>) -> [Block<S>; 3] {
    let normal = scale(kappa.normal, kappa.inverse);
    let slope = kappa.sharpness * kappa.slopes[0];
    let [first, second] = [0, 1].map(|k| slope * kappa.shortness[k] * kappa.weights[k]);
    let square = Block::outer(normal, normal);
    let (by_first, by_second) = (stiffness * first, stiffness * second);
    [square.times(by_first * first), square.times(-(by_first * second)), square.times(by_second * second)]
}

/// Adds what shear and twist of the cells bring.
pub struct Cells<'a, 'v> {
    /// Shape.
    pub given: Given<'a>,
    /// Which second derivatives of shear.
    pub kind: Curvature,
    /// Of which batches.
    pub part: Part,
    /// Which of them.
    pub making: Making<'a, 4>,
    /// Slots of each batch's diagonals and of its pairs, in the order of `SHEAR_PAIRS`, as far as batches name no ghost.
    pub slots: &'a [[Slots; 10]],
    /// The cells of the other batches, as shear sees them, and as twist does.
    pub stencils: (&'a Stencils<2>, &'a Stencils<1>),
    /// Where the blocks go.
    pub values: &'a mut Values<'v>,
}

impl WithSimd for Cells<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let Given { batches, fabric, history, x, .. } = self.given;
        let mut law = fabric.shear.lanes();
        let mut next = 0;
        for (k, batch) in batches.shears.iter().enumerate() {
            if Part::of(&self.values.pattern.parts[1], k) != self.part {
                continue;
            }
            let replaces = self.making.replaces();
            let (is_due, mut shape) = self.making.of(next);
            next += 1;
            if !is_due {
                continue;
            }
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let now = (
                    gather_all(simd, x, batch.is_run, &batch.nodes, from),
                    pick(simd, &history.shears, &batch.ids, from),
                );
                let size = Pack::load(simd, &batch.size, from);
                let mut blocks = [Block::diagonal(size.like(0.0)); 4];
                // What they were is taken off first.
                for takes_off in (0..1 + usize::from(replaces)).rev() {
                    let (nodes, p) = match &shape {
                        Some(shape) if takes_off > 0 => shape.load(simd, from),
                        _ => now,
                    };
                    let phi = angle_of(simd, batch, from, self.given, nodes);
                    let [force, stiffness] = answer(&mut law, simd, phi.value, p, self.kind);
                    let [aa, ab, bb] = shears::blocks_of(&phi, force * size, stiffness * size, self.kind);
                    let own = [aa, ab, bb, turned(&phi, size * size.like(fabric.twist))];
                    for b in 0..4 {
                        blocks[b] = own[b].minus(blocks[b]);
                    }
                }
                if let Some(shape) = &mut shape {
                    shape.store(from, now);
                }
                let [aa, ab, bb, turned] = blocks;
                let Some(slots) = self.slots.get(k) else {
                    let ids = batch.ids.counting(from, S::F64_LANES);
                    let (sheared, twisted) = self.stencils;
                    sheared.add(simd, ids, &[aa, ab, bb], self.values.sums);
                    twisted.add(simd, ids, &[turned], self.values.sums);
                    continue;
                };
                shears::add_cell(self.values, slots, from, &[aa, ab, bb], Some(&turned));
            }
        }
    }
}

/// Second derivative of twist in the mixed difference of the corners, along the normal N.
#[inline(always)]
fn turned<S: Simd>(phi: &Angle<S>, stiffness: Pack<S>) -> Block<S> {
    let normal = cross(phi.vectors[0], phi.vectors[1]);
    let inverse = (dot(normal, normal) + stiffness.like(ROUNDING)).sqrt().inverse();
    let weight = phi.halves[0] * phi.halves[1] * inverse * inverse.like(4.0);
    let normal = scale(normal, weight);
    Block::outer(scale(normal, stiffness), normal)
}
