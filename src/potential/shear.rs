//! Shear angle of a cell: how far warp and weft are from 90°, φ = asin(a·b / (|a||b|)), with derivatives in a and b.
//!
//! a and b are the cell's mean side vectors over their rest lengths. Lengths and the angle are rounded off where the cell
//! collapses or closes, so that every derivative stays finite.

use super::rounded::Rounded;
use crate::{
    grid::Shear,
    math::{Mat3, Vec3},
};

/// Weights that make a (warp) and b (weft) from the four corners.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights(pub [[f64; 4]; 2]);

/// Shear angle [rad] and its gradient in a and b.
#[derive(Clone, Copy, Debug)]
pub struct Angle {
    /// φ [rad].
    pub value: f64,
    /// ∂φ/∂(a, b).
    pub gradient: [Vec3; 2],
    vectors: [Vec3; 2],
    /// Of |a|² and |b|².
    rounded: [Rounded; 2],
    /// a·b.
    dot: f64,
    sine: f64,
    /// Of the sine over a·b.
    root: f64,
}

/// Keeps the sine below 1, so that a closed cell has a finite slope.
pub(super) const REACH: f64 = 1.0 - 1e-10;

impl Weights {
    /// The weights of a cell.
    pub fn new(shear: &Shear) -> Weights {
        let [p, q] = shear.lengths.map(|l| 0.5 / l);
        Weights([[-p, p, -p, p], [-q, -q, q, q]])
    }

    /// a and b at the corners' positions.
    pub fn vectors(&self, x: [Vec3; 4]) -> [Vec3; 2] {
        self.0.map(|w| x[0] * w[0] + x[1] * w[1] + x[2] * w[2] + x[3] * w[3])
    }

    /// Gradient of the angle in each corner.
    pub fn spread(&self, gradient: &[Vec3; 2]) -> [Vec3; 4] {
        std::array::from_fn(|n| gradient[0] * self.0[0][n] + gradient[1] * self.0[1][n])
    }
}

/// Shear angle of the side vectors a and b.
pub fn angle([a, b]: [Vec3; 2]) -> Angle {
    let rounded = [a, b].map(|v| Rounded::new(v.norm_squared()));
    let root = REACH * (rounded[0].inverse * rounded[1].inverse).sqrt();
    let dot = a.dot(&b);
    let sine = dot * root;
    let slope = 1.0 / (1.0 - sine * sine).sqrt();
    let [p, q] = rounded.map(|r| r.first);
    let gradient = [(b - a * (dot * p)) * (root * slope), (a - b * (dot * q)) * (root * slope)];
    Angle { value: sine.asin(), gradient, vectors: [a, b], rounded, dot, sine, root }
}

impl Angle {
    /// ∂²φ over (a, b): the blocks aa, ab, bb.
    pub fn hessian(&self) -> [Mat3; 3] {
        let [a, b] = self.vectors;
        let ([p, q], u) = (self.rounded.map(|r| r.first), self.dot);
        let [second_a, second_b] = self.rounded.map(|r| r.second);
        let slope = 1.0 / (1.0 - self.sine * self.sine).sqrt();
        let scale = slope * self.root;
        let (aa, ab, bb) = (a * a.transpose(), a * b.transpose(), b * b.transpose());
        let one = Mat3::identity();
        let both = ab + ab.transpose();
        // d²(asin s) = slope d²s + s slope³ ds dsᵀ, and the gradient already holds one slope.
        let bend = self.sine * slope;
        let [ga, gb] = self.gradient;
        [
            (both * -p - one * (u * p) + aa * (u * second_a)) * scale + ga * ga.transpose() * bend,
            (one - bb * q - aa * p + ab * (u * p * q)) * scale + ga * gb.transpose() * bend,
            (both * -q - one * (u * q) + bb * (u * second_b)) * scale + gb * gb.transpose() * bend,
        ]
    }
}
