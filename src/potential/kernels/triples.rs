//! Kernels of bending elements; `potential::triple` says what they compute. Nodes are −e1, e1 − e2, e2, −b, b.

use super::{Given, answer, gather_all, keep, pick, scatter};
use crate::{
    batch::{Planes, TripleBatch},
    fabric::law::Law,
    math::{
        block::Block,
        pack::{Pack, Pack3, WIDTH, axpy, cross, dot, neg, scale, sub},
    },
    potential::{
        Curvature, fade::FadeLanes, ghosted::Stencils, halves::Part, pattern::Slots, triple::ROUNDING,
        values::Values,
    },
};
use pulp::{Simd, WithSimd};

pub(super) struct Bend<S: Simd> {
    pub(super) value: Pack<S>,
    /// What is left of the chord of the turn, the chord over reach, and the derivative of κ in what is left of that.
    angle: Pack<S>,
    chord: Pack<S>,
    slope: Pack<S>,
    fade: FadeLanes<S>,
    /// Derivative of κ in the chord over reach.
    pub(super) steepness: Pack<S>,
    /// In e1, e2, b; and of the chord over reach.
    gradient: [Pack3<S>; 3],
    bare: [Pack3<S>; 3],
    tangents: [Pack3<S>; 2],
    /// 1/|e|.
    pub(super) shortness: [Pack<S>; 2],
    a: Pack3<S>,
    b: Pack3<S>,
    pub(super) normal: Pack3<S>,
    /// 1/|a × b|.
    pub(super) inverse: Pack<S>,
    turn: Pack3<S>,
    by_normal: Pack3<S>,
    /// 1/rest length of both edges, and 1/span.
    pub(super) weights: [Pack<S>; 3],
    shares: [Pack<S>; 2],
    pub(super) sharpness: Pack<S>,
}

#[inline(always)]
pub(super) fn bend<S: Simd>(simd: S, batch: &TripleBatch, from: usize, given: Given) -> Bend<S> {
    let nodes = gather_all(simd, given.x, batch.is_run, &batch.nodes, from);
    bend_of(simd, batch, from, given, nodes)
}

/// The same of nodes that are somewhere else.
#[inline(always)]
pub(super) fn bend_of<S: Simd>(
    simd: S,
    batch: &TripleBatch,
    from: usize,
    given: Given,
    [p, c, n, u, v]: [Pack3<S>; 5],
) -> Bend<S> {
    let weights = [
        Pack::load(simd, &batch.inverses[0], from),
        Pack::load(simd, &batch.inverses[1], from),
        Pack::load(simd, &batch.across, from),
    ];
    let shares = [Pack::load(simd, &batch.shares[0], from), Pack::load(simd, &batch.shares[1], from)];
    let sharpness = Pack::load(simd, &batch.sharpness, from);
    let e = [scale(sub(c, p), weights[0]), scale(sub(n, c), weights[1])];
    let b = scale(sub(v, u), weights[2]);
    let rounding = sharpness.like(ROUNDING);
    let shortness =
        [(dot(e[0], e[0]) + rounding).sqrt().inverse(), (dot(e[1], e[1]) + rounding).sqrt().inverse()];
    let tangents = [scale(e[0], shortness[0]), scale(e[1], shortness[1])];
    let turned = sub(tangents[1], tangents[0]);
    let turn = scale(turned, sharpness);
    let a = axpy(e[0], shares[0], scale(e[1], shares[1]));
    let normal = cross(a, b);
    let square = dot(normal, normal);
    let inverse = (square + rounding).sqrt().inverse();
    let fade = FadeLanes::new(a, b, square);
    let whole = dot(normal, turned) * inverse;
    let (chord, angle) = (whole * sharpness, whole * fade.value);
    let [one, square] = [rounding.like(1.0), angle * angle];
    let slope = square.mul_add(one.like(0.125), one);
    let value =
        angle * sharpness * square.mul_add(one.like(1.0 / 24.0), one) - given.none(simd, &batch.rest, from);
    let by_normal = axpy(normal, -(chord * inverse * inverse), scale(turn, inverse));
    let by_a = cross(b, by_normal);
    let by_turn = scale(normal, sharpness * inverse);
    let bare = [
        axpy(by_a, shares[0], scale(across(by_turn, tangents[0]), -shortness[0])),
        axpy(by_a, shares[1], scale(across(by_turn, tangents[1]), shortness[1])),
        cross(by_normal, a),
    ];
    let steepness = slope * fade.value;
    let mut gradient = [scale(bare[0], steepness), scale(bare[1], steepness), scale(bare[2], steepness)];
    if let Some([by_a, by_b]) = fade.gradient() {
        let fading = slope * chord;
        gradient = [
            axpy(by_a, fading * shares[0], gradient[0]),
            axpy(by_a, fading * shares[1], gradient[1]),
            axpy(by_b, fading, gradient[2]),
        ];
    }
    Bend {
        value,
        angle,
        chord,
        slope,
        fade,
        steepness,
        gradient,
        bare,
        tangents,
        shortness,
        a,
        b,
        normal,
        inverse,
        turn,
        by_normal,
        weights,
        shares,
        sharpness,
    }
}

