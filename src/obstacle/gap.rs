//! Signed distance of a point to a shape, with first and second derivatives, in closed form.

use crate::math::{Mat3, Vec3};
use nalgebra::UnitQuaternion;

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

impl Gap {
    /// The gap in another frame.
    pub fn rotated(&self, rotation: &UnitQuaternion<f64>) -> Gap {
        let r = rotation.to_rotation_matrix();
        Gap {
            value: self.value,
            normal: r * self.normal,
            hessian: r.matrix() * self.hessian * r.matrix().transpose(),
        }
    }

    /// Gap to a point-like surface seen along `offset`, free to turn in the space that `free` projects to.
    fn round(offset: Vec3, free: Mat3) -> Gap {
        let length = offset.norm();
        // At the very centre every direction is as good: up.
        let normal = if length > 1e-12 { offset / length } else { Vec3::z() };
        let hessian = (free - normal * normal.transpose()) / length.max(1e-12);
        Gap { value: length, normal, hessian }
    }
}

/// Gap to a ball around the origin.
pub fn ball(point: Vec3, radius: f64) -> Gap {
    let gap = Gap::round(point, Mat3::identity());
    Gap { value: gap.value - radius, ..gap }
}

/// Gap to a capsule along the z axis.
pub fn capsule(point: Vec3, half: f64, radius: f64) -> Gap {
    let along = point.z.clamp(-half, half);
    let free =
        if along == point.z { Mat3::from_diagonal(&Vec3::new(1.0, 1.0, 0.0)) } else { Mat3::identity() };
    let gap = Gap::round(point - Vec3::z() * along, free);
    Gap { value: gap.value - radius, ..gap }
}

/// Signed distance to a box around the origin alone [m].
pub fn cuboid_distance(point: Vec3, half: Vec3) -> f64 {
    let beyond = point.abs() - half;
    let outside = beyond.map(|v| v.max(0.0)).norm();
    if outside > 0.0 { outside } else { beyond.max() }
}

/// Gap to a box around the origin.
pub fn cuboid(point: Vec3, half: Vec3) -> Gap {
    let sign = point.map(|v| if v < 0.0 { -1.0 } else { 1.0 });
    let beyond = point.abs() - half;
    let outside = beyond.map(|v| v.max(0.0));
    if outside.norm() > 0.0 {
        let free = Mat3::from_diagonal(&beyond.map(|v| if v > 0.0 { 1.0 } else { 0.0 }));
        return Gap::round(outside.component_mul(&sign), free);
    }
    let axis = beyond.imax();
    let mut normal = Vec3::zeros();
    normal[axis] = sign[axis];
    Gap { value: beyond[axis], normal, hessian: Mat3::zeros() }
}

/// Distance of a point to a triangle, never negative.
pub fn triangle(point: Vec3, corners: [Vec3; 3]) -> Gap {
    let weights = nearest_on_triangle(point, corners);
    let foot = corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2];
    let [a, b, c] = corners;
    let free = match weights.map(|w| w > 0.0) {
        [true, true, true] => {
            let normal = (b - a).cross(&(c - a)).normalize();
            normal * normal.transpose()
        }
        [true, true, false] => across(b - a),
        [true, false, true] => across(c - a),
        [false, true, true] => across(c - b),
        _ => Mat3::identity(),
    };
    Gap::round(point - foot, free)
}

/// Projection to the plane at right angles to a direction.
pub fn across(direction: Vec3) -> Mat3 {
    let u = direction.normalize();
    Mat3::identity() - u * u.transpose()
}

