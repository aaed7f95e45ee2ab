//! The system's matrix times a vector, both in planes: whole registers of neighbouring particles.

use super::pattern::{Pattern, Run};
use crate::math::pack::{Pack, Pack3, WIDTH};
use pulp::{Simd, WithSimd};
use std::ops::Range;

/// Rows that are done with before the next ones begin, so that what goes with them stays in the nearest caches.
const TILE: usize = 512;

/// Blocks of a pattern times a vector: those of pairs whose first particle is one of some rows, and of these rows' diagonals.
pub struct Apply<'a> {
    /// Where blocks lie.
    pub pattern: &'a Pattern,
    /// Planes of the blocks.
    pub blocks: &'a [f64],
    /// Rows, the first a multiple of `PADDING`, and so the end where it is not the last.
    pub rows: Range<usize>,
    /// Planes of the vector.
    pub x: &'a [f64],
    /// Planes of the product; what is before the rows is left alone, and what pairs do not reach.
    pub out: &'a mut [f64],
}

impl Apply<'_> {
    /// Where the rows end that pairs reach whose first particle comes before `middle`.
    pub fn end(pattern: &Pattern, middle: usize) -> usize {
        let end = |run: &Run| match middle.saturating_sub(run.first).min(run.len) {
            0 => middle,
            before => run.second + before,
        };
        pattern.lines.runs.iter().map(end).fold(middle, usize::max)
    }
}

/// Three numbers of a vector in planes, per lane.
#[inline(always)]
fn load3<S: Simd>(simd: S, x: &[f64], plane: usize, at: usize) -> Pack3<S> {
    [Pack::load_at(simd, x, at), Pack::load_at(simd, x, plane + at), Pack::load_at(simd, x, 2 * plane + at)]
}

/// Row `k` of a matrix times a vector.
#[inline(always)]
fn row<S: Simd>(a: Pack<S>, b: Pack<S>, c: Pack<S>, x: Pack3<S>) -> Pack<S> {
    a.mul_add(x[0], b.mul_add(x[1], c * x[2]))
}

impl WithSimd for Apply<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Apply { pattern, blocks, rows, x, out } = self;
        let (plane, stride) = (pattern.lines.plane, pattern.lines.stride);
        let reached = Apply::end(pattern, rows.end);
        (0..3).for_each(|k| out[k * plane..][rows.start..reached].fill(0.0));
        for run in pattern.lines.runs.iter().filter(|run| !run.is_padded) {
            let pairs = part(run, &rows);
            if pairs.len() <= FEW {
                pairs.for_each(|k| {
                    add_one(blocks, stride, run.at + k, x, out, plane, [run.first + k, run.second + k])
                });
                continue;
            }
            for k in pairs.clone().step_by(S::F64_LANES) {
                // Zeros instead of the blocks of other runs behind this one: vectors have room behind them.
                let own = part9(simd, blocks, stride, run.at + k, (pairs.end - k).min(S::F64_LANES));
                forth(own, load3(simd, x, plane, run.second + k), out, plane, run.first + k);
                back(own, load3(simd, x, plane, run.first + k), out, plane, run.second + k);
            }
        }
        for start in rows.clone().step_by(TILE) {
            let tile = start..(start + TILE).min(rows.end);
            for at in tile.clone().step_by(S::F64_LANES) {
                let v = load3(simd, x, plane, at);
                let mut own = [Pack::splat(simd, 0.0); 9];
                for k in [0, 3, 4, 6, 7, 8] {
                    own[k] = Pack::load_at(simd, blocks, k * stride + at);
                }
                row(own[0], own[3], own[6], v).add_to(out, at);
                row(own[3], own[4], own[7], v).add_to(out, plane + at);
                row(own[6], own[7], own[8], v).add_to(out, 2 * plane + at);
            }
            for run in pattern.lines.runs.iter().filter(|run| run.is_padded) {
                let pairs = part(run, &tile).step_by(S::F64_LANES);
                if run.second - run.first > 2 * WIDTH {
                    for k in pairs {
                        let own = load9(simd, blocks, stride, run.at + k);
                        forth(own, load3(simd, x, plane, run.second + k), out, plane, run.first + k);
                        back(own, load3(simd, x, plane, run.first + k), out, plane, run.second + k);
                    }
                } else {
                    // What one line stores the next would load before it is there.
                    for k in pairs.clone() {
                        let own = load9(simd, blocks, stride, run.at + k);
                        forth(own, load3(simd, x, plane, run.second + k), out, plane, run.first + k);
                    }
                    for k in pairs {
                        let own = load9(simd, blocks, stride, run.at + k);
                        back(own, load3(simd, x, plane, run.first + k), out, plane, run.second + k);
                    }
                }
            }
        }
    }
}

