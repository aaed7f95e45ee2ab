//! Hysteretic laws: force over strain inside a measured envelope, the history held by one scalar `p` per element.
//!
//! With `mid` = (loading + unloading)/2, `half` = (loading − unloading)/2 ≥ 0 and g(x) = ∫₀ˣ half,
//!
//! ```text
//! F(x, p) = mid(x) + half(x)·clamp(u, −1, 1),   u = k (g(x) − p)
//! ```
//!
//! is the derivative of a C¹ potential (Huber's function of g − p), never leaves the envelope, dissipates on every closed
//! path and holds its force under tremor. `p` moves only in `commit`. The law knows no units, no time and no direction.

use crate::{
    fabric::curve::{Curves, Knot, Place},
    math::pack::Pack,
};
use pulp::Simd;

/// Force, tangent stiffness and stored energy of a law at a strain.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Response {
    /// Conjugate force.
    pub force: f64,
    /// Tangent stiffness, d force / d strain.
    pub stiffness: f64,
    /// Incremental potential: the integral of the force over the strain, at the given internal variable.
    pub energy: f64,
}

/// The envelope at one strain: both branches with their slopes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Branches {
    /// Strain.
    pub x: f64,
    /// Force and slope on the loading (upper) branch.
    pub loading: [f64; 2],
    /// Force and slope on the unloading (lower) branch.
    pub unloading: [f64; 2],
}

/// Why an envelope makes no law.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Unfit {
    /// The unloading branch lies above the loading branch.
    #[error("the unloading branch lies above the loading branch at strain {0:.4}")]
    Crossing(f64),
    /// A branch falls with the strain.
    #[error("a branch falls with growing strain at strain {0:.4}")]
    Falling(f64),
    /// A number is not finite or the strains do not increase.
    #[error("the curve is not made of finite numbers over increasing strains")]
    NotACurve,
}

/// Rounding that is forgiven when a force is compared with the envelope, relative to both.
pub const ROUNDING: f64 = 1e-12;

/// Force over strain with rate-independent hysteresis held by one scalar `p`.
#[derive(Clone, Debug)]
pub struct Law {
    /// mid and half over one knot vector.
    curves: Curves<2>,
    /// k [1 / unit of g] and 1/k, both kept: this is the innermost loop, and divisions are slow.
    steepness: f64,
    stick: f64,
    virgin: f64,
}

impl Law {
    /// A law from its envelope, given at two strains or more, with the stick 1/k [force × strain] and the virgin `p`.
    /// Outside the given strains both branches go on in parallel, along the middle of the two end slopes.
    pub fn from_envelope(envelope: &[Branches], stick: f64, virgin: f64) -> Result<Law, Unfit> {
        let numbers = |b: &Branches| [b.x, b.loading[0], b.loading[1], b.unloading[0], b.unloading[1]];
        let increasing = envelope.windows(2).all(|b| b[0].x < b[1].x);
        let finite = envelope.iter().flat_map(numbers).all(f64::is_finite) && virgin.is_finite();
        if envelope.len() < 2 || !increasing || !finite || stick.is_nan() || stick <= 0.0 {
            return Err(Unfit::NotACurve);
        }
        let last = envelope.len() - 1;
        let force = envelope.iter().fold(0.0, |f: f64, b| f.max(b.loading[0].abs()));
        let half_at = |i: usize| 0.5 * (envelope[i].loading[0] - envelope[i].unloading[0]);
        if let Some(i) = (0..=last).find(|&i| half_at(i) < -1e-9 * force) {
            return Err(Unfit::Crossing(envelope[i].x));
        }
        let knots: Vec<Knot<2>> = envelope
            .iter()
            .enumerate()
            .map(|(i, b)| {
                let mid = [0, 1].map(|d| 0.5 * (b.loading[d] + b.unloading[d]));
                let half = half_at(i).max(0.0);
                // The end slope of half is 0, so that half stays constant outside. A slope of at most three times value
                // over width keeps a cubic of positive ends positive.
                let half_slope = if i == 0 || i == last {
                    0.0
                } else {
                    let slope = 0.5 * (b.loading[1] - b.unloading[1]);
                    slope
                        .max(-3.0 * half / (envelope[i + 1].x - b.x))
                        .min(3.0 * half / (b.x - envelope[i - 1].x))
                };
                Knot { x: b.x, values: [mid[0], half], slopes: [mid[1], half_slope] }
            })
            .collect();
        let law = Law { curves: Curves::through(&knots), steepness: 1.0 / stick, stick, virgin };
        law.verify(&knots)?;
        Ok(law)
    }

