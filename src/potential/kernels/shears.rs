//! Kernels of shear elements; `potential::shear` says what they compute.

use super::{Given, answer, gather_all, keep, pick, scatter};
use crate::{
    batch::{Planes, ShearBatch},
    math::pack::{Block, Pack, Pack3, WIDTH, add, axpy, dot, neg, scale, sub},
    potential::{
        Curvature,
        ghosted::Stencils,
        halves::Part,
        pattern::Slots,
        shear::{REACH, ROUNDING},
        values::Values,
    },
};
use pulp::{Simd, WithSimd};

pub(super) struct Angle<S: Simd> {
    pub(super) value: Pack<S>,
    gradient: [Pack3<S>; 2],
    pub(super) vectors: [Pack3<S>; 2],
    /// 1/|a|², 1/|b|².
    inverses: [Pack<S>; 2],
    dot: Pack<S>,
    sine: Pack<S>,
    slope: Pack<S>,
    root: Pack<S>,
    pub(super) halves: [Pack<S>; 2],
}

#[inline(always)]
pub(super) fn angle<S: Simd>(simd: S, batch: &ShearBatch, from: usize, given: Given) -> Angle<S> {
    let nodes = gather_all(simd, given.x, batch.is_run, &batch.nodes, from);
    angle_of(simd, batch, from, given, nodes)
}

/// The same of nodes that are somewhere else.
#[inline(always)]
pub(super) fn angle_of<S: Simd>(
    simd: S,
    batch: &ShearBatch,
    from: usize,
    given: Given,
    [p, q, r, s]: [Pack3<S>; 4],
) -> Angle<S> {
    let halves = [Pack::load(simd, &batch.halves[0], from), Pack::load(simd, &batch.halves[1], from)];
    let (rising, falling) = (sub(s, p), sub(q, r));
    let (a, b) = (scale(add(rising, falling), halves[0]), scale(sub(rising, falling), halves[1]));
    let rounding = halves[0].like(ROUNDING);
    let squares = [dot(a, a) + rounding, dot(b, b) + rounding];
    let inverses = [squares[0].inverse(), squares[1].inverse()];
    let one = rounding.like(1.0);
    let root = (inverses[0] * inverses[1]).sqrt() * one.like(REACH);
    let product = dot(a, b);
    let sine = product * root;
    let slope = (one - sine * sine).sqrt().inverse();
    let steep = root * slope;
    let gradient = [
        scale(axpy(a, -(product * inverses[0]), b), steep),
        scale(axpy(b, -(product * inverses[1]), a), steep),
    ];
    let value = sine.map(f64::asin) - given.none(simd, &batch.rest, from);
    Angle { value, gradient, vectors: [a, b], inverses, dot: product, sine, slope, root, halves }
}

/// Adds the cells' gradient [N] and keeps angles and shear forces.
pub struct Gradient<'a> {
    /// Shape.
    pub given: Given<'a>,
    /// Where the gradient is added [N].
    pub out: &'a mut Planes,
    /// Where angles and shear forces go.
    pub measures: &'a mut [[f64; 2]],
}

impl WithSimd for Gradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Given { batches, fabric, history, .. } = self.given;
        let mut law = fabric.shear.lanes();
        for batch in &batches.shears {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let phi = angle(simd, batch, from, self.given);
                let p = pick(simd, &history.shears, &batch.ids, from);
                let [force, ..] = law.evaluate(simd, phi.value, p);
                keep(self.measures, &batch.ids, from, phi.value, force);
                let force = force * Pack::load(simd, &batch.size, from);
                let by_a = scale(phi.gradient[0], force * phi.halves[0]);
                let by_b = scale(phi.gradient[1], force * phi.halves[1]);
                let (both, apart) = (add(by_a, by_b), sub(by_a, by_b));
                scatter(self.out, batch.is_run, &batch.nodes[0], from, neg(both));
                scatter(self.out, batch.is_run, &batch.nodes[1], from, apart);
                scatter(self.out, batch.is_run, &batch.nodes[2], from, neg(apart));
                scatter(self.out, batch.is_run, &batch.nodes[3], from, both);
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
    pub stencils: &'a Stencils<2>,
    /// Where the blocks go.
    pub values: &'a mut Values<'v>,
}

