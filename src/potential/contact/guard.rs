//! No step passes an obstacle: every change of positions is turned aside or cut short, particle by particle, before it could.
//!
//! Between a triangle of the cloth and a convex piece of an obstacle lies a plane. While the triangle's three particles stay
//! on their side of it, the triangle cannot meet the piece, whatever way they go: so each particle may come nearer by part of
//! its own distance from the plane (conservative advancement), and go along it as far as it likes. Each particle's bound depends on
//! its own way alone, so any mixture of allowed ways is allowed too. Planes per pair: [Li 2020], 4.4, made local as in [Chen 2025].

use super::{
    candidates::{Candidates, Listed},
    distance::{Ball, Near},
    room::{Beside, Plane, Room, Stop},
};
use crate::{
    math::Vec3,
    model::Model,
    obstacle::{Obstacle, Shape},
};
use nalgebra::{Isometry3, Point3};
use smallvec::{SmallVec, smallvec};
use std::iter;

/// The part of its distance, or of the activation distance if that is less, that a particle keeps from a plane.
const KEPT: f64 = 0.5;
/// A distance over the activation distance below which nothing comes nearer: well above rounding.
const FLOOR: f64 = 1e-6;
/// The distance over the activation distance to which a moving obstacle takes cloth along.
const CARRIED: f64 = 0.9;

/// Times that every plane turns steps aside: a particle may have several.
const SWEEPS: usize = 4;
/// Part of its step by which a particle turned aside stays farther off, so that rounding does not stop it.
const SPARED: f64 = 1e-9;

/// Height to keep above a plane, from the height before and the activation distance [m].
type Kept = fn(f64, f64) -> f64;

/// Where particles want to go.
struct Course<'a> {
    /// Whether pieces of cloth with this node are to be looked at.
    concerns: &'a dyn Fn(u32) -> bool,
    /// Lowest height of a particle above a plane on its way from a height above it [m], whatever part of it is gone.
    lowest: &'a dyn Fn(u32, &Plane, f64) -> f64,
    /// A bound on the length of its way [m].
    way: &'a dyn Fn(u32) -> f64,
    /// What it must keep.
    kept: Kept,
}

/// The particles of a triangle, or one particle three times, and the plane between them and a piece of an obstacle.
type Parted<'a> = &'a mut dyn FnMut([u32; 3], &Plane);

impl Candidates {
    /// Turns the step of each particle aside, and shortens what that does not help, until no triangle passes an obstacle. What goes along
    /// an obstacle is kept: neighbours that were stopped altogether, each at another place, would stretch what lies between them.
    pub fn limit(&self, model: &Model, x: &[Vec3], step: &mut [Vec3], room: &mut Room) {
        if model.obstacles.is_empty() {
            return;
        }
        room.begin(model, &self.poses, x.len());
        room.ask_for_movers(model, step);
        self.find_stops(model, x, step, room);
        if turn_aside(model, step, room) {
            self.find_stops(model, x, step, room);
        }
        if self.find_shares(model, x, step, room) < 1.0 {
            model.elements.present().for_each(|n| step[n] *= room.shares[n]);
        }
        model.elements.fill(step);
    }

    /// The part of a step that nothing keeps any particle from, all going as far.
    pub fn free_share(&self, model: &Model, x: &[Vec3], step: &[Vec3], room: &mut Room) -> f64 {
        if model.obstacles.is_empty() {
            return 1.0;
        }
        room.begin(model, &self.poses, x.len());
        room.ask_for_movers(model, step);
        self.find_stops(model, x, step, room);
        self.find_shares(model, x, step, room)
    }

    /// What keeps nodes from their whole steps, into `room.stops`: of all pieces of cloth with a node that is asked for.
    fn find_stops(&self, model: &Model, x: &[Vec3], step: &[Vec3], room: &mut Room) {
        let Room { stops, asked, beside, .. } = room;
        stops.clear();
        let activation = model.contact.barrier.activation;
        for listed in self.listed() {
            let way = |n: u32| {
                let mut way = 0.0;
                model.elements.each_master(n, |m, w| way += w * step[m as usize].norm());
                way
            };
            let coming = |n: u32, plane: &Plane| coming(model, step, n, plane.normal);
            let lowest = |n: u32, plane: &Plane, height: f64| height - coming(n, plane);
            let concerns = |n: u32| asked[n as usize];
            let course = Course { concerns: &concerns, lowest: &lowest, way: &way, kept };
            self.part(model, listed, x, &course, beside, &mut |nodes, plane| {
                for node in nodes {
                    let before = plane.height(x[node as usize]);
                    let room = before - kept(before, activation);
                    if coming(node, plane) > room {
                        stops.push(Stop { node, normal: plane.normal, room });
                    }
                }
            });
        }
    }

