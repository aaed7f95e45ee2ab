//! A second opinion on distances: parry's own algorithms (GJK on shapes, winding numbers on solids), sharing no code with contact.
//!
//! Slow; for checks at the start of a world, in tests and in benches. Physics between goes by `potential::contact`.

use super::{Obstacle, Shape};
use crate::math::Vec3;
use nalgebra::{Isometry3, Point3};
use parry3d_f64::{
    math::{Pose, Vector},
    query,
    shape::{Ball, Capsule, Cuboid, HalfSpace, SharedShape, TriMesh, Triangle},
};

/// An obstacle as parry knows it.
pub struct Witness {
    shape: SharedShape,
    /// Radius of a ball around the own origin that holds it [m].
    reach: f64,
    obstacle: Obstacle,
}

impl Witness {
    /// The obstacle's double.
    pub fn new(obstacle: &Obstacle) -> Witness {
        let vector = |p: &Vec3| Vector::new(p.x, p.y, p.z);
        let shape = match &obstacle.shape {
            Shape::Cuboid { half } => SharedShape::new(Cuboid::new(Vector::new(half[0], half[1], half[2]))),
            Shape::Sphere { radius } => SharedShape::new(Ball::new(*radius)),
            Shape::Capsule { half, radius } => SharedShape::new(Capsule::new_z(*half, *radius)),
            Shape::Plane => SharedShape::new(HalfSpace::new(Vector::new(0.0, 0.0, 1.0))),
            Shape::Polyhedron(solid) => {
                let points = solid.points().iter().map(vector).collect();
                let mesh = TriMesh::new(points, solid.faces().to_vec());
                SharedShape::new(mesh.expect("a solid is a mesh"))
            }
        };
        Witness { shape, reach: obstacle.shape.reach(), obstacle: obstacle.clone() }
    }

    /// Distance [m] between a triangle and the obstacle at `pose`; 0 where they meet, and where a particle is inside. Exact below
    /// `bound`, which saves work.
    pub fn distance(&self, pose: &Isometry3<f64>, triangle: [Vec3; 3], bound: f64) -> f64 {
        let local = triangle.map(|p| pose.inverse_transform_point(&Point3::from(p)).coords);
        let size = (local[1] - local[0]).norm().max((local[2] - local[0]).norm());
        let far = local[0].norm() - size - self.reach;
        if far > bound {
            return far;
        }
        let is_inside = |p: &Vec3| match &self.obstacle.shape {
            Shape::Polyhedron(solid) => solid.gap(*p).value <= 0.0,
            _ => false,
        };
        if local.iter().any(is_inside) {
            return 0.0;
        }
        let [a, b, c] = local.map(|p| Vector::new(p.x, p.y, p.z));
        let still = Pose::IDENTITY;
        let found = query::distance(&still, &Triangle::new(a, b, c), &still, self.shape.0.as_ref());
        found.expect("parry knows triangles and our shapes").distance
    }
}