    /// A linear law without hysteresis.
    pub fn linear(slope: f64) -> Law {
        let knot = |x: f64| Knot { x, values: [slope * x, 0.0], slopes: [slope, 0.0] };
        Law { curves: Curves::through(&[knot(-1.0), knot(1.0)]), steepness: 1.0, stick: 1.0, virgin: 0.0 }
    }

    fn verify(&self, knots: &[Knot<2>]) -> Result<(), Unfit> {
        let force = knots.iter().fold(0.0, |f: f64, k| f.max(k.values[0].abs()));
        let slope = force / (knots[knots.len() - 1].x - knots[0].x);
        for pair in knots.windows(2) {
            for eighth in 0..=8 {
                let x = pair[0].x + f64::from(eighth) / 8.0 * (pair[1].x - pair[0].x);
                let [mid, half] = self.curves.at(x);
                // A little is forgiven: a measured branch may be flat within its noise.
                if mid.slope - half.slope.abs() < -0.02 * slope {
                    return Err(Unfit::Falling(x));
                }
            }
        }
        Ok(())
    }

    /// Internal variable of a virgin element.
    pub fn virgin(&self) -> f64 {
        self.virgin
    }

    /// 1/k, the way of `p` from the middle of the envelope to sliding [force × strain].
    pub fn stick(&self) -> f64 {
        self.stick
    }

    /// Response at strain `x` with the internal variable at `p`.
    #[inline]
    pub fn evaluate(&self, x: f64, p: f64) -> Response {
        let [mid, half] = self.curves.at(x);
        let stretch = half.integral - p;
        let u = self.steepness * stretch;
        if u.abs() < 1.0 {
            Response {
                force: mid.value + half.value * u,
                stiffness: mid.slope + half.slope * u + self.steepness * half.value * half.value,
                energy: mid.integral + 0.5 * u * stretch,
            }
        } else {
            let sign = u.signum();
            Response {
                force: mid.value + half.value * sign,
                stiffness: mid.slope + half.slope * sign,
                energy: mid.integral + stretch.abs() - 0.5 * self.stick,
            }
        }
    }

