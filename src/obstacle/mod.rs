//! Obstacles: shapes, poses, gaps of points, and the features (corners, ridges, faces) that a cloth can touch.
//!
//! A shape is a skeleton of features, thickened by a radius: a ball is one corner, a capsule one ridge with two corners.
//! Cloth is not known here; what touches what is the business of `potential::contact`.

pub mod barrier;
pub mod gap;
mod motion;
pub mod witness;
mod polyhedron;

use crate::math::Vec3;
pub use gap::Gap;
pub use motion::{Motion, slide, with_unit_rotation};
use nalgebra::{Isometry3, Point3};
pub use polyhedron::{Polyhedron, Unfit};
use std::sync::Arc;

/// Shape of an obstacle, in its own frame.
#[derive(Clone, Debug, PartialEq)]
pub enum Shape {
    /// Box with half lengths [m] along its own axes, centred at the origin.
    Cuboid { half: [f64; 3] },
    /// Ball of this radius [m], centred at the origin.
    Sphere { radius: f64 },
    /// All points nearer than `radius` [m] to the segment from −`half` to `half` [m] on the own z axis.
    Capsule { half: f64, radius: f64 },
    /// Half space below its own plane z = 0.
    Plane,
    /// Convex hull or closed triangle mesh.
    Polyhedron(Arc<Polyhedron>),
}

/// A rigid obstacle at a pose.
#[derive(Clone, Debug)]
pub struct Obstacle {
    /// Name, unique in a scene.
    pub name: String,
    /// Shape in its own frame.
    pub shape: Shape,
    /// World from obstacle, at the start.
    pub pose: Isometry3<f64>,
    /// Coulomb friction coefficient against the fabric; none: the fabric's own.
    pub friction: Option<f64>,
}

/// What of an obstacle can meet edges and triangles of a cloth, in one frame.
#[derive(Clone, Debug, Default)]
pub struct Features {
    /// Points [m].
    pub points: Vec<Vec3>,
    /// Convex edges, as indices into `points`.
    pub ridges: Vec<[u32; 2]>,
    /// The lines that ridges lie on, where the features are placed.
    axes: Vec<Axis>,
    /// Ends of ridges, as indices into `points`.
    pub corners: Vec<u32>,
    /// Triangles of a polyhedron; of other shapes none.
    pub faces: Vec<[u32; 3]>,
    /// The patch that each face is part of: a whole convex solid, else faces in one plane that hang together.
    pub patches: Vec<u32>,
    /// A ball that holds each face: centre and radius [m].
    pub balls: Vec<(Vec3, f64)>,
    /// What the skeleton is thickened by [m].
    pub radius: f64,
}

/// A ridge as a line: where it starts, its direction, its length [m].
#[derive(Clone, Copy, Debug)]
struct Axis {
    start: Vec3,
    along: Vec3,
    length: f64,
}

impl Features {
    /// The features with their frame at `pose`.
    pub fn placed(&self, pose: &Isometry3<f64>) -> Features {
        let mut placed = self.clone();
        self.place(pose, &mut placed);
        placed
    }

    /// Moves a copy of the features so that their frame is at `pose`.
    pub fn place(&self, pose: &Isometry3<f64>, placed: &mut Features) {
        let place = |p: &Vec3| (pose * Point3::from(*p)).coords;
        placed.points.iter_mut().zip(&self.points).for_each(|(to, p)| *to = place(p));
        placed.balls.iter_mut().zip(&self.balls).for_each(|(to, (center, _))| to.0 = place(center));
        placed.axes.clear();
        placed.axes.extend((0..self.ridges.len()).map(|ridge| {
            let [start, end] = self.ridges[ridge].map(|n| placed.points[n as usize]);
            let length = (end - start).norm();
            Axis { start, along: (end - start) / length, length }
        }));
    }

    /// Ends of a ridge [m].
    pub fn ridge(&self, ridge: u32) -> [Vec3; 2] {
        self.ridges[ridge as usize].map(|n| self.points[n as usize])
    }

    /// Squared distance of a ridge of placed features from a point [m²].
    pub fn ridge_from(&self, ridge: u32, point: Vec3) -> f64 {
        let Axis { start, along, length } = self.axes[ridge as usize];
        let offset = point - start;
        (offset - along * offset.dot(&along).clamp(0.0, length)).norm_squared()
    }

    /// Corners of a face [m].
    pub fn face(&self, face: u32) -> [Vec3; 3] {
        self.faces[face as usize].map(|n| self.points[n as usize])
    }

