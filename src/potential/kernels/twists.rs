//! Kernels of twist; `potential::twist` says what they compute.

use super::{Given, gather_all, put, scatter, triples::own};
use crate::{
    batch::{Planes, ShearBatch},
    math::{
        block::Block,
        pack::{Pack, Pack3, WIDTH, add, axpy, cross, dot, neg, scale, sub},
    },
    potential::{
        Curvature, ghosted::Stencils, halves::Part, pattern::Slots, rounded::RoundedLanes, values::Values,
    },
};
use pulp::{Simd, WithSimd};

pub(super) struct Twist<S: Simd> {
    pub(super) value: Pack<S>,
    a: Pack3<S>,
    b: Pack3<S>,
    d: Pack3<S>,
    normal: Pack3<S>,
    /// Of |a × b|², and 1/|a × b|.
    rounded: RoundedLanes<S>,
    inverse: Pack<S>,
    by_normal: Pack3<S>,
    /// In a, b, D, scaled to the corners.
    gradient: [Pack3<S>; 3],
    /// What a corner weighs in a, b, D, but for the sign.
    weights: [Pack<S>; 3],
}

#[inline(always)]
pub(super) fn twist<S: Simd>(simd: S, batch: &ShearBatch, from: usize, x: &Planes) -> Twist<S> {
    let [p, q, r, s] = gather_all(simd, x, batch.is_bent_run, &batch.bent, from);
    let [u, v] = [Pack::load(simd, &batch.halves[0], from), Pack::load(simd, &batch.halves[1], from)];
    let weights = [u, v, u * v * u.like(4.0)];
    let (rising, falling) = (sub(s, p), sub(q, r));
    let (a, b) = (scale(add(rising, falling), u), scale(sub(rising, falling), v));
    let d = scale(sub(add(p, s), add(q, r)), weights[2]);
    let normal = cross(a, b);
    let rounded = RoundedLanes::new(dot(normal, normal));
    let inverse = rounded.inverse.sqrt();
    let value = dot(normal, d) * inverse;
    let by_normal = axpy(normal, -(value * rounded.first), scale(d, inverse));
    let gradient = [
        scale(cross(b, by_normal), weights[0]),
        scale(cross(by_normal, a), weights[1]),
        scale(normal, inverse * weights[2]),
    ];
    Twist { value, a, b, d, normal, rounded, inverse, by_normal, gradient, weights }
}

/// Adds the cells' gradient [N] and keeps their twists.
pub struct Gradient<'a> {
    /// Shape.
    pub given: Given<'a>,
    /// Where the gradient is added [N].
    pub out: &'a mut Planes,
    /// Where twists go.
    pub measures: &'a mut [f64],
}

impl WithSimd for Gradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Given { batches, fabric, x, .. } = self.given;
        for batch in &batches.shears {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let tau = twist(simd, batch, from, x);
                put(self.measures, &batch.ids, from, tau.value);
                let moment = tau.value * Pack::load(simd, &batch.size, from) * tau.value.like(fabric.twist);
                let [a, b, d] = tau.gradient;
                let (a, b, d) = (scale(a, moment), scale(b, moment), scale(d, moment));
                let (both, apart) = (add(a, b), sub(a, b));
                scatter(self.out, batch.is_bent_run, &batch.bent[0], from, sub(d, both));
                scatter(self.out, batch.is_bent_run, &batch.bent[1], from, sub(apart, d));
                scatter(self.out, batch.is_bent_run, &batch.bent[2], from, neg(add(apart, d)));
                scatter(self.out, batch.is_bent_run, &batch.bent[3], from, add(both, d));
            }
        }
    }
}

/// Adds the cells' Hessian.
pub struct Hessian<'a, 'v> {
    /// Shape.
    pub given: Given<'a>,
    /// Which second derivatives.
    pub kind: Curvature,
    /// Of which batches.
    pub part: Part,
    /// Slots of each batch's diagonals and of its pairs, in the order of `SHEAR_PAIRS`, as far as batches name no ghost.
    pub slots: &'a [[Slots; 10]],
    /// The cells of the other batches.
    pub stencils: &'a Stencils<3>,
    /// Where the blocks go.
    pub values: &'a mut Values<'v>,
}

