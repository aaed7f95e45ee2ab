//! Kernels over laws alone: what a committed step changes in the history, and what a state stores and violates.

use crate::{
    batch::{Batches, Ids},
    fabric::{Fabric, law::Law},
    math::pack::{Pack, WIDTH},
};
use pulp::{Simd, WithSimd};

use super::{pick, pick_of, put};

/// Batches of elements of one kind as their laws see them.
pub struct Lots<'a, I> {
    laws: [&'a Law; 2],
    each: I,
}

/// A batch of them.
#[derive(Clone, Copy)]
pub struct Lot<'a> {
    /// Which of the laws.
    law: usize,
    ids: &'a Ids,
    size: &'a [f64; WIDTH],
}

/// The edges' lots.
pub fn edges<'a>(batches: &'a Batches, fabric: &'a Fabric) -> Lots<'a, impl Iterator<Item = Lot<'a>>> {
    let each = batches.edges.iter().map(|b| Lot { law: b.direction, ids: &b.ids, size: &b.size });
    Lots { laws: fabric.tensile.each_ref(), each }
}

/// The triples' lots.
pub fn triples<'a>(batches: &'a Batches, fabric: &'a Fabric) -> Lots<'a, impl Iterator<Item = Lot<'a>>> {
    let each = batches.triples.iter().map(|b| Lot { law: b.direction, ids: &b.ids, size: &b.size });
    Lots { laws: fabric.bending.each_ref(), each }
}

/// The cells' lots.
pub fn shears<'a>(batches: &'a Batches, fabric: &'a Fabric) -> Lots<'a, impl Iterator<Item = Lot<'a>>> {
    let each = batches.shears.iter().map(|b| Lot { law: 0, ids: &b.ids, size: &b.size });
    Lots { laws: [&fabric.shear; 2], each }
}

/// Moves the internal variables to what the measures demand; gives the energy that was dissipated [J].
pub struct Commit<'a, I> {
    /// Elements.
    pub lots: Lots<'a, I>,
    /// Measure and force per element.
    pub measures: &'a [[f64; 2]],
    /// Internal variable per element.
    pub history: &'a mut [f64],
}

impl<'a, I: Iterator<Item = Lot<'a>>> WithSimd for Commit<'_, I> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let mut lost = [0.0; WIDTH];
        let mut laws = self.lots.laws.map(Law::lanes);
        for Lot { law, ids, size } in self.lots.each {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let measure = pick_of(simd, self.measures, 0, ids, from);
                let old = pick(simd, self.history, ids, from);
                let new = laws[law].commit(simd, measure, old);
                let way = (new - old).abs();
                // Lanes keep their own sums, so that the width of the machine's registers does not change the order.
                way.mul_add(Pack::load(simd, size, from), Pack::load(simd, &lost, from))
                    .store(&mut lost, from);
                put(self.history, ids, from, new);
            }
        }
        lost.iter().sum()
    }
}

/// Energy stored in the elements [J], and the elements, number and area [m²], whose force lies outside the envelope.
pub struct Account<'a, I> {
    /// Elements.
    pub lots: Lots<'a, I>,
    /// Measure and force per element.
    pub measures: &'a [[f64; 2]],
    /// Internal variable per element.
    pub history: &'a [f64],
}

impl<'a, I: Iterator<Item = Lot<'a>>> WithSimd for Account<'_, I> {
    type Output = (f64, Vec<(u32, f64)>);

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        let mut stored = [0.0; WIDTH];
        let mut outside = Vec::new();
        let mut laws = self.lots.laws.map(Law::lanes);
        for Lot { law, ids, size } in self.lots.each {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let measure = pick_of(simd, self.measures, 0, ids, from);
                let force = pick_of(simd, self.measures, 1, ids, from);
                let p = pick(simd, self.history, ids, from);
                let ([_, _, energy], misfit) = laws[law].account(simd, measure, p, force);
                energy
                    .mul_add(Pack::load(simd, size, from), Pack::load(simd, &stored, from))
                    .store(&mut stored, from);
                let mut lanes = [0.0; WIDTH];
                misfit.store(&mut lanes, 0);
                for lane in 0..S::F64_LANES {
                    if lanes[lane] > 0.0 && size[from + lane] > 0.0 {
                        outside.push((ids.lanes[from + lane], size[from + lane]));
                    }
                }
            }
        }
        (stored.iter().sum(), outside)
    }
}
