//! Yarns of a whole lattice, solved exactly in its smoother.
//!
//! Where cloth is much stiffer along its yarns of one direction than across, as in a sheet that falls, errors that are smooth along a yarn
//! and alternate from one to the next are neither smoothed by Jacobi nor seen on a coarser level. They are errors of the direction in which
//! each particle is held the least. So the smoother D of block Jacobi becomes D + N T Nᵀ: N holds that direction of each particle, the soft
//! eigenvector of its block, and T what neighbours on a yarn have to do with each other there, a number a pair. With G = Nᵀ D⁻¹ N,
//! W = D⁻¹ N G^-½ and K = 1 + G^½ T G^½ its inverse is D⁻¹ + W (K⁻¹ − 1) Wᵀ, and K falls apart into a tridiagonal matrix a yarn.

use super::{
    DAMPING,
    halves::{parts, parts_mut},
    numbers::{Numbers, Sixteen, Three, load, load3, plus, store},
};
use crate::{
    cores::Team,
    math::pack::dispatch,
    potential::pattern::{Lines, PADDING, Run},
};
use pulp::{Simd, WithSimd};

/// Least pivot of K, whose diagonal is 1 and more: a pair that left less is taken apart.
const LEAST: f32 = 0.1;
/// Powers of a block's inverse that stand for the one that leaves its soft eigenvector alone. Any direction would do; this one pays.
const POWERS: u32 = 6;

/// Least particles of a sheet on which they save iterations.
const FEWEST: usize = 3000;

/// What a smoother knows of the yarns across the rows of a lattice.
pub struct Yarns {
    /// Whether they smooth: they make an iteration some 4 % longer, and save none where a hand leads the cloth.
    pub are_used: bool,
    /// Particles of a row: neighbours on a yarn lie that far apart.
    step: usize,
    rows: usize,
    /// Pairs of neighbours on a yarn, and of second neighbours.
    pairs: [Option<Run>; 2],
    /// √damping W, and N G^½ while K is made, in planes.
    soft: Vec<f32>,
    scaled: Vec<f32>,
    /// K = (1 + F) P (1 + Fᵀ): F by the first particle of each pair, and the inverse of P.
    factors: Vec<f32>,
    inverses: Vec<f32>,
    /// Wᵀ of what is smoothed, then (K⁻¹ − 1) Wᵀ of it.
    own: Vec<f32>,
    solved: Vec<f32>,
}

impl Yarns {
    /// Of a sheet that is a whole lattice of so many rows of so many particles, if it is large.
    pub fn new(counts: [usize; 2], lines: &Lines) -> Option<Yarns> {
        (lines.particles >= FEWEST).then(|| Yarns::of_rows(counts, lines))
    }

    /// Of particles in so many rows of so many.
    pub fn of_rows([rows, step]: [usize; 2], lines: &Lines) -> Yarns {
        let run = |distance: usize| {
            let is_sought = |run: &&Run| run.is_padded && run.second - run.first == distance;
            lines.runs.iter().find(is_sought).copied()
        };
        let (zeros, planes) = (vec![0.0; lines.plane], vec![0.0; 3 * lines.plane]);
        Yarns {
            are_used: false,
            step,
            rows,
            pairs: [run(step), run(2 * step)],
            soft: planes.clone(),
            scaled: planes,
            factors: zeros.clone(),
            inverses: zeros.clone(),
            own: zeros.clone(),
            solved: zeros,
        }
    }

