//! Obstacles: shapes, poses and the gap between a point and a shape.

use nalgebra::Isometry3;

/// Shape of an obstacle, in its own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Box with half lengths [m] along its own axes, centred at the origin.
    Cuboid { half: [f64; 3] },
    /// Ball of this radius [m], centred at the origin.
    Sphere { radius: f64 },
    /// Half space below its own plane z = 0.
    Plane,
}

/// A rigid obstacle at a pose.
#[derive(Clone, Debug)]
pub struct Obstacle {
    /// Name, unique in a scene.
    pub name: String,
    /// Shape in its own frame.
    pub shape: Shape,
    /// World from obstacle.
    pub pose: Isometry3<f64>,
}