/// The part of v at right angles to the unit-like vector t.
#[inline(always)]
fn across<S: Simd>(v: Pack3<S>, t: Pack3<S>) -> Pack3<S> {
    axpy(t, -dot(t, v), v)
}

/// Adds the triples' gradient [N] and keeps curvatures and moments.
pub struct Gradient<'a> {
    /// Shape.
    pub given: Given<'a>,
    /// Where the gradient is added [N].
    pub out: &'a mut Planes,
    /// Where curvatures and moments go.
    pub measures: &'a mut [[f64; 2]],
}

impl WithSimd for Gradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Given { batches, fabric, history, .. } = self.given;
        let mut laws = fabric.bending.each_ref().map(Law::lanes);
        for batch in &batches.triples {
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let kappa = bend(simd, batch, from, self.given);
                let p = pick(simd, &history.triples, &batch.ids, from);
                let [moment, ..] = laws[batch.direction].evaluate(simd, kappa.value, p);
                keep(self.measures, &batch.ids, from, kappa.value, moment);
                let moment = moment * Pack::load(simd, &batch.size, from);
                let g1 = scale(kappa.gradient[0], moment * kappa.weights[0]);
                let g2 = scale(kappa.gradient[1], moment * kappa.weights[1]);
                let gb = scale(kappa.gradient[2], moment * kappa.weights[2]);
                scatter(self.out, batch.is_run, &batch.nodes[0], from, neg(g1));
                scatter(self.out, batch.is_run, &batch.nodes[1], from, sub(g1, g2));
                scatter(self.out, batch.is_run, &batch.nodes[2], from, g2);
                scatter(self.out, batch.is_run, &batch.nodes[3], from, neg(gb));
                scatter(self.out, batch.is_run, &batch.nodes[4], from, gb);
            }
        }
    }
}

/// Adds the triples' Hessian.
pub struct Hessian<'a, 'v> {
    /// Shape.
    pub given: Given<'a>,
    /// Which second derivatives.
    pub kind: Curvature,
    /// Of which batches.
    pub part: Part,
    /// Slots of each batch's diagonals and of its pairs, in the order of `TRIPLE_PAIRS`, as far as batches name no ghost.
    pub slots: &'a [[Slots; 15]],
    /// The triples of the other batches.
    pub stencils: &'a Stencils<3>,
    /// Where the blocks go.
    pub values: &'a mut Values<'v>,
}

impl WithSimd for Hessian<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Given { batches, fabric, history, .. } = self.given;
        let mut laws = fabric.bending.each_ref().map(Law::lanes);
        for (k, batch) in batches.triples.iter().enumerate() {
            if Part::of(&self.values.pattern.parts[0], k) != self.part {
                continue;
            }
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let kappa = bend(simd, batch, from, self.given);
                let p = pick(simd, &history.triples, &batch.ids, from);
                let [moment, stiffness] = answer(&mut laws[batch.direction], simd, kappa.value, p, self.kind);
                let size = Pack::load(simd, &batch.size, from);
                let blocks = blocks_of(&kappa, moment * size, stiffness * size, self.kind);
                let Some(slots) = self.slots.get(k) else {
                    let ids = batch.ids.counting(from, S::F64_LANES);
                    self.stencils.add(simd, ids, &blocks, self.values.sums);
                    continue;
                };
                let [h11, h12, h1b, h22, h2b, hbb] = blocks;
                let across = h1b.minus(h2b);
                add_line(self.values, slots, from, &[h11, h12, h22]);
                self.values.add_own(slots[3], from, &hbb.symmetric());
                self.values.add_own(slots[4], from, &hbb.symmetric());
                self.values.add_lanes(slots[7], from, &h1b);
                self.values.add_lanes(slots[8], from, &h1b.negated());
                self.values.add_lanes(slots[10], from, &across.negated());
                self.values.add_lanes(slots[11], from, &across);
                self.values.add_lanes(slots[12], from, &h2b.negated());
                self.values.add_lanes(slots[13], from, &h2b);
                self.values.add_lanes(slots[14], from, &hbb.negated());
            }
        }
    }
}

