//! Small linear algebra: the nalgebra types used everywhere, and packs of numbers for the innermost loops.

/// 3-vector: a position [m], a velocity [m/s] or a force [N].
pub type Vec3 = nalgebra::Vector3<f64>;
/// 3 × 3 matrix.
pub type Mat3 = nalgebra::Matrix3<f64>;

pub mod block;
pub mod pack;
