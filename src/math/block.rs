//! 3 × 3 matrices of packs: one per lane.

#![expect(clippy::needless_range_loop, reason = "entries read best by their numbers")]

use super::pack::{Pack, Pack3, add, axpy, neg, scale, sub};
use pulp::Simd;

/// A 3 × 3 matrix per lane, row by row.
#[derive(Clone, Copy)]
pub struct Block<S: Simd>(pub [Pack3<S>; 3]);

impl<S: Simd> Block<S> {
    /// No entry but the diagonal.
    #[inline(always)]
    pub fn diagonal(value: Pack<S>) -> Self {
        let zero = value.like(0.0);
        Block([[value, zero, zero], [zero, value, zero], [zero, zero, value]])
    }

    /// u vᵀ
    #[inline(always)]
    pub fn outer(u: Pack3<S>, v: Pack3<S>) -> Self {
        Block([scale(v, u[0]), scale(v, u[1]), scale(v, u[2])])
    }

    /// self + u vᵀ
    #[inline(always)]
    pub fn plus_outer(self, u: Pack3<S>, v: Pack3<S>) -> Self {
        let [a, b, c] = self.0;
        Block([axpy(v, u[0], a), axpy(v, u[1], b), axpy(v, u[2], c)])
    }

    /// self + u vᵀ + v uᵀ
    #[inline(always)]
    pub fn plus_both(self, u: Pack3<S>, v: Pack3<S>) -> Self {
        self.plus_outer(u, v).plus_outer(v, u)
    }

    /// self + [v]×, the matrix of the cross product with v.
    #[inline(always)]
    pub fn plus_cross(self, v: Pack3<S>) -> Self {
        let [a, b, c] = self.0;
        Block([
            [a[0], a[1] - v[2], a[2] + v[1]],
            [b[0] + v[2], b[1], b[2] - v[0]],
            [c[0] - v[1], c[1] + v[0], c[2]],
        ])
    }

    /// self + other
    #[inline(always)]
    pub fn plus(self, other: Self) -> Self {
        let ([a, b, c], [d, e, f]) = (self.0, other.0);
        Block([add(a, d), add(b, e), add(c, f)])
    }

    /// self − other
    #[inline(always)]
    pub fn minus(self, other: Self) -> Self {
        let ([a, b, c], [d, e, f]) = (self.0, other.0);
        Block([sub(a, d), sub(b, e), sub(c, f)])
    }

    /// self · factor
    #[inline(always)]
    pub fn times(self, factor: Pack<S>) -> Self {
        let [a, b, c] = self.0;
        Block([scale(a, factor), scale(b, factor), scale(c, factor)])
    }

    /// self · factor + other
    #[inline(always)]
    pub fn times_plus(self, factor: Pack<S>, other: Self) -> Self {
        let ([a, b, c], [d, e, f]) = (self.0, other.0);
        Block([axpy(a, factor, d), axpy(b, factor, e), axpy(c, factor, f)])
    }

    /// −self
    #[inline(always)]
    pub fn negated(self) -> Self {
        let [a, b, c] = self.0;
        Block([neg(a), neg(b), neg(c)])
    }

    /// One that is symmetric, by what lies on and below the diagonal.
    #[inline(always)]
    pub fn symmetric(self) -> Symmetric<S> {
        let [a, b, c] = self.0;
        Symmetric([a[0], b[0], b[1], c[0], c[1], c[2]])
    }

    /// self + selfᵀ, and v of self − selfᵀ = [v]×.
    #[inline(always)]
    pub fn both_parts(self) -> (Symmetric<S>, Pack3<S>) {
        let [a, b, c] = self.0;
        let even = Symmetric([a[0] + a[0], b[0] + a[1], b[1] + b[1], c[0] + a[2], c[1] + b[2], c[2] + c[2]]);
        (even, [c[1] - b[2], a[2] - c[0], b[0] - a[1]])
    }

    /// Transpose.
    #[inline(always)]
    pub fn transposed(self) -> Self {
        let [a, b, c] = self.0;
        Block([[a[0], b[0], c[0]], [a[1], b[1], c[1]], [a[2], b[2], c[2]]])
    }
}

/// A symmetric 3 × 3 matrix per lane: what lies on and below the diagonal, row by row.
#[derive(Clone, Copy)]
pub struct Symmetric<S: Simd>([Pack<S>; 6]);

impl<S: Simd> Symmetric<S> {
    /// No entry but the diagonal.
    #[inline(always)]
    pub fn diagonal(value: Pack<S>) -> Self {
        let zero = value.like(0.0);
        Symmetric([value, zero, value, zero, zero, value])
    }

    /// u uᵀ
    #[inline(always)]
    pub fn square(u: Pack3<S>) -> Self {
        Symmetric::of(u, u)
    }

    /// factor · u uᵀ
    #[inline(always)]
    pub fn outer(u: Pack3<S>, factor: Pack<S>) -> Self {
        Symmetric::of(u, scale(u, factor))
    }

    /// u vᵀ of parallel vectors
    #[inline(always)]
    fn of(u: Pack3<S>, v: Pack3<S>) -> Self {
        Symmetric([v[0] * u[0], v[1] * u[0], v[1] * u[1], v[2] * u[0], v[2] * u[1], v[2] * u[2]])
    }

    /// self + factor · u uᵀ
    #[inline(always)]
    pub fn plus_outer(mut self, u: Pack3<S>, factor: Pack<S>) -> Self {
        let v = scale(u, factor);
        for row in 0..3 {
            for column in 0..=row {
                let k = Self::place(row, column);
                self.0[k] = v[row].mul_add(u[column], self.0[k]);
            }
        }
        self
    }

    /// self + u vᵀ + v uᵀ
    #[inline(always)]
    pub fn plus_both(mut self, u: Pack3<S>, v: Pack3<S>) -> Self {
        for row in 0..3 {
            for column in 0..=row {
                let k = Self::place(row, column);
                self.0[k] = u[row].mul_add(v[column], v[row].mul_add(u[column], self.0[k]));
            }
        }
        self
    }

    /// self + other
    #[inline(always)]
    pub fn plus(mut self, other: Self) -> Self {
        for k in 0..6 {
            self.0[k] = self.0[k] + other.0[k];
        }
        self
    }

    /// self − other
    #[inline(always)]
    pub fn minus(mut self, other: Self) -> Self {
        for k in 0..6 {
            self.0[k] = self.0[k] - other.0[k];
        }
        self
    }

    /// self · factor
    #[inline(always)]
    pub fn times(mut self, factor: Pack<S>) -> Self {
        for k in 0..6 {
            self.0[k] = self.0[k] * factor;
        }
        self
    }

    /// −self
    #[inline(always)]
    pub fn negated(mut self) -> Self {
        for k in 0..6 {
            self.0[k] = -self.0[k];
        }
        self
    }

    /// self + [v]×, the matrix of the cross product with v.
    #[inline(always)]
    pub fn plus_cross(self, v: Pack3<S>) -> Block<S> {
        self.block().plus_cross(v)
    }

    /// All nine entries.
    #[inline(always)]
    pub fn block(self) -> Block<S> {
        let [xx, xy, yy, xz, yz, zz] = self.0;
        Block([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    }

    /// An entry.
    #[inline(always)]
    pub fn entry(&self, row: usize, column: usize) -> Pack<S> {
        self.0[Self::place(row.max(column), row.min(column))]
    }

    #[inline(always)]
    fn place(row: usize, column: usize) -> usize {
        row * (row + 1) / 2 + column
    }
}