/// The sum over some rows of (tr D)² |x|², D their diagonal blocks.
pub struct Weigh<'a> {
    /// Where blocks lie.
    pub pattern: &'a Pattern,
    /// Planes of the blocks.
    pub blocks: &'a [f64],
    /// Rows, the first a multiple of `PADDING`, and so the end where it is not the last.
    pub rows: Range<usize>,
    /// Planes of the vector.
    pub x: &'a [f64],
}

impl WithSimd for Weigh<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let Weigh { pattern, blocks, rows, x } = self;
        let (plane, stride) = (pattern.lines.plane, pattern.lines.stride);
        // Lanes keep their own sums, so that the width of the machine's registers does not change the order.
        let mut sums = [0.0; WIDTH];
        for at in rows.step_by(S::F64_LANES) {
            let v = load3(simd, x, plane, at);
            let trace = Pack::load_at(simd, blocks, at)
                + Pack::load_at(simd, blocks, 4 * stride + at)
                + Pack::load_at(simd, blocks, 8 * stride + at);
            (trace * trace * row(v[0], v[1], v[2], v)).add_to(&mut sums, at % WIDTH);
        }
        sums.iter().sum()
    }
}

/// Those of a run's pairs whose first particle is one of some rows.
fn part(run: &Run, rows: &Range<usize>) -> Range<usize> {
    let [start, end] = [rows.start, rows.end].map(|row| row.saturating_sub(run.first).min(run.len));
    start..end
}

/// Pairs that go faster one by one than as registers that they fill in part.
const FEW: usize = 2;

/// Adds what one pair gives.
#[inline(always)]
fn add_one(
    blocks: &[f64],
    stride: usize,
    at: usize,
    x: &[f64],
    out: &mut [f64],
    plane: usize,
    [a, b]: [usize; 2],
) {
    let block: [f64; 9] = std::array::from_fn(|k| blocks[k * stride + at]);
    let [of_a, of_b]: [[f64; 3]; 2] = [a, b].map(|n| std::array::from_fn(|k| x[k * plane + n]));
    for k in 0..3 {
        out[k * plane + a] +=
            block[3 * k] * of_b[0] + block[3 * k + 1] * of_b[1] + block[3 * k + 2] * of_b[2];
        out[k * plane + b] += block[k] * of_a[0] + block[3 + k] * of_a[1] + block[6 + k] * of_a[2];
    }
}

#[inline(always)]
fn load9<S: Simd>(simd: S, blocks: &[f64], stride: usize, at: usize) -> [Pack<S>; 9] {
    let mut own = [Pack::splat(simd, 0.0); 9];
    for (k, own) in own.iter_mut().enumerate() {
        *own = Pack::load_at(simd, blocks, k * stride + at);
    }
    own
}

#[inline(always)]
fn part9<S: Simd>(simd: S, blocks: &[f64], stride: usize, at: usize, len: usize) -> [Pack<S>; 9] {
    let mut own = [Pack::splat(simd, 0.0); 9];
    for (k, own) in own.iter_mut().enumerate() {
        *own = Pack::load_part(simd, &blocks[k * stride + at..][..len]);
    }
    own
}

#[inline(always)]
fn forth<S: Simd>(b: [Pack<S>; 9], x: Pack3<S>, out: &mut [f64], plane: usize, at: usize) {
    row(b[0], b[1], b[2], x).add_to(out, at);
    row(b[3], b[4], b[5], x).add_to(out, plane + at);
    row(b[6], b[7], b[8], x).add_to(out, 2 * plane + at);
}

#[inline(always)]
fn back<S: Simd>(b: [Pack<S>; 9], x: Pack3<S>, out: &mut [f64], plane: usize, at: usize) {
    row(b[0], b[3], b[6], x).add_to(out, at);
    row(b[1], b[4], b[7], x).add_to(out, plane + at);
    row(b[2], b[5], b[8], x).add_to(out, 2 * plane + at);
}
