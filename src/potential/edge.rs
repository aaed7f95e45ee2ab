//! Tensile strain of an edge: ε = l/L − 1, with first and second derivatives in the difference of its ends.

use crate::math::{Mat3, Vec3};

/// Strain of an edge and what its derivatives are made of.
#[derive(Clone, Copy, Debug)]
pub struct Strain {
    /// ε [1].
    pub value: f64,
    /// ∂ε/∂e [1/m], e being end minus start; the gradient in the end, minus the gradient in the start.
    pub gradient: Vec3,
    /// Rest length [m].
    length: f64,
    /// Present length, rounded off at zero [m].
    stretched: f64,
}

/// Rounds the length off where an edge collapses to a point, relative to its rest length.
pub(super) const ROUNDING: f64 = 1e-5;
/// What the rounding leaves of a rest length, so that rest is without strain: √(1 + ROUNDING²).
pub(super) const REST: f64 = 1.0 + 0.5 * ROUNDING * ROUNDING;

/// Strain of the edge vector `e` [m] with rest length `length` [m].
pub fn strain(e: Vec3, length: f64) -> Strain {
    let rounding = ROUNDING * length;
    let stretched = (e.norm_squared() + rounding * rounding).sqrt();
    Strain { value: stretched / length - REST, gradient: e / (stretched * length), length, stretched }
}

impl Strain {
    /// ∂²ε/∂e² [1/m²].
    pub fn hessian(&self) -> Mat3 {
        let t = self.gradient * self.length;
        (Mat3::identity() - t * t.transpose()) / (self.stretched * self.length)
    }
}