/// Adds second derivatives 11, 12, 22 to the three particles in line: −e1, e1 − e2, e2.
#[inline(always)]
fn add_line<S: Simd>(values: &mut Values, slots: &[Slots; 15], from: usize, [h11, h12, h22]: &[Block<S>; 3]) {
    let (first, second) = (h12.minus(*h11), h12.minus(*h22));
    values.add_own(slots[0], from, &h11.symmetric());
    values.add_own(slots[1], from, &h22.minus(*h12).minus(first.transposed()).symmetric());
    values.add_own(slots[2], from, &h22.symmetric());
    values.add_lanes(slots[5], from, &first);
    values.add_lanes(slots[6], from, &h12.negated());
    values.add_lanes(slots[9], from, &second);
}

/// Second derivatives 11, 12, 1b, 22, 2b, bb, scaled to the nodes: moment · ∂²κ + stiffness · ∂κ ∂κᵀ.
#[inline(always)]
fn blocks_of<S: Simd>(
    kappa: &Bend<S>,
    moment: Pack<S>,
    stiffness: Pack<S>,
    kind: Curvature,
) -> [Block<S>; 6] {
    let [w1, w2, wb] = kappa.weights;
    let [g1, g2, gb] = kappa.gradient;
    let g = [scale(g1, w1), scale(g2, w2), scale(gb, wb)];
    // The curvature of κ in what is left of its chord, a quarter of turn and reach, acts on that one's gradient, which is that of κ over
    // the slope.
    let steepness = kappa.slope * kappa.slope * kappa.sharpness * moment.like(4.0);
    let rank = match kind {
        Curvature::Exact => (moment * kappa.angle).mul_add(steepness.inverse(), stiffness),
        Curvature::Clamped | Curvature::Bounding => stiffness,
    };
    let steep = [scale(g[0], rank), scale(g[1], rank), scale(g[2], rank)];
    if kind != Curvature::Exact {
        return [
            Block::outer(steep[0], g[0]),
            Block::outer(steep[0], g[1]),
            Block::outer(steep[0], g[2]),
            Block::outer(steep[1], g[1]),
            Block::outer(steep[1], g[2]),
            Block::outer(steep[2], g[2]),
        ];
    }
    let Bend { a, b, normal: n, turn: d, inverse: i, .. } = *kappa;
    let i3 = i * i * i;
    // Chord/m² and 3 chord/m⁴ · 1: what stands before the identity and before N Nᵀ, m = |N|.
    let fi3 = kappa.chord * i * i;
    let fi5 = fi3 * i * i * i.like(3.0);
    let (bd, bn, ad, an) = (cross(b, d), cross(b, n), cross(a, d), cross(a, n));
    let (aa, bb) = (own([b, bd, bn], fi3, fi5, i3), own([a, ad, an], fi3, fi5, i3));
    let ab = Block::diagonal(fi3 * dot(a, b))
        .plus_outer(scale(a, -fi3), b)
        .plus_outer(scale(bd, i3), an)
        .plus_outer(scale(bn, i3), ad)
        .plus_outer(scale(bn, -fi5), an)
        .plus_cross(neg(kappa.by_normal));
    let [ad1, db1, own1] = turning(kappa, 0, bn, an, i3);
    let [ad2, db2, own2] = turning(kappa, 1, bn, an, i3);
    let [p, q] = kappa.shares;
    let mut bent = [
        aa.times(p * p).plus(ad1.plus(ad1.transposed()).times_plus(p, own1)),
        aa.times(p * q).plus(ad2.times_plus(p, ad1.transposed().times(q))),
        ab.times_plus(p, db1),
        aa.times(q * q).plus(ad2.plus(ad2.transposed()).times_plus(q, own2)),
        ab.times_plus(q, db2),
        bb,
    ];
    if let (Some([fa, fb]), Some(curved)) = (kappa.fade.gradient(), kappa.fade.hessian()) {
        bent = faded(kappa, bent, [scale(fa, p), scale(fa, q), fb], curved);
    }
    let [h11, h12, h1b, h22, h2b, hbb] = bent;
    let moment = moment * kappa.slope;
    let (m1, m2, mb) = (moment * w1, moment * w2, moment * wb);
    [
        h11.times(m1 * w1).plus_outer(steep[0], g[0]),
        h12.times(m1 * w2).plus_outer(steep[0], g[1]),
        h1b.times(m1 * wb).plus_outer(steep[0], g[2]),
        h22.times(m2 * w2).plus_outer(steep[1], g[1]),
        h2b.times(m2 * wb).plus_outer(steep[1], g[2]),
        hbb.times(mb * wb).plus_outer(steep[2], g[2]),
    ]
}

