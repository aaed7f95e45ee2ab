//! The finest level in single precision, plane by plane: whole registers of neighbouring particles, smoothed by block Jacobi.

use super::DAMPING;
use crate::potential::{
    pattern::{Pattern, Run},
    system::System,
};
use pulp::Simd;

/// Matrix, smoother and vectors of the finest level.
pub struct Stencil {
    runs: Vec<Run>,
    len: usize,
    plane: usize,
    stride: usize,
    /// Planes of the blocks, those of the diagonals whole.
    pub blocks: Vec<f32>,
    /// Damped inverses of the diagonal blocks: 00, 10, 11, 20, 21, 22.
    inverses: Vec<f32>,
    /// What it solves for.
    pub x: Vec<f32>,
    b: Vec<f32>,
    /// What is left.
    pub r: Vec<f32>,
}

type Three<S> = [<S as Simd>::f32s; 3];

#[inline(always)]
fn load<S: Simd>(_: S, list: &[f32], at: usize) -> S::f32s {
    S::as_simd_f32s(&list[at..at + S::F32_LANES]).0[0]
}

#[inline(always)]
fn store<S: Simd>(_: S, list: &mut [f32], at: usize, value: S::f32s) {
    S::as_mut_simd_f32s(&mut list[at..at + S::F32_LANES]).0[0] = value;
}

#[inline(always)]
fn load3<S: Simd>(simd: S, list: &[f32], plane: usize, at: usize) -> Three<S> {
    [load(simd, list, at), load(simd, list, plane + at), load(simd, list, 2 * plane + at)]
}

/// Row of a matrix times a vector.
#[inline(always)]
fn row<S: Simd>(simd: S, a: S::f32s, b: S::f32s, c: S::f32s, x: Three<S>) -> S::f32s {
    simd.mul_add_e_f32s(a, x[0], simd.mul_add_e_f32s(b, x[1], simd.mul_f32s(c, x[2])))
}

#[inline(always)]
fn load9<S: Simd>(simd: S, blocks: &[f32], stride: usize, at: usize) -> [S::f32s; 9] {
    let mut own = [simd.splat_f32s(0.0); 9];
    for (k, own) in own.iter_mut().enumerate() {
        *own = load(simd, blocks, k * stride + at);
    }
    own
}

/// Takes a block times a vector from `out`.
#[inline(always)]
fn take<S: Simd>(simd: S, b: [S::f32s; 9], x: Three<S>, out: &mut [f32], plane: usize, at: usize) {
    for k in 0..3 {
        let at = k * plane + at;
        let product = row(simd, b[3 * k], b[3 * k + 1], b[3 * k + 2], x);
        let left = simd.sub_f32s(load(simd, out, at), product);
        store(simd, out, at, left);
    }
}

#[inline(always)]
fn turned<T: Copy>(b: [T; 9]) -> [T; 9] {
    [b[0], b[3], b[6], b[1], b[4], b[7], b[2], b[5], b[8]]
}

impl Stencil {
    /// Memory for a pattern.
    pub fn new(pattern: &Pattern) -> Stencil {
        let plane = pattern.plane;
        Stencil {
            runs: pattern.runs.clone(),
            len: pattern.order.len(),
            plane,
            stride: pattern.stride,
            blocks: vec![0.0; 9 * pattern.stride],
            inverses: vec![0.0; 6 * plane],
            x: vec![0.0; 3 * plane],
            b: vec![0.0; 3 * plane],
            r: vec![0.0; 3 * plane],
        }
    }

    /// Whether a particle does not move: it has no smoother.
    #[inline(always)]
    pub fn is_fixed(&self, place: usize) -> bool {
        self.inverses[place] == 0.0
    }

    /// Takes over the system's matrix. Fixed particles have no part in it.
    #[inline(always)]
    pub fn set<S: Simd>(&mut self, _: S, system: &System) {
        for (to, from) in self.blocks.iter_mut().zip(&system.blocks) {
            *to = *from as f32;
        }
        let (n, stride) = (self.len, self.stride);
        for (place, &particle) in system.pattern.order.iter().enumerate() {
            if system.fixed[particle as usize] {
                (0..9).for_each(|k| self.blocks[k * stride + place] = 0.0);
            }
        }
        for [from, to] in [[3, 1], [6, 2], [7, 5]] {
            self.blocks.copy_within(from * stride..from * stride + n, to * stride);
        }
        self.invert();
    }