    /// How much of its step each particle may go, into `room.shares`, for the stops found there and for what is not listed; the least of them.
    fn find_shares(&self, model: &Model, x: &[Vec3], step: &[Vec3], room: &mut Room) -> f64 {
        let Room { stops, shares, .. } = room;
        shares.clear();
        shares.resize(x.len(), 1.0);
        let mut least = 1.0_f64;
        for n in model.elements.present().filter(|&n| !self.reaches(n, x[n], step[n])) {
            let (left, way) = (self.left(n, x[n]), step[n].norm());
            if way > left {
                shares[n] = left / way;
                least = least.min(shares[n]);
            }
        }
        for &Stop { node, normal, room } in &*stops {
            let coming = coming(model, step, node, normal);
            model.elements.each_master(node, |m, w| {
                if approach(step, m, w, normal) > 0.0 {
                    let share = &mut shares[m as usize];
                    *share = share.min((room / coming).max(0.0));
                    least = least.min(*share);
                }
            });
        }
        least
    }

    /// Where the cloth at `x` goes when obstacles move from the listed poses to `poses`: particles in the way are carried along. `None`
    /// where that cannot be done without passing one, as fixed particles stay.
    pub fn carry(
        &self,
        model: &Model,
        x: &[Vec3],
        poses: &[Isometry3<f64>],
        fixed: &[bool],
        room: &mut Room,
    ) -> Option<Vec<Vec3>> {
        let activation = model.contact.barrier.activation;
        let mut carried = x.to_vec();
        room.begin(model, &self.poses, x.len());
        for listed in self.listed() {
            let o = listed.obstacle;
            if self.pose(o) == &poses[o] {
                continue;
            }
            let moved = poses[o] * self.pose(o).inverse();
            // Everything in the frame of the obstacle before it moved.
            let end = |n: u32| moved.inverse_transform_point(&Point3::from(x[n as usize])).coords;
            let mut share = vec![0.0_f64; x.len()];
            let course = Course {
                concerns: &|_| true,
                lowest: &|n, plane, _| plane.height(end(n)),
                way: &|n| (end(n) - x[n as usize]).norm(),
                kept: carried_to,
            };
            self.part(model, listed, x, &course, &mut room.beside, &mut |nodes, plane| {
                for n in nodes {
                    let [before, after] = [x[n as usize], end(n)].map(|p| plane.height(p));
                    let wanted = carried_to(before, activation);
                    if after < wanted {
                        let share = &mut share[n as usize];
                        *share = share.max(((wanted - after) / (before - after)).min(1.0));
                    }
                }
            });
            for ghost in &model.elements.ghosts {
                let own = share[ghost.node as usize];
                ghost.masters.iter().for_each(|&(m, _)| share[m as usize] = share[m as usize].max(own));
            }
            for (n, share) in share.into_iter().enumerate().filter(|(_, s)| *s > 0.0) {
                let along = moved.transform_point(&Point3::from(x[n])).coords;
                carried[n] += (along - x[n]) * share;
            }
        }
        for n in (0..x.len()).filter(|&n| fixed[n]) {
            carried[n] = x[n];
        }
        model.elements.fill(&mut carried);
        self.is_clear(model, x, &carried, poses, room).then_some(carried)
    }

    /// Whether the cloth can go from `x` to `to` while obstacles move from the listed poses to `poses`.
    fn is_clear(
        &self,
        model: &Model,
        x: &[Vec3],
        to: &[Vec3],
        poses: &[Isometry3<f64>],
        room: &mut Room,
    ) -> bool {
        let activation = model.contact.barrier.activation;
        let mut clear = true;
        room.begin(model, &self.poses, x.len());
        for listed in self.listed() {
            let o = listed.obstacle;
            let moved = poses[o] * self.pose(o).inverse();
            let end = |n: u32| moved.inverse_transform_point(&Point3::from(to[n as usize])).coords;
            let course = Course {
                concerns: &|_| true,
                lowest: &|n, plane, _| plane.height(end(n)),
                way: &|n| (end(n) - x[n as usize]).norm(),
                kept: at_least,
            };
            self.part(model, listed, x, &course, &mut room.beside, &mut |nodes, plane| {
                clear &= nodes
                    .iter()
                    .all(|&n| plane.height(end(n)) >= at_least(plane.height(x[n as usize]), activation));
            });
        }
        // Cloth that is not listed is farther off than the lists were made for.
        clear
            && x.iter()
                .zip(to)
                .enumerate()
                .take(model.surface.areas.len())
                .all(|(n, (a, b))| (b - a).norm() <= self.left(n, *a))
    }

