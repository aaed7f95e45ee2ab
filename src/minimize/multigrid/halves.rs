//! Vectors in planes, in two halves of about as many particles: each is one thread's, so that what it writes it finds in its own cache, and
//! sums are the same whoever does which half.

use crate::{cores::Team, math::pack::dispatch, potential::pattern::PADDING};
use pulp::{Simd, WithSimd};

/// The particles of a vector in planes before one and from there on, the first in whole registers.
pub fn parts<T>(list: &[T], middle: usize) -> [[&[T]; 3]; 2] {
    let plane = list.len() / 3;
    let middle = middle.next_multiple_of(PADDING);
    let [(a, d), (b, e), (c, f)] = [0, 1, 2].map(|k| list[k * plane..][..plane].split_at(middle));
    [[a, b, c], [d, e, f]]
}

/// The same, to be written.
pub fn parts_mut<T>(list: &mut [T], middle: usize) -> [[&mut [T]; 3]; 2] {
    let plane = list.len() / 3;
    let middle = middle.next_multiple_of(PADDING);
    let (a, rest) = list.split_at_mut(plane);
    let (b, c) = rest.split_at_mut(plane);
    let [(a, d), (b, e), (c, f)] = [a, b, c].map(|list| list.split_at_mut(middle));
    [[a, b, c], [d, e, f]]
}

/// Who does halves, and where they part.
#[derive(Clone, Copy)]
pub struct Halves<'a> {
    /// A thread and its helper.
    pub team: &'a Team,
    /// The second half's first particle.
    pub middle: usize,
}

/// What is left of a right-hand side, in planes.
#[derive(Clone, Copy)]
pub struct Residual<'a> {
    pub(super) r: &'a [f64],
    pub(super) halves: Halves<'a>,
}

impl Residual<'_> {
    /// Its products with others.
    pub fn dots<const N: usize>(&self, others: [&[f32]; N]) -> [f64; N] {
        self.halves.dots(self.r, others)
    }

    /// Its square.
    pub fn square(&self) -> f64 {
        self.halves.dots(self.r, [self.r])[0]
    }
}

/// A number of either precision.
pub trait Number: Copy + Into<f64> + Sync {}

impl<T: Copy + Into<f64> + Sync> Number for T {}

impl Halves<'_> {
    /// Products of a vector with others.
    pub fn dots<A: Number, B: Number, const N: usize>(&self, a: &[A], others: [&[B]; N]) -> [f64; N] {
        let (mut low, mut high) = ([0.0; N], [0.0; N]);
        let [a, a_high] = parts(a, self.middle);
        let [b, b_high] = [0, 1].map(|half| others.map(|b| parts(b, self.middle)[half]));
        self.team.both(
            || low = dispatch(Dots { a, others: b }),
            || high = dispatch(Dots { a: a_high, others: b_high }),
        );
        std::array::from_fn(|k| low[k] + high[k])
    }

    /// d ← z + β d
    pub fn conjugate(&self, d: &mut [f32], beta: f32, z: &[f32]) {
        let ([d, d_high], [z, z_high]) = (parts_mut(d, self.middle), parts(z, self.middle));
        self.team.both(
            || dispatch(Conjugate { d, beta, z }),
            || dispatch(Conjugate { d: d_high, beta, z: z_high }),
        );
    }

    /// x ← x + factor · d and r ← r − factor · image
    pub fn advance(&self, factor: f64, d: &[f32], image: &[f32], x: &mut [f64], r: &mut [f64]) {
        let ([d, d_high], [image, image_high]) = (parts(d, self.middle), parts(image, self.middle));
        let ([x, x_high], [r, r_high]) = (parts_mut(x, self.middle), parts_mut(r, self.middle));
        self.team.both(
            || dispatch(Advance { factor, d, image, x, r }),
            || dispatch(Advance { factor, d: d_high, image: image_high, x: x_high, r: r_high }),
        );
    }
}

/// Products of one vector with others, each in sixteen sums.
struct Dots<'a, A, B, const N: usize> {
    a: [&'a [A]; 3],
    others: [[&'a [B]; 3]; N],
}

impl<A: Number, B: Number, const N: usize> WithSimd for Dots<'_, A, B, N> {
    type Output = [f64; N];

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> [f64; N] {
        let mut sums = [0.0; N];
        for (sum, other) in sums.iter_mut().zip(self.others) {
            // Sums in a list would go through memory.
            let mut own = [0.0; 16];
            for (a, b) in self.a.into_iter().zip(other) {
                let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<16>(), b.as_chunks::<16>());
                for (a, b) in a.iter().zip(b) {
                    for k in 0..16 {
                        own[k] += a[k].into() * b[k].into();
                    }
                }
                for (k, (a, b)) in a_rest.iter().zip(b_rest).enumerate() {
                    own[k] += (*a).into() * (*b).into();
                }
            }
            *sum = own.iter().sum();
        }
        sums
    }
}

struct Conjugate<'a> {
    d: [&'a mut [f32]; 3],
    beta: f32,
    z: [&'a [f32]; 3],
}

impl WithSimd for Conjugate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (d, z) in self.d.into_iter().zip(self.z) {
            for (d, z) in d.iter_mut().zip(z) {
                *d = z + self.beta * *d;
            }
        }
    }
}

struct Advance<'a> {
    factor: f64,
    d: [&'a [f32]; 3],
    image: [&'a [f32]; 3],
    x: [&'a mut [f64]; 3],
    r: [&'a mut [f64]; 3],
}

impl WithSimd for Advance<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (x, d) in self.x.into_iter().zip(self.d) {
            for (x, d) in x.iter_mut().zip(d) {
                *x += self.factor * f64::from(*d);
            }
        }
        for (r, image) in self.r.into_iter().zip(self.image) {
            for (r, image) in r.iter_mut().zip(image) {
                *r -= self.factor * f64::from(*image);
            }
        }
    }
}