    /// The law for packs of strains.
    pub fn lanes(&self) -> Lanes<'_> {
        Lanes { law: self, place: self.curves.start() }
    }

    /// `sliding` is the second derivative in g [1 / unit of g] where the law slides.
    #[inline(always)]
    fn respond<S: Simd>(
        &self,
        [mid, half]: [[Pack<S>; 3]; 2],
        x: Pack<S>,
        p: Pack<S>,
        sliding: Pack<S>,
    ) -> [Pack<S>; 3] {
        let stretch = half[2] - p;
        let one = x.like(1.0);
        let u = stretch * x.like(self.steepness);
        // u limited to [−1, 1]; a number that is none passes the first choice and stays none.
        let limited = one.select_less(u, one, u);
        let limited = limited.select_less(-one, -one, limited);
        let size = u.abs();
        let sticks = size.select_less(one, x.like(self.steepness), sliding);
        let force = half[0].mul_add(limited, mid[0]);
        let stiffness = half[1].mul_add(limited, mid[1]);
        let stiffness = (half[0] * half[0]).mul_add(sticks, stiffness);
        let bent = (u * stretch) * x.like(0.5);
        let slid = stretch * limited - x.like(0.5 * self.stick);
        [force, stiffness, mid[2] + size.select_less(one, bent, slid)]
    }

    /// Internal variable after the step that ended at strain `x`.
    #[inline]
    pub fn commit(&self, x: f64, p: f64) -> f64 {
        let g = self.curves.at(x)[1].integral;
        // Not `clamp`, which panics when the strain is not a number; so `p` keeps its old value then.
        p.max(g - self.stick).min(g + self.stick)
    }

    /// Energy lost when the internal variable moved from `old` to `new` [force × strain].
    pub fn dissipated(&self, old: f64, new: f64) -> f64 {
        (new - old).abs()
    }

    /// Force on the loading branch.
    pub fn loading(&self, x: f64) -> f64 {
        self.envelope(x)[1]
    }

    /// Force on the unloading branch.
    pub fn unloading(&self, x: f64) -> f64 {
        self.envelope(x)[0]
    }

    /// Forces that the law allows at strain `x`: `[lower, upper]`.
    #[inline]
    pub fn envelope(&self, x: f64) -> [f64; 2] {
        let [mid, half] = self.curves.at(x);
        [mid.value - half.value, mid.value + half.value]
    }

    /// Both branches and their slopes at strain `x`.
    pub fn branches(&self, x: f64) -> Branches {
        let [mid, half] = self.curves.at(x);
        Branches {
            x,
            loading: [mid.value + half.value, mid.slope + half.slope],
            unloading: [mid.value - half.value, mid.slope - half.slope],
        }
    }

    /// g: half the area that the envelope encloses between strain 0 and `x` [force × strain].
    pub fn enclosed(&self, x: f64) -> f64 {
        self.curves.at(x)[1].integral
    }

    /// Strains of the knots, in order: what a plot needs to meet every bend.
    pub fn knots(&self) -> impl Iterator<Item = f64> + '_ {
        self.curves.knots()
    }

    /// Strains at which the law allows `force`: `[min, max]`, from the loading to the unloading branch.
    /// Infinite where a branch never reaches the force.
    pub fn strains(&self, force: f64) -> [f64; 2] {
        // A hair of force keeps a flat piece of the unloading branch on the right side of rounding.
        [self.reach(force, 1.0), self.reach(force + 1e-12 * force.abs(), -1.0)]
    }

    /// Strain at which an element of this slip state in [−1, 1] pulls with `force`; infinite where none does.
    pub fn strain_at(&self, force: f64, slip: f64) -> f64 {
        self.reach(force, slip)
    }

    /// Strain where the branch `mid + side·half` passes `force`.
    fn reach(&self, force: f64, side: f64) -> f64 {
        let branch = |x: f64| {
            let [mid, half] = self.curves.at(x);
            [mid.value + side * half.value - force, mid.slope + side * half.slope]
        };
        // On a flat piece the loading branch gives its left end, the unloading branch its right end.
        let short = |value: f64| if side > 0.0 { value < 0.0 } else { value <= 0.0 };
        let knots = self.curves.knots();
        let [mut low, mut high] = [f64::NEG_INFINITY, f64::INFINITY];
        for x in knots {
            if short(branch(x)[0]) {
                low = x;
            } else {
                high = x;
                break;
            }
        }
        if low.is_infinite() || high.is_infinite() {
            let [knot, outward] = if low.is_infinite() { [high, -1.0] } else { [low, 1.0] };
            let [value, slope] = [branch(knot)[0], branch(knot + outward)[1]];
            return if slope > 0.0 { knot - value / slope } else { outward * f64::INFINITY };
        }
        let mut x = 0.5 * (low + high);
        for _ in 0..80 {
            let [value, slope] = branch(x);
            if short(value) {
                low = x;
            } else {
                high = x;
            }
            let newton = x - value / slope;
            let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
            if (next - x).abs() <= 1e-15 * (1.0 + x.abs()) || high - low <= 1e-16 {
                return next;
            }
            x = next;
        }
        x
    }
}

/// A law for packs of strains, one after the other.
#[derive(Clone, Copy, Debug)]
pub struct Lanes<'a> {
    law: &'a Law,
    place: Place<'a, 2>,
}

