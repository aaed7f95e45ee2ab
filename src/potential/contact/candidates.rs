//! Candidates: the pieces of cloth and of obstacles that may meet in a step, kept as long as nothing moved far.
//!
//! Whatever is not listed stays apart while every particle keeps within its allowance of where it was when the list was made. No
//! bounding volumes meet: no list, and contact costs a comparison per particle.

use super::distance::{Ball, Near};
use crate::{
    math::Vec3,
    model::Model,
    obstacle::{Features, Shape},
    state::State,
};
use nalgebra::{Isometry3, Point3};
use parry3d_f64::{
    bounding_volume::Aabb,
    math::Vector,
    partitioning::{Bvh, BvhBuildStrategy, BvhNode},
};

/// How far cloth may go before lists are made anew, over the activation distance, beyond twice what it may go in a step: where it hardly
/// moves they last for a hundred steps and more. Of a polyhedron they would become long.
const SPARE: f64 = 10.0;
const SPARE_OF_FACES: f64 = 1.0;
/// How much farther than is wanted now, at the most, by the margin of shapes.
const GENEROUS: f64 = 3.0;

/// How far cloth may go before lists are made anew [m], from the way that it may go in a step and what is spared beyond.
fn margin(model: &Model, travel: f64, spare: f64) -> f64 {
    2.0 * travel + spare * model.contact.barrier.activation
}

/// What may meet one obstacle.
#[derive(Clone, Debug, Default)]
pub struct Listed {
    /// Place in the model's list of obstacles.
    pub obstacle: usize,
    /// Particles, against the shape as a whole; and how far off each was [m].
    pub particles: Vec<u32>,
    pub particle_gaps: Vec<f64>,
    /// Particles and faces.
    pub faces: Pairs,
    /// Edges and ridges.
    pub edges: Pairs,
    /// Triangles and corners.
    pub corners: Pairs,
    /// Triangles, against the shape as a whole.
    pub triangles: Vec<u32>,
    /// Triangles and faces.
    pub pieces: Vec<(u32, u32)>,
}

impl Listed {
    fn clear(&mut self) {
        let Listed { obstacle: _, particles, particle_gaps, faces, edges, corners, triangles, pieces } = self;
        [particles, triangles].into_iter().for_each(Vec::clear);
        [faces, edges, corners].into_iter().for_each(Pairs::clear);
        particle_gaps.clear();
        pieces.clear();
    }
}

/// Pieces of cloth of a kind, and the parts of an obstacle that each may meet.
#[derive(Clone, Debug, Default)]
pub struct Pairs {
    pieces: Vec<Piece>,
    /// Each part, and how far off it was [m].
    parts: Vec<(u32, f64)>,
}

#[derive(Clone, Copy, Debug)]
struct Piece {
    number: u32,
    /// How far off its nearest part was [m].
    gap: f64,
    /// Where its parts end.
    end: usize,
}

impl Pairs {
    fn clear(&mut self) {
        self.pieces.clear();
        self.parts.clear();
    }

    /// Adds a pair, after those of the same piece.
    fn add(&mut self, piece: u32, part: u32, gap: f64) {
        self.parts.push((part, gap));
        let end = self.parts.len();
        match self.pieces.last_mut() {
            Some(last) if last.number == piece => (last.gap, last.end) = (last.gap.min(gap), end),
            _ => self.pieces.push(Piece { number: piece, gap, end }),
        }
    }

    /// Visits each piece that may be nearer than `bound` [m] to some of its parts, with these: `moved` tells the square of how far a
    /// piece has gone since the lists were made, at the most [m²].
    pub fn each(
        &self,
        bound: f64,
        moved: impl Fn(u32) -> f64,
        mut visit: impl FnMut(u32, &mut dyn Iterator<Item = u32>),
    ) {
        let mut start = 0;
        for &Piece { number, gap, end } in &self.pieces {
            let parts = &self.parts[start..end];
            start = end;
            let moved = moved(number);
            if may_be_within(bound, gap, moved) {
                let near = parts.iter().filter(|(_, gap)| may_be_within(bound, *gap, moved));
                visit(number, &mut near.map(|(part, _)| *part));
            }
        }
    }
}

/// Whether what was `gap` off [m] may be nearer than `bound` [m] after a way of the square `moved` [m²].
pub fn may_be_within(bound: f64, gap: f64, moved: f64) -> bool {
    let spare = gap - bound;
    spare <= 0.0 || moved >= spare * spare
}