impl WithSimd for Hessian<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Given { batches, fabric, x, .. } = self.given;
        for (k, batch) in batches.shears.iter().enumerate() {
            if Part::of(&self.values.pattern.parts[1], k) != self.part {
                continue;
            }
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let tau = twist(simd, batch, from, x);
                let size = Pack::load(simd, &batch.size, from);
                let blocks = blocks_of(&tau, size * size.like(fabric.twist), self.kind);
                let Some(slots) = self.slots.get(k) else {
                    let ids = batch.ids.counting(from, S::F64_LANES);
                    self.stencils.add(simd, ids, &blocks, self.values.sums);
                    continue;
                };
                let [aa, ab, ad, bb, bd, dd] = blocks;
                // Corners are −a−b+D, a−b−D, b−a−D, a+b+D: rows of the two diagonals' sums and differences make every pair.
                let (ba, da, db) = (ab.transposed(), ad.transposed(), bd.transposed());
                let (along, across) =
                    ([aa.plus(ba), ab.plus(bb), ad.plus(bd)], [aa.minus(ba), ab.minus(bb), ad.minus(bd)]);
                let rows = [
                    [da.minus(along[0]), db.minus(along[1]), dd.minus(along[2])],
                    [across[0].minus(da), across[1].minus(db), across[2].minus(dd)],
                    [
                        across[0].plus(da).negated(),
                        across[1].plus(db).negated(),
                        across[2].plus(dd).negated(),
                    ],
                    [along[0].plus(da), along[1].plus(db), along[2].plus(dd)],
                ];
                let column = [
                    rows[0][2].minus(rows[0][0]).minus(rows[0][1]),
                    rows[1][0].minus(rows[1][1]).minus(rows[1][2]),
                    rows[2][1].minus(rows[2][0]).minus(rows[2][2]),
                    rows[3][0].plus(rows[3][1]).plus(rows[3][2]),
                ];
                self.values.add_own(slots[0], from, &column[0].symmetric());
                self.values.add_own(slots[1], from, &column[1].symmetric());
                self.values.add_own(slots[2], from, &column[2].symmetric());
                self.values.add_own(slots[3], from, &column[3].symmetric());
                self.values.add_lanes(slots[4], from, &rows[0][0].minus(rows[0][1]).minus(rows[0][2]));
                self.values.add_lanes(slots[5], from, &rows[0][1].minus(rows[0][0]).minus(rows[0][2]));
                self.values.add_lanes(slots[6], from, &rows[0][0].plus(rows[0][1]).plus(rows[0][2]));
                self.values.add_lanes(slots[7], from, &rows[1][1].minus(rows[1][0]).minus(rows[1][2]));
                self.values.add_lanes(slots[8], from, &rows[1][0].plus(rows[1][1]).plus(rows[1][2]));
                self.values.add_lanes(slots[9], from, &rows[2][0].plus(rows[2][1]).plus(rows[2][2]));
            }
        }
    }
}

/// Second derivatives aa, ab, aD, bb, bD, DD, scaled to the corners: stiffness · (τ ∂²τ + ∂τ ∂τᵀ).
#[inline(always)]
fn blocks_of<S: Simd>(tau: &Twist<S>, stiffness: Pack<S>, kind: Curvature) -> [Block<S>; 6] {
    let [ga, gb, gd] = tau.gradient;
    let (sa, sb, sd) = (scale(ga, stiffness), scale(gb, stiffness), scale(gd, stiffness));
    let rank = [
        Block::outer(sa, ga),
        Block::outer(sa, gb),
        Block::outer(sa, gd),
        Block::outer(sb, gb),
        Block::outer(sb, gd),
        Block::outer(sd, gd),
    ];
    if kind != Curvature::Exact {
        return rank;
    }
    let Twist { a, b, d, normal: n, inverse: i, .. } = *tau;
    let i3 = i * tau.rounded.first;
    let fi3 = tau.value * tau.rounded.first;
    let fi5 = tau.value * tau.rounded.second();
    let (bd, bn, ad, an) = (cross(b, d), cross(b, n), cross(a, d), cross(a, n));
    let mixed = Block::diagonal(fi3 * dot(a, b))
        .plus_outer(scale(a, -fi3), b)
        .plus_outer(scale(bd, i3), an)
        .plus_outer(scale(bn, i3), ad)
        .plus_outer(scale(bn, -fi5), an)
        .plus_cross(neg(tau.by_normal));
    let zero = Block::diagonal(i.like(0.0));
    let a_d = zero.plus_cross(scale(b, i)).plus_outer(scale(bn, -i3), n);
    let b_d = zero.plus_cross(scale(a, -i)).plus_outer(scale(an, i3), n);
    let [wa, wb, wd] = tau.weights;
    let moment = stiffness * tau.value;
    [
        own([b, bd, bn], fi3, fi5, i3).times_plus(moment * wa * wa, rank[0]),
        mixed.times_plus(moment * wa * wb, rank[1]),
        a_d.times_plus(moment * wa * wd, rank[2]),
        own([a, ad, an], fi3, fi5, i3).times_plus(moment * wb * wb, rank[3]),
        b_d.times_plus(moment * wb * wd, rank[4]),
        rank[5],
    ]
}
