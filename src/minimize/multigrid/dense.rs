//! The coarsest level, solved by a dense Cholesky factor.

use super::matrix::{Matrix, Node};
use crate::math::pack::dispatch;
use pulp::{Simd, WithSimd};

/// A small matrix, its factor, and the vector that it solves for in place.
pub struct Dense {
    /// The matrix.
    pub matrix: Matrix,
    /// Right-hand side, then solution.
    pub x: Vec<Node>,
    /// Factor, row by row, its diagonal inverted.
    factor: Vec<f64>,
    y: Vec<f64>,
}

/// What takes vector instructions.
enum Long<'a> {
    Factorize(&'a mut Dense),
    Solve(&'a mut Dense),
}

impl WithSimd for Long<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        match self {
            Long::Factorize(dense) => dense.factor(),
            Long::Solve(dense) => dense.substitute(),
        }
    }
}

impl Dense {
    /// Memory for a matrix of this pattern.
    pub fn new(matrix: Matrix) -> Dense {
        let n = matrix.len();
        Dense { x: vec![[0.0; 4]; n], factor: vec![0.0; 9 * n * n], y: vec![0.0; 3 * n], matrix }
    }

    /// Factors the matrix. Unknowns that nothing holds, and what rounding has made indefinite, are left out: they stay zero.
    pub fn factorize(&mut self) {
        dispatch(Long::Factorize(self));
    }

    #[inline(always)]
    fn factor(&mut self) {
        let size = self.y.len();
        self.factor.fill(0.0);
        for row in 0..self.matrix.len() {
            for place in self.matrix.row(row) {
                let column = self.matrix.columns[place] as usize;
                let block = self.matrix.window(place);
                for k in 0..9 {
                    self.factor[(3 * row + k % 3) * size + 3 * column + k / 3] = f64::from(block[k]);
                }
            }
        }
        for j in 0..size {
            let (above, below) = self.factor.split_at_mut((j + 1) * size);
            let row = &mut above[j * size..];
            let own = row[j];
            let pivot = own - dot(&row[..j], &row[..j]);
            let inverse = if pivot > 1e-6 * own && own > 0.0 { 1.0 / pivot.sqrt() } else { 0.0 };
            row[j] = inverse;
            for other in below.chunks_exact_mut(size) {
                other[j] = (other[j] - dot(&other[..j], &row[..j])) * inverse;
            }
        }
    }

    /// Solves in place.
    pub fn solve(&mut self) {
        dispatch(Long::Solve(self));
    }

    #[inline(always)]
    fn substitute(&mut self) {
        let size = self.y.len();
        for (y, x) in self.y.chunks_exact_mut(3).zip(&self.x) {
            (0..3).for_each(|k| y[k] = f64::from(x[k]));
        }
        for j in 0..size {
            let row = &self.factor[j * size..][..size];
            self.y[j] = (self.y[j] - dot(&row[..j], &self.y[..j])) * row[j];
        }
        for j in (0..size).rev() {
            let row = &self.factor[j * size..][..size];
            let value = self.y[j] * row[j];
            self.y[j] = value;
            self.y[..j].iter_mut().zip(row).for_each(|(y, l)| *y -= l * value);
        }
        for (y, x) in self.y.chunks_exact(3).zip(&mut self.x) {
            (0..3).for_each(|k| x[k] = y[k] as f32);
        }
    }
}

#[inline(always)]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    for (a, b) in a.iter().zip(b) {
        for k in 0..8 {
            sums[k] += a[k] * b[k];
        }
    }
    let mut sum = 0.0;
    for (a, b) in a_rest.iter().zip(b_rest) {
        sum += a * b;
    }
    sum + ((sums[0] + sums[4]) + (sums[1] + sums[5])) + ((sums[2] + sums[6]) + (sums[3] + sums[7]))
}