/// What does not change of an obstacle, and its features where it is.
#[derive(Clone)]
struct Prepared {
    own: Features,
    placed: Features,
    /// Radius of a ball around the own origin that holds all [m].
    reach: f64,
    /// Faces by their boxes in the own frame, and the ridges of each face; of polyhedra alone.
    tree: Option<Bvh>,
    ridges_of: Vec<Vec<u32>>,
}

/// The lists of all obstacles, and how far each particle may go until they are made anew.
#[derive(Clone, Default)]
pub struct Candidates {
    prepared: Vec<Prepared>,
    listed: Vec<Listed>,
    /// Lists out of use, for their memory, and edges of the cloth and pairs before they are measured.
    spare: Vec<Listed>,
    sides: Vec<u32>,
    pairs: Vec<(u32, u32)>,
    /// How far the particles are from the obstacle in turn, at least [m].
    distances: Vec<f64>,
    /// How far a particle was to go in a step when the lists were made [m].
    travel: f64,
    pub(super) poses: Vec<Isometry3<f64>>,
    reference: Vec<Vec3>,
    allowance: Vec<f64>,
    /// How often the lists were made.
    pub builds: u64,
}

impl Candidates {
    /// Nothing listed yet.
    pub fn new(model: &Model) -> Candidates {
        let prepared = model.obstacles.iter().map(|o| Prepared::new(&o.shape)).collect();
        Candidates { prepared, ..Candidates::default() }
    }

    /// What touches in a state.
    pub fn of(model: &Model, state: &State) -> Candidates {
        let mut candidates = Candidates::new(model);
        candidates.update(model, &state.poses, &state.positions, 0.0);
        candidates
    }

    /// The lists.
    pub fn listed(&self) -> &[Listed] {
        &self.listed
    }

    /// Features of an obstacle in the world.
    pub fn features(&self, obstacle: usize) -> &Features {
        &self.prepared[obstacle].placed
    }

    /// Pose of an obstacle that the lists hold for.
    pub fn pose(&self, obstacle: usize) -> &Isometry3<f64> {
        &self.poses[obstacle]
    }

    /// Radius of a ball around an obstacle's origin that holds it [m].
    pub fn reach(&self, obstacle: usize) -> f64 {
        self.prepared[obstacle].reach
    }

    /// How far a particle at `x` may still go [m].
    pub fn left(&self, particle: usize, x: Vec3) -> f64 {
        (self.allowance[particle] - (x - self.reference[particle]).norm()).max(0.0)
    }

    /// The square of how far one of these particles is from where the lists were made, at the most [m²].
    pub fn moved<const N: usize>(&self, particles: [u32; N], x: &[Vec3]) -> f64 {
        let ways = particles.map(|n| (x[n as usize] - self.reference[n as usize]).norm_squared());
        ways.into_iter().fold(0.0, f64::max)
    }

    /// Whether it may certainly go `way` from `x`: what most particles are asked for, without roots.
    pub fn reaches(&self, particle: usize, x: Vec3, way: Vec3) -> bool {
        let allowance = self.allowance[particle];
        2.0 * ((x - self.reference[particle]).norm_squared() + way.norm_squared()) <= allowance * allowance
    }

    /// Makes the lists anew if particles could leave their allowance within `travel` [m] of `x`, an obstacle moved, or the lists are
    /// those of much faster cloth: what they hold is looked at several times in each step.
    pub fn update(&mut self, model: &Model, poses: &[Isometry3<f64>], x: &[Vec3], travel: f64) {
        if model.obstacles.is_empty() {
            return;
        }
        let fresh = self.poses == poses
            && self.reference.len() == x.len()
            && margin(model, self.travel, SPARE) <= GENEROUS * margin(model, travel, SPARE)
            && model.elements.present().all(|n| self.left(n, x[n]) >= travel);
        if !fresh {
            self.build(model, poses, x, travel);
        }
    }

