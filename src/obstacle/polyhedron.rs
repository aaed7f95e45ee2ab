//! Convex hulls and closed triangle meshes: which edges are ridges, which points lie inside.

use super::{Features, gap, gap::Gap};
use crate::math::Vec3;
use std::collections::BTreeMap;

/// A solid bounded by triangles, counter-clockwise seen from outside.
#[derive(Clone, Debug, PartialEq)]
pub struct Polyhedron {
    points: Vec<Vec3>,
    faces: Vec<[u32; 3]>,
    ridges: Vec<[u32; 2]>,
    corners: Vec<u32>,
    patches: Vec<u32>,
    convex: bool,
}

/// Why points and triangles make no solid.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Unfit {
    /// Fewer points than a tetrahedron has, or all in one plane.
    #[error("the points span no volume")]
    Flat,
    /// A triangle names a point that is not there, or has no area.
    #[error("triangle {0} has no area or names a point that is not there")]
    Triangle(usize),
    /// An edge does not belong to two triangles of opposite sense.
    #[error(
        "the edge between points {0} and {1} does not part exactly two triangles of the same sense: the mesh is not closed"
    )]
    Open(u32, u32),
    /// The triangles face inwards.
    #[error("the triangles are clockwise seen from outside; turn them over")]
    Inward,
}

/// Sine of the angle between two faces below which the edge between them is flat.
const FLAT: f64 = 1e-6;

impl Polyhedron {
    /// A solid from points [m] and triangles.
    pub fn mesh(points: Vec<Vec3>, faces: Vec<[u32; 3]>) -> Result<Polyhedron, Unfit> {
        let at = |n: u32| points[n as usize];
        let mut normals = Vec::with_capacity(faces.len());
        for (k, &[a, b, c]) in faces.iter().enumerate() {
            if [a, b, c].iter().any(|&n| n as usize >= points.len()) {
                return Err(Unfit::Triangle(k));
            }
            let normal = (at(b) - at(a)).cross(&(at(c) - at(a)));
            normals.push(normal.try_normalize(1e-300).ok_or(Unfit::Triangle(k))?);
        }
        let mut sides: BTreeMap<[u32; 2], Vec<(usize, bool, u32)>> = BTreeMap::new();
        for (k, &[a, b, c]) in faces.iter().enumerate() {
            for (from, to, other) in [(a, b, c), (b, c, a), (c, a, b)] {
                sides.entry([from.min(to), from.max(to)]).or_default().push((k, from < to, other));
            }
        }
        let (mut ridges, mut convex) = (Vec::new(), true);
        let mut patches: Vec<u32> = (0..faces.len() as u32).collect();
        for (&[from, to], owners) in &sides {
            let [(first, forward, _), (second, backward, other)] = owners[..] else {
                return Err(Unfit::Open(from, to));
            };
            if forward == backward {
                return Err(Unfit::Open(from, to));
            }
            // How far the second face's third point lies beyond the first face's plane: below on a ridge.
            let rise = normals[first].dot(&(at(other) - at(from)));
            let width = (at(other) - at(from)).norm();
            let bent = normals[first].cross(&normals[second]).norm() > FLAT
                || normals[first].dot(&normals[second]) < 0.0;
            if bent && rise < 0.0 {
                ridges.push([from, to]);
            }
            if !bent {
                join(&mut patches, first as u32, second as u32);
            }
            convex &= rise <= FLAT * width;
        }
        let volume: f64 = faces.iter().map(|f| at(f[0]).dot(&at(f[1]).cross(&at(f[2])))).sum();
        if !faces.is_empty() && volume < 0.0 {
            return Err(Unfit::Inward);
        }
        if faces.len() < 4 || volume <= 0.0 {
            return Err(Unfit::Flat);
        }
        let mut corners: Vec<u32> = ridges.iter().flatten().copied().collect();
        corners.sort_unstable();
        corners.dedup();
        for face in 0..faces.len() as u32 {
            patches[face as usize] = if convex { 0 } else { root(&patches, face) };
        }
        Ok(Polyhedron { points, faces, ridges, corners, patches, convex })
    }

    /// The convex hull of points [m].
    pub fn hull(points: &[Vec3]) -> Result<Polyhedron, Unfit> {
        let given: Vec<_> = points.iter().map(|p| parry3d_f64::math::Vector::new(p.x, p.y, p.z)).collect();
        if given.len() < 4 {
            return Err(Unfit::Flat);
        }
        let (points, faces) =
            parry3d_f64::transformation::try_convex_hull(&given).map_err(|_| Unfit::Flat)?;
        Polyhedron::mesh(points.iter().map(|p| Vec3::new(p.x, p.y, p.z)).collect(), faces)
    }

    /// Whether the solid is convex.
    pub fn is_convex(&self) -> bool {
        self.convex
    }

    /// Points [m].
    pub fn points(&self) -> &[Vec3] {
        &self.points
    }

    /// Triangles, counter-clockwise seen from outside.
    pub fn faces(&self) -> &[[u32; 3]] {
        &self.faces
    }

    pub(super) fn features(&self) -> Features {
        Features {
            points: self.points.clone(),
            ridges: self.ridges.clone(),
            corners: self.corners.clone(),
            faces: self.faces.clone(),
            patches: self.patches.clone(),
            balls: (0..self.faces.len()).map(|f| ball(self.corners_of(f))).collect(),
            radius: 0.0,
            axes: Vec::new(),
        }
    }

    /// Corners of a face [m].
    pub fn corners_of(&self, face: usize) -> [Vec3; 3] {
        self.faces[face].map(|n| self.points[n as usize])
    }

