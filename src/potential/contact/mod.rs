//! Contact of the cloth's surface with obstacles, and friction, as potentials of pairs.
//!
//! Particles meet shapes or faces, edges meet ridges, triangles meet corners: each pair pays the barrier's energy for its own gap,
//! times the area it stands for. That keeps states apart; that no step passes through is `guard`'s business. Nearly parallel edges and
//! ridges, whose nearest places jump, are faded out: the ends of what overlaps then meet as particles and corners [Li 2020].

pub mod candidates;
pub mod distance;
pub mod friction;
pub mod guard;
pub mod room;
mod touch;

use super::Curvature;
use crate::{
    math::{Mat3, Vec3},
    model::Model,
    state::{Anchor, Meeting, Pair, State},
};
use candidates::{Candidates, Listed, may_be_within};
use distance::{Ball, Near};
use friction::Slip;
use nalgebra::Point3;
use smallvec::SmallVec;
use touch::{Fade, Touch};

pub use touch::Pressed;

/// Contact in one step.
#[derive(Clone, Copy)]
pub struct Contact<'a> {
    /// Constants.
    pub model: &'a Model,
    /// Anchors and poses.
    pub state: &'a State,
    /// What may meet.
    pub candidates: &'a Candidates,
}

/// What obstacles do to the cloth in a state.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ContactReport {
    /// Pairs that press.
    pub pairs: usize,
    /// Pairs whose friction is at its limit.
    pub sliding: usize,
    /// Sum of the obstacles' forces on the cloth, friction included [N].
    pub force: Vec3,
    /// Sum of the friction forces' magnitudes [N].
    pub friction: f64,
    /// Sum of their Coulomb limits [N].
    pub friction_limit: f64,
}

/// The pairs that press somewhere, kept: to find them takes longer than what is asked of them.
#[derive(Default)]
pub struct Touches(Vec<Touch>);

impl Touches {
    /// The nodes that press.
    pub fn nodes(&self) -> impl Iterator<Item = u32> {
        self.0.iter().flat_map(|touch| touch.nodes[..touch.count].iter().copied())
    }
}