    /// Takes over a matrix.
    pub fn set(&mut self, numbers: &Numbers, team: &Team) {
        let Yarns { pairs, soft, scaled, factors, inverses, own, .. } = self;
        let half = numbers.inverses.len() / 2;
        let middle = half * PADDING;
        let (low, high) = numbers.inverses.split_at(half);
        let ([soft, soft_high], [to, to_high]) = (parts_mut(soft, middle), parts_mut(scaled, middle));
        team.both(
            || dispatch(Soften { damped: low, soft, scaled: to }),
            || dispatch(Soften { damped: high, soft: soft_high, scaled: to_high }),
        );
        own.fill(0.0);
        for (run, to) in pairs.iter().zip([factors, own]) {
            let (low, high) = to.split_at_mut(middle);
            if let Some(run) = run {
                team.both(
                    || dispatch(Couple { numbers, run, scaled, to: low, from: 0 }),
                    || dispatch(Couple { numbers, run, scaled, to: high, from: middle }),
                );
            }
        }
        // Second neighbours count as held by as much: what bending does to the others alone would leave K indefinite.
        inverses.fill(1.0);
        if let Some(run) = pairs[1] {
            for (at, size) in own[..run.len].iter().map(|pair| pair.abs()).enumerate() {
                inverses[at] += size;
                inverses[run.second + at] += size;
            }
        }
        dispatch(Eliminate(self));
    }

    /// Adds what yarns add to a smoothed vector, or takes it off, when `own` of the halves is known.
    pub fn correct(&mut self, team: &Team, sign: f32, x: &mut [f32], middle: usize) {
        dispatch(Solve(self));
        let Yarns { soft, own, .. } = self;
        let ([soft, soft_high], [x, x_high]) = (parts(soft, middle), parts_mut(x, middle));
        let (own, own_high) = own.split_at(x[0].len());
        team.both(
            || dispatch(Add { sign, soft, own, x }),
            || dispatch(Add { sign, soft: soft_high, own: own_high, x: x_high }),
        );
    }

    /// Who finds `own` in the rows before the middle and in the others.
    pub fn halves(&mut self, middle: usize) -> [Own<'_>; 2] {
        let [soft, soft_high] = parts(&self.soft, middle);
        let (own, own_high) = self.own.split_at_mut(soft[0].len());
        [Own { soft, own }, Own { soft: soft_high, own: own_high }]
    }
}

/// Wᵀ in some rows.
pub struct Own<'a> {
    soft: [&'a [f32]; 3],
    own: &'a mut [f32],
}

impl Own<'_> {
    /// Takes a register of what is smoothed.
    #[inline(always)]
    pub fn take<S: Simd>(&mut self, simd: S, at: usize, value: Three<S>) {
        let [a, b, c] = self.soft;
        let soft = [load(simd, a, at), load(simd, b, at), load(simd, c, at)];
        store(simd, self.own, at, dot(simd, soft, value));
    }
}

/// Finds the soft directions of some rows from their damped inverses.
struct Soften<'a> {
    damped: &'a [Sixteen<6>],
    soft: [&'a mut [f32]; 3],
    scaled: [&'a mut [f32]; 3],
}

impl WithSimd for Soften<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Soften { damped, soft, scaled } = self;
        for (chunk, Sixteen(own)) in damped.iter().enumerate() {
            let (mut to, mut other) = ([[0.0; PADDING]; 3], [[0.0; PADDING]; 3]);
            for k in 0..PADDING {
                let [a, b, c, d, e, f] = [0, 1, 2, 3, 4, 5].map(|number| own[number][k]);
                let times = |v: [f32; 3]| {
                    [
                        a * v[0] + b * v[1] + d * v[2],
                        b * v[0] + c * v[1] + e * v[2],
                        d * v[0] + e * v[1] + f * v[2],
                    ]
                };
                // Powers of the inverse leave the eigenvector, from the column that has most of it.
                let mut v = if a >= c && a >= f {
                    [a, b, d]
                } else if c >= f {
                    [b, c, e]
                } else {
                    [d, e, f]
                };
                let trace = a + c + f;
                for _ in 0..POWERS {
                    v = times(v).map(|v| v / trace);
                }
                let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
                let n = v.map(|v| v / length);
                let p = times(n);
                let root = (n[0] * p[0] + n[1] * p[1] + n[2] * p[2]).sqrt();
                let moves = trace > 0.0 && root > 0.0;
                for i in 0..3 {
                    to[i][k] = if moves { p[i] / root } else { 0.0 };
                    other[i][k] = if moves { n[i] * (root / DAMPING.sqrt()) } else { 0.0 };
                }
            }
            let rows = chunk * PADDING..(chunk + 1) * PADDING;
            for i in 0..3 {
                soft[i][rows.clone()].copy_from_slice(&to[i]);
                scaled[i][rows.clone()].copy_from_slice(&other[i]);
            }
        }
    }
}