    /// Signed gap to the nearest face.
    pub fn gap(&self, point: Vec3) -> Gap {
        let mut nearest: Option<Gap> = None;
        for face in 0..self.faces.len() {
            let gap = gap::triangle(point, self.corners_of(face));
            if nearest.is_none_or(|n| gap.value < n.value) {
                nearest = Some(gap);
            }
        }
        let gap = nearest.expect("a solid has faces");
        if self.holds(point) {
            return Gap { value: -gap.value, normal: -gap.normal, hessian: -gap.hessian };
        }
        gap
    }

    /// Whether a point lies inside: the solid angle that the faces fill, seen from it [Van Oosterom & Strackee 1983].
    fn holds(&self, point: Vec3) -> bool {
        let angle: f64 = (0..self.faces.len())
            .map(|face| {
                let [a, b, c] = self.corners_of(face).map(|p| p - point);
                let [la, lb, lc] = [a.norm(), b.norm(), c.norm()];
                let below = la * lb * lc + a.dot(&b) * lc + b.dot(&c) * la + c.dot(&a) * lb;
                2.0 * a.dot(&b.cross(&c)).atan2(below)
            })
            .sum();
        angle > 2.0 * std::f64::consts::PI
    }
}

/// The first face of the patch that a face is part of; patches are trees of faces, each naming one before it.
fn root(patches: &[u32], mut face: u32) -> u32 {
    while patches[face as usize] != face {
        face = patches[face as usize];
    }
    face
}

/// Makes the patches of two faces one.
fn join(patches: &mut [u32], a: u32, b: u32) {
    let [a, b] = [root(patches, a), root(patches, b)];
    patches[a.max(b) as usize] = a.min(b);
}

/// A ball that holds a triangle: centre and radius [m], the radius a hair too large for rounding.
fn ball(triangle: [Vec3; 3]) -> (Vec3, f64) {
    let center = triangle.iter().sum::<Vec3>() / 3.0;
    let radius = triangle.iter().map(|p| (p - center).norm()).fold(0.0, f64::max);
    (center, radius * (1.0 + 1e-9))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::obstacle::Shape;

    fn cube() -> Vec<Vec3> {
        Shape::Cuboid { half: [0.1, 0.2, 0.3] }.features().points
    }

    #[test]
    fn hull_of_a_box_has_the_boxs_ridges_and_gaps() {
        let mut points = cube();
        points.push(Vec3::new(0.01, 0.02, 0.03));
        let hull = Polyhedron::hull(&points).unwrap();
        assert!(hull.is_convex());
        assert_eq!(
            (hull.points().len(), hull.faces().len(), hull.ridges.len(), hull.corners.len()),
            (8, 12, 12, 8)
        );
        for p in [[0.3, 0.1, 0.2], [0.0, 0.0, 0.1], [0.15, 0.25, 0.35], [0.05, 0.19, 0.0]] {
            let (ours, exact) =
                (hull.gap(Vec3::from(p)), gap::cuboid(Vec3::from(p), Vec3::new(0.1, 0.2, 0.3)));
            assert!(
                (ours.value - exact.value).abs() < 1e-12 && (ours.normal - exact.normal).norm() < 1e-9,
                "{p:?}"
            );
        }
    }

    #[test]
    fn a_groove_is_no_ridge() {
        // A box whose top is pressed in: a pyramid hollow with four valleys.
        let mut points = cube();
        points.push(Vec3::zeros());
        let mut faces = Polyhedron::hull(&cube()).unwrap().faces().to_vec();
        let hull_points = Polyhedron::hull(&cube()).unwrap().points().to_vec();
        faces.retain(|f| !f.iter().all(|&n| hull_points[n as usize].z > 0.0));
        let centre = hull_points.len() as u32;
        let mut all = hull_points.clone();
        all.push(Vec3::zeros());
        let rim: Vec<u32> = (0..centre).filter(|&n| hull_points[n as usize].z > 0.0).collect();
        let angle = |n: &u32| hull_points[*n as usize].y.atan2(hull_points[*n as usize].x);
        let mut rim = rim;
        rim.sort_by(|a, b| angle(a).total_cmp(&angle(b)));
        faces.extend((0..4).map(|k| [rim[k], rim[(k + 1) % 4], centre]));
        let solid = Polyhedron::mesh(all, faces).unwrap();
        assert!(!solid.is_convex());
        assert_eq!(solid.ridges.len(), 12, "four of the bottom, four of the sides, four of the rim");
        assert!(solid.gap(Vec3::new(0.0, 0.0, 0.2)).value > 0.0, "the hollow is outside");
        assert!(solid.gap(Vec3::new(0.0, 0.0, -0.2)).value < 0.0);
    }

    #[test]
    fn what_is_no_solid_is_refused() {
        let hull = Polyhedron::hull(&cube()).unwrap();
        let (points, mut faces) = (hull.points().to_vec(), hull.faces().to_vec());
        let inward = faces.iter().map(|&[a, b, c]| [a, c, b]).collect();
        assert_eq!(Polyhedron::mesh(points.clone(), inward), Err(Unfit::Inward));
        faces.pop();
        assert!(matches!(Polyhedron::mesh(points.clone(), faces), Err(Unfit::Open(..))));
        assert_eq!(Polyhedron::mesh(points, vec![[0, 1, 99]]), Err(Unfit::Triangle(0)));
        assert_eq!(Polyhedron::hull(&cube()[..3]), Err(Unfit::Flat));
    }
}