impl Contact<'_> {
    /// Whether anything may press or stick.
    pub fn is_near(&self) -> bool {
        !self.candidates.listed().is_empty() || !self.state.anchors.is_empty()
    }

    /// The pairs that press at `x`.
    pub fn touches(&self, x: &[Vec3]) -> Touches {
        let mut touches = Touches::default();
        self.find(x, &mut touches);
        touches
    }

    /// The same, in memory that is there.
    pub fn find(&self, x: &[Vec3], touches: &mut Touches) {
        touches.0.clear();
        self.each(x, &mut |touch| touches.0.push(touch));
    }

    /// Finds which of the pairs that press, `touches`, press no more where a way [m] leads, `there`, yet would be pushed back by what they
    /// bear, where particles yield [m/N] to it.
    pub fn find_returning(
        &self,
        touches: &Touches,
        (there, way): (&mut Touches, &[Vec3]),
        yields: &dyn Fn(u32) -> f64,
        returning: &mut Touches,
    ) {
        returning.0.clear();
        returning.0.extend(touches.0.iter().filter(|touch| touch.returns(self.model, way, yields)).cloned());
        if !returning.0.is_empty() {
            there.0.sort_unstable_by_key(|touch| touch.pair);
            let presses_there = |pair| there.0.binary_search_by_key(&pair, |touch| touch.pair).is_ok();
            returning.0.retain(|touch| !presses_there(touch.pair));
        }
    }

    /// Energy of the barrier and of friction [J].
    pub fn energy(&self, x: &[Vec3]) -> f64 {
        let mut energy = 0.0;
        self.each(x, &mut |touch| energy += touch.energy(self.model));
        energy + self.slips(x).map(|(_, slip)| slip.energy()).sum::<f64>()
    }

    /// Adds the gradient [N]: minus the obstacles' forces.
    pub fn add_gradient(&self, x: &[Vec3], out: &mut [Vec3]) {
        self.add_gradient_of(&self.touches(x), x, out);
    }

    /// The same, where the pairs that press at `x` are known.
    pub fn add_gradient_of(&self, touches: &Touches, x: &[Vec3], out: &mut [Vec3]) {
        self.add_press(touches, out);
        for (anchor, slip) in self.slips(x) {
            let gradient = slip.gradient();
            for (&n, w) in anchor.nodes.iter().zip(anchor.weights) {
                out[n as usize] += gradient * w;
            }
        }
    }

    /// Adds the gradient of the barrier alone [N].
    pub fn add_press(&self, touches: &Touches, out: &mut [Vec3]) {
        for touch in &touches.0 {
            for k in 0..touch.count {
                out[touch.nodes[k] as usize] += touch.gradient(self.model, k);
            }
        }
    }

    /// Makes the gradient at `x` before a commit that of after it: the anchors `before` are no more, the state's pull instead.
    pub fn change_anchors(&self, before: &[Anchor], x: &[Vec3], out: &mut [Vec3]) {
        for (anchors, sign) in [(before, -1.0), (&self.state.anchors, 1.0)] {
            for anchor in anchors {
                let gradient = Slip::new(self.model, self.state, anchor, x).gradient() * sign;
                for (&n, w) in anchor.nodes.iter().zip(anchor.weights) {
                    self.model.elements.each_master(n, |m, share| out[m as usize] += gradient * (w * share));
                }
            }
        }
    }

    /// Hands over the Hessian's blocks [N/m] as (row, column, block), the blocks between two particles once. `touches` are the pairs that
    /// press at `x`.
    pub fn hessian(
        &self,
        touches: &Touches,
        x: &[Vec3],
        kind: Curvature,
        add: &mut dyn FnMut(u32, u32, &Mat3),
    ) {
        self.press_hessian(touches, x, kind, add);
        for (anchor, slip) in self.slips(x) {
            let block = slip.hessian(kind);
            let bears = |k: &usize| anchor.weights[*k] != 0.0;
            for a in (0..3).filter(bears) {
                for b in (0..=a).filter(bears) {
                    let block = block * (anchor.weights[a] * anchor.weights[b]);
                    add(anchor.nodes[a], anchor.nodes[b], &block);
                }
            }
        }
    }

    /// The same of the barrier alone.
    pub fn press_hessian(
        &self,
        touches: &Touches,
        x: &[Vec3],
        kind: Curvature,
        add: &mut dyn FnMut(u32, u32, &Mat3),
    ) {
        for touch in &touches.0 {
            let blocks = touch.hessian(self.model, kind, x);
            for (a, row) in blocks.iter().enumerate().take(touch.count) {
                for (b, block) in row.iter().enumerate().take(a + 1) {
                    add(touch.nodes[a], touch.nodes[b], block);
                }
            }
        }
    }

    /// The anchors after a step that ended at `x`, where `touches` press, into `anchors`; what sliding dissipated [J], and what the
    /// obstacles do there.
    pub fn commit(&self, touches: &Touches, x: &[Vec3], anchors: &mut Vec<Anchor>) -> (f64, ContactReport) {
        let (model, old) = (self.model, &self.state.anchors);
        let mut report = ContactReport::default();
        let mut lost = 0.0;
        for (_, slip) in self.slips(x) {
            lost += slip.held().1;
            report.sliding += usize::from(!slip.sticks());
            report.friction += slip.gradient().norm();
            report.friction_limit += slip.limit();
            report.force -= slip.gradient();
        }
        anchors.clear();
        let held = |anchor: &Anchor| Slip::new(model, self.state, anchor, x).held().0;
        for touch in &touches.0 {
            let pose = &self.state.poses[touch.pair.obstacle as usize];
            let own = old.binary_search_by_key(&touch.pair, |a| a.pair);
            let slip = own.map_or(Vec3::zeros(), |k| held(&old[k]));
            let slip = slip - touch.normal * touch.normal.dot(&slip);
            let place: Vec3 = (0..touch.count).map(|k| x[touch.nodes[k] as usize] * touch.weights[k]).sum();
            report.force -= (0..touch.count).map(|k| touch.gradient(model, k)).sum::<Vec3>();
            anchors.push(Anchor {
                pair: touch.pair,
                nodes: touch.nodes,
                weights: touch.weights,
                point: pose.inverse_transform_point(&Point3::from(place - slip)).coords,
                normal: pose.rotation.inverse() * touch.normal,
                force: touch.force(model),
                stiffness: model.contact.tangential * touch.area,
            });
        }
        // A pair is there once, so there is but one order.
        anchors.sort_unstable_by_key(|a| a.pair);
        for now in anchors.chunk_by_mut(|a, b| piece(a.pair) == piece(b.pair)) {
            let Some((from, to)) = handed_over(old, now) else { continue };
            let pose = &self.state.poses[from.pair.obstacle as usize];
            let slip = pose.rotation.inverse() * held(from);
            to.point -= slip - to.normal * to.normal.dot(&slip);
        }
        report.pairs = anchors.len();
        (lost, report)
    }

    /// The smallest gap [m], negative where a particle is inside a shape; infinite where all are above twice the activation distance.
    pub fn min_gap(&self, x: &[Vec3]) -> f64 {
        let mut smallest = f64::INFINITY;
        self.every(x, 2.0 * self.model.contact.barrier.activation, &mut |touch| {
            smallest = smallest.min(touch.gap)
        });
        smallest
    }

    /// Visits the pairs that press at `x`, seen along a way of the cloth [m].
    pub fn pressed(&self, x: &[Vec3], way: &[Vec3], visit: &mut dyn FnMut(Pressed)) {
        self.each(x, &mut |touch| visit(touch.pressed(self.model, way)));
    }

    fn slips(&self, x: &[Vec3]) -> impl Iterator<Item = (&Anchor, Slip)> {
        self.state.anchors.iter().map(|a| (a, Slip::new(self.model, self.state, a, x)))
    }

    /// Visits the pairs that press.
    fn each(&self, x: &[Vec3], visit: &mut dyn FnMut(Touch)) {
        self.every(x, self.model.contact.barrier.activation, visit);
    }

    /// Visits the pairs with a gap below `bound` [m].
    fn every(&self, x: &[Vec3], bound: f64, visit: &mut dyn FnMut(Touch)) {
        for listed in self.candidates.listed() {
            self.particles(listed, x, bound, visit);
            self.faces(listed, x, bound, visit);
            self.edges(listed, x, bound, visit);
            self.corners(listed, x, bound, visit);
        }
    }

    fn particles(&self, listed: &Listed, x: &[Vec3], bound: f64, visit: &mut dyn FnMut(Touch)) {
        let (o, model) = (listed.obstacle, self.model);
        let (obstacle, pose) = (&model.obstacles[o], self.candidates.pose(o));
        for (&n, &gap) in listed.particles.iter().zip(&listed.particle_gaps) {
            let place = x[n as usize];
            if may_be_within(bound, gap, self.candidates.moved([n], x))
                && obstacle.distance_at(pose, place) < bound
            {
                let gap = obstacle.gap_at(pose, place);
                let pair = Pair { obstacle: o as u32, kind: Meeting::ParticleFace, cloth: n, part: 0 };
                let area = model.surface.areas[n as usize];
                visit(Touch::of_particle(pair, area, &gap));
            }
        }
    }

    /// Particles and faces of polyhedra: of each patch the nearest face counts, so that sides within a plane are not felt.
    fn faces(&self, listed: &Listed, x: &[Vec3], bound: f64, visit: &mut dyn FnMut(Touch)) {
        let o = listed.obstacle;
        let features = self.candidates.features(o);
        let mut nearest: SmallVec<[(u32, Near); 4]> = SmallVec::new();
        let moved = |n: u32| self.candidates.moved([n], x);
        listed.faces.each(bound, moved, |n, faces| {
            let place = x[n as usize];
            nearest.clear();
            for f in faces.filter(|f| features.face_at_least(*f, place) < bound) {
                let near = Near::particle_face(place, features.face(f));
                let patch = features.patches[f as usize];
                match nearest.iter_mut().find(|(p, _)| *p == patch) {
                    _ if near.distance >= bound => {}
                    Some((_, known)) if known.distance <= near.distance => {}
                    Some((_, known)) => *known = near,
                    None => nearest.push((patch, near)),
                }
            }
            let area = self.model.surface.areas[n as usize];
            for &(patch, near) in &nearest {
                let pair = Pair { obstacle: o as u32, kind: Meeting::ParticleFace, cloth: n, part: patch };
                visit(Touch::of_parts(pair, [n; 3], 1, near, 0.0, area));
            }
        });
    }

    fn edges(&self, listed: &Listed, x: &[Vec3], bound: f64, visit: &mut dyn FnMut(Touch)) {
        let (o, surface) = (listed.obstacle, &self.model.surface);
        let features = self.candidates.features(o);
        let moved = |edge: u32| self.candidates.moved(surface.edges[edge as usize], x);
        listed.edges.each(bound, moved, |edge, ridges| {
            let [a, b] = surface.edges[edge as usize];
            let ends = [a, b].map(|n| x[n as usize]);
            let ball = Ball::of_edge(ends);
            for ridge in ridges {
                if ball.is_apart_from(features, ridge, bound + features.radius) {
                    continue;
                }
                let segment = features.ridge(ridge);
                let near = Near::edge_segment(ends, segment);
                if near.distance - features.radius < bound {
                    let pair =
                        Pair { obstacle: o as u32, kind: Meeting::EdgeRidge, cloth: edge, part: ridge };
                    let area = surface.edge_areas[edge as usize];
                    let mut touch = Touch::of_parts(pair, [a, b, b], 2, near, features.radius, area);
                    let rest = surface.edge_lengths[edge as usize];
                    touch.fade = Fade::new(ends[1] - ends[0], rest, segment[1] - segment[0]);
                    visit(touch);
                }
            }
        });
    }

    fn corners(&self, listed: &Listed, x: &[Vec3], bound: f64, visit: &mut dyn FnMut(Touch)) {
        let (o, surface) = (listed.obstacle, &self.model.surface);
        let features = self.candidates.features(o);
        let moved = |triangle: u32| self.candidates.moved(surface.triangles[triangle as usize], x);
        listed.corners.each(bound, moved, |triangle, corners| {
            let nodes = surface.triangles[triangle as usize];
            let cloth = nodes.map(|n| x[n as usize]);
            let ball = Ball::of_triangle(cloth);
            for corner in corners {
                let point = features.points[corner as usize];
                if ball.is_apart(point, bound + features.radius) {
                    continue;
                }
                let near = Near::triangle_point(cloth, point);
                if near.distance - features.radius < bound {
                    let kind = Meeting::TriangleCorner;
                    let pair = Pair { obstacle: o as u32, kind, cloth: triangle, part: corner };
                    let area = surface.triangle_areas[triangle as usize];
                    visit(Touch::of_parts(pair, nodes, 3, near, features.radius, area));
                }
            }
        });
    }
}