/// Finds what the pairs of a run have to do with each other in their soft directions, in some rows.
struct Couple<'a> {
    numbers: &'a Numbers,
    run: &'a Run,
    scaled: &'a [f32],
    to: &'a mut [f32],
    from: usize,
}

impl WithSimd for Couple<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Couple { numbers, run, scaled, to, from } = self;
        let plane = numbers.lines.plane;
        let zero = [simd.splat_f32s(0.0); 3];
        for at in (0..to.len()).step_by(S::F32_LANES) {
            let row = from + at;
            if row >= run.len {
                break;
            }
            let block = &numbers.blocks[(run.at + row) / PADDING];
            let block = block.load(simd, row % PADDING / S::F32_LANES);
            let of_other = plus(simd, block, load3(simd, scaled, plane, run.second + row), zero);
            store(simd, to, at, dot(simd, load3(simd, scaled, plane, row), of_other));
        }
    }
}

#[inline(always)]
fn dot<S: Simd>(simd: S, a: Three<S>, b: Three<S>) -> S::f32s {
    simd.mul_add_f32s(a[0], b[0], simd.mul_add_f32s(a[1], b[1], simd.mul_f32s(a[2], b[2])))
}

/// Factors K, whose diagonal is where its pivots' inverses belong, and whose pairs are where its factors do.
struct Eliminate<'a>(&'a mut Yarns);

impl WithSimd for Eliminate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Yarns { step, rows, factors, inverses, .. } = self.0;
        for first in (0..*rows - 1).map(|row| row * *step) {
            let (pivots, next) = inverses[first..].split_at_mut(*step);
            for ((pivot, next), factor) in pivots.iter().zip(next).zip(&mut factors[first..]) {
                let part = *factor / *pivot;
                let left = *next - part * *factor;
                let stays = left > LEAST;
                *next = if stays { left } else { *next };
                *factor = if stays { part } else { 0.0 };
            }
        }
        inverses.iter_mut().for_each(|pivot| *pivot = 1.0 / *pivot);
    }
}

/// Finds (K⁻¹ − 1) Wᵀ of what is smoothed.
struct Solve<'a>(&'a mut Yarns);

impl WithSimd for Solve<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Yarns { step, rows, factors, inverses, own, solved, .. } = self.0;
        let step = *step;
        solved[..step].copy_from_slice(&own[..step]);
        for first in (1..*rows).map(|row| row * step) {
            let (before, to) = solved.split_at_mut(first);
            let before = before[first - step..].iter().zip(&factors[first - step..]);
            for ((to, own), (before, factor)) in to[..step].iter_mut().zip(&own[first..]).zip(before) {
                *to = own - factor * before;
            }
        }
        let last = (*rows - 1) * step;
        for first in (0..*rows).rev().map(|row| row * step) {
            let (to, behind) = solved[first..].split_at_mut(step);
            for (to, inverse) in to.iter_mut().zip(&inverses[first..]) {
                *to *= inverse;
            }
            if first < last {
                for ((to, behind), factor) in to.iter_mut().zip(behind).zip(&factors[first..]) {
                    *to -= factor * *behind;
                }
            }
            for (own, to) in own[first..].iter_mut().zip(&*to) {
                *own = to - *own;
            }
        }
    }
}

/// Adds W times a vector to some rows, or takes it off.
struct Add<'a> {
    sign: f32,
    soft: [&'a [f32]; 3],
    own: &'a [f32],
    x: [&'a mut [f32]; 3],
}

impl WithSimd for Add<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (x, soft) in self.x.into_iter().zip(self.soft) {
            for (x, (soft, own)) in x.iter_mut().zip(soft.iter().zip(self.own)) {
                *x += self.sign * soft * own;
            }
        }
    }
}
