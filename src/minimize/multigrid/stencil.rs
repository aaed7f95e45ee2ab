//! A level in single precision, plane by plane: whole registers of neighbouring particles, smoothed by block Jacobi.

use super::{DAMPING, matrix::Node};
use crate::potential::{
    pattern::{Lines, Run},
    system::System,
};
use pulp::Simd;
use std::{ops::Range, sync::Arc};

/// Rows that are done with before the next ones begin, so that what goes with them stays in the nearest cache.
const TILE: usize = 512;

/// A matrix in planes.
#[derive(Clone)]
pub struct Numbers {
    /// How it lies.
    pub lines: Arc<Lines>,
    /// Planes of the blocks, those of the diagonals whole.
    pub blocks: Vec<f32>,
    /// Damped inverses of the diagonal blocks: 00, 10, 11, 20, 21, 22.
    inverses: Vec<f32>,
}

/// Matrix, smoother and vectors of a level.
pub struct Stencil {
    /// The matrix.
    pub numbers: Numbers,
    /// What it solves for.
    pub x: Vec<f32>,
    b: Vec<f32>,
    /// A x − b
    excess: Vec<f32>,
    /// By nodes: the right-hand side, then what the first smoothing left, at last the solution.
    pub nodes: Vec<Node>,
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

/// Adds a block times a vector to `out`.
#[inline(always)]
fn add<S: Simd>(simd: S, b: [S::f32s; 9], x: Three<S>, out: &mut [f32], plane: usize, at: usize) {
    for k in 0..3 {
        let at = k * plane + at;
        let [a, b, c] = [b[3 * k], b[3 * k + 1], b[3 * k + 2]];
        let sum = simd.mul_add_e_f32s(c, x[2], load(simd, out, at));
        store(simd, out, at, simd.mul_add_e_f32s(a, x[0], simd.mul_add_e_f32s(b, x[1], sum)));
    }
}

#[inline(always)]
fn turned<T: Copy>(b: [T; 9]) -> [T; 9] {
    [b[0], b[3], b[6], b[1], b[4], b[7], b[2], b[5], b[8]]
}

impl Numbers {
    /// Memory for a matrix.
    pub fn new(lines: Arc<Lines>) -> Numbers {
        let (blocks, inverses) = (vec![0.0; 9 * lines.stride], vec![0.0; 6 * lines.plane]);
        Numbers { lines, blocks, inverses }
    }

