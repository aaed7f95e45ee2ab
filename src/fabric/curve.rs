//! C¹ piecewise cubics over one shared knot vector: value, slope and integral, each exact.
//!
//! One lookup serves all `N` curves. Outside the knots every curve goes on as a straight line. This file does not
//! choose slopes of its own except by `monotone_slopes`, for curves that are known only by samples [Steffen 1990].

use crate::math::pack::{Mask, Pack, WIDTH};
use pulp::Simd;

/// One curve at one abscissa.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sample {
    /// Value.
    pub value: f64,
    /// First derivative.
    pub slope: f64,
    /// Integral from 0 to the abscissa.
    pub integral: f64,
}

/// What `N` curves are at one knot: the abscissa, and value and slope of each curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Knot<const N: usize> {
    /// Abscissa.
    pub x: f64,
    /// Values.
    pub values: [f64; N],
    /// Slopes.
    pub slopes: [f64; N],
}

/// Cubics between two knots, in powers of the distance from the left one, with the integrals up to there.
#[derive(Clone, Copy, Debug)]
struct Piece<const N: usize> {
    x: f64,
    /// Abscissae that it holds for, from the first on and below the second.
    span: [f64; 2],
    cubic: [[f64; 4]; N],
    integral: [f64; N],
}

/// Where curves were looked up last: neighbours strain nearly alike, so mostly one piece serves them all, and the next ones.
#[derive(Clone, Copy, Debug)]
pub struct Place<'a, const N: usize>(&'a Piece<N>);

/// Buckets of the lookup per knot: where knots lie close together, few share one.
const BUCKETS: usize = 16;

type PiecesOf<S, const N: usize> = (Pack<S>, [[Pack<S>; 4]; N], [Pack<S>; N]);

/// `N` curves over one knot vector.
#[derive(Clone, Debug)]
pub struct Curves<const N: usize> {
    /// One piece per interval, then one straight piece from the last knot on.
    pieces: Vec<Piece<N>>,
    /// First piece that can hold an abscissa of the bucket: makes the lookup O(1).
    buckets: Vec<u16>,
    first: f64,
    per_bucket: f64,
    /// Straight piece before the first knot, in powers of the (negative) distance from it.
    before: Piece<N>,
}

impl<const N: usize> Curves<N> {
    /// Curves through `knots`: at least two, finite, abscissae strictly increasing (anything else is a bug here: panics).
    pub fn through(knots: &[Knot<N>]) -> Curves<N> {
        assert!(knots.len() >= 2 && knots.len() < usize::from(u16::MAX), "two knots make a curve");
        assert!(knots.windows(2).all(|k| k[0].x < k[1].x), "knots increase strictly");
        let mut pieces: Vec<Piece<N>> = Vec::with_capacity(knots.len());
        let mut integral = [0.0; N];
        for pair in knots.windows(2) {
            let width = pair[1].x - pair[0].x;
            let cubic = std::array::from_fn(|n| hermite(pair, n, width));
            pieces.push(Piece { x: pair[0].x, span: [pair[0].x, pair[1].x], cubic, integral });
            integral = std::array::from_fn(|n| integral[n] + antiderivative(&cubic[n], width));
        }
        let [first, last] = [&knots[0], &knots[knots.len() - 1]];
        let line = |k: &Knot<N>| std::array::from_fn(|n| [k.values[n], k.slopes[n], 0.0, 0.0]);
        pieces.push(Piece { x: last.x, span: [last.x, f64::INFINITY], cubic: line(last), integral });
        let span = [f64::NEG_INFINITY, first.x];
        let before = Piece { x: first.x, span, cubic: line(first), integral: [0.0; N] };
        let count = BUCKETS * knots.len();
        let per_bucket = count as f64 / (last.x - first.x);
        let buckets = (0..count)
            .map(|b| {
                let start = first.x + b as f64 / per_bucket;
                knots.iter().rposition(|k| k.x <= start).unwrap_or(0).min(knots.len() - 2) as u16
            })
            .collect();
        let mut curves = Curves { pieces, buckets, first: first.x, per_bucket, before };
        let at_zero = curves.at(0.0).map(|s| s.integral);
        for piece in curves.pieces.iter_mut().chain([&mut curves.before]) {
            for (integral, zero) in piece.integral.iter_mut().zip(at_zero) {
                *integral -= zero;
            }
        }
        curves
    }