    /// A lower bound on the distance of a face from a point [m], at a fraction of the exact one's cost.
    pub fn face_at_least(&self, face: u32, point: Vec3) -> f64 {
        let (center, radius) = self.balls[face as usize];
        (point - center).norm() - radius
    }
}

impl Shape {
    /// Features in the shape's own frame.
    pub fn features(&self) -> Features {
        match self {
            Shape::Plane => Features::default(),
            Shape::Sphere { radius } => Features {
                points: vec![Vec3::zeros()],
                corners: vec![0],
                radius: *radius,
                ..Features::default()
            },
            Shape::Capsule { half, radius } => Features {
                points: [-half, *half].map(|z| Vec3::z() * z).to_vec(),
                ridges: vec![[0, 1]],
                corners: vec![0, 1],
                radius: *radius,
                ..Features::default()
            },
            Shape::Cuboid { half } => {
                let sign = |n: u32, axis: u32| if n >> axis & 1 == 1 { 1.0 } else { -1.0 };
                let corner = |n: u32| Vec3::from_fn(|axis, _| sign(n, axis as u32) * half[axis]);
                let ridges = (0..8_u32).flat_map(|n| (0..3).map(move |axis| [n, n | 1 << axis]));
                Features {
                    points: (0..8).map(corner).collect(),
                    ridges: ridges.filter(|[a, b]| a != b).collect(),
                    corners: (0..8).collect(),
                    ..Features::default()
                }
            }
            Shape::Polyhedron(solid) => solid.features(),
        }
    }

    /// Whether every segment between two of its points lies in it.
    pub fn is_convex(&self) -> bool {
        match self {
            Shape::Polyhedron(solid) => solid.is_convex(),
            _ => true,
        }
    }

    /// Gap of a point in the shape's own frame; of a mesh that is not convex, to the nearest face.
    fn gap(&self, local: Vec3) -> Gap {
        match self {
            Shape::Cuboid { half } => gap::cuboid(local, Vec3::from(*half)),
            Shape::Sphere { radius } => gap::ball(local, *radius),
            Shape::Capsule { half, radius } => gap::capsule(local, *half, *radius),
            Shape::Plane => Gap { value: local.z, normal: Vec3::z(), hessian: nalgebra::zero() },
            Shape::Polyhedron(solid) => solid.gap(local),
        }
    }

    /// The gap's value alone [m]: of a box at a fraction of the cost.
    fn distance(&self, local: Vec3) -> f64 {
        match self {
            Shape::Cuboid { half } => gap::cuboid_distance(local, Vec3::from(*half)),
            _ => self.gap(local).value,
        }
    }

    /// Radius [m] of a ball around the own origin that holds the shape; infinite for a plane.
    pub fn reach(&self) -> f64 {
        match self {
            Shape::Plane => f64::INFINITY,
            _ => {
                let features = self.features();
                features.points.iter().map(|p| p.norm()).fold(0.0, f64::max) + features.radius
            }
        }
    }
}

impl Obstacle {
    /// Gap between the point and the surface, with the obstacle at `pose`.
    pub fn gap_at(&self, pose: &Isometry3<f64>, point: Vec3) -> Gap {
        let local = pose.inverse_transform_point(&Point3::from(point)).coords;
        self.shape.gap(local).rotated(&pose.rotation)
    }

    /// The value alone of `gap_at` [m].
    pub fn distance_at(&self, pose: &Isometry3<f64>, point: Vec3) -> f64 {
        self.shape.distance(pose.inverse_transform_point(&Point3::from(point)).coords)
    }

    /// Gap between the point and the surface, with the obstacle where it starts.
    pub fn gap(&self, point: Vec3) -> Gap {
        self.gap_at(&self.pose, point)
    }

    /// Greatest depth [m] below the surface along the segment from `a` to `b`, searched by thirds as in a convex shape; 0 when it
    /// stays outside.
    pub fn depth(&self, pose: &Isometry3<f64>, a: Vec3, b: Vec3) -> f64 {
        let gap = |t: f64| self.distance_at(pose, a + (b - a) * t);
        let (mut from, mut to) = (0.0, 1.0);
        for _ in 0..40 {
            let [s, t] = [from + (to - from) / 3.0, to - (to - from) / 3.0];
            if gap(s) > gap(t) { from = s } else { to = t }
        }
        (-gap(0.5 * (from + to))).max(0.0)
    }

    /// A lower bound on the distance [m] of a point outside, exact for all shapes but polyhedra.
    pub fn at_least(&self, pose: &Isometry3<f64>, reach: f64, point: Vec3) -> f64 {
        match self.shape {
            Shape::Polyhedron(_) => (point - pose.translation.vector).norm() - reach,
            _ => self.distance_at(pose, point),
        }
    }
}
