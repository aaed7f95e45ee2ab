//! A matrix in single precision, in planes of sixteen neighbours: whole registers of them go at once.

use super::DAMPING;
use crate::{
    cores::Team,
    math::pack::dispatch,
    potential::{
        pattern::{Lines, PADDING},
        system::System,
    },
};
use pulp::{Simd, WithSimd};
use std::sync::Arc;

/// Numbers of sixteen neighbours' blocks, one after the other: what is read together lies together, in whole lines of the cache.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub struct Sixteen<const N: usize>(pub [[f32; PADDING]; N]);

/// A matrix in planes, sixteen places at a time.
#[derive(Clone)]
pub struct Numbers {
    /// How it lies.
    pub lines: Arc<Lines>,
    /// The blocks, those of the diagonals whole.
    pub(super) blocks: Vec<Sixteen<9>>,
    /// Damped inverses of the diagonal blocks: 00, 10, 11, 20, 21, 22.
    pub(super) inverses: Vec<Sixteen<6>>,
    /// Share that rows take in what their masters do: those without an inverse do not move.
    pub(super) shares: Vec<f32>,
}

/// A register of each of three numbers.
pub type Three<S> = [<S as Simd>::f32s; 3];

/// A register of a list.
#[inline(always)]
pub fn load<S: Simd>(_: S, list: &[f32], at: usize) -> S::f32s {
    S::as_simd_f32s(&list[at..at + S::F32_LANES]).0[0]
}

/// Keeps a register in a list.
#[inline(always)]
pub fn store<S: Simd>(_: S, list: &mut [f32], at: usize, value: S::f32s) {
    S::as_mut_simd_f32s(&mut list[at..at + S::F32_LANES]).0[0] = value;
}

/// Registers of a vector in planes of this length.
#[inline(always)]
pub fn load3<S: Simd>(simd: S, list: &[f32], plane: usize, at: usize) -> Three<S> {
    [load(simd, list, at), load(simd, list, plane + at), load(simd, list, 2 * plane + at)]
}

/// Row of a matrix times a vector.
#[inline(always)]
fn row<S: Simd>(simd: S, a: S::f32s, b: S::f32s, c: S::f32s, x: Three<S>) -> S::f32s {
    simd.mul_add_e_f32s(a, x[0], simd.mul_add_e_f32s(b, x[1], simd.mul_f32s(c, x[2])))
}

/// A sum and a block times a vector.
#[inline(always)]
pub fn plus<S: Simd>(simd: S, b: [S::f32s; 9], x: Three<S>, sum: Three<S>) -> Three<S> {
    let row = |k: usize| {
        let sum = simd.mul_add_e_f32s(b[3 * k + 2], x[2], sum[k]);
        simd.mul_add_e_f32s(b[3 * k], x[0], simd.mul_add_e_f32s(b[3 * k + 1], x[1], sum))
    };
    [row(0), row(1), row(2)]
}

/// A block's transpose.
#[inline(always)]
pub fn turned<T: Copy>(b: [T; 9]) -> [T; 9] {
    [b[0], b[3], b[6], b[1], b[4], b[7], b[2], b[5], b[8]]
}

impl<const N: usize> Sixteen<N> {
    const ZERO: Sixteen<N> = Sixteen([[0.0; PADDING]; N]);

    /// One of their registers.
    #[inline(always)]
    pub fn load<S: Simd>(&self, simd: S, register: usize) -> [S::f32s; N] {
        let mut own = [simd.splat_f32s(0.0); N];
        for (own, list) in own.iter_mut().zip(&self.0) {
            *own = S::as_simd_f32s(list).0[register];
        }
        own
    }
}

/// Sixteens that are taken over together: as many as stay in the nearest cache.
const SPAN: usize = 32;

impl Numbers {
    /// Memory for a matrix.
    pub fn new(lines: Arc<Lines>) -> Numbers {
        let blocks = vec![Sixteen::ZERO; lines.stride.div_ceil(PADDING)];
        let inverses = vec![Sixteen::ZERO; lines.plane.div_ceil(PADDING)];
        let shares = vec![0.0; PADDING * inverses.len()];
        Numbers { lines, blocks, inverses, shares }
    }

    /// The block at a place.
    #[inline(always)]
    pub fn block(&self, at: usize) -> [f32; 9] {
        let lists = &self.blocks[at / PADDING].0;
        std::array::from_fn(|k| lists[k][at % PADDING])
    }

    /// Puts a block at a place.
    #[inline(always)]
    pub fn set_block(&mut self, at: usize, block: [f32; 9]) {
        let lists = &mut self.blocks[at / PADDING].0;
        lists.iter_mut().zip(block).for_each(|(list, value)| list[at % PADDING] = value);
    }

