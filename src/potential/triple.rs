//! Signed normal curvature of a triple: κ = n · D, with first and second derivatives.
//!
//! D = 2 (t2 − t1)/(L1 + L2) is linear in the positions (t = e/L, which a strain of ε changes by ε), and n is the unit normal
//! of a × b, the scaled central differences along the line and across it. In-plane bending is left to shear. The normal
//! is rounded off where a and b become parallel, so that every derivative stays finite.

use crate::{
    grid::Triple,
    math::{Mat3, Vec3},
};

/// Weights that make a (tangent), b (transverse tangent) and D (curvature vector) from the five nodes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights(pub [[f64; 5]; 3]);

/// Signed curvature [1/m] and its gradient in a, b and D.
#[derive(Clone, Copy, Debug)]
pub struct Curvature {
    /// κ [1/m].
    pub value: f64,
    /// ∂κ/∂(a, b, D).
    pub gradient: [Vec3; 3],
    vectors: [Vec3; 3],
    /// a × b.
    normal: Vec3,
    /// Rounded length of a × b.
    length: f64,
}

/// Squared rounding of |a × b|, which is 1 on a flat sheet.
const ROUNDING: f64 = 1e-6;

impl Weights {
    /// The weights of a triple; weft triples flip b so that both directions share one normal, warp × weft.
    pub fn new(triple: &Triple) -> Weights {
        let [l1, l2] = triple.lengths;
        let along = 1.0 / (l1 + l2);
        let across = if triple.direction == 0 { 1.0 } else { -1.0 } / triple.span;
        let [d1, d2] = [2.0 * along / l1, 2.0 * along / l2];
        let mut tangent = [0.0, 0.0, 0.0, -across, across];
        // Where the sheet ends, the centre stands in for the missing neighbour: give its weight to the centre itself.
        for side in [3, 4] {
            if triple.nodes[side] == triple.nodes[1] {
                tangent[1] += std::mem::take(&mut tangent[side]);
            }
        }
        Weights([[-along, 0.0, along, 0.0, 0.0], tangent, [d1, -d1 - d2, d2, 0.0, 0.0]])
    }

    /// The same weights with the nodes in another order.
    pub fn permuted(&self, order: [usize; 5]) -> Weights {
        Weights(self.0.map(|row| order.map(|n| row[n])))
    }

    /// a, b and D at the nodes' positions.
    pub fn vectors(&self, x: [Vec3; 5]) -> [Vec3; 3] {
        self.0.map(|w| x[0] * w[0] + x[1] * w[1] + x[2] * w[2] + x[3] * w[3] + x[4] * w[4])
    }

    /// Gradient of the curvature in each node.
    pub fn spread(&self, gradient: &[Vec3; 3]) -> [Vec3; 5] {
        let w = &self.0;
        std::array::from_fn(|n| gradient[0] * w[0][n] + gradient[1] * w[1][n] + gradient[2] * w[2][n])
    }
}

/// Curvature of the vectors a, b, D.
pub fn curvature([a, b, d]: [Vec3; 3]) -> Curvature {
    let normal = a.cross(&b);
    let square = normal.norm_squared() + ROUNDING;
    let length = square.sqrt();
    let value = normal.dot(&d) / length;
    let by_normal = d / length - normal * (value / square);
    let gradient = [b.cross(&by_normal), by_normal.cross(&a), normal / length];
    Curvature { value, gradient, vectors: [a, b, d], normal, length }
}

impl Curvature {
    /// ∂²κ over (a, b, D): the blocks aa, ab, aD, bb, bD; DD is zero.
    pub fn hessian(&self) -> [Mat3; 5] {
        let [a, b, d] = self.vectors;
        let (n, m) = (self.normal, self.length);
        let m3 = m * m * m;
        let f = self.value * m;
        let dn = d * n.transpose();
        let nn = n * n.transpose();
        let by_normal = d / m - n * (f / m3);
        let normal2 = (dn + dn.transpose()) * (-1.0 / m3) - Mat3::identity() * (f / m3) + nn * (3.0 * f / (m3 * m * m));
        let mixed = Mat3::identity() / m - nn / m3;
        let [ja, jb] = [-b.cross_matrix(), a.cross_matrix()];
        let [ta, tb] = [ja.transpose(), jb.transpose()];
        [
            ta * normal2 * ja,
            ta * normal2 * jb - by_normal.cross_matrix(),
            ta * mixed,
            tb * normal2 * jb,
            tb * mixed,
        ]
    }
}
