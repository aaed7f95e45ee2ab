//! Twist of a cell: how far its two opposite sides are turned against each other, τ = n · D, with derivatives in a, b and D.
//!
//! a and b are the cell's mean side vectors over their rest lengths, D is the mixed difference of its corners over the product of its rest
//! lengths, n the unit normal of a × b. Bending along warp or weft and every plane deformation leave τ at 0. No KES test measures
//! twist: the energy per area is ½ T τ² without hysteresis, T `chosen`. With T = 2B in a fabric alike in warp and weft, ½ (B κ₁² + B κ₂² + T τ²)
//! is the same in all directions: bending on the bias then resists like bending along a thread. Corners that hang are
//! bending's cubic ghosts: linear ones would turn half of a curvature into twist. The normal is rounded off where a × b vanishes.

use super::{rounded::Rounded, shear};
use crate::{
    grid::Shear,
    math::{Mat3, Vec3},
};

/// Twist [1/m] and its gradient in a, b and D.
#[derive(Clone, Copy, Debug)]
pub struct Twist {
    /// τ [1/m].
    pub value: f64,
    /// ∂τ/∂(a, b, D).
    pub gradient: [Vec3; 3],
    vectors: [Vec3; 3],
    /// a × b, and of its square.
    normal: Vec3,
    rounded: Rounded,
}

/// Weights that make a, b and D from the four corners (0,0), (1,0), (0,1), (1,1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights(pub [[f64; 4]; 3]);

impl Weights {
    /// The weights of a cell.
    pub fn new(cell: &Shear) -> Weights {
        let [a, b] = shear::Weights::new(cell).0;
        let d = 1.0 / (cell.lengths[0] * cell.lengths[1]);
        Weights([a, b, [d, -d, -d, d]])
    }

    /// a, b and D at the corners' positions.
    pub fn vectors(&self, x: [Vec3; 4]) -> [Vec3; 3] {
        self.0.map(|w| x[0] * w[0] + x[1] * w[1] + x[2] * w[2] + x[3] * w[3])
    }

    /// Gradient in each corner of what has this gradient in a, b and D.
    pub fn spread(&self, gradient: &[Vec3; 3]) -> [Vec3; 4] {
        std::array::from_fn(|n| (0..3).map(|v| gradient[v] * self.0[v][n]).sum())
    }
}

/// Twist of the vectors a, b and D.
pub fn twist([a, b, d]: [Vec3; 3]) -> Twist {
    let normal = a.cross(&b);
    let rounded = Rounded::new(normal.norm_squared());
    let root = rounded.inverse.sqrt();
    let value = normal.dot(&d) * root;
    let by_normal = d * root - normal * (value * rounded.first);
    let gradient = [b.cross(&by_normal), by_normal.cross(&a), normal * root];
    Twist { value, gradient, vectors: [a, b, d], normal, rounded }
}

impl Twist {
    /// ∂²τ over (a, b, D): the blocks aa, ab, aD, bb, bD; DD is 0.
    pub fn hessian(&self) -> [Mat3; 5] {
        let ([a, b, d], n, tau) = (self.vectors, self.normal, self.value);
        let Rounded { inverse, first, second } = self.rounded;
        let root = inverse.sqrt();
        let (dn, nn, one) = (d * n.transpose(), n * n.transpose(), Mat3::identity());
        let by_normal = d * root - n * (tau * first);
        let normal2 = (dn + dn.transpose()) * -(root * first) - one * (tau * first) + nn * (tau * second);
        let mixed = (one - nn * first) * root;
        let [ja, jb] = [-b.cross_matrix(), a.cross_matrix()];
        [
            ja.tr_mul(&(normal2 * ja)),
            ja.tr_mul(&(normal2 * jb)) - by_normal.cross_matrix(),
            ja.tr_mul(&mixed),
            jb.tr_mul(&(normal2 * jb)),
            jb.tr_mul(&mixed),
        ]
    }

    /// ∂²τ times a displacement of (a, b, D).
    pub fn hessian_times(&self, v: [Vec3; 3]) -> [Vec3; 3] {
        let [aa, ab, ad, bb, bd] = self.hessian();
        [
            aa * v[0] + ab * v[1] + ad * v[2],
            ab.tr_mul(&v[0]) + bb * v[1] + bd * v[2],
            ad.tr_mul(&v[0]) + bd.tr_mul(&v[1]),
        ]
    }
}