    /// All curves at `x`.
    #[inline]
    pub fn at(&self, x: f64) -> [Sample; N] {
        let piece = self.piece(x);
        let d = x - piece.x;
        std::array::from_fn(|n| {
            let [a, b, c, e] = piece.cubic[n];
            Sample {
                value: a + d * (b + d * (c + d * e)),
                slope: b + d * (2.0 * c + d * 3.0 * e),
                integral: piece.integral[n] + antiderivative(&piece.cubic[n], d),
            }
        })
    }

    /// Where looking up begins.
    pub fn start(&self) -> Place<'_, N> {
        Place(&self.before)
    }

    /// All curves in every lane: value, slope and integral. Looks first where it was last.
    #[inline(always)]
    pub fn at_lanes<'a, S: Simd>(
        &'a self,
        simd: S,
        x: Pack<S>,
        place: &mut Place<'a, N>,
    ) -> [[Pack<S>; 3]; N] {
        let is_there = x.outside(place.0.span).is_empty();
        let (start, cubics, integrals) =
            if is_there { place.0.in_all(simd) } else { self.pieces_of(simd, x, place) };
        let d = x - start;
        let mut out = [[d; 3]; N];
        for n in 0..N {
            let [a, b, c, e] = cubics[n];
            let integral = e.mul_add(d * d.like(0.25), c * d.like(1.0 / 3.0));
            let integral = integral.mul_add(d, b * d.like(0.5)).mul_add(d, a);
            out[n] = [
                e.mul_add(d, c).mul_add(d, b).mul_add(d, a),
                (e * d.like(3.0)).mul_add(d, c * d.like(2.0)).mul_add(d, b),
                integral.mul_add(d, integrals[n]),
            ];
        }
        out
    }

    /// Start, cubics and integrals of the piece of each lane; the place becomes the first one's.
    #[inline(always)]
    fn pieces_of<'a, S: Simd>(&'a self, simd: S, x: Pack<S>, place: &mut Place<'a, N>) -> PiecesOf<S, N> {
        let mut lanes = [0.0; WIDTH];
        x.store(&mut lanes, 0);
        let first = self.piece(lanes[0]);
        *place = Place(first);
        let (mut of, mut left) = (first.in_all(simd), x.outside(first.span));
        for &lane in &lanes[1..S::F64_LANES] {
            if left.is_empty() {
                break;
            }
            if !first.holds(lane) {
                let piece = self.piece(lane);
                let others = x.outside(piece.span);
                of = piece.but_in(others, simd, of);
                left = left.and(others);
            }
        }
        of
    }

    /// Abscissae of the knots.
    pub fn knots(&self) -> impl Iterator<Item = f64> + '_ {
        self.pieces.iter().map(|p| p.x)
    }

    #[inline]
    fn piece(&self, x: f64) -> &Piece<N> {
        let position = (x - self.first) * self.per_bucket;
        // Not a number comes here too: it must give a number back as not a number, not panic.
        if position < 0.0 || position.is_nan() {
            return &self.before;
        }
        let bucket = (position as usize).min(self.buckets.len() - 1);
        let mut index = usize::from(self.buckets[bucket]);
        while index + 1 < self.pieces.len() && x >= self.pieces[index + 1].x {
            index += 1;
        }
        &self.pieces[index]
    }
}

impl<const N: usize> Piece<N> {
    #[inline(always)]
    fn holds(&self, x: f64) -> bool {
        let [from, to] = self.span;
        from <= x && x < to
    }

    #[inline(always)]
    fn in_all<S: Simd>(&self, simd: S) -> PiecesOf<S, N> {
        let start = Pack::splat(simd, self.x);
        let (mut numbers, mut sums) = ([[start; 4]; N], [start; N]);
        for n in 0..N {
            for (number, value) in numbers[n].iter_mut().zip(self.cubic[n]) {
                *number = Pack::splat(simd, value);
            }
            sums[n] = Pack::splat(simd, self.integral[n]);
        }
        (start, numbers, sums)
    }