    /// What is no inverse of a positive definite block becomes zero.
    #[inline(always)]
    fn invert(&mut self) {
        let (n, stride, plane) = (self.len, self.stride, self.plane);
        let of = |k: usize| &self.blocks[k * stride..k * stride + n];
        let [a, b, c, d, e, f] = [of(0), of(3), of(6), of(4), of(7), of(8)];
        let (p0, rest) = self.inverses.split_at_mut(plane);
        let (p1, rest) = rest.split_at_mut(plane);
        let (p2, rest) = rest.split_at_mut(plane);
        let (p3, rest) = rest.split_at_mut(plane);
        let (p4, p5) = rest.split_at_mut(plane);
        let (p0, p1, p2) = (&mut p0[..n], &mut p1[..n], &mut p2[..n]);
        let (p3, p4, p5) = (&mut p3[..n], &mut p4[..n], &mut p5[..n]);
        let damping = f64::from(DAMPING);
        for k in 0..n {
            let [a, b, c] = [f64::from(a[k]), f64::from(b[k]), f64::from(c[k])];
            let [d, e, f] = [f64::from(d[k]), f64::from(e[k]), f64::from(f[k])];
            let (p, q, r) = (d * f - e * e, c * e - b * f, b * e - c * d);
            let determinant = a * p + b * q + c * r;
            let scale = if determinant > 0.0 { damping / determinant } else { 0.0 };
            p0[k] = (p * scale) as f32;
            p1[k] = (q * scale) as f32;
            p2[k] = ((a * f - c * c) * scale) as f32;
            p3[k] = (r * scale) as f32;
            p4[k] = ((b * c - a * e) * scale) as f32;
            p5[k] = ((a * d - b * b) * scale) as f32;
        }
    }

    /// Starts from zero towards a right-hand side and leaves what is left.
    #[inline(always)]
    pub fn smooth_first<S: Simd>(&mut self, simd: S, b: &[f64]) {
        for (to, from) in self.b.iter_mut().zip(b) {
            *to = *from as f32;
        }
        let Stencil { inverses, x, b, plane, .. } = self;
        for at in (0..self.len).step_by(S::F32_LANES) {
            let change = smoothed(simd, inverses, load3(simd, b, *plane, at), *plane, at);
            for k in 0..3 {
                store(simd, x, k * *plane + at, change[k]);
            }
        }
        self.leave(simd);
    }

    /// Smooths once more and hands over the solution.
    #[inline(always)]
    pub fn smooth_last<S: Simd>(&mut self, simd: S, z: &mut [f64]) {
        self.leave(simd);
        let Stencil { inverses, x, r, plane, .. } = self;
        for at in (0..self.len).step_by(S::F32_LANES) {
            let change = smoothed(simd, inverses, load3(simd, r, *plane, at), *plane, at);
            for k in 0..3 {
                let at = k * *plane + at;
                let sum = simd.add_f32s(load(simd, x, at), change[k]);
                store(simd, x, at, sum);
            }
        }
        for (to, from) in z.iter_mut().zip(&self.x) {
            *to = f64::from(*from);
        }
    }

    /// out = A x
    #[inline(always)]
    pub fn multiply<S: Simd>(&mut self, simd: S, x: &[f64], out: &mut [f64]) {
        for (to, from) in self.x.iter_mut().zip(x) {
            *to = *from as f32;
        }
        self.b.fill(0.0);
        self.leave(simd);
        for (to, from) in out.iter_mut().zip(&self.r) {
            *to = -f64::from(*from);
        }
    }

    /// r = b − A x
    #[inline(always)]
    fn leave<S: Simd>(&mut self, simd: S) {
        let Stencil { blocks, x, b, r, plane, stride, .. } = self;
        let (plane, stride) = (*plane, *stride);
        r.copy_from_slice(b);
        for at in (0..self.len).step_by(S::F32_LANES) {
            take(simd, load9(simd, blocks, stride, at), load3(simd, x, plane, at), r, plane, at);
        }
        for run in &self.runs {
            if !run.is_padded {
                for k in 0..run.len {
                    take_one(blocks, stride, run, k, x, plane, r);
                }
            } else if run.second - run.first > 32 {
                for k in (0..run.len).step_by(S::F32_LANES) {
                    let own = load9(simd, blocks, stride, run.at + k);
                    take(simd, own, load3(simd, x, plane, run.second + k), r, plane, run.first + k);
                    take(simd, turned(own), load3(simd, x, plane, run.first + k), r, plane, run.second + k);
                }
            } else {
                // What one line stores the next would load before it is there.
                for k in (0..run.len).step_by(S::F32_LANES) {
                    let own = load9(simd, blocks, stride, run.at + k);
                    take(simd, own, load3(simd, x, plane, run.second + k), r, plane, run.first + k);
                }
                for k in (0..run.len).step_by(S::F32_LANES) {
                    let own = turned(load9(simd, blocks, stride, run.at + k));
                    take(simd, own, load3(simd, x, plane, run.first + k), r, plane, run.second + k);
                }
            }
        }
    }
}

/// Smoother times a vector.
#[inline(always)]
fn smoothed<S: Simd>(simd: S, inverses: &[f32], v: Three<S>, plane: usize, at: usize) -> Three<S> {
    let mut own = [simd.splat_f32s(0.0); 6];
    for (k, own) in own.iter_mut().enumerate() {
        *own = load(simd, inverses, k * plane + at);
    }
    [
        row(simd, own[0], own[1], own[3], v),
        row(simd, own[1], own[2], own[4], v),
        row(simd, own[3], own[4], own[5], v),
    ]
}

#[inline(always)]
fn take_one(blocks: &[f32], stride: usize, run: &Run, k: usize, x: &[f32], plane: usize, out: &mut [f32]) {
    let (a, b) = (run.first + k, run.second + k);
    for r in 0..3 {
        for c in 0..3 {
            let value = blocks[(3 * r + c) * stride + run.at + k];
            out[r * plane + a] -= value * x[c * plane + b];
            out[c * plane + b] -= value * x[r * plane + a];
        }
    }
}
