//! The hand: what it takes, where it goes in a step, and what it feels.

use super::World;
use crate::{
    grid::Site,
    hand::{self, HandReport},
    math::{Mat3, Vec3},
    minimize::Budget,
    obstacle::slide,
    potential::Pull,
};

/// Distance from obstacles that the hand keeps, over the activation distance: there the cloth it holds is pressed hard.
const CLEARANCE: f64 = 0.02;
/// Way [m] below which the hand counts as not getting on.
const NO_WAY: f64 = 1e-6;
/// Farthest the hand goes per solve of the budget [m]; what is left of its path comes in the next steps. One linear solve
/// cannot follow a farther move on sheets like ours; 5 mm cost some 2 % of force error.
const TRAVEL: f64 = 5e-3;
/// Such ways in one step at the most, however large the budget.
const MOST_TRAVELS: u32 = 4;
/// Sub-steps of one step at the most, when the hand's path turns back within it.
const TURNS: usize = 3;
/// Validity of the force model around the continued path, relative to the shorter side of the sheet.
const RADIUS: f64 = 0.01;

impl World {
    pub(super) fn grab(&mut self, particle: Site) -> bool {
        self.make_active(particle);
        let n = self.model.grid.index(particle);
        if !self.model.grid.is_active(n) {
            // The mesh cannot be split there now: the hand takes nothing.
            return false;
        }
        self.held = true;
        self.target = None;
        let woken = self.hand != Some(n) || !self.minimizer.system.fixed[n];
        self.hand = Some(n);
        self.minimizer.system.hand = Some(n as u32);
        self.minimizer.system.fixed[n] = true;
        self.state.velocities[n] = Vec3::zeros();
        self.ahead_of = None;
        woken
    }

    pub(super) fn release(&mut self, let_go: bool) -> bool {
        let was_held = std::mem::take(&mut self.held);
        self.target = None;
        let Some(n) = self.hand.filter(|_| let_go && was_held) else { return false };
        self.minimizer.system.fixed[n] = false;
        self.minimizer.system.hand = None;
        self.hand = None;
        true
    }

    /// Where the hand goes in this step: the turns of its path and its end, no farther than the budget can follow. What is left
    /// stays the hand's target for the next steps.
    pub(super) fn hand_stops(&mut self, path: &[Vec3], budget: Budget, stops: &mut Vec<Vec3>) {
        stops.clear();
        let Some(h) = self.hand else { return };
        self.target = path.last().copied().or(self.target);
        let from = self.state.positions[h];
        if path.is_empty() {
            stops.extend(self.target);
        } else {
            turns(from, path, stops);
        }
        let mut left = farthest(budget);
        let mut last = from;
        if self.caution > 0 {
            // The step is shorter; the hand must not become faster.
            let way: f64 = stops.iter().map(|stop| (stop - std::mem::replace(&mut last, *stop)).norm()).sum();
            left = left.min(way * self.prudence());
            last = from;
        }
        self.report.hand_blocked = false;
        let clearance = CLEARANCE * self.model.contact.barrier.activation;
        for stop in stops.iter_mut() {
            let way = *stop - last;
            if way.norm() > left {
                *stop = last + way * (left / way.norm());
            }
            let free = slide(&self.model.obstacles, &self.state.poses, last, *stop, clearance);
            self.report.hand_blocked |= (free - *stop).norm() > NO_WAY;
            *stop = free;
            left -= (*stop - last).norm();
            last = *stop;
        }
        if self.target == Some(last) {
            self.target = None;
        } else if (last - from).norm() <= NO_WAY {
            // An obstacle holds it up for good: it waits there for the next command.
            stops.clear();
            return;
        }
        stops.dedup();
        stops.retain(|s| *s != from || last != from);
    }

    /// After a step that should have brought the hand to `stop`: what cloth pressed to an obstacle kept it from stays its target,
    /// as long as it gets on at all.
    pub(super) fn see_to_hand(&mut self, stop: Option<Vec3>) {
        let (Some(h), Some(stop)) = (self.hand, stop) else { return };
        let missing = stop - self.state.positions[h];
        if missing.norm() <= NO_WAY {
            return;
        }
        self.report.hand_blocked = true;
        let velocity = self.state.velocities[h];
        self.target = (velocity.norm() > 0.0).then_some(self.target.unwrap_or(stop));
    }

    /// Force model of a moving cloth. Its horizon is one more step like the one just taken.
    pub(super) fn feel(&mut self, dt: f64) {
        let Some(n) = self.hand else {
            self.report.hand = None;
            return;
        };
        let stiffness = hand::stiffness(&self.minimizer);
        let velocity = self.state.velocities[n];
        // What the next step begins with: the pull of inertia moves on to x + dt v. The last one began so too, and what it changed the
        // next one will change again if all goes on: no stiffness is asked for, which a response of a moment ago makes stiffer than it is.
        std::mem::swap(&mut self.ahead, &mut self.begun);
        let gradient = &self.minimizer.gradient;
        self.model.elements.ghosts.iter().for_each(|ghost| self.ahead[ghost.node as usize] = Vec3::zeros());
        for k in self.model.grid.active() {
            let x = self.positions[k];
            let now = (x - self.pull.targets[k]) * self.pull.weights[k];
            let (weight, target) = Pull::of_inertia(&self.model, &self.state, dt, k);
            self.ahead[k] = gradient[k] + ((x - target) * weight - now);
        }
        // But for what elements whose rests fade pull then: a little of that is met a step later.
        self.ahead_of = (!self.rests_fade_much(dt)).then_some(dt);
        let [(force, correction), (begun, _), (begins, _)] =
            hand::corrected(&self.minimizer, [gradient, &self.begun, &self.ahead]);
        let rate = (begun - begins) / dt;
        self.report.hand = Some(HandReport {
            velocity,
            force: -force,
            force_error: correction.norm(),
            rate,
            stiffness,
            ..self.still_hand(n, dt)
        });
    }

    /// A force model without forces, of a hand that does not move, for so long [s].
    pub(super) fn still_hand(&self, n: usize, horizon: f64) -> HandReport {
        HandReport {
            particle: self.model.grid.site(n),
            held: self.held,
            position: self.positions[n],
            velocity: Vec3::zeros(),
            force: Vec3::zeros(),
            force_error: 0.0,
            rate: Vec3::zeros(),
            stiffness: Mat3::zeros(),
            radius: RADIUS * self.model.grid.size[0].min(self.model.grid.size[1]),
            horizon,
        }
    }
}

/// How far something may be moved in one step [m].
pub(super) fn farthest(budget: Budget) -> f64 {
    TRAVEL * f64::from(budget.solves.clamp(1, MOST_TRAVELS))
}

/// Appends the corners of the hand's path at which it turns back, and its end: hysteresis depends on where it turned.
fn turns(from: Vec3, path: &[Vec3], stops: &mut Vec<Vec3>) {
    let mut last = from;
    let mut heading = Vec3::zeros();
    for &point in path {
        let step = point - last;
        if step.dot(&heading) < 0.0 && stops.len() + 1 < TURNS {
            stops.push(last);
        }
        if step != Vec3::zeros() {
            heading = step;
        }
        last = point;
    }
    if !path.is_empty() {
        stops.push(last);
    }
}