    /// This piece but in some lanes, which have others.
    #[inline(always)]
    fn but_in<S: Simd>(&self, lanes: Mask<S>, simd: S, others: PiecesOf<S, N>) -> PiecesOf<S, N> {
        let choose = |own: f64, other: Pack<S>| lanes.select(other, Pack::splat(simd, own));
        let (mut start, mut numbers, mut sums) = others;
        start = choose(self.x, start);
        for n in 0..N {
            for (number, value) in numbers[n].iter_mut().zip(self.cubic[n]) {
                *number = choose(value, *number);
            }
            sums[n] = choose(self.integral[n], sums[n]);
        }
        (start, numbers, sums)
    }
}

fn hermite<const N: usize>(pair: &[Knot<N>], n: usize, width: f64) -> [f64; 4] {
    let [left, right] = [pair[0].slopes[n], pair[1].slopes[n]];
    let chord = (pair[1].values[n] - pair[0].values[n]) / width;
    let c = (3.0 * chord - 2.0 * left - right) / width;
    let e = (left + right - 2.0 * chord) / (width * width);
    [pair[0].values[n], left, c, e]
}

#[inline]
fn antiderivative(cubic: &[f64; 4], d: f64) -> f64 {
    // Products: a division by 3 costs more than all the rest.
    d * (cubic[0] + d * (cubic[1] * 0.5 + d * (cubic[2] * (1.0 / 3.0) + d * (cubic[3] * 0.25))))
}

