//! One dynamic step: obstacles move, the cloth is minimized, and what came of it becomes the state.

use super::{Before, World, hand::farthest};
use crate::{
    math::Vec3,
    minimize::{Budget, Outcome},
    obstacle::Motion,
    phase::{Phase, Watch},
    potential::{Potential, Pull},
};

/// Steps that are longer [s] change the response to the hand by too much for it to be renewed a column at a time.
const LONG_STEP: f64 = 0.005;
/// Longest step [s] that is told what the last ones left, if one solve may do: what longer ones leave is not alike, and what a second solve
/// leaves is less than that.
const TOLD_STEP: f64 = 0.0025;
/// Halvings of a step at the most.
const MOST_CAUTION: i32 = 6;

impl World {
    /// One dynamic step of `dt`, or less after trouble, with fixed particles going to their targets; rolled back if a number is not finite.
    pub(super) fn advance(
        &mut self,
        targets: &[(usize, Vec3)],
        dt: f64,
        budget: Budget,
        before: &mut Before,
    ) {
        let dt = dt * self.prudence();
        let watch = budget.watch;
        self.report.time += dt;
        before.poses.clone_from(&self.state.poses);
        before.motions.clone_from(&self.state.motions);
        self.model.elements.copy(&self.state.positions, &mut self.positions);
        self.fade_rests(dt);
        let travel = self.expected_travel(targets, dt);
        self.push_obstacles(dt, budget);
        watch.ended(Phase::Setup);
        self.candidates.update(&self.model, &self.state.poses, &self.positions, travel);
        watch.ended(Phase::Contact);
        self.pull.set_inertia(&self.model, &self.state, dt);
        self.minimizer.system.prescribe_nothing();
        for &(n, target) in targets {
            self.minimizer.system.prescribe(n, target - self.positions[n]);
        }
        let potential = Potential {
            model: &self.model,
            state: &self.state,
            candidates: &self.candidates,
            pull: &self.pull,
        };
        let tolerance = budget.residual * self.mean_weight();
        self.minimizer.solves = 0;
        self.minimizer.is_told = dt <= TOLD_STEP && budget.least <= 1;
        // Where obstacles stand nothing but pull and anchors has changed since the last step foresaw this gradient.
        let foreseen = self.ahead_of == Some(dt) && before.poses == self.state.poses;
        if foreseen {
            potential.contact().change_anchors(&self.anchors, &self.positions, &mut self.ahead);
            self.model.elements.copy(&self.ahead, &mut self.minimizer.gradient);
        } else {
            watch.ended(Phase::Setup);
            self.minimizer.measure(&potential, &self.positions, watch);
            self.model.elements.copy(&self.minimizer.gradient, &mut self.ahead);
        }
        self.ahead_of = None;
        let outcome = self.minimizer.descend(&potential, &mut self.positions, tolerance, budget);
        self.report.solves += self.minimizer.solves;
        self.report.outcome = outcome;
        self.caution = match outcome {
            Outcome::Stalled | Outcome::NotFinite => (self.caution + 1).min(MOST_CAUTION),
            _ if self.minimizer.is_troubled() => self.caution,
            _ => (self.caution - 1).max(0),
        };
        if outcome == Outcome::NotFinite {
            self.state.poses.clone_from(&before.poses);
            self.state.motions.clone_from(&before.motions);
            self.roll_back();
            return;
        }
        if dt > LONG_STEP {
            self.minimizer.renew_response(watch);
        }
        for n in self.model.elements.present() {
            self.state.velocities[n] = (self.positions[n] - self.state.positions[n]) / dt;
        }
        watch.ended(Phase::Advance);
        self.commit();
        watch.ended(Phase::Commit);
        self.fade_loads(dt);
        self.feel(dt);
        watch.ended(Phase::Feel);
    }

    /// Share of a step that is gone at once: less after trouble.
    pub(super) fn prudence(&self) -> f64 {
        0.5_f64.powi(self.caution)
    }

    /// Speed of the fastest particle [m/s].
    pub(super) fn top_speed(&self) -> f64 {
        let velocities = self.model.elements.present().map(|n| self.state.velocities[n]);
        velocities.map(|v| v.norm_squared()).fold(0.0, f64::max).sqrt()
    }

