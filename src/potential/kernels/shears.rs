//! Kernels of shear elements; `potential::shear` says what they compute.

use super::{Given, answer, gather_all, keep, pick, scatter};
use crate::{
    batch::{Planes, ShearBatch},
    math::{
        block::{Block, Symmetric},
        pack::{Pack, Pack3, WIDTH, add, axpy, dot, neg, scale, sub},
    },
    potential::{
        Curvature, ghosted::Stencils, halves::Part, pattern::Slots, rounded::RoundedLanes, shear::REACH,
        values::Values,
    },
};
use pulp::{Simd, WithSimd};

pub(super) struct Angle<S: Simd> {
    pub(super) value: Pack<S>,
    gradient: [Pack3<S>; 2],
    pub(super) vectors: [Pack3<S>; 2],
    /// Of |a|² and |b|².
    rounded: [RoundedLanes<S>; 2],
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
    let rounded = [RoundedLanes::new(dot(a, a)), RoundedLanes::new(dot(b, b))];
    let one = halves[0].like(1.0);
    let root = (rounded[0].inverse * rounded[1].inverse).sqrt() * one.like(REACH);
    let product = dot(a, b);
    let sine = product * root;
    let slope = (one - sine * sine).sqrt().inverse();
    let steep = root * slope;
    let gradient = [
        scale(axpy(a, -(product * rounded[0].first), b), steep),
        scale(axpy(b, -(product * rounded[1].first), a), steep),
    ];
    let value = sine.map(f64::asin) - given.none(simd, &batch.rest, from);
    Angle { value, gradient, vectors: [a, b], rounded, dot: product, sine, slope, root, halves }
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
                let sheared = blocks_of(&phi, force * size, stiffness * size, self.kind);
                let Some(slots) = self.slots.get(k) else {
                    let ids = batch.ids.counting(from, S::F64_LANES);
                    self.stencils.add(simd, ids, &sheared.blocks(), self.values.sums);
                    continue;
                };
                sheared.add_to(self.values, slots, from, None);
            }
        }
    }
}

/// Second derivatives aa, ab, bb, scaled to the corners.
pub(super) struct Sheared<S: Simd> {
    aa: Symmetric<S>,
    ab: Block<S>,
    bb: Symmetric<S>,
}

impl<S: Simd> Sheared<S> {
    #[inline(always)]
    pub(super) fn minus(&self, other: &Sheared<S>) -> Sheared<S> {
        let Sheared { aa, ab, bb } = self;
        Sheared { aa: aa.minus(other.aa), ab: ab.minus(other.ab), bb: bb.minus(other.bb) }
    }

    #[inline(always)]
    pub(super) fn blocks(&self) -> [Block<S>; 3] {
        [self.aa.block(), self.ab, self.bb.block()]
    }

    /// Adds them to the corners of cells, −a−b, a−b, b−a, a+b, and one in the mixed difference, 1, −1, −1, 1.
    #[inline(always)]
    pub(super) fn add_to(
        &self,
        values: &mut Values,
        slots: &[Slots; 10],
        from: usize,
        mixed: Option<&Symmetric<S>>,
    ) {
        // Sums and differences make every pair.
        let (both, turned) = self.ab.both_parts();
        let (same, apart) = (self.aa.plus(self.bb), self.bb.minus(self.aa));
        let (outer, inner) = (same.plus(both), same.minus(both));
        let mixed = mixed.copied().unwrap_or(Symmetric::diagonal(turned[0].like(0.0)));
        values.add_own(slots[0], from, &mixed.plus(outer));
        values.add_own(slots[1], from, &mixed.plus(inner));
        values.add_own(slots[2], from, &mixed.plus(inner));
        values.add_own(slots[3], from, &mixed.plus(outer));
        values.add_even(slots[6], from, &mixed.minus(outer));
        values.add_even(slots[7], from, &mixed.minus(inner));
        let (less, more) = (apart.minus(mixed), apart.plus(mixed).negated());
        values.add_lanes(slots[4], from, &less.plus_cross(turned));
        values.add_lanes(slots[5], from, &more.plus_cross(neg(turned)));
        values.add_lanes(slots[8], from, &more.plus_cross(turned));
        values.add_lanes(slots[9], from, &less.plus_cross(neg(turned)));
    }
}

/// Second derivatives in a and b, scaled to the corners: force · ∂²φ + stiffness · ∂φ ∂φᵀ.
#[inline(always)]
pub(super) fn blocks_of<S: Simd>(
    phi: &Angle<S>,
    force: Pack<S>,
    stiffness: Pack<S>,
    kind: Curvature,
) -> Sheared<S> {
    let [p, q] = phi.halves;
    let [ga, gb] = phi.gradient;
    if kind != Curvature::Exact {
        return Sheared {
            aa: Symmetric::outer(ga, stiffness * p * p),
            ab: Block::outer(scale(ga, stiffness * p * q), gb),
            bb: Symmetric::outer(gb, stiffness * q * q),
        };
    }
    let ([a, b], [of_a, of_b], u) = (phi.vectors, phi.rounded, phi.dot);
    let (ip, iq) = (of_a.first, of_b.first);
    let steep = phi.slope * phi.root * force;
    let rank = (phi.sine * phi.slope).mul_add(force, stiffness);
    let f = steep * p * q;
    let ab = Block::diagonal(f)
        .plus_outer(scale(b, -(f * iq)), b)
        .plus_outer(scale(a, -(f * ip)), a)
        .plus_outer(scale(a, f * u * ip * iq), b)
        .plus_outer(scale(ga, rank * p * q), gb);
    let (aa, bb) = (side([a, b, ga], u, rank, steep, of_a, p), side([b, a, gb], u, rank, steep, of_b, q));
    Sheared { aa, ab, bb }
}

/// Second derivative in one of both vectors: v that one, w the other, g the angle's gradient in v.
#[inline(always)]
fn side<S: Simd>(
    [v, w, g]: [Pack3<S>; 3],
    product: Pack<S>,
    rank: Pack<S>,
    steep: Pack<S>,
    rounded: RoundedLanes<S>,
    half: Pack<S>,
) -> Symmetric<S> {
    let whole = steep * half * half;
    let f = whole * rounded.first;
    Symmetric::diagonal(-(f * product))
        .plus_both(scale(v, -f), w)
        .plus_outer(v, whole * product * rounded.second())
        .plus_outer(g, rank * half * half)
}
