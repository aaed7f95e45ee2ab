//! Obstacles: shapes, poses, the gap between a point and a shape, and how deep a segment cuts into one.
//!
//! Contact acts on particles today; the depth of segments is measured, not yet prevented.

use crate::math::{Mat3, Vec3};
use nalgebra::{Isometry3, Point3};

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

/// Signed distance of a point to a surface, with derivatives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gap {
    /// Distance [m], negative inside.
    pub value: f64,
    /// Outward normal: the gradient.
    pub normal: Vec3,
    /// Second derivative [1/m].
    pub hessian: Mat3,
}

impl Obstacle {
    /// Gap between the point and the surface.
    pub fn gap(&self, point: Vec3) -> Gap {
        let rotation = self.pose.rotation;
        let local = self.pose.inverse_transform_point(&Point3::from(point)).coords;
        let gap = match self.shape {
            Shape::Cuboid { half } => cuboid_gap(local, Vec3::from(half)),
            Shape::Sphere { radius } => sphere_gap(local, radius),
            Shape::Plane => Gap { value: local.z, normal: Vec3::z(), hessian: Mat3::zeros() },
        };
        let r = rotation.to_rotation_matrix();
        Gap {
            normal: rotation * gap.normal,
            hessian: r.matrix() * gap.hessian * r.matrix().transpose(),
            ..gap
        }
    }

    /// Signed distance [m] of the point, without derivatives.
    pub fn distance(&self, point: Vec3) -> f64 {
        let local = self.pose.inverse_transform_point(&Point3::from(point)).coords;
        match self.shape {
            Shape::Cuboid { half } => {
                let d = local.abs() - Vec3::from(half);
                let outside = d.map(|v| v.max(0.0)).norm();
                if outside > 0.0 { outside } else { d.max() }
            }
            Shape::Sphere { radius } => local.norm() - radius,
            Shape::Plane => local.z,
        }
    }

    /// Greatest depth [m] below the surface along the segment from `a` to `b`; 0 when it stays outside.
    pub fn depth(&self, a: Vec3, b: Vec3) -> f64 {
        let [a, b] = [a, b].map(|p| self.pose.inverse_transform_point(&Point3::from(p)).coords);
        match self.shape {
            Shape::Cuboid { half } => cuboid_depth(a, b, Vec3::from(half)),
            Shape::Sphere { radius } => {
                let along = b - a;
                let t = (-a.dot(&along) / along.norm_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
                (radius - (a + along * t).norm()).max(0.0)
            }
            Shape::Plane => (-a.z.min(b.z)).max(0.0),
        }
    }
}

fn sphere_gap(local: Vec3, radius: f64) -> Gap {
    let length = local.norm();
    // At the very centre every direction is as good: up.
    let normal = if length > 1e-12 { local / length } else { Vec3::z() };
    let hessian = (Mat3::identity() - normal * normal.transpose()) / length.max(1e-12);
    Gap { value: length - radius, normal, hessian }
}

fn cuboid_gap(local: Vec3, half: Vec3) -> Gap {
    let sign = local.map(|v| if v < 0.0 { -1.0 } else { 1.0 });
    let beyond = local.abs() - half;
    let outside = beyond.map(|v| v.max(0.0));
    let distance = outside.norm();
    if distance > 0.0 {
        let normal = outside.component_mul(&sign) / distance;
        let active = Mat3::from_diagonal(&beyond.map(|v| if v > 0.0 { 1.0 } else { 0.0 }));
        return Gap {
            value: distance,
            normal,
            hessian: (active - normal * normal.transpose()) / distance.max(1e-9),
        };
    }
    let axis = beyond.imax();
    let mut normal = Vec3::zeros();
    normal[axis] = sign[axis];
    Gap { value: beyond[axis], normal, hessian: Mat3::zeros() }
}

/// Depth is concave along the part of the segment inside the box: clip, then search by thirds.
fn cuboid_depth(a: Vec3, b: Vec3, half: Vec3) -> f64 {
    let along = b - a;
    let (mut from, mut to) = (0.0_f64, 1.0_f64);
    for k in 0..3 {
        if along[k].abs() < 1e-300 {
            if a[k].abs() > half[k] {
                return 0.0;
            }
            continue;
        }
        let [s, t] = [(-half[k] - a[k]) / along[k], (half[k] - a[k]) / along[k]];
        from = from.max(s.min(t));
        to = to.min(s.max(t));
    }
    if from >= to {
        return 0.0;
    }
    let depth = |t: f64| (half - (a + along * t).abs()).min();
    for _ in 0..60 {
        let [s, t] = [from + (to - from) / 3.0, to - (to - from) / 3.0];
        if depth(s) < depth(t) { from = s } else { to = t }
    }
    depth(0.5 * (from + to)).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion};

    fn obstacles() -> Vec<Obstacle> {
        let rotation = UnitQuaternion::from_euler_angles(0.3, -0.7, 1.1);
        let pose = Isometry3::from_parts(Translation3::new(0.1, -0.2, 0.3), rotation);
        [Shape::Cuboid { half: [0.1, 0.2, 0.05] }, Shape::Sphere { radius: 0.15 }, Shape::Plane]
            .map(|shape| Obstacle { name: "it".into(), shape, pose })
            .to_vec()
    }

    #[test]
    fn gap_derivatives_match_differences() {
        for obstacle in obstacles() {
            for local in
                [[0.3, 0.4, 0.2], [0.02, 0.4, 0.01], [0.02, 0.25, 0.3], [0.25, 0.5, 0.4], [-0.3, 0.1, -0.2]]
            {
                let p = obstacle.pose * Point3::from(Vec3::from(local));
                let (p, h) = (p.coords, 1e-5);
                let gap = obstacle.gap(p);
                assert!((gap.value - obstacle.distance(p)).abs() < 1e-15);
                for k in 0..3 {
                    let step = Vec3::ith(k, h);
                    let [up, down] = [obstacle.gap(p + step), obstacle.gap(p - step)];
                    assert!(((up.value - down.value) / (2.0 * h) - gap.normal[k]).abs() < 1e-8);
                    assert!(((up.normal - down.normal) / (2.0 * h) - gap.hessian.column(k)).norm() < 1e-6);
                }
            }
        }
    }

    #[test]
    fn depth_of_a_segment_matches_dense_sampling() {
        for obstacle in obstacles() {
            for (a, b) in [
                ([-0.2, 0.0, 0.0], [0.2, 0.1, 0.03]),
                ([0.3, 0.0, 0.2], [0.0, 0.25, 0.01]),
                ([1.0, 1.0, 1.0], [0.4, 0.5, 0.6]),
            ] {
                let [a, b] = [a, b].map(|v: [f64; 3]| (obstacle.pose * Point3::from(Vec3::from(v))).coords);
                let sampled = (0..=20_000)
                    .map(|k| -obstacle.distance(a + (b - a) * (k as f64 / 20_000.0)))
                    .fold(0.0_f64, f64::max);
                assert!((obstacle.depth(a, b) - sampled).abs() < 1e-5, "{:?}", obstacle.shape);
            }
        }
    }
}