    /// Takes over a system's matrix. Fixed particles have no part in it.
    #[inline(always)]
    pub fn set(&mut self, system: &System) {
        for (to, from) in self.blocks.iter_mut().zip(&system.blocks) {
            *to = *from as f32;
        }
        let (n, stride) = (self.lines.particles, self.lines.stride);
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
    pub fn invert(&mut self) {
        let Lines { particles: n, stride, plane, .. } = *self.lines;
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

    /// out = A x
    #[inline(always)]
    pub fn multiply<S: Simd>(&self, simd: S, x: &[f32], out: &mut [f32]) {
        out.fill(0.0);
        self.add_loose(x, out);
        for tile in self.tiles() {
            self.add_tile(simd, tile, x, out);
        }
    }

    /// Rows in pieces, one after the other.
    fn tiles(&self) -> impl Iterator<Item = Range<usize>> + use<> {
        let end = self.lines.particles;
        (0..end).step_by(TILE).map(move |from| from..(from + TILE).min(end))
    }

    /// out ← out + A x, of pairs that do not stand in line; the others go tile by tile.
    #[inline(always)]
    fn add_loose(&self, x: &[f32], out: &mut [f32]) {
        let Lines { plane, stride, .. } = *self.lines;
        for run in self.lines.runs.iter().filter(|run| !run.is_padded) {
            for k in 0..run.len {
                add_one(&self.blocks, stride, run, k, x, plane, out);
            }
        }
    }

    /// out ← out + A x, of the pairs whose first particle is in the tile, and the diagonals. With the tiles before, that completes its rows;
    /// later tiles do not look at them any more.
    #[inline(always)]
    fn add_tile<S: Simd>(&self, simd: S, tile: Range<usize>, x: &[f32], out: &mut [f32]) {
        let Numbers { lines, blocks, .. } = self;
        let Lines { plane, stride, .. } = **lines;
        for at in tile.clone().step_by(S::F32_LANES) {
            add(simd, load9(simd, blocks, stride, at), load3(simd, x, plane, at), out, plane, at);
        }
        for run in self.lines.runs.iter().filter(|run| run.is_padded) {
            let tile = tile.start..tile.end.min(run.len);
            if run.second - run.first > 32 {
                for k in tile.step_by(S::F32_LANES) {
                    let (first, second) = (run.first + k, run.second + k);
                    let own = load9(simd, blocks, stride, run.at + k);
                    add(simd, own, load3(simd, x, plane, second), out, plane, first);
                    add(simd, turned(own), load3(simd, x, plane, first), out, plane, second);
                }
            } else {
                // What one line stores the next would load before it is there.
                for k in tile.clone().step_by(S::F32_LANES) {
                    let own = load9(simd, blocks, stride, run.at + k);
                    add(simd, own, load3(simd, x, plane, run.second + k), out, plane, run.first + k);
                }
                for k in tile.step_by(S::F32_LANES) {
                    let own = turned(load9(simd, blocks, stride, run.at + k));
                    add(simd, own, load3(simd, x, plane, run.first + k), out, plane, run.second + k);
                }
            }
        }
    }
}

impl Stencil {
    /// With room for vectors.
    pub fn new(numbers: Numbers) -> Stencil {
        let Lines { particles, plane, .. } = *numbers.lines;
        let zeros = || vec![0.0; 3 * plane];
        Stencil { numbers, x: zeros(), b: zeros(), excess: zeros(), nodes: vec![[0.0; 4]; particles] }
    }

    /// Whether a particle does not move: it has no smoother.
    #[inline(always)]
    pub fn is_fixed(&self, place: usize) -> bool {
        self.numbers.inverses[place] == 0.0
    }

    /// Adds to what is solved for one particle.
    #[inline(always)]
    pub fn add(&mut self, place: usize, node: &Node) {
        let plane = self.numbers.lines.plane;
        (0..3).for_each(|k| self.x[k * plane + place] += node[k]);
    }

    /// Starts from zero towards the right-hand side and leaves what is left.
    #[inline(always)]
    pub fn smooth_first<S: Simd>(&mut self, simd: S) {
        let plane = self.numbers.lines.plane;
        for (place, node) in self.nodes.iter().enumerate() {
            (0..3).for_each(|k| self.b[k * plane + place] = node[k]);
        }
        self.smooth(simd);
    }

    /// The same towards a right-hand side in planes.
    #[inline(always)]
    pub fn smooth_towards<S: Simd>(&mut self, simd: S, b: &[f64]) {
        for (to, from) in self.b.iter_mut().zip(b) {
            *to = *from as f32;
        }
        self.smooth(simd);
    }

    #[inline(always)]
    fn smooth<S: Simd>(&mut self, simd: S) {
        let Stencil { numbers, x, b, excess, nodes } = self;
        let Lines { particles, plane, .. } = *numbers.lines;
        for at in (0..particles).step_by(S::F32_LANES) {
            let change = smoothed(simd, &numbers.inverses, load3(simd, b, plane, at), plane, at);
            for k in 0..3 {
                store(simd, x, k * plane + at, change[k]);
            }
        }
        begin(numbers, b, x, excess);
        for tile in numbers.tiles() {
            numbers.add_tile(simd, tile.clone(), x, excess);
            for place in tile {
                nodes[place] = [-excess[place], -excess[plane + place], -excess[2 * plane + place], 0.0];
            }
        }
    }

    /// Smooths once more.
    #[inline(always)]
    pub fn smooth_last<S: Simd>(&mut self, simd: S) {
        let Stencil { numbers, x, b, excess, .. } = self;
        let plane = numbers.lines.plane;
        begin(numbers, b, x, excess);
        for tile in numbers.tiles() {
            numbers.add_tile(simd, tile.clone(), x, excess);
            for at in tile.step_by(S::F32_LANES) {
                let change = smoothed(simd, &numbers.inverses, load3(simd, excess, plane, at), plane, at);
                for k in 0..3 {
                    let at = k * plane + at;
                    let left = simd.sub_f32s(load(simd, x, at), change[k]);
                    store(simd, x, at, left);
                }
            }
        }
    }

    /// Lays the solution by nodes, as finer levels follow it.
    #[inline(always)]
    pub fn hand_over(&mut self) {
        let plane = self.numbers.lines.plane;
        for (place, node) in self.nodes.iter_mut().enumerate() {
            *node = [self.x[place], self.x[plane + place], self.x[2 * plane + place], 0.0];
        }
    }
}

/// Begins A x − b.
#[inline(always)]
fn begin(numbers: &Numbers, b: &[f32], x: &[f32], excess: &mut [f32]) {
    for (excess, b) in excess.iter_mut().zip(b) {
        *excess = -b;
    }
    numbers.add_loose(x, excess);
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
fn add_one(blocks: &[f32], stride: usize, run: &Run, k: usize, x: &[f32], plane: usize, out: &mut [f32]) {
    let (a, b) = (run.first + k, run.second + k);
    for r in 0..3 {
        for c in 0..3 {
            let value = blocks[(3 * r + c) * stride + run.at + k];
            out[r * plane + a] += value * x[c * plane + b];
            out[c * plane + b] += value * x[r * plane + a];
        }
    }
}
