//! A second opinion on distances: parry's closed forms of points, segments and triangles, sharing no code with contact.
//!
//! Not by GJK, which stops at about 1e-9 m and calls that a meeting, and which slivers of metres lead astray. Slow; for checks at
//! the start of a world, in tests and in benches. Physics between goes by `potential::contact`.

use super::{Obstacle, Polyhedron, Shape};
use crate::math::Vec3;
use nalgebra::{Isometry3, Point3};
use parry3d_f64::{
    bounding_volume::BoundingVolume,
    math::{Pose, Vector},
    query::{PointQuery, Ray, RayCast, details::closest_points_segment_segment_with_locations as nearest},
    shape::{Cuboid, Segment, TriMesh, Triangle},
};
use std::sync::Arc;

/// Own units in a metre, as parry's thresholds are absolute and fit lengths of millimetres.
const UNITS: f64 = 1e3;

/// An obstacle as parry knows it.
pub struct Witness {
    core: Core,
    /// What is nearer to the core than this is inside.
    radius: f64,
    /// Radius [m] of a ball around the own origin that holds the obstacle.
    reach: f64,
}

/// What a shape is made of, in own units.
enum Core {
    /// Of no length in a sphere.
    Axis(Segment),
    /// Below z = 0.
    HalfSpace,
    /// A surface, and the solid within it in metres.
    Faces(Box<TriMesh>, Solid),
}

enum Solid {
    Cuboid(Cuboid),
    Polyhedron(Arc<Polyhedron>),
}

impl Witness {
    /// The obstacle's double.
    pub fn new(obstacle: &Obstacle) -> Witness {
        let surface = |points: Vec<Vector>, faces: Vec<[u32; 3]>| {
            let points = points.into_iter().map(|p| p * UNITS).collect();
            Box::new(TriMesh::new(points, faces).expect("a solid is a mesh"))
        };
        let (core, radius) = match &obstacle.shape {
            Shape::Cuboid { half } => {
                let cuboid = Cuboid::new(Vector::from(*half));
                let (points, faces) = cuboid.to_trimesh();
                (Core::Faces(surface(points, faces), Solid::Cuboid(cuboid)), 0.0)
            }
            Shape::Sphere { radius } => (Core::Axis(Segment::new(Vector::ZERO, Vector::ZERO)), *radius),
            Shape::Capsule { half, radius } => {
                let end = Vector::new(0.0, 0.0, half * UNITS);
                (Core::Axis(Segment::new(-end, end)), *radius)
            }
            Shape::Plane => (Core::HalfSpace, 0.0),
            Shape::Polyhedron(solid) => {
                let points = solid.points().iter().map(|p| Vector::new(p.x, p.y, p.z)).collect();
                let faces = surface(points, solid.faces().to_vec());
                (Core::Faces(faces, Solid::Polyhedron(solid.clone())), 0.0)
            }
        };
        Witness { core, radius: radius * UNITS, reach: obstacle.shape.reach() }
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
            let [a, b, c] = triangle.map(|p| Vector::new(p.x, p.y, p.z) * UNITS);
            let far = self.far(&Triangle::new(a, b, c), smallest * UNITS + self.radius);
            smallest = smallest.min((far - self.radius).max(0.0) / UNITS);
        }
        smallest
    }

    /// Distance of a triangle to the core, exact below `bound`.
    fn far(&self, triangle: &Triangle, bound: f64) -> f64 {
        match &self.core {
            Core::Axis(segment) => to_segment(triangle, segment),
            Core::HalfSpace => triangle.vertices().iter().map(|p| p.z).fold(f64::INFINITY, f64::min),
            Core::Faces(mesh, _) => {
                let near = triangle.local_aabb().loosened(bound);
                let faces = mesh.bvh().intersect_aabb(&near).map(|face| mesh.triangle(face));
                faces.map(|face| between(triangle, &face)).fold(f64::INFINITY, f64::min)
            }
        }
    }

    /// Whether a solid within a surface holds a point of its own frame.
    fn holds(&self, point: Vec3) -> bool {
        match &self.core {
            Core::Faces(_, Solid::Cuboid(solid)) => {
                solid.contains_local_point(Vector::new(point.x, point.y, point.z))
            }
            Core::Faces(_, Solid::Polyhedron(solid)) => solid.gap(point).value <= 0.0,
            _ => false,
        }
    }
}

