//! Kernels of stretch elements; `potential::edge` says what they compute.

use super::{Given, answer, gather_all, keep, pick, put, scatter};
use crate::{
    batch::{Batches, EdgeBatch, Planes},
    fabric::law::Law,
    math::{
        block::Symmetric,
        pack::{Pack, Pack3, WIDTH, axpy, dot, neg, scale, sub},
    },
    potential::{
        Curvature,
        edge::{REST, ROUNDING},
        ghosted::Stencils,
        pattern::Slots,
        values::Values,
    },
};
use pulp::{Simd, WithSimd};

/// Strain, unit-like direction t = e/l, and 1/l.
pub(super) struct Strain<S: Simd> {
    pub(super) value: Pack<S>,
    tangent: Pack3<S>,
    inverse: Pack<S>,
    /// 1/rest length.
    rest: Pack<S>,
}

#[inline(always)]
pub(super) fn strain<S: Simd>(simd: S, batch: &EdgeBatch, from: usize, given: Given) -> Strain<S> {
    let [a, b] = gather_all(simd, given.x, batch.is_run, &batch.nodes, from);
    let rest = Pack::load(simd, &batch.inverse, from);
    let e = scale(sub(b, a), rest);
    let stretched = (dot(e, e) + rest.like(ROUNDING * ROUNDING)).sqrt();
    let inverse = stretched.inverse();
    let none = given.none(simd, &batch.rest, from) + rest.like(REST);
    Strain { value: stretched - none, tangent: scale(e, inverse), inverse: inverse * rest, rest }
}

/// How much edges differ between two shapes, over their rest lengths; the largest, or NaN where a place is not a number.
pub struct Turned<'a> {
    /// Elements.
    pub batches: &'a Batches,
    /// The shapes.
    pub shapes: [&'a Planes; 2],
}

impl WithSimd for Turned<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let Turned { batches, shapes } = self;
        let zero = Pack::splat(simd, 0.0);
        let (mut most, mut sum) = (zero, zero);
        for batch in &batches.edges {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let [a, b] = gather_all(simd, shapes[0], batch.is_run, &batch.nodes, from);
                let [c, d] = gather_all(simd, shapes[1], batch.is_run, &batch.nodes, from);
                let change = sub(sub(d, c), sub(b, a));
                let rest = Pack::load(simd, &batch.inverse, from);
                let square = dot(change, change) * rest * rest;
                // Lanes that do not count have no size.
                let square = zero.select_less(Pack::load(simd, &batch.size, from), square, zero);
                most = most.max(square);
                sum = sum + square;
            }
        }
        let mut lanes = [[0.0; WIDTH]; 2];
        most.store(&mut lanes[0], 0);
        sum.store(&mut lanes[1], 0);
        // What is not a number is left in the sum.
        let most = lanes[0].into_iter().fold(0.0, f64::max);
        (most + 0.0 * lanes[1].iter().sum::<f64>()).sqrt()
    }
}

/// Adds the edges' gradient [N] and keeps strains and tensions.
pub struct Gradient<'a> {
    /// Shape.
    pub given: Given<'a>,
    /// Where the gradient is added [N].
    pub out: &'a mut Planes,
    /// Where strains and tensions go.
    pub measures: &'a mut [[f64; 2]],
}

impl WithSimd for Gradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Given { batches, fabric, history, .. } = self.given;
        let mut laws = fabric.tensile.each_ref().map(Law::lanes);
        for batch in &batches.edges {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let strain = strain(simd, batch, from, self.given);
                let p = pick(simd, &history.edges, &batch.ids, from);
                let [tension, ..] = laws[batch.direction].evaluate(simd, strain.value, p);
                keep(self.measures, &batch.ids, from, strain.value, tension);
                let pull = scale(strain.tangent, strain.rest * tension * Pack::load(simd, &batch.size, from));
                scatter(self.out, batch.is_run, &batch.nodes[0], from, neg(pull));
                scatter(self.out, batch.is_run, &batch.nodes[1], from, pull);
            }
        }
    }
}

/// Adds the edges' Hessian, with tensions from the independent strains of a mixed Newton step.
pub struct Hessian<'a, 'v> {
    /// Shape.
    pub given: Given<'a>,
    /// Independent strain unknowns, per edge.
    pub strains: &'a [f64],
    /// Whether the shape is that of the middle of a step: the unknowns are then the strains where it begins, and exceed nothing.
    pub is_middle: bool,
    /// Which second derivatives.
    pub kind: Curvature,
    /// Slots of each batch's diagonals and its pair, as far as batches name no ghost.
    pub slots: &'a [[Slots; 3]],
    /// The edges of the other batches.
    pub stencils: &'a Stencils<1>,
    /// Where the blocks go.
    pub values: &'a mut Values<'v>,
    /// Where what the linearized tension exceeds the true one goes [N].
    pub rhs: &'a mut Planes,
}

