//! Distance between a piece of cloth (particle, edge, triangle) and a piece of an obstacle (point, segment, triangle), with
//! gradient and Hessian in the cloth's particles.
//!
//! The distance is a minimum over the places on both pieces. Its gradient follows from the nearest places alone; its Hessian
//! takes in how these move, by eliminating them (Schur complement) in the places' own free directions.

use crate::{
    math::{Mat3, Vec3},
    obstacle::{
        Features,
        gap::{nearest_on_segments, nearest_on_triangle},
    },
};

/// Nearest places of a piece of cloth and a piece of an obstacle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Near {
    /// Distance [m], never negative.
    pub distance: f64,
    /// Unit vector from the obstacle's place to the cloth's.
    pub normal: Vec3,
    /// Weights of the cloth's particles in its place; their sum is 1.
    pub weights: [f64; 3],
    /// The obstacle's place [m].
    pub foot: Vec3,
    /// Which directions are free on the obstacle: none, a line, a plane.
    along: [Option<Vec3>; 2],
}

/// Distance [m] below which the difference of two places no longer tells its direction well.
const CLOSE: f64 = 1e-6;
/// Squared sine of the angle between two directions below which they count as one.
const HARDLY: f64 = 1e-12;

/// Second derivative of a distance [1/m] in three particles, row by row.
pub type Blocks = [[Mat3; 3]; 3];

impl Near {
    fn new(cloth: &[Vec3], weights: [f64; 3], foot: Vec3, along: [Option<Vec3>; 2]) -> Near {
        let place: Vec3 = cloth.iter().zip(weights).map(|(x, w)| x * w).sum();
        let offset = place - foot;
        let distance = offset.norm();
        // Where both coincide every direction is as good; contact keeps states away from there.
        let normal = if distance > 0.0 { offset / distance } else { Vec3::z() };
        let exact = if distance < CLOSE { across(cloth, weights, along, normal) } else { None };
        let normal = exact.unwrap_or(normal);
        Near { distance, normal, weights, foot, along }
    }

    /// A particle and a segment.
    pub fn particle_segment(particle: Vec3, segment: [Vec3; 2]) -> Near {
        Near::edge_segment([particle; 2], segment)
    }

    /// A particle and a triangle of an obstacle.
    pub fn particle_face(particle: Vec3, face: [Vec3; 3]) -> Near {
        let on = nearest_on_triangle(particle, face);
        let foot = face[0] * on[0] + face[1] * on[1] + face[2] * on[2];
        let mut sides = (0..3).filter(|&k| on[k] > 0.0).map(|k| face[k]);
        let first = sides.next().unwrap_or(face[0]);
        let along = [sides.next().map(|p| p - first), sides.next().map(|p| p - first)];
        Near::new(&[particle], [1.0, 0.0, 0.0], foot, along)
    }

    /// An edge of the cloth and a segment of an obstacle.
    pub fn edge_segment(edge: [Vec3; 2], segment: [Vec3; 2]) -> Near {
        let [s, t] = nearest_on_segments(edge, segment);
        let foot = segment[0] + (segment[1] - segment[0]) * t;
        let free = (t > 0.0 && t < 1.0).then(|| segment[1] - segment[0]);
        Near::new(&edge, [1.0 - s, s, 0.0], foot, [free, None])
    }

    /// A triangle of the cloth and a point of an obstacle.
    pub fn triangle_point(triangle: [Vec3; 3], point: Vec3) -> Near {
        Near::new(&triangle, nearest_on_triangle(point, triangle), point, [None; 2])
    }

    /// A triangle of the cloth and one of an obstacle: the nearest of all pairs of their parts.
    pub fn triangle_face(triangle: [Vec3; 3], face: [Vec3; 3]) -> Near {
        let mut best: Option<Near> = None;
        let mut attempt = |near: Near| {
            if best.is_none_or(|b| near.distance < b.distance) {
                best = Some(near);
            }
        };
        for k in 0..3 {
            let near = Near::particle_face(triangle[k], face);
            attempt(Near { weights: std::array::from_fn(|n| if n == k { 1.0 } else { 0.0 }), ..near });
            attempt(Near::triangle_point(triangle, face[k]));
            for m in 0..3 {
                let l = (k + 1) % 3;
                let near = Near::edge_segment([triangle[k], triangle[l]], [face[m], face[(m + 1) % 3]]);
                let mut weights = [0.0; 3];
                (weights[k], weights[l]) = (near.weights[0], near.weights[1]);
                attempt(Near { weights, ..near });
            }
        }
        best.expect("fifteen pairs")
    }