    /// Hands over a plane for each piece of cloth that a listed obstacle may meet on its course from `x`, where memory was begun.
    fn part(
        &self,
        model: &Model,
        listed: &Listed,
        x: &[Vec3],
        course: &Course,
        beside: &mut [Beside],
        parted: Parted,
    ) {
        let o = listed.obstacle;
        let (obstacle, pose, features) = (&model.obstacles[o], self.pose(o), self.features(o));
        let activation = model.contact.barrier.activation;
        // Few are so near that it matters which way they go.
        let keeps_above = |n: u32, plane: &Plane| {
            let before = plane.height(x[n as usize]);
            let keeps =
                |kept: f64| before - (course.way)(n) >= kept || (course.lowest)(n, plane, before) >= kept;
            before > FLOOR * activation && keeps((course.kept)(before, activation))
        };
        // Farther apart than this no plane keeps a triangle from its way.
        let reach = |nodes: [u32; 3]| nodes.map(course.way).into_iter().fold(0.0, f64::max) + activation;
        if model.contact.particles_only {
            for &n in listed.particles.iter().filter(|&&n| (course.concerns)(n)) {
                let gap = obstacle.gap_at(pose, x[n as usize]);
                let foot = x[n as usize] - gap.normal * gap.value;
                parted([n; 3], &Plane { normal: gap.normal, foot });
            }
            return;
        }
        let planes = planes_of(obstacle, pose);
        let Beside { above, last, partings, .. } = &mut beside[o];
        let mut is_above = |nodes: [u32; 3], plane: usize| {
            nodes.iter().all(|&n| above[n as usize].knows(plane, || keeps_above(n, &planes[plane])))
        };
        for &t in &listed.triangles {
            let nodes = model.surface.triangles[t as usize];
            if !nodes.into_iter().any(course.concerns) {
                continue;
            }
            // What was above a plane mostly still is.
            let last = &mut last[t as usize];
            let all = 0..planes.len() as u8;
            let mut in_turn = iter::once(*last).filter(|plane| all.contains(plane)).chain(all.clone());
            if let Some(plane) = in_turn.find(|&plane| is_above(nodes, plane.into())) {
                *last = plane;
                continue;
            }
            let triangle = nodes.map(|n| x[n as usize]);
            let farthest = nodes.map(|n| obstacle.at_least(pose, self.reach(o), x[n as usize]));
            let [a, b, c] = triangle;
            let size = (b - a).norm().max((c - b).norm()).max((a - c).norm());
            if farthest.into_iter().fold(f64::NEG_INFINITY, f64::max) - size > reach(nodes) {
                continue;
            }
            let (place, plane) = &mut partings[t as usize];
            if *place != triangle {
                (*place, *plane) = (triangle, between(obstacle, pose, self, o, triangle));
            }
            parted(nodes, plane);
        }
        for pieces in listed.pieces.chunk_by(|a, b| a.0 == b.0) {
            let nodes = model.surface.triangles[pieces[0].0 as usize];
            if !nodes.into_iter().any(course.concerns) {
                continue;
            }
            let triangle = nodes.map(|n| x[n as usize]);
            let middle = triangle.iter().sum::<Vec3>() / 3.0;
            let size = triangle.iter().map(|p| (p - middle).norm()).fold(0.0, f64::max);
            let reach = reach(nodes) + size;
            for &(_, face) in pieces {
                if features.face_at_least(face, middle) > reach {
                    continue;
                }
                let face = features.face(face);
                let normal = (face[1] - face[0]).cross(&(face[2] - face[0])).normalize();
                let plane = Plane { normal, foot: face[0] };
                if nodes.iter().all(|&n| keeps_above(n, &plane)) {
                    continue;
                }
                let near = Near::triangle_face(triangle, face);
                parted(nodes, &Plane { normal: near.normal, foot: near.foot });
            }
        }
    }
}

/// How much nearer a particle comes to a plane [m], for its part of a node.
fn approach(step: &[Vec3], particle: u32, part: f64, normal: Vec3) -> f64 {
    part * (-normal.dot(&step[particle as usize])).max(0.0)
}