/// Distance of a triangle to a segment: between two edges, or from an end to the face, or none where the segment pierces it.
fn to_segment(triangle: &Triangle, segment: &Segment) -> f64 {
    let ray = Ray::new(segment.a, segment.b - segment.a);
    if triangle.cast_local_ray(&ray, 1.0, true).is_some() {
        return 0.0;
    }
    let edges = triangle.edges().into_iter().map(|edge| {
        let (one, other) = nearest(&Pose::IDENTITY, &edge, segment);
        (edge.point_at(&one) - segment.point_at(&other)).length()
    });
    let ends =
        [segment.a, segment.b].map(|end| (triangle.project_local_point(end, true).point - end).length());
    edges.chain(ends).fold(f64::INFINITY, f64::min)
}

/// Distance of two triangles.
fn between(one: &Triangle, other: &Triangle) -> f64 {
    let all = other.edges().map(|edge| to_segment(one, &edge)).into_iter();
    all.chain(one.edges().map(|edge| to_segment(other, &edge))).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gap of a capsule to one triangle, far apart otherwise.
    fn gap(half: f64, radius: f64, triangle: [[f64; 3]; 3]) -> f64 {
        let obstacle = Obstacle {
            name: "it".into(),
            shape: Shape::Capsule { half, radius },
            pose: Isometry3::identity(),
            friction: None,
        };
        let x = triangle.map(|[x, y, z]| Vec3::new(x, y, z));
        Witness::new(&obstacle).distance(&obstacle.pose, &x, &[[0, 1, 2]], 1.0)
    }

    /// Both made GJK report a meeting; the references are minima in 60 digits, over the axis and each triangle.
    #[test]
    fn small_gaps_and_slivers_are_measured_exactly() {
        let close = gap(
            0.00948407873234795,
            0.006205368421670884,
            [
                [0.002241290130749007, -0.001473071850717574, -0.015079905791784514],
                [0.01981243050661042, 0.004517167312520876, -0.01420091101509516],
                [0.015430443896397552, 0.02243539951591723, -0.020128726256470032],
            ],
        );
        assert!((close - 4.317247e-10).abs() < 1e-15, "{close:e}");
        let sliver = gap(
            0.015780546661632196,
            0.01289155941098819,
            [
                [0.7495928888134433, 0.8360445642798207, 1.0511603223407595],
                [-0.04952897874338828, -0.05651631725925309, -0.0348894173854353],
                [3.3785592112240526, 3.7531192028284632, 4.6044463252515],
            ],
        );
        assert!((sliver - 9.862682e-6).abs() < 1e-11, "{sliver:e}");
        let pierced = gap(0.1, 0.001, [[-1.0, -1.0, 0.02], [1.0, -1.0, 0.02], [0.0, 1.0, 0.02]]);
        assert_eq!(pierced, 0.0);
    }

    #[test]
    fn boxes_are_measured_by_faces_edges_and_corners() {
        let obstacle = Obstacle {
            name: "it".into(),
            shape: Shape::Cuboid { half: [0.01, 0.02, 0.03] },
            pose: Isometry3::identity(),
            friction: None,
        };
        let witness = Witness::new(&obstacle);
        let far = |x: [[f64; 3]; 3]| {
            let x = x.map(|[x, y, z]| Vec3::new(x, y, z));
            witness.distance(&obstacle.pose, &x, &[[0, 1, 2]], 1.0)
        };
        let near = |a: f64, b: f64| (a - b).abs() < 1e-15;
        // A triangle's face above a corner, an edge across a ridge, one wholly inside.
        let face = far([[-0.1, -0.1, 0.031], [0.2, -0.1, 0.031], [-0.1, 0.2, 0.031]]);
        assert!(near(face, 0.001), "{face}");
        let across = far([[0.02, 0.015, 0.0], [0.005, 0.03, 0.0], [0.1, 0.1, 0.0]]);
        assert!(near(across, 0.005 / 2.0_f64.sqrt()), "{across}");
        assert_eq!(far([[0.0, 0.0, 0.0], [0.001, 0.0, 0.0], [0.0, 0.001, 0.0]]), 0.0);
    }
}
