//! Coming to rest: the static equilibrium near a quiet cloth.

use super::World;
use crate::{
    hand::{self, HandReport},
    math::Vec3,
    minimize::{Budget, Outcome},
    phase::Watch,
    potential::{Potential, Pull},
};

/// The residual, relative to the weight of a mean particle, at which the cloth may rest.
const REST_TOLERANCE: f64 = 1e-7;
/// Speed [m/s] below which rest is tried.
pub const QUIET_SPEED: f64 = 4e-3;
/// Farthest [m] that a particle may be from rest when it is tried.
const QUIET_DISTANCE: f64 = 2e-3;
/// Simulated time [s] for which the cloth must be quiet until rest is tried, and again after it failed.
const PATIENCE: f64 = 0.2;
/// How much more may be out of balance after a commit than before it when friction agrees with the normal forces.
const AGREED: f64 = 2.0;
/// Farthest [m] that one more step may take a particle from rest where not the tolerance but rounding ends the search: what is rounding to
/// stiff particles may still push soft ones, and those slide on.
const REST_STEP: f64 = 1e-8;
/// Energy lost since rest was last tried, over the sheet's weight times its longer side, below which it is no matter.
const REST_LOSS: f64 = 1e-8;
/// Solves of one attempt to come to rest.
const REST_SOLVES: u32 = 12;
/// Rate [1/s²] at which what leaves an equilibrium may speed up, over its way: nothing turns a sheet that hangs from one pin about the
/// vertical, nor back, and rounding makes a slow instability of that.
const REST_DRIFT: f64 = 1e-2;
/// Horizon of the force model at rest [s].
const REST_HORIZON: f64 = 0.01;

/// How far the cloth is from rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Settling {
    /// It moves; so much quiet time [s] until rest is tried (again), and what was dissipated [J] when it last was in vain.
    Moving { patience: f64, dissipated: f64 },
    /// It is at rest.
    Resting,
}

impl Settling {
    /// Something moves the cloth.
    pub const STIRRED: Settling = Settling::Moving { patience: PATIENCE, dissipated: f64::NEG_INFINITY };
}

impl World {
    /// Tries to find the static equilibrium when the cloth is quiet, after a step of `dt` [s]. If it is near, the cloth rests there.
    pub(super) fn try_rest(&mut self, dt: f64) {
        let Settling::Moving { patience, dissipated: last } = self.settling else { return };
        if self.top_speed() > QUIET_SPEED {
            return;
        }
        // Rounded to whole steps.
        if patience > 0.5 * dt {
            self.settling = Settling::Moving { patience: patience - dt, dissipated: last };
            return;
        }
        if self.mesh_works(dt) {
            return;
        }
        self.ahead_of = None;
        let before = self.state.clone();
        let (dissipated, changed) = (self.report.dissipated, self.report.contact_changed);
        let side = self.model.grid.size[0].max(self.model.grid.size[1]);
        let loses = dissipated - last > REST_LOSS * self.model.weight_on_earth() * side;
        if self.find_rest(loses) {
            self.settling = Settling::Resting;
            self.report.outcome = Outcome::Converged;
        } else {
            self.settling = Settling::Moving { patience: PATIENCE, dissipated };
            self.state = before;
            self.positions.copy_from_slice(&self.state.positions);
            (self.report.dissipated, self.report.contact_changed) = (dissipated, changed);
            self.measure();
        }
    }

    /// Static equilibrium from the present state, which lately lost energy or did not; false when it is far or does not converge.
    fn find_rest(&mut self, loses: bool) -> bool {
        let tolerance = REST_TOLERANCE * self.mean_weight();
        let still = Pull::still(&self.model, &self.state);
        let start = self.state.positions.clone();
        self.candidates.update(&self.model, &self.state.poses, &self.positions, 2.0 * QUIET_DISTANCE);
        let mut solves = 0;
        // Friction's Coulomb limits follow the normal forces only in a commit: repeat until they agree.
        for _ in 0..REST_SOLVES {
            self.minimizer.solves = 0;
            let potential = Potential {
                model: &self.model,
                state: &self.state,
                candidates: &self.candidates,
                pull: &still,
            };
            // All or nothing: an attempt that the clock cuts short would never succeed on a slow machine.
            let allowed = Budget::solves(REST_SOLVES - solves);
            let outcome = self.minimizer.polish(&potential, &mut self.positions, tolerance, allowed);
            solves += self.minimizer.solves;
            self.report.solves += self.minimizer.solves;
            let ways = self.model.elements.present().map(|n| (self.positions[n] - start[n]).norm());
            let moved = ways.fold(0.0, f64::max);
            if outcome != Outcome::Converged || moved > QUIET_DISTANCE {
                return false;
            }
            let polished = self.minimizer.residual();
            self.commit();
            let potential = Potential {
                model: &self.model,
                state: &self.state,
                candidates: &self.candidates,
                pull: &still,
            };
            self.minimizer.measure(&potential, &self.positions, Watch::default());
            if self.minimizer.residual() <= tolerance.max(AGREED * polished) {
                self.state.velocities.fill(Vec3::zeros());
                return self.feel_at_rest(loses);
            }
            if solves >= REST_SOLVES {
                return false;
            }
        }
        false
    }

    /// Force model at rest, with the static stiffness; false where the equilibrium is not stable or not quite reached.
    fn feel_at_rest(&mut self, loses: bool) -> bool {
        self.minimizer.solves = 0;
        self.minimizer.system.prescribe_nothing();
        let mut pull = Pull::still(&self.model, &self.state);
        let stable = [0.0, REST_DRIFT].into_iter().any(|drift| {
            pull.set_shift(&self.model, &self.positions, drift);
            let potential = Potential {
                model: &self.model,
                state: &self.state,
                candidates: &self.candidates,
                pull: &pull,
            };
            self.minimizer.linearize(&potential, &self.positions)
        });
        let may_creep = loses && self.minimizer.residual() > REST_TOLERANCE * self.mean_weight();
        if !stable || may_creep && self.minimizer.longest_step() > REST_STEP {
            return false;
        }
        self.report.solves += self.minimizer.solves;
        self.pull = Pull::still(&self.model, &self.state);
        let (force, correction) = hand::corrected(&self.minimizer, &self.minimizer.gradient);
        let stiffness = hand::stiffness(&self.minimizer);
        self.report.hand = self.hand.map(|n| HandReport {
            force: -force,
            force_error: correction.norm(),
            stiffness,
            ..self.still_hand(n, REST_HORIZON)
        });
        true
    }
}
