//! What all elements store, by the kernels' own measures.

use super::{Given, edges::strain, pick, shears::angle, triples::bend, twists::twist};
use crate::{
    fabric::law::Law,
    math::pack::{Pack, WIDTH},
};
use pulp::{Simd, WithSimd};

/// Energy stored in half of the elements of each kind [J].
pub struct Energy<'a> {
    /// Shape.
    pub given: Given<'a>,
    /// Which half.
    pub half: usize,
}

impl WithSimd for Energy<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let Given { batches, fabric, history, x, .. } = self.given;
        let mut sums = [0.0; WIDTH];
        let [mut tensile, mut bending] =
            [&fabric.tensile, &fabric.bending].map(|laws| laws.each_ref().map(Law::lanes));
        let mut shear = fabric.shear.lanes();
        for batch in half(&batches.edges, self.half) {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let p = pick(simd, &history.edges, &batch.ids, from);
                let strain = strain(simd, batch, from, self.given).value;
                let [_, _, energy] = tensile[batch.direction].evaluate(simd, strain, p);
                add(simd, &mut sums, from, &batch.size, energy);
            }
        }
        for batch in half(&batches.triples, self.half) {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let p = pick(simd, &history.triples, &batch.ids, from);
                let kappa = bend(simd, batch, from, self.given).value;
                let [_, _, energy] = bending[batch.direction].evaluate(simd, kappa, p);
                add(simd, &mut sums, from, &batch.size, energy);
            }
        }
        for batch in half(&batches.shears, self.half) {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let p = pick(simd, &history.shears, &batch.ids, from);
                let phi = angle(simd, batch, from, self.given).value;
                let [_, _, mut energy] = shear.evaluate(simd, phi, p);
                if fabric.twist > 0.0 {
                    let tau = twist(simd, batch, from, x).value;
                    energy = (tau * tau).mul_add(tau.like(0.5 * fabric.twist), energy);
                }
                add(simd, &mut sums, from, &batch.size, energy);
            }
        }
        sums.iter().sum()
    }
}

/// One of the two halves of a list.
fn half<T>(list: &[T], which: usize) -> &[T] {
    let (first, second) = list.split_at(list.len() / 2);
    [first, second][which]
}

/// Adds energies per size; lanes keep their own sums, so that the width of the machine's registers does not change the order.
#[inline(always)]
fn add<S: Simd>(simd: S, sums: &mut [f64; WIDTH], from: usize, size: &[f64; WIDTH], energy: Pack<S>) {
    energy.mul_add(Pack::load(simd, size, from), Pack::load(simd, sums, from)).store(sums, from);
}