    /// How far a particle may want to go in a step [m]: as in the last one, with gravity and the hand; and a bit.
    pub(super) fn expected_travel(&self, targets: &[(usize, Vec3)], dt: f64) -> f64 {
        let speed = self.top_speed();
        let shift = targets.iter().map(|(n, p)| (p - self.positions[*n]).norm()).fold(0.0, f64::max);
        1.5 * (speed * dt + self.model.gravity * dt * dt)
            + 2.0 * shift
            + self.model.contact.barrier.activation
    }

    /// Moves the obstacles on, and the cloth in their way with them: as far as cloth that is held allows.
    pub(super) fn push_obstacles(&mut self, dt: f64, budget: Budget) {
        if self.state.motions.iter().all(Option::is_none) {
            return;
        }
        let travel = farthest(budget);
        // Nothing beyond the lists comes near while obstacles go so far.
        self.candidates.update(&self.model, &self.state.poses, &self.positions, 2.0 * travel);
        let (model, candidates) = (&self.model, &self.candidates);
        // Of an obstacle that turns, only what may meet the cloth counts: a plane has no end.
        let reach: Vec<f64> = (self.state.poses.iter().enumerate())
            .map(|(o, pose)| {
                let from = pose.translation.vector;
                let farthest = self.positions.iter().map(|x| (x - from).norm()).fold(0.0, f64::max);
                candidates.reach(o).min(farthest + 2.0 * travel)
            })
            .collect();
        for halvings in 0..8 {
            let share = 0.5_f64.powi(halvings);
            let after = |o: usize, m: &Motion| m.after(dt * share, reach[o], travel * share);
            let mut poses = self.state.poses.clone();
            for (o, motion) in self.state.motions.iter().enumerate() {
                if let Some(m) = motion {
                    poses[o] = m.pose(after(o, m));
                }
            }
            let (fixed, room) = (&self.minimizer.system.fixed, &mut self.minimizer.room);
            if let Some(carried) = candidates.carry(model, &self.positions, &poses, fixed, room) {
                for (o, motion) in self.state.motions.iter_mut().enumerate() {
                    if let Some(m) = motion {
                        m.done = after(o, m);
                        *motion = (m.done < 1.0).then_some(*m);
                    }
                }
                self.positions = carried;
                self.state.poses = poses;
                self.report.obstacle_blocked |= halvings > 0;
                return;
            }
        }
        self.report.obstacle_blocked = true;
    }

    /// Goes back to the last state, stopped, with what the solver remembers made finite again.
    pub(super) fn roll_back(&mut self) {
        self.state.velocities.fill(Vec3::zeros());
        self.positions.copy_from_slice(&self.state.positions);
        self.candidates.update(&self.model, &self.state.poses, &self.positions, 0.0);
        self.minimizer.forget();
        self.pull = Pull::still(&self.model, &self.state);
        self.measure();
    }

    /// Gradient and measures at the positions, under the present pull.
    pub(super) fn measure(&mut self) {
        let potential = Potential {
            model: &self.model,
            state: &self.state,
            candidates: &self.candidates,
            pull: &self.pull,
        };
        self.minimizer.measure(&potential, &self.positions, Watch::default());
    }

    /// Makes the minimized positions the state: history and anchors advance.
    pub(super) fn commit(&mut self) {
        let potential = Potential {
            model: &self.model,
            state: &self.state,
            candidates: &self.candidates,
            pull: &self.pull,
        };
        let (slid, contact) =
            potential.contact().commit(&self.minimizer.touches, &self.positions, &mut self.anchors);
        self.report.contact_changed |=
            !self.anchors.iter().map(|a| a.pair).eq(self.state.anchors.iter().map(|a| a.pair));
        self.report.contact = contact;
        std::mem::swap(&mut self.state.anchors, &mut self.anchors);
        let lost = self.state.history.advance(&self.model, &self.minimizer.measures);
        self.report.dissipated += lost + slid;
        self.model.elements.copy(&self.positions, &mut self.state.positions);
    }
}