    fn build(&mut self, model: &Model, poses: &[Isometry3<f64>], x: &[Vec3], travel: f64) {
        self.builds += 1;
        self.travel = travel;
        self.poses.clear();
        self.poses.extend_from_slice(poses);
        self.reference.clear();
        self.reference.extend_from_slice(x);
        self.allowance.clear();
        self.allowance.resize(x.len(), f64::INFINITY);
        self.spare.append(&mut self.listed);
        let present = (0..model.surface.areas.len()).filter(|&n| model.surface.areas[n] > 0.0);
        let (low, high) = present
            .fold((Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY)), |(low, high), n| {
                (low.inf(&x[n]), high.sup(&x[n]))
            });
        let activation = model.contact.barrier.activation;
        for (o, pose) in poses.iter().enumerate() {
            let Prepared { own, placed, tree, .. } = &mut self.prepared[o];
            own.place(pose, placed);
            let spare = if tree.is_some() { SPARE_OF_FACES } else { SPARE };
            let radius = activation + margin(model, travel, spare);
            let apart = apart(&model.obstacles[o].shape, pose, self.prepared[o].reach, low, high);
            if apart > radius {
                self.allowance.iter_mut().for_each(|a| *a = a.min(apart - activation));
                continue;
            }
            let mut listed = self.spare.pop().unwrap_or_default();
            listed.clear();
            listed.obstacle = o;
            self.triangles_near(model, &mut listed, x, radius);
            self.pairs_near(model, &mut listed, x, radius);
            self.listed.push(listed);
        }
        // A ghost goes no farther than the farthest of its masters.
        for ghost in &model.elements.ghosts {
            for &(master, _) in &ghost.masters {
                let allowance = self.allowance[ghost.node as usize].min(self.allowance[master as usize]);
                self.allowance[master as usize] = allowance;
            }
        }
    }

    /// Triangles that may be within `radius` of an obstacle; of the others the particles' allowance.
    fn triangles_near(&mut self, model: &Model, listed: &mut Listed, x: &[Vec3], radius: f64) {
        let o = listed.obstacle;
        let (prepared, pose) = (&self.prepared[o], &self.poses[o]);
        let obstacle = &model.obstacles[o];
        let distances = &mut self.distances;
        distances.clear();
        let particles = &x[..model.surface.areas.len()];
        distances.extend(particles.iter().map(|p| obstacle.at_least(pose, prepared.reach, *p)));
        let activation = model.contact.barrier.activation;
        if model.contact.particles_only {
            for (n, &distance) in distances.iter().enumerate().filter(|&(n, _)| model.surface.areas[n] > 0.0)
            {
                if distance > radius {
                    self.allowance[n] = self.allowance[n].min(distance - activation);
                } else {
                    listed.particles.push(n as u32);
                    listed.particle_gaps.push(distance);
                }
            }
            // A particle that is listed meets the shape as a whole.
            return;
        }
        for (t, nodes) in model.surface.triangles.iter().enumerate() {
            let [a, b, c] = nodes.map(|n| x[n as usize]);
            let longest = (b - a).norm().max((c - b).norm()).max((a - c).norm());
            let farthest = nodes.iter().map(|&n| distances[n as usize]).fold(f64::NEG_INFINITY, f64::max);
            // What a triangle that is near is not paired with is at least this far off, too.
            let apart = (farthest - longest).max(radius);
            if farthest - longest < radius {
                if let Some(tree) = &prepared.tree {
                    let local = [a, b, c].map(|p| pose.inverse_transform_point(&Point3::from(p)).coords);
                    let from = listed.pieces.len();
                    let near = faces_near(tree, &prepared.own, &local, radius);
                    listed.pieces.extend(near.map(|face| (t as u32, face)));
                    listed.pieces[from..].sort_unstable();
                } else {
                    listed.triangles.push(t as u32);
                }
            }
            for n in nodes.map(|n| n as usize) {
                self.allowance[n] = self.allowance[n].min(apart - activation);
            }
        }
    }

    /// Pairs of parts within `radius` of each other, of the triangles listed.
    fn pairs_near(&mut self, model: &Model, listed: &mut Listed, x: &[Vec3], radius: f64) {
        let (surface, prepared) = (&model.surface, &self.prepared[listed.obstacle]);
        let features = &prepared.placed;
        let reach = radius + features.radius;
        let at = |n: u32| x[n as usize];
        if model.contact.particles_only {
            return;
        }
        let Listed { particles, particle_gaps, faces, edges, corners, triangles, pieces, .. } = listed;
        let own_triangles = triangles.iter().map(|t| *t as usize);
        particles.extend(own_triangles.clone().flat_map(|t| surface.triangles[t]));
        sort_once(particles);
        particle_gaps.extend(particles.iter().map(|&n| self.distances[n as usize]));

        let pairs = &mut self.pairs;
        let of_face = |&(t, face): &(u32, u32)| surface.triangles[t as usize].map(|n| (n, face));
        pairs.clear();
        pairs.extend(pieces.iter().flat_map(of_face));
        sort_once(pairs);
        for &(n, f) in pairs.iter().filter(|(n, f)| features.face_at_least(*f, at(*n)) < reach) {
            let distance = Near::particle_face(at(n), features.face(f)).distance;
            if distance < reach {
                faces.add(n, f, distance);
            }
        }

        let sides = &mut self.sides;
        sides.clear();
        sides.extend(own_triangles.flat_map(|t| surface.sides[t]));
        sort_once(sides);
        pairs.clear();
        let all = 0..features.ridges.len() as u32;
        pairs.extend(sides.iter().flat_map(|&side| all.clone().map(move |ridge| (side, ridge))));
        for &(t, face) in pieces.iter() {
            for side in surface.sides[t as usize] {
                pairs.extend(prepared.ridges_of[face as usize].iter().map(|&ridge| (side, ridge)));
            }
        }
        sort_once(pairs);
        for own in pairs.chunk_by(|a, b| a.0 == b.0) {
            let e = own[0].0;
            let ends = surface.edges[e as usize].map(at);
            let ball = Ball::of_edge(ends);
            for &(_, r) in own.iter().filter(|(_, r)| !ball.is_apart_from(features, *r, reach)) {
                let distance = Near::edge_segment(ends, features.ridge(r)).distance;
                if distance < reach {
                    edges.add(e, r, distance - features.radius);
                }
            }
        }

        pairs.clear();
        pairs.extend(triangles.iter().flat_map(|&t| features.corners.iter().map(move |&corner| (t, corner))));
        for &(t, face) in pieces.iter() {
            let own = features.faces[face as usize];
            pairs.extend(own.iter().filter(|c| features.corners.binary_search(c).is_ok()).map(|&c| (t, c)));
        }
        sort_once(pairs);
        for own in pairs.chunk_by(|a, b| a.0 == b.0) {
            let t = own[0].0;
            let triangle = surface.triangles[t as usize].map(at);
            let ball = Ball::of_triangle(triangle);
            let points = own.iter().map(|&(_, c)| (c, features.points[c as usize]));
            for (c, corner) in points.filter(|(_, corner)| !ball.is_apart(*corner, reach)) {
                let distance = Near::triangle_point(triangle, corner).distance;
                if distance < reach {
                    corners.add(t, c, distance - features.radius);
                }
            }
        }
    }
}