    /// Hessian of the distance in the particles of `cloth` [1/m].
    ///
    /// With r the offset and F = ½ r·r over particles x and free places z: H_F = F_xx − F_xz F_zz⁻¹ F_zx, and the distance is √(2F).
    pub fn hessian(&self, cloth: &[Vec3]) -> Blocks {
        let (n, w, r) = (self.normal, self.weights, self.normal * self.distance);
        // Free directions: weight moves from the first particle that bears some to another, or the foot moves.
        let mut bearing = (0..cloth.len()).filter(|&k| w[k] > 0.0);
        let first = bearing.next().unwrap_or(0);
        let mut tangents = [Vec3::zeros(); 3];
        let mut couplings = [[Vec3::zeros(); 3]; 3];
        let mut count = 0;
        for k in bearing {
            tangents[count] = cloth[k] - cloth[first];
            couplings[count][k] += r;
            couplings[count][first] -= r;
            count += 1;
        }
        for u in self.along.iter().flatten() {
            // Two pieces meet in two free directions at the most, unless they meet outright.
            if count < 3 {
                tangents[count] = -u;
                count += 1;
            }
        }
        let mut blocks = Blocks::default();
        let inverse = inverse_of_gram(&tangents[..count]);
        // Columns of F_xz, one vector per particle.
        let column = |z: usize, k: usize| tangents[z] * w[k] + couplings[z][k];
        for a in 0..cloth.len() {
            for b in 0..cloth.len() {
                let mut block = Mat3::identity() * (w[a] * w[b]);
                for i in 0..count {
                    for j in 0..count {
                        block -= column(i, a) * column(j, b).transpose() * inverse[(i, j)];
                    }
                }
                block -= n * n.transpose() * (w[a] * w[b]);
                blocks[a][b] = block / self.distance;
            }
        }
        blocks
    }
}

/// The unit vector at right angles to both directions that are free, on the side of `normal`: that one is a difference of nearly equal
/// places, which at a gap of 1 nm is off by 1e-7, and by more than the gap where a piece is long. `None` where other than two directions,
/// or hardly two, are free.
fn across(cloth: &[Vec3], weights: [f64; 3], along: [Option<Vec3>; 2], normal: Vec3) -> Option<Vec3> {
    let mut bearing = cloth.iter().zip(weights).filter(|(_, w)| *w > 0.0).map(|(x, _)| x);
    let first = bearing.next()?;
    let mut free = bearing.map(|x| x - first).chain(along.into_iter().flatten());
    let (a, b) = (free.next()?, free.next()?);
    let across = a.cross(&b);
    if free.next().is_some() || across.norm_squared() <= HARDLY * a.norm_squared() * b.norm_squared() {
        return None;
    }
    let across = across.normalize();
    Some(if across.dot(&normal) < 0.0 { -across } else { across })
}

/// A ball that holds a piece of cloth: what is farther off need not be measured, at a fraction of the cost.
#[derive(Clone, Copy)]
pub struct Ball {
    center: Vec3,
    radius: f64,
}

impl Ball {
    /// Around an edge.
    pub fn of_edge([a, b]: [Vec3; 2]) -> Ball {
        Ball { center: (a + b) * 0.5, radius: 0.5 * (b - a).norm() }
    }

    /// Around a triangle.
    pub fn of_triangle([a, b, c]: [Vec3; 3]) -> Ball {
        Ball { center: a, radius: (b - a).norm_squared().max((c - a).norm_squared()).sqrt() }
    }

    /// Whether a ridge is certainly farther off than `bound` [m].
    pub fn is_apart_from(&self, features: &Features, ridge: u32, bound: f64) -> bool {
        let reach = self.radius + bound;
        features.ridge_from(ridge, self.center) > reach * reach
    }

    /// Whether a point is.
    pub fn is_apart(&self, point: Vec3, bound: f64) -> bool {
        let reach = self.radius + bound;
        (self.center - point).norm_squared() > reach * reach
    }
}

/// Inverse of the matrix of dot products; directions that depend on others (degenerate pieces) count nothing.
fn inverse_of_gram(tangents: &[Vec3]) -> Mat3 {
    let dot = |i: usize, j: usize| tangents[i].dot(&tangents[j]);
    let mut inverse = Mat3::zeros();
    match tangents.len() {
        1 if dot(0, 0) > 0.0 => inverse[(0, 0)] = 1.0 / dot(0, 0),
        2 => {
            let (a, b, c) = (dot(0, 0), dot(0, 1), dot(1, 1));
            let determinant = a * c - b * b;
            if determinant > 1e-14 * a * c {
                inverse[(0, 0)] = c / determinant;
                inverse[(1, 1)] = a / determinant;
                inverse[(0, 1)] = -b / determinant;
                inverse[(1, 0)] = -b / determinant;
            } else if a.max(c) > 0.0 {
                let k = if a >= c { 0 } else { 1 };
                inverse[(k, k)] = 1.0 / a.max(c);
            }
        }
        3 => {
            let gram = Mat3::from_fn(dot);
            inverse = gram.try_inverse().unwrap_or_else(Mat3::zeros);
        }
        _ => {}
    }
    inverse
}
