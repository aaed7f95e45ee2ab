//! What soft elements bring to a matrix that may lag: of bending and twist what goes along the normal alone, of shear all.
//!
//! Bending's moment turns with the cloth, and its normal with the threads across: both are smaller than what stands here by the angle that
//! neighbouring edges make, and both vanish on a flat sheet (tested). A step's matrix of a moment ago errs by as much, and leaving them out
//! spares most of the arithmetic and more than half of the stores.

use super::{
    Given, answer, gather_all, pick,
    shears::{self, Angle, angle_of},
    triples::{Bend, bend_of},
};
use crate::{
    fabric::law::Law,
    math::{
        block::{Block, Symmetric},
        pack::{Pack, WIDTH, cross, dot, scale},
    },
    potential::{
        Curvature, ghosted::Stencils, halves::Part, made::Making, pattern::Slots, rounded::RoundedLanes,
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
                let mut former = None;
                // What they were is taken off what they are, so that planes are gone through once.
                for turn in (0..1 + usize::from(replaces)).rev() {
                    let is_former = turn > 0;
                    let (nodes, p) = match &shape {
                        Some(was) if is_former => was.load(simd, from),
                        _ => now,
                    };
                    let kappa = bend_of(simd, batch, from, self.given, nodes);
                    let [_, stiffness] = answer(&mut laws[batch.direction], simd, kappa.value, p, self.kind);
                    let bent = Bent::new(&kappa, stiffness * size);
                    if is_former {
                        former = Some(bent);
                        continue;
                    }
                    let bent = match &former {
                        Some(former) => bent.minus(former),
                        None => bent,
                    };
                    match self.slots.get(k) {
                        Some(slots) => bent.add_to(self.values, slots, from),
                        None => {
                            let ids = batch.ids.counting(from, S::F64_LANES);
                            self.stencils.add(simd, ids, &bent.blocks(), self.values.sums);
                        }
                    }
                }
                if let Some(shape) = &mut shape {
                    shape.store(from, now);
                }
            }
        }
    }
}

/// Second derivatives 11, 12, 22 along the normal N: an edge turns by its part along N over its length, so all of them are multiples of N Nᵀ.
struct Bent<S: Simd>([Symmetric<S>; 3]);

impl<S: Simd> Bent<S> {
    #[inline(always)]
    fn new(kappa: &Bend<S>, stiffness: Pack<S>) -> Bent<S> {
        let square = Symmetric::square(scale(kappa.normal, kappa.inverse));
        let slope = kappa.sharpness * kappa.steepness;
        let first = slope * kappa.shortness[0] * kappa.weights[0];
        let second = slope * kappa.shortness[1] * kappa.weights[1];
        let (by_first, by_second) = (stiffness * first, stiffness * second);
        Bent([
            square.times(by_first * first),
            square.times(-(by_first * second)),
            square.times(by_second * second),
        ])
    }

    #[inline(always)]
    fn minus(&self, other: &Bent<S>) -> Bent<S> {
        let (Bent([a, b, c]), Bent([d, e, f])) = (self, other);
        Bent([a.minus(*d), b.minus(*e), c.minus(*f)])
    }

    #[inline(always)]
    fn blocks(&self) -> [Block<S>; 3] {
        let Bent([first, both, second]) = self;
        [first.block(), both.block(), second.block()]
    }

    /// Adds them to the three particles in line: −e1, e1 − e2, e2.
    #[inline(always)]
    fn add_to(&self, values: &mut Values, slots: &[Slots; 15], from: usize) {
        let Bent([first, both, second]) = self;
        let (before, behind) = (both.minus(*first), both.minus(*second));
        values.add_own(slots[0], from, first);
        values.add_own(slots[1], from, &before.plus(behind).negated());
        values.add_own(slots[2], from, second);
        values.add_even(slots[5], from, &before);
        values.add_even(slots[6], from, &both.negated());
        values.add_even(slots[9], from, &behind);
    }
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
                let mut former = None;
                // What they were is taken off what they are, so that planes are gone through once.
                for turn in (0..1 + usize::from(replaces)).rev() {
                    let is_former = turn > 0;
                    let (nodes, p) = match &shape {
                        Some(was) if is_former => was.load(simd, from),
                        _ => now,
                    };
                    let phi = angle_of(simd, batch, from, self.given, nodes);
                    let [force, stiffness] = answer(&mut law, simd, phi.value, p, self.kind);
                    let sheared = shears::blocks_of(&phi, force * size, stiffness * size, self.kind);
                    let twisted = turned(&phi, size * size.like(fabric.twist));
                    if is_former {
                        former = Some((sheared, twisted));
                        continue;
                    }
                    let (sheared, twisted) = match &former {
                        Some((was, turned)) => (sheared.minus(was), twisted.minus(*turned)),
                        None => (sheared, twisted),
                    };
                    let Some(slots) = self.slots.get(k) else {
                        let ids = batch.ids.counting(from, S::F64_LANES);
                        let (shears, mixed) = self.stencils;
                        shears.add(simd, ids, &sheared.blocks(), self.values.sums);
                        mixed.add(simd, ids, &[twisted.block()], self.values.sums);
                        continue;
                    };
                    sheared.add_to(self.values, slots, from, Some(&twisted));
                }
                if let Some(shape) = &mut shape {
                    shape.store(from, now);
                }
            }
        }
    }
}

/// Second derivative of twist in the mixed difference of the corners, along the normal N.
#[inline(always)]
fn turned<S: Simd>(phi: &Angle<S>, stiffness: Pack<S>) -> Symmetric<S> {
    let normal = cross(phi.vectors[0], phi.vectors[1]);
    let inverse = RoundedLanes::new(dot(normal, normal)).inverse.sqrt();
    let weight = phi.halves[0] * phi.halves[1] * inverse * inverse.like(4.0);
    Symmetric::outer(scale(normal, weight), stiffness)
}