fn sort_once<T: Ord>(list: &mut Vec<T>) {
    list.sort_unstable();
    list.dedup();
}

impl Prepared {
    fn new(shape: &Shape) -> Prepared {
        let own = shape.features();
        let boxes = (0..own.faces.len()).map(|f| (f, bounds(own.face(f as u32), 0.0)));
        let tree = (!own.faces.is_empty()).then(|| Bvh::from_iter(BvhBuildStrategy::Binned, boxes));
        let holds = |face: &[u32; 3], ridge: &[u32; 2]| ridge.iter().all(|n| face.contains(n));
        let ridges = |face: &[u32; 3]| -> Vec<u32> {
            (0..own.ridges.len() as u32).filter(|&r| holds(face, &own.ridges[r as usize])).collect()
        };
        let ridges_of = own.faces.iter().map(ridges).collect();
        Prepared { placed: own.clone(), reach: shape.reach(), tree, ridges_of, own }
    }
}

/// Faces within `radius` of a triangle.
fn faces_near<'a>(
    tree: &'a Bvh,
    features: &'a Features,
    triangle: &'a [Vec3; 3],
    radius: f64,
) -> impl Iterator<Item = u32> + 'a {
    let around = BvhNode::leaf(bounds(*triangle, radius), 0);
    let near = move |f: &u32| {
        let face = features.face(*f);
        // Where corners are near, the rest need not be measured.
        (triangle[0] - face[0]).norm_squared() < radius * radius
            || Near::triangle_face(*triangle, face).distance < radius
    };
    tree.leaves(move |node: &BvhNode| node.intersects(&around)).filter(near)
}

fn bounds(corners: [Vec3; 3], margin: f64) -> Aabb {
    let low = corners[0].inf(&corners[1]).inf(&corners[2]).add_scalar(-margin);
    let high = corners[0].sup(&corners[1]).sup(&corners[2]).add_scalar(margin);
    Aabb::new(Vector::new(low.x, low.y, low.z), Vector::new(high.x, high.y, high.z))
}

/// A lower bound on the distance [m] between an obstacle and a box of the world.
fn apart(shape: &Shape, pose: &Isometry3<f64>, reach: f64, low: Vec3, high: Vec3) -> f64 {
    if *shape == Shape::Plane {
        let normal = pose.rotation * Vec3::z();
        let lowest = Vec3::from_fn(|k, _| if normal[k] > 0.0 { low[k] } else { high[k] });
        return normal.dot(&(lowest - pose.translation.vector));
    }
    let center = pose.translation.vector;
    (center - center.sup(&low).inf(&high)).norm() - reach
}