impl WithSimd for Hessian<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Given { batches, fabric, history, .. } = self.given;
        let mut law = fabric.shear.lanes();
        for (k, batch) in batches.shears.iter().enumerate() {
            if Part::of(&self.values.pattern.parts[1], k) != self.part {
                continue;
            }
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let phi = angle(simd, batch, from, self.given);
                let p = pick(simd, &history.shears, &batch.ids, from);
                let [force, stiffness] = answer(&mut law, simd, phi.value, p, self.kind);
                let size = Pack::load(simd, &batch.size, from);
                let blocks = blocks_of(&phi, force * size, stiffness * size, self.kind);
                let Some(slots) = self.slots.get(k) else {
                    let ids = batch.ids.counting(from, S::F64_LANES);
                    self.stencils.add(simd, ids, &blocks, self.values.sums);
                    continue;
                };
                add_cell(self.values, slots, from, &blocks, None);
            }
        }
    }
}

/// Adds second derivatives in a and b to the corners of cells, −a−b, a−b, b−a, a+b, and one in the mixed difference, 1, −1, −1, 1.
#[inline(always)]
pub(super) fn add_cell<S: Simd>(
    values: &mut Values,
    slots: &[Slots; 10],
    from: usize,
    [aa, ab, bb]: &[Block<S>; 3],
    mixed: Option<&Block<S>>,
) {
    // Sums and differences make every pair.
    let same = aa.plus(*bb);
    let (both, turned) = (ab.plus(ab.transposed()), ab.minus(ab.transposed()));
    let (outer, inner) = (same.plus(both), same.minus(both));
    let apart = bb.minus(*aa);
    values.add_own(slots[0], from, &plus(outer, mixed));
    values.add_own(slots[1], from, &plus(inner, mixed));
    values.add_own(slots[2], from, &plus(inner, mixed));
    values.add_own(slots[3], from, &plus(outer, mixed));
    values.add_lanes(slots[4], from, &minus(apart.plus(turned), mixed));
    values.add_lanes(slots[5], from, &minus(apart.plus(turned).negated(), mixed));
    values.add_lanes(slots[6], from, &plus(outer.negated(), mixed));
    values.add_lanes(slots[7], from, &plus(inner.negated(), mixed));
    values.add_lanes(slots[8], from, &minus(turned.minus(apart), mixed));
    values.add_lanes(slots[9], from, &minus(apart.minus(turned), mixed));
}

#[inline(always)]
fn plus<S: Simd>(block: Block<S>, mixed: Option<&Block<S>>) -> Block<S> {
    match mixed {
        Some(mixed) => block.plus(*mixed),
        None => block,
    }
}

#[inline(always)]
fn minus<S: Simd>(block: Block<S>, mixed: Option<&Block<S>>) -> Block<S> {
    match mixed {
        Some(mixed) => block.minus(*mixed),
        None => block,
    }
}

/// Second derivatives in a and b, scaled to the corners: force · ∂²φ + stiffness · ∂φ ∂φᵀ.
#[inline(always)]
pub(super) fn blocks_of<S: Simd>(
    phi: &Angle<S>,
    force: Pack<S>,
    stiffness: Pack<S>,
    kind: Curvature,
) -> [Block<S>; 3] {
    let [p, q] = phi.halves;
    let [ga, gb] = phi.gradient;
    if kind != Curvature::Exact {
        return [
            Block::outer(scale(ga, stiffness * p * p), ga),
            Block::outer(scale(ga, stiffness * p * q), gb),
            Block::outer(scale(gb, stiffness * q * q), gb),
        ];
    }
    let ([a, b], [ip, iq], u) = (phi.vectors, phi.inverses, phi.dot);
    let steep = phi.slope * phi.root * force;
    let rank = (phi.sine * phi.slope).mul_add(force, stiffness);
    let f = steep * p * q;
    let ab = Block::diagonal(f)
        .plus_outer(scale(b, -(f * iq)), b)
        .plus_outer(scale(a, -(f * ip)), a)
        .plus_outer(scale(a, f * u * ip * iq), b)
        .plus_outer(scale(ga, rank * p * q), gb);
    [side([a, b, ga], u, rank, steep, ip, p), ab, side([b, a, gb], u, rank, steep, iq, q)]
}

/// Second derivative in one of both vectors: v that one, w the other, g the angle's gradient in v.
#[inline(always)]
fn side<S: Simd>(
    [v, w, g]: [Pack3<S>; 3],
    product: Pack<S>,
    rank: Pack<S>,
    steep: Pack<S>,
    inverse: Pack<S>,
    half: Pack<S>,
) -> Block<S> {
    let f = steep * half * half * inverse;
    Block::diagonal(-(f * product))
        .plus_both(scale(v, -f), w)
        .plus_outer(scale(v, f.like(3.0) * product * f * inverse), v)
        .plus_outer(scale(g, rank * half * half), g)
}