    /// Takes over a system's matrix. Fixed particles have no part in it.
    pub fn set(&mut self, system: &System, team: &Team) {
        let (n, stride) = (self.lines.particles, self.lines.stride);
        let middle = self.blocks.len() / 2 / SPAN * SPAN;
        let (low, high) = self.blocks.split_at_mut(middle);
        let (blocks, from) = (&system.blocks[..], low.len() * PADDING);
        team.both(
            || dispatch(Narrow { blocks, stride, from: 0, to: low }),
            || dispatch(Narrow { blocks, stride, from, to: high }),
        );
        for (place, &particle) in system.pattern.order.iter().enumerate() {
            if system.fixed[particle as usize] {
                self.set_block(place, [0.0; 9]);
            }
        }
        for own in &mut self.blocks[..n.div_ceil(PADDING)] {
            [[3, 1], [6, 2], [7, 5]].into_iter().for_each(|[from, to]| own.0[to] = own.0[from]);
        }
        self.invert(team);
    }

    /// What is no inverse of a positive definite block becomes zero.
    pub fn invert(&mut self, team: &Team) {
        let diagonals = &self.blocks[..self.lines.particles.div_ceil(PADDING)];
        let middle = diagonals.len() / 2;
        let ((low, high), (to, others)) = (diagonals.split_at(middle), self.inverses.split_at_mut(middle));
        team.both(
            || dispatch(Invert { diagonals: low, to }),
            || dispatch(Invert { diagonals: high, to: others }),
        );
        for (shares, inverses) in self.shares.as_chunks_mut::<PADDING>().0.iter_mut().zip(&self.inverses) {
            *shares = inverses.0[0].map(|inverse| f32::from(u8::from(inverse != 0.0)));
        }
    }

    /// The smoother times a vector, in a register of rows.
    #[inline(always)]
    pub fn smoothed<S: Simd>(&self, simd: S, v: Three<S>, at: usize) -> Three<S> {
        let own = self.inverses[at / PADDING].load(simd, at % PADDING / S::F32_LANES);
        [
            row(simd, own[0], own[1], own[3], v),
            row(simd, own[1], own[2], own[4], v),
            row(simd, own[3], own[4], own[5], v),
        ]
    }
}

/// Takes over blocks from planes in double precision, from a place on.
struct Narrow<'a> {
    blocks: &'a [f64],
    stride: usize,
    from: usize,
    to: &'a mut [Sixteen<9>],
}

impl WithSimd for Narrow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Narrow { blocks, stride, from, to } = self;
        // A plane at a time, as far as what is written stays in the nearest cache. They become narrow in one row: of a loop over sixteens
        // the compiler makes one over numbers as far apart, which AVX-512 gathers and scatters at a fifth of the speed.
        let mut numbers = [[0.0; PADDING]; SPAN];
        for (to, place) in to.chunks_mut(SPAN).zip((from..stride).step_by(SPAN * PADDING)) {
            for k in 0..9 {
                let from = &blocks[k * stride + place..(k + 1) * stride];
                numbers.as_flattened_mut().iter_mut().zip(from).for_each(|(to, from)| *to = *from as f32);
                to.iter_mut().zip(&numbers).for_each(|(to, numbers)| to.0[k] = *numbers);
            }
        }
    }
}

/// Makes the damped inverses of diagonal blocks.
struct Invert<'a> {
    diagonals: &'a [Sixteen<9>],
    to: &'a mut [Sixteen<6>],
}

impl WithSimd for Invert<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let damping = f64::from(DAMPING);
        for (to, own) in self.to.iter_mut().zip(self.diagonals) {
            let mut inverses = [[0.0; PADDING]; 6];
            for k in 0..PADDING {
                let [a, b, c, d, e, f] = [0, 3, 6, 4, 7, 8].map(|number| f64::from(own.0[number][k]));
                let (p, q, r) = (d * f - e * e, c * e - b * f, b * e - c * d);
                let determinant = a * p + b * q + c * r;
                let scale = if determinant > 0.0 { damping / determinant } else { 0.0 };
                inverses[0][k] = (p * scale) as f32;
                inverses[1][k] = (q * scale) as f32;
                inverses[2][k] = ((a * f - c * c) * scale) as f32;
                inverses[3][k] = (r * scale) as f32;
                inverses[4][k] = ((b * c - a * e) * scale) as f32;
                inverses[5][k] = ((a * d - b * b) * scale) as f32;
            }
            to.0 = inverses;
        }
    }
}