/// Second derivatives of a chord that fades: of its product with the fade, whose gradient in e1, e2, b is f.
#[inline(always)]
fn faded<S: Simd>(
    kappa: &Bend<S>,
    [h11, h12, h1b, h22, h2b, hbb]: [Block<S>; 6],
    f: [Pack3<S>; 3],
    [faa, fab, fbb]: [Block<S>; 3],
) -> [Block<S>; 6] {
    let (g, left, chord) = (kappa.bare, kappa.fade.value, kappa.chord);
    let [p, q] = kappa.shares;
    [
        h11.times_plus(left, faa.times(chord * p * p).plus_outer(g[0], f[0]).plus_outer(f[0], g[0])),
        h12.times_plus(left, faa.times(chord * p * q).plus_outer(g[0], f[1]).plus_outer(f[0], g[1])),
        h1b.times_plus(left, fab.times(chord * p).plus_outer(g[0], f[2]).plus_outer(f[0], g[2])),
        h22.times_plus(left, faa.times(chord * q * q).plus_outer(g[1], f[1]).plus_outer(f[1], g[1])),
        h2b.times_plus(left, fab.times(chord * q).plus_outer(g[1], f[2]).plus_outer(f[1], g[2])),
        hbb.times_plus(left, fbb.times(chord).plus_outer(g[2], f[2]).plus_outer(f[2], g[2])),
    ]
}

/// Second derivative in a or b at constant turn; v is the other one, vd and vn its cross products with the turn and N.
#[inline(always)]
pub(super) fn own<S: Simd>([v, vd, vn]: [Pack3<S>; 3], fi3: Pack<S>, fi5: Pack<S>, i3: Pack<S>) -> Block<S> {
    Block::diagonal(-(fi3 * dot(v, v)))
        .plus_outer(scale(v, fi3), v)
        .plus_both(scale(vd, -i3), vn)
        .plus_outer(scale(vn, fi5), vn)
}

/// Second derivatives through the turn of edge `k`: in a and the edge, in the edge and b, in the edge twice.
#[inline(always)]
fn turning<S: Simd>(kappa: &Bend<S>, k: usize, bn: Pack3<S>, an: Pack3<S>, i3: Pack<S>) -> [Block<S>; 3] {
    let (t, s, n) = (kappa.tangents[k], kappa.shortness[k], kappa.normal);
    let signed = if k == 0 { -s } else { s };
    let slope = signed * kappa.sharpness;
    let along = dot(t, n);
    let level = axpy(t, -along, n);
    let steep = slope * kappa.inverse;
    // ∂²/∂a∂e of the turn: [b]× less its part along t, over m, and −(b × N) (N − t t·N)ᵀ/m³.
    let by_a = Block::outer(scale(cross(kappa.b, t), -steep), t)
        .plus_cross(scale(kappa.b, steep))
        .plus_outer(scale(bn, -(slope * i3)), level);
    let by_b = Block::outer(scale(t, steep), cross(kappa.a, t))
        .plus_cross(scale(kappa.a, steep))
        .plus_outer(scale(level, slope * i3), an);
    let bent = -(steep * s);
    let own = Block::diagonal(bent * along)
        .plus_both(scale(t, bent), n)
        .plus_outer(scale(t, bent * along * s.like(-3.0)), t);
    [by_a, by_b, own]
}
