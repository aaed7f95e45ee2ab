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

    /// Distance [m] between the triangles of a surface and the obstacle at `pose`; 0 where they meet, and where a particle is
    /// inside; NaN where a particle is nowhere. Exact below `bound`, which saves work.
    pub fn distance(&self, pose: &Isometry3<f64>, x: &[Vec3], triangles: &[[u32; 3]], bound: f64) -> f64 {
        let local: Vec<Vec3> =
            x.iter().map(|p| pose.inverse_transform_point(&Point3::from(*p)).coords).collect();
        let is_nowhere = |t: &[u32; 3]| t.iter().any(|&n| !local[n as usize].iter().all(|v| v.is_finite()));
        if triangles.iter().any(is_nowhere) {
            return f64::NAN;
        }
        let mut inside = vec![None; local.len()];
        let mut smallest = bound;
        for nodes in triangles {
            let triangle = nodes.map(|n| local[n as usize]);
            let size = (triangle[1] - triangle[0]).norm().max((triangle[2] - triangle[0]).norm());
            if triangle[0].norm() - size - self.reach > smallest {
                continue;
            }
            for n in nodes.map(|n| n as usize) {
                if *inside[n].get_or_insert_with(|| self.holds(local[n])) {
                    return 0.0;
                }
            }
            let [a, b, c] = triangle.map(|p| Vector::new(p.x, p.y, p.z));
            let still = Pose::IDENTITY;
            let found = query::distance(&still, &Triangle::new(a, b, c), &still, self.shape.0.as_ref());
            smallest = smallest.min(found.expect("parry knows triangles and our shapes").distance);
        }
        smallest
    }

    /// Whether a mesh holds a point of its own frame; parry's other shapes are solid anyway.
    fn holds(&self, point: Vec3) -> bool {
        match &self.obstacle.shape {
            Shape::Polyhedron(solid) => solid.gap(point).value <= 0.0,
            _ => false,
        }
    }
}