/// How much nearer a node comes to a plane at the most [m]. A ghost's way is its masters': whatever part of theirs they go, together they
/// keep the room.
fn coming(model: &Model, step: &[Vec3], node: u32, normal: Vec3) -> f64 {
    let mut coming = 0.0;
    model.elements.each_master(node, |m, w| coming += approach(step, m, w, normal));
    coming
}

/// Takes out of steps what leads too near to planes, one after the other; ghosts have no steps of their own. No step grows longer. False
/// where there is no such plane; else the nodes that go elsewhere now, and may need another plane, are those to be asked for next.
fn turn_aside(model: &Model, step: &mut [Vec3], room: &mut Room) -> bool {
    room.ask_for_stopped(model);
    for _ in 0..SWEEPS {
        for stop in room.stops.iter().filter(|stop| model.elements.ghost(stop.node).is_none()) {
            let way = &mut step[stop.node as usize];
            let over = -stop.normal.dot(way) - stop.room;
            if over > 0.0 {
                *way += stop.normal * (over + SPARED * way.norm());
            }
        }
    }
    !room.stops.is_empty()
}

/// How far from a plane a particle stays in a step.
fn kept(height: f64, activation: f64) -> f64 {
    let floor = FLOOR * activation;
    if height <= floor { height } else { (KEPT * height.min(activation)).max(floor) }
}

/// How far in front of itself a moving obstacle takes a particle along.
fn carried_to(height: f64, activation: f64) -> f64 {
    height.min(CARRIED * activation)
}

/// What must be left of a height.
fn at_least(height: f64, activation: f64) -> f64 {
    height.min(FLOOR * activation)
}

/// The planes of a shape's faces; of round ones none.
fn planes_of(obstacle: &Obstacle, pose: &Isometry3<f64>) -> SmallVec<[Plane; 6]> {
    let foot = pose.translation.vector;
    match obstacle.shape {
        Shape::Plane => smallvec![Plane { normal: pose.rotation * Vec3::z(), foot }],
        Shape::Cuboid { half } => (0..6)
            .map(|k| {
                let normal = pose.rotation * Vec3::ith(k / 2, if k % 2 == 0 { 1.0 } else { -1.0 });
                Plane { normal, foot: foot + normal * half[k / 2] }
            })
            .collect(),
        _ => SmallVec::new(),
    }
}

/// The plane at right angles to the shortest way between a triangle and a convex shape.
fn between(
    obstacle: &Obstacle,
    pose: &Isometry3<f64>,
    candidates: &Candidates,
    o: usize,
    triangle: [Vec3; 3],
) -> Plane {
    let features = candidates.features(o);
    if let Shape::Plane = obstacle.shape {
        return Plane { normal: pose.rotation * Vec3::z(), foot: pose.translation.vector };
    }
    let mut best =
        Parting { distance: f64::INFINITY, plane: Plane { normal: Vec3::z(), foot: Vec3::zeros() } };
    if features.radius == 0.0 {
        for x in triangle {
            let gap = obstacle.gap_at(pose, x);
            best.attempt(gap.value, Plane { normal: gap.normal, foot: x - gap.normal * gap.value });
        }
    }
    let attempt = |best: &mut Parting, near: Near| {
        let foot = near.foot + near.normal * features.radius;
        best.attempt(near.distance, Plane { normal: near.normal, foot });
    };
    // What is farther off than what is known need not be measured.
    let edges = [0, 1, 2].map(|k| [triangle[k], triangle[(k + 1) % 3]]);
    let balls = edges.map(Ball::of_edge);
    for ridge in 0..features.ridges.len() as u32 {
        for (edge, ball) in edges.iter().zip(&balls) {
            if !ball.is_apart_from(features, ridge, best.distance) {
                attempt(&mut best, Near::edge_segment(*edge, features.ridge(ridge)));
            }
        }
    }
    let ball = Ball::of_triangle(triangle);
    for &corner in &features.corners {
        let corner = features.points[corner as usize];
        if !ball.is_apart(corner, best.distance) {
            attempt(&mut best, Near::triangle_point(triangle, corner));
        }
    }
    best.plane
}

/// The plane at right angles to the shortest way that is known.
struct Parting {
    distance: f64,
    plane: Plane,
}

impl Parting {
    fn attempt(&mut self, distance: f64, plane: Plane) {
        if distance < self.distance {
            *self = Parting { distance, plane };
        }
    }
}