/// Says whether there was any such excess.
impl WithSimd for Hessian<'_, '_> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> bool {
        let Given { batches, fabric, history, .. } = self.given;
        let mut laws = fabric.tensile.each_ref().map(Law::lanes);
        let mut exceeds = false;
        for (k, batch) in batches.edges.iter().enumerate() {
            let law = &mut laws[batch.direction];
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let strain = strain(simd, batch, from, self.given);
                let p = pick(simd, &history.edges, &batch.ids, from);
                let unknown = pick(simd, self.strains, &batch.ids, from);
                let [tension, stiffness] = answer(law, simd, unknown, p, self.kind);
                let size = Pack::load(simd, &batch.size, from);
                let bearing = match self.kind {
                    Curvature::Exact => tension,
                    Curvature::Clamped | Curvature::Bounding => tension.max(tension.like(0.0)),
                };
                // Along t: stiffness/L²; across: tension/(l L).
                let t = strain.tangent;
                let across = bearing * strain.inverse * strain.rest * size;
                let along = stiffness * strain.rest * strain.rest * size - across;
                let block = Symmetric::diagonal(across).plus_outer(t, along);
                if let Some(slots) = self.slots.get(k) {
                    self.values.add_own(slots[0], from, &block);
                    self.values.add_own(slots[1], from, &block);
                    self.values.add_even(slots[2], from, &block.negated());
                } else {
                    let ids = batch.ids.counting(from, S::F64_LANES);
                    self.stencils.add(simd, ids, &[block.block()], self.values.sums);
                }
                let gap = strain.value - unknown;
                // In a step's first solve the unknowns are the strains.
                if self.is_middle || gap.outside([0.0, f64::MIN_POSITIVE]).is_empty() {
                    continue;
                }
                exceeds = true;
                let [truly, ..] = law.evaluate(simd, strain.value, p);
                let excess = stiffness.mul_add(gap, tension) - truly;
                let extra = scale(t, strain.rest * size * excess);
                scatter(self.rhs, batch.is_run, &batch.nodes[0], from, neg(extra));
                scatter(self.rhs, batch.is_run, &batch.nodes[1], from, extra);
            }
        }
        exceeds
    }
}

/// Strains by linear extrapolation along a step: the tension unknowns after a mixed Newton step.
pub struct Linearized<'a> {
    /// Shape.
    pub given: Given<'a>,
    /// Step per particle [m].
    pub step: &'a Planes,
    /// Whether the shape is that of the middle of the step, and `out` holds the strains where it begins.
    pub is_middle: bool,
    /// Strain per edge.
    pub out: &'a mut [f64],
}

impl WithSimd for Linearized<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for batch in &self.given.batches.edges {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let strain = strain(simd, batch, from, self.given);
                let [a, b] = gather_all(simd, self.step, batch.is_run, &batch.nodes, from);
                let zero = [strain.value.like(0.0); 3];
                let along = dot(strain.tangent, axpy(sub(b, a), strain.rest, zero));
                let start =
                    if self.is_middle { pick(simd, self.out, &batch.ids, from) } else { strain.value };
                put(self.out, &batch.ids, from, start + along);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        grid::Grid,
        math::{
            Vec3,
            pack::{all_instructions, dispatch, with_instructions},
        },
    };
    use nalgebra::Rotation3;

    #[test]
    fn edges_turn_with_the_sheet_and_not_with_its_way() {
        let grid = Grid::uniform([5, 11], [0.1, 0.3]);
        let elements = grid.elements(|_| false);
        let batches = Batches::new(&elements);
        let at = |n| {
            let [i, j] = grid.site(n);
            Vec3::new(i as f64 * grid.spacing(0), j as f64 * grid.spacing(1), 0.0)
        };
        let flat: Vec<Vec3> = (0..grid.particles()).map(at).collect();
        let planes = |x: Vec<Vec3>| {
            let mut planes = Planes::new(elements.named.len());
            planes.set(&x, &elements.named);
            planes
        };
        let from = planes(flat.clone());
        let turned = |x: Vec<Vec3>| dispatch(Turned { batches: &batches, shapes: [&from, &planes(x)] });
        for arch in all_instructions() {
            with_instructions(arch, || {
                let away = Vec3::new(3.0, -2.0, 1.0);
                assert!(turned(flat.iter().map(|x| x + away).collect()) < 1e-12);
                let rotation = Rotation3::from_axis_angle(&Vec3::x_axis(), 0.2);
                let chord = 2.0 * 0.1_f64.sin();
                let whole = turned(flat.iter().map(|x| rotation * x).collect());
                assert!((whole - chord).abs() < 1e-12, "{whole}");
                // One particle by a tenth of the shorter edge, wherever it is.
                for n in 0..flat.len() {
                    let mut x = flat.clone();
                    x[n].z += 0.1 * 0.025;
                    let one = turned(x.clone());
                    assert!((one - 0.1).abs() < 1e-12, "{n}: {one}");
                    x[n].y = f64::NAN;
                    assert!(turned(x).is_nan(), "{n}");
                }
            });
        }
    }
}