impl Lanes<'_> {
    #[inline(always)]
    fn look_up<S: Simd>(&mut self, simd: S, x: Pack<S>) -> [[Pack<S>; 3]; 2] {
        self.law.curves.at_lanes(simd, x, &mut self.place)
    }

    /// Force, tangent stiffness and energy in every lane: `evaluate` for a pack of strains.
    #[inline(always)]
    pub fn evaluate<S: Simd>(&mut self, simd: S, x: Pack<S>, p: Pack<S>) -> [Pack<S>; 3] {
        let curves = self.look_up(simd, x);
        self.law.respond(curves, x, p, x.like(0.0))
    }

    /// The same with the stiffness of the parabola in g that touches Huber's function at `x` and is nowhere below it: half²/|g − p| more
    /// than the tangent's where the law slides. A step by it overestimates what the way costs, so it does not lead beyond where the
    /// force turns.
    #[inline(always)]
    pub fn bound<S: Simd>(&mut self, simd: S, x: Pack<S>, p: Pack<S>) -> [Pack<S>; 3] {
        let curves = self.look_up(simd, x);
        let sliding = (curves[1][2] - p).abs().inverse();
        self.law.respond(curves, x, p, sliding)
    }

    /// The response, and how far a force lies outside the envelope beyond the law's own rounding (not above 0 inside).
    #[inline(always)]
    pub fn account<S: Simd>(
        &mut self,
        simd: S,
        x: Pack<S>,
        p: Pack<S>,
        force: Pack<S>,
    ) -> ([Pack<S>; 3], Pack<S>) {
        let curves = self.look_up(simd, x);
        let (mid, half) = (curves[0][0], curves[1][0]);
        let misfit = (force - mid).abs() - half - (mid.abs() + half) * x.like(ROUNDING);
        (self.law.respond(curves, x, p, x.like(0.0)), misfit)
    }

    /// `commit` in every lane.
    #[inline(always)]
    pub fn commit<S: Simd>(&mut self, simd: S, x: Pack<S>, p: Pack<S>) -> Pack<S> {
        let g = self.look_up(simd, x)[1][2];
        let (low, high) = (g - x.like(self.law.stick), g + x.like(self.law.stick));
        let p = p.max(low);
        high.select_less(p, high, p)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        fabric::parameters::{Bending, Chosen},
        math::pack::{WIDTH, all_instructions, dispatch, with_instructions},
    };
    use pulp::WithSimd;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    struct Bound<'a>(&'a Law, f64, f64);

    impl WithSimd for Bound<'_> {
        type Output = [f64; 3];

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> [f64; 3] {
            let Bound(law, x, p) = self;
            law.lanes().bound(simd, Pack::splat(simd, x), Pack::splat(simd, p)).map(|pack| {
                let mut lanes = [0.0; WIDTH];
                pack.store(&mut lanes, 0);
                lanes[0]
            })
        }
    }

    #[test]
    fn no_energy_of_a_law_lies_above_its_bounding_parabola() {
        // Bending's envelope is as wide everywhere, so g is the strain times a constant and its parabola one in the strain.
        let law = Bending { b: 1e-5, width: 2e-3 }.law(&Chosen::default()).unwrap();
        for arch in all_instructions() {
            let mut rng = Pcg64Mcg::seed_from_u64(1);
            let (mut slid, mut tangents) = (0, 0);
            for _ in 0..2000 {
                let [x, y] = [(); 2].map(|()| rng.random_range(-100.0..100.0));
                let p = law.enclosed(rng.random_range(-100.0..100.0));
                let [force, stiffness, energy] = with_instructions(arch, || dispatch(Bound(&law, x, p)));
                let [here, there] = [law.evaluate(x, p), law.evaluate(y, p)];
                assert!((force - here.force).abs() < 1e-14 && (energy - here.energy).abs() < 1e-12);
                let above = |stiffness: f64| energy + force * (y - x) + 0.5 * stiffness * (y - x).powi(2);
                let rounding = 1e-12 * (energy.abs() + there.energy.abs());
                assert!(there.energy <= above(stiffness) + rounding, "{x} to {y} with {p}");
                slid += u32::from((force - 1e-5 * x).abs() > 0.99e-3);
                tangents += u32::from(there.energy > above(here.stiffness) + rounding);
            }
            assert!(slid > 1000 && tangents > 500, "{slid} slid, {tangents} lie above the tangent's");
        }
    }
}