/// A piece of cloth at an obstacle.
fn piece(pair: Pair) -> (u32, Meeting, u32) {
    (pair.obstacle, pair.kind, pair.cloth)
}

/// The old anchor of a piece whose slip goes on with another pair, and the piece's anchor that takes it: of those that press no more the one that
/// pressed hardest, and of the new ones the one that presses hardest. Its Coulomb limit bounds what it takes. One slip taken twice, or taken from a
/// pair that goes on itself, would be energy from nothing.
fn handed_over<'a>(old: &'a [Anchor], now: &'a mut [Anchor]) -> Option<(&'a Anchor, &'a mut Anchor)> {
    let own = piece(now[0].pair);
    let known = &old[old.partition_point(|a| piece(a.pair) < own)..];
    let known = &known[..known.partition_point(|a| piece(a.pair) == own)];
    let is_in = |anchors: &[Anchor], pair: Pair| anchors.binary_search_by_key(&pair, |a| a.pair).is_ok();
    let from = known.iter().filter(|a| !is_in(now, a.pair)).max_by(|a, b| a.force.total_cmp(&b.force))?;
    let to = now.iter_mut().filter(|a| !is_in(known, a.pair)).max_by(|a, b| a.force.total_cmp(&b.force))?;
    Some((from, to))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slip_goes_on_with_one_new_pair_where_its_own_presses_no_more() {
        let pair = |cloth: u32, part: u32| Pair { obstacle: 0, kind: Meeting::EdgeRidge, cloth, part };
        let anchor = |(cloth, part, force): (u32, u32, f64)| Anchor {
            pair: pair(cloth, part),
            nodes: [0; 3],
            weights: [1.0, 0.0, 0.0],
            point: Vec3::zeros(),
            normal: Vec3::z(),
            force,
            stiffness: 1.0,
        };
        let old = [(1, 0, 9.0), (2, 3, 1.0), (2, 5, 2.0), (2, 6, 9.0), (4, 7, 9.0)].map(anchor);
        let over = |now: &[(u32, u32, f64)]| {
            let mut now: Vec<Anchor> = now.iter().copied().map(anchor).collect();
            handed_over(&old, &mut now).map(|(from, to)| (from.pair.part, to.pair.part))
        };
        assert_eq!(
            over(&[(2, 4, 1.0), (2, 6, 1.0), (2, 7, 3.0)]),
            Some((5, 7)),
            "the hardest that ended, the hardest new"
        );
        assert_eq!(over(&[(2, 3, 1.0), (2, 4, 1.0), (2, 5, 1.0), (2, 6, 1.0)]), None, "all go on themselves");
        assert_eq!(over(&[(2, 3, 1.0)]), None, "nobody is new");
        assert_eq!(over(&[(3, 3, 1.0)]), None, "another edge's is none of its business");
    }
}