/// Slopes at the knots that keep the interpolant monotone wherever the samples are [Steffen 1990].
pub fn monotone_slopes(x: &[f64], y: &[f64]) -> Vec<f64> {
    let last = x.len() - 1;
    let chord = |i: usize| (y[i + 1] - y[i]) / (x[i + 1] - x[i]);
    let end = |near: f64, far: f64, h: f64, next: f64| {
        let slope = near * (1.0 + h / (h + next)) - far * h / (h + next);
        if slope * near <= 0.0 { 0.0 } else { slope.signum() * slope.abs().min(2.0 * near.abs()) }
    };
    (0..=last)
        .map(|i| match i {
            _ if last == 1 => chord(0),
            0 => end(chord(0), chord(1), x[1] - x[0], x[2] - x[1]),
            i if i == last => end(chord(i - 1), chord(i - 2), x[i] - x[i - 1], x[i - 1] - x[i - 2]),
            _ => {
                let [s0, s1] = [chord(i - 1), chord(i)];
                let [h0, h1] = [x[i] - x[i - 1], x[i + 1] - x[i]];
                let parabola = (s0 * h1 + s1 * h0) / (h0 + h1);
                let sign = if s0 * s1 <= 0.0 { 0.0 } else { s0.signum() };
                2.0 * sign * s0.abs().min(s1.abs()).min(0.5 * parabola.abs())
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::pack::{all_instructions, dispatch, with_instructions};
    use pulp::WithSimd;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    fn wavy() -> Curves<2> {
        let knots: Vec<Knot<2>> = [-1.0, -0.4, -0.39, 0.0, 0.2, 1.5]
            .iter()
            .map(|&x: &f64| Knot { x, values: [x.sin(), x * x], slopes: [x.cos(), 2.0 * x] })
            .collect();
        Curves::through(&knots)
    }

    #[test]
    fn a_quadratic_comes_back_exactly_with_slope_and_integral() {
        for x in [-1.0, -0.7, -0.395, 0.0, 0.1, 0.2, 1.49, 1.5] {
            let [_, square] = wavy().at(x);
            assert!((square.value - x * x).abs() < 1e-14);
            assert!((square.slope - 2.0 * x).abs() < 1e-13);
            assert!((square.integral - x * x * x / 3.0).abs() < 1e-14);
        }
    }

    #[test]
    fn slope_and_integral_agree_with_differences_of_value_everywhere_and_outside() {
        let (curves, h) = (wavy(), 1e-5);
        for step in 0..400 {
            let x = -2.0 + 0.01137 * f64::from(step);
            for n in 0..2 {
                let [left, here, right] = [x - h, x, x + h].map(|x| curves.at(x)[n]);
                assert!(((right.value - left.value) / (2.0 * h) - here.slope).abs() < 1e-4);
                assert!(((right.integral - left.integral) / (2.0 * h) - here.value).abs() < 1e-4);
            }
        }
    }

    /// Value, slope and integral of both curves at eight abscissae at a time, each looked up from where the last ones were or from the start.
    struct Looked<'a> {
        curves: &'a Curves<2>,
        packs: &'a [[f64; WIDTH]],
        begins_anew: bool,
    }

    impl WithSimd for Looked<'_> {
        type Output = Vec<[[f64; WIDTH]; 6]>;

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
            let Looked { curves, packs, begins_anew } = self;
            let mut place = curves.start();
            let mut all = Vec::new();
            for pack in packs {
                let mut out = [[0.0; WIDTH]; 6];
                for from in (0..WIDTH).step_by(S::F64_LANES) {
                    if begins_anew {
                        place = curves.start();
                    }
                    let found = curves.at_lanes(simd, Pack::load(simd, pack, from), &mut place);
                    for (numbers, out) in found.as_flattened().iter().zip(&mut out) {
                        numbers.store(out, from);
                    }
                }
                all.push(out);
            }
            all
        }
    }

    #[test]
    fn packs_are_looked_up_as_numbers_are_wherever_the_last_ones_were() {
        let (curves, mut rng) = (wavy(), Pcg64Mcg::seed_from_u64(9));
        let strange = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0, -0.4, -0.39, 1.5];
        let packs: Vec<[f64; WIDTH]> = (0..2000)
            .map(|k| {
                let (middle, spread) = (rng.random_range(-2.0..2.0), [0.01, 0.3, 2.0][k % 3]);
                std::array::from_fn(|_| match rng.random_range(0..40) {
                    which if which < strange.len() && k % 2 == 0 => strange[which],
                    _ => middle + rng.random_range(-spread..spread),
                })
            })
            .collect();
        for arch in all_instructions() {
            let look = |begins_anew| {
                with_instructions(arch, || dispatch(Looked { curves: &curves, packs: &packs, begins_anew }))
            };
            let (found, anew) = (look(false), look(true));
            for ((found, anew), pack) in found.iter().zip(&anew).zip(&packs) {
                for (lane, &x) in pack.iter().enumerate() {
                    let bits = |numbers: &[[f64; WIDTH]; 6]| numbers.map(|number| number[lane].to_bits());
                    if x.is_finite() {
                        assert_eq!(bits(found), bits(anew), "{x} of {pack:?}");
                    }
                    let one = curves.at(x);
                    for (n, number) in found.iter().enumerate() {
                        let Sample { value, slope, integral } = one[n / 3];
                        let (own, exact) = (number[lane], [value, slope, integral][n % 3]);
                        let is_near = (own - exact).abs() < 1e-13 * (1.0 + exact.abs());
                        assert!(is_near || !x.is_finite() && !own.is_finite(), "{x}: {own} for {exact}");
                    }
                }
            }
        }
    }

    #[test]
    fn not_a_number_in_is_not_a_number_out() {
        assert!(wavy().at(f64::NAN)[0].value.is_nan());
        assert!(!wavy().at(f64::INFINITY)[0].value.is_finite());
    }

    #[test]
    fn monotone_samples_make_monotone_curves() {
        let x = [0.0, 0.1, 0.5, 0.6, 2.0, 2.1];
        let y = [0.0, 0.0, 0.3, 5.0, 5.1, 9.0];
        let slopes = monotone_slopes(&x, &y);
        let knots: Vec<Knot<1>> =
            (0..6).map(|i| Knot { x: x[i], values: [y[i]], slopes: [slopes[i]] }).collect();
        let curve = Curves::through(&knots);
        for step in 0..2100 {
            assert!(curve.at(f64::from(step) * 1e-3)[0].slope >= -1e-12);
        }
    }
}