/// Weights of the corners in the point of the triangle that is nearest to `point`; 0 for corners that have no part in it.
///
/// Regions as in [Ericson 2005], 5.1.5, with corners that coincide (a cloth crumpled to a point) allowed.
pub fn nearest_on_triangle(point: Vec3, [a, b, c]: [Vec3; 3]) -> [f64; 3] {
    let (ab, ac, ap) = (b - a, c - a, point - a);
    let (d1, d2) = (ab.dot(&ap), ac.dot(&ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return [1.0, 0.0, 0.0];
    }
    let bp = point - b;
    let (d3, d4) = (ab.dot(&bp), ac.dot(&bp));
    if d3 >= 0.0 && d4 <= d3 {
        return [0.0, 1.0, 0.0];
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 && d1 > d3 {
        let v = d1 / (d1 - d3);
        return [1.0 - v, v, 0.0];
    }
    let cp = point - c;
    let (d5, d6) = (ab.dot(&cp), ac.dot(&cp));
    if d6 >= 0.0 && d5 <= d6 {
        return [0.0, 0.0, 1.0];
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 && d2 > d6 {
        let w = d2 / (d2 - d6);
        return [1.0 - w, 0.0, w];
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 && d4 - d3 + d5 - d6 > 0.0 {
        let w = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return [0.0, 1.0 - w, w];
    }
    let sum = va + vb + vc;
    let inside = [va / sum, vb / sum, vc / sum];
    if sum > SLIVER * ab.norm_squared() * ac.norm_squared() {
        return inside;
    }
    // The weights of a sliver are differences of much larger numbers: its sides may be nearer than what they come to.
    let on_side = |from: Vec3, to: Vec3| {
        let way = to - from;
        let length = way.norm_squared();
        if length > 0.0 { (way.dot(&(point - from)) / length).clamp(0.0, 1.0) } else { 0.0 }
    };
    let [u, v, w] = [on_side(a, b), on_side(b, c), on_side(c, a)];
    let places = [inside, [1.0 - u, u, 0.0], [0.0, 1.0 - v, v], [w, 0.0, 1.0 - w]];
    let distance = |on: &[f64; 3]| {
        let place = a * on[0] + b * on[1] + c * on[2];
        let distance = (place - point).norm_squared();
        if distance.is_nan() { f64::INFINITY } else { distance }
    };
    places.into_iter().min_by(|p, q| distance(p).total_cmp(&distance(q))).unwrap_or(inside)
}

/// Squared double area of a triangle over the squares of two sides below which it is a sliver.
const SLIVER: f64 = 1e-6;

/// Places s on the segment a–b and t on the segment p–q, each from 0 to 1, where the two are nearest.
///
/// Tries the inside of both and all four ends, so that nearly parallel segments are as exact as others.
pub fn nearest_on_segments([a, b]: [Vec3; 2], [p, q]: [Vec3; 2]) -> [f64; 2] {
    let (e, u) = (b - a, q - p);
    let along = |from: Vec3, direction: Vec3, point: Vec3| {
        let length = direction.norm_squared();
        if length > 0.0 { (direction.dot(&(point - from)) / length).clamp(0.0, 1.0) } else { 0.0 }
    };
    let mut best = ([0.0, 0.0], f64::INFINITY);
    let mut attempt = |s: f64, t: f64| {
        let distance = (a + e * s - p - u * t).norm_squared();
        if distance < best.1 {
            best = ([s, t], distance);
        }
    };
    let (ee, eu, uu) = (e.dot(&e), e.dot(&u), u.dot(&u));
    let determinant = ee * uu - eu * eu;
    if determinant > 1e-12 * ee * uu {
        let r = a - p;
        let s = (eu * u.dot(&r) - uu * e.dot(&r)) / determinant;
        let t = (ee * u.dot(&r) - eu * e.dot(&r)) / determinant;
        if (0.0..=1.0).contains(&s) && (0.0..=1.0).contains(&t) {
            attempt(s, t);
        }
    }
    attempt(0.0, along(p, u, a));
    attempt(1.0, along(p, u, b));
    attempt(along(a, e, p), 0.0);
    attempt(along(a, e, q), 1.0);
    best.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shapes() -> Vec<Box<dyn Fn(Vec3) -> Gap>> {
        let corners = [[0.0, 0.0, 0.0], [0.2, 0.02, 0.01], [0.05, 0.3, -0.05]].map(Vec3::from);
        vec![
            Box::new(|p| ball(p, 0.15)),
            Box::new(|p| capsule(p, 0.1, 0.05)),
            Box::new(|p| cuboid(p, Vec3::new(0.1, 0.2, 0.05))),
            Box::new(move |p| triangle(p, corners)),
        ]
    }

    #[test]
    fn the_nearest_place_on_a_sliver_is_no_farther_than_its_sides() {
        let wave = |k: usize| (12.9898 * k as f64 + 0.7).sin();
        for k in 0..2000 {
            let v = |n: usize| Vec3::new(wave(20 * k + n), wave(20 * k + n + 1), wave(20 * k + n + 2));
            let (a, along) = (v(0), v(3));
            let thin = 10.0_f64.powi(-(k as i32 % 18));
            let mut corners = [a, a + along * 0.05, a + along + v(6) * thin];
            if k % 5 == 0 {
                // Two coincide.
                corners[k / 5 % 3] = corners[(k / 5 + 1) % 3];
            }
            let point = a + along * (0.5 + wave(20 * k + 17)) + v(9) * 10.0_f64.powi(-(k as i32 / 18 % 6));
            let on = nearest_on_triangle(point, corners);
            let place = (0..3).map(|n| corners[n] * on[n]).sum::<Vec3>();
            let sides = (0..3).map(|n| {
                let [s, _] = nearest_on_segments([corners[n], corners[(n + 1) % 3]], [point; 2]);
                (corners[n] * (1.0 - s) + corners[(n + 1) % 3] * s - point).norm()
            });
            let nearest = sides.fold(f64::INFINITY, f64::min);
            let distance = (place - point).norm();
            assert!(distance <= nearest + 1e-8 * along.norm(), "{k}: {distance:e} against {nearest:e}");
        }
    }

    #[test]
    fn gap_derivatives_match_differences() {
        for (n, shape) in shapes().into_iter().enumerate() {
            for p in [
                [0.3, 0.4, 0.2],
                [0.02, 0.4, 0.01],
                [0.02, 0.25, 0.3],
                [0.25, 0.5, 0.4],
                [-0.3, 0.1, -0.2],
                [0.08, 0.1, 0.07],
            ] {
                let (p, h) = (Vec3::from(p), 1e-5);
                let gap = shape(p);
                for k in 0..3 {
                    let step = Vec3::ith(k, h);
                    let [up, down] = [shape(p + step), shape(p - step)];
                    let slope = (up.value - down.value) / (2.0 * h);
                    assert!((slope - gap.normal[k]).abs() < 1e-7, "shape {n} at {p:?}");
                    let turn = (up.normal - down.normal) / (2.0 * h) - gap.hessian.column(k);
                    assert!(turn.norm() < 1e-5, "shape {n} at {p:?}: {turn:?}");
                }
            }
        }
    }

    #[test]
    fn the_distance_to_a_box_is_its_gaps_value() {
        let (half, at) = (Vec3::new(0.1, 0.2, 0.05), [-0.3, -0.19, -0.1, -0.04, 0.0, 0.03, 0.09, 0.21]);
        for (x, y) in at.into_iter().flat_map(|x| at.map(|y| (x, y))) {
            for z in at {
                let p = Vec3::new(x, y, z);
                assert_eq!(cuboid_distance(p, half), cuboid(p, half).value, "{p:?}");
            }
        }
    }

    #[test]
    fn nearest_points_of_segments_match_dense_sampling() {
        let v = Vec3::from;
        for (cloth, ridge) in [
            ([v([0.0, 0.0, 0.1]), v([1.0, 0.2, 0.1])], [v([0.5, -1.0, 0.0]), v([0.4, 1.0, 0.0])]),
            ([v([0.0, 0.0, 0.1]), v([1.0, 1e-9, 0.1])], [v([0.2, 0.0, 0.0]), v([0.9, 0.0, 0.0])]),
            ([v([0.0, 0.0, 0.0]), v([0.0, 0.0, 0.0])], [v([1.0, 0.0, 0.0]), v([2.0, 0.0, 0.0])]),
            ([v([0.0, 0.0, 1.0]), v([1.0, 0.0, 0.5])], [v([3.0, 0.1, 0.0]), v([2.0, 0.0, 0.0])]),
        ] {
            let at = |[a, b]: [Vec3; 2], s: f64| a + (b - a) * s;
            let [s, t] = nearest_on_segments(cloth, ridge);
            let found = (at(cloth, s) - at(ridge, t)).norm();
            let sampled = (0..=400)
                .flat_map(|i| (0..=400).map(move |k| [f64::from(i) / 400.0, f64::from(k) / 400.0]))
                .map(|[s, t]| (at(cloth, s) - at(ridge, t)).norm())
                .fold(f64::INFINITY, f64::min);
            assert!(found <= sampled + 1e-12 && found > sampled - 0.01, "{found} {sampled}");
        }
    }
}
