//! Coming to rest: the static equilibrium near a quiet cloth.

use super::World;
use crate::{
    hand::{self, HandReport},
    math::Vec3,
    minimize::{Budget, Outcome},
    phase::Watch,
    potential::{Potential, Pull},
    state::State,
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
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Settling {
    /// It moves; so much quiet time [s] until rest is tried (again), and what was dissipated [J] when it last was in vain.
    Moving { patience: f64, dissipated: f64 },
    /// Rest is being looked for, as a clock counts; the cloth does not know of it until it is found.
    Seeking(Box<Search>),
    /// It is at rest.
    Resting,
}

impl Settling {
    /// Something moves the cloth.
    pub const STIRRED: Settling = Settling::Moving { patience: PATIENCE, dissipated: f64::NEG_INFINITY };
}

/// A search for rest that goes on in the next step.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Search {
    /// The last state that was committed on the way, and positions beyond it [m].
    state: State,
    positions: Vec<Vec3>,
    /// What was dissipated in it [J], and when rest last was tried in vain.
    dissipated: [f64; 2],
    contact_changed: bool,
    solves: u32,
}

/// What became of an attempt to find rest.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Attempt {
    Found,
    /// After so many solves in all.
    Unfinished(u32),
    Failed,
}

impl World {
    /// Tries to find the static equilibrium when the cloth is quiet, after a step of `dt` [s]. If it is near, the cloth rests there. Where
    /// a clock counts, a step looks no further than one solve, and the next one goes on.
    pub(super) fn try_rest(&mut self, dt: f64, budget: Budget) {
        if self.settling == Settling::Resting {
            return;
        }
        if self.top_speed() > QUIET_SPEED {
            self.stop_seeking();
            return;
        }
        // Rounded to whole steps.
        if let Settling::Moving { patience, .. } = &mut self.settling
            && *patience > 0.5 * dt
        {
            *patience -= dt;
            return;
        }
        if self.mesh_works(dt) {
            self.stop_seeking();
            return;
        }
        self.ahead_of = None;
        let (dissipated, changed) = (self.report.dissipated, self.report.contact_changed);
        let (before, last, solves) = match std::mem::replace(&mut self.settling, Settling::STIRRED) {
            Settling::Seeking(search) => {
                let Search { state, positions, dissipated: [yet, last], contact_changed, solves } = *search;
                self.positions = positions;
                (self.report.dissipated, self.report.contact_changed) = (yet, contact_changed);
                (std::mem::replace(&mut self.state, state), last, solves)
            }
            Settling::Moving { dissipated: last, .. } => (self.state.clone(), last, 0),
            Settling::Resting => unreachable!("it was looked at above"),
        };
        let side = self.model.grid.size[0].max(self.model.grid.size[1]);
        let loses = dissipated - last > REST_LOSS * self.model.weight_on_earth() * side;
        let at_once = if budget.stop.is_some() { 1 } else { REST_SOLVES };
        let attempt = self.find_rest(&before.positions, loses, solves, at_once);
        if attempt == Attempt::Found {
            self.settling = Settling::Resting;
            self.report.outcome = Outcome::Converged;
            // The cloth went on while rest was looked for, and what it has told does not fall.
            self.report.dissipated = self.report.dissipated.max(dissipated);
            return;
        }
        let state = std::mem::replace(&mut self.state, before);
        self.settling = if let Attempt::Unfinished(solves) = attempt {
            Settling::Seeking(Box::new(Search {
                state,
                positions: self.positions.clone(),
                dissipated: [self.report.dissipated, last],
                contact_changed: self.report.contact_changed,
                solves,
            }))
        } else {
            Settling::Moving { patience: PATIENCE, dissipated }
        };
        self.positions.copy_from_slice(&self.state.positions);
        (self.report.dissipated, self.report.contact_changed) = (dissipated, changed);
        self.measure();
    }

    /// What was found on the way to a rest of other times or another mesh is none of this.
    pub(super) fn stop_seeking(&mut self) {
        if let Settling::Seeking(search) = &self.settling {
            self.settling = Settling::Moving { patience: PATIENCE, dissipated: search.dissipated[1] };
        }
    }

    /// Static equilibrium near `start`, where a cloth is that lately lost energy or did not: sought from the world's positions, after some
    /// solves, by no more than `at_once` now. Fails when it is far or does not converge.
    fn find_rest(&mut self, start: &[Vec3], loses: bool, after: u32, mut at_once: u32) -> Attempt {
        let tolerance = REST_TOLERANCE * self.mean_weight();
        let still = Pull::still(&self.model, &self.state);
        self.candidates.update(&self.model, &self.state.poses, start, 2.0 * QUIET_DISTANCE);
        let mut solves = after;
        // Friction's Coulomb limits follow the normal forces only in a commit: repeat until they agree.
        for _ in 0..REST_SOLVES {
            self.minimizer.solves = 0;
            let potential = Potential {
                model: &self.model,
                state: &self.state,
                candidates: &self.candidates,
                pull: &still,
            };
            let from = self.positions.clone();
            let allowed = Budget::solves(at_once.min(REST_SOLVES - solves));
            let outcome = self.minimizer.polish(&potential, &mut self.positions, tolerance, allowed);
            solves += self.minimizer.solves;
            self.report.solves += self.minimizer.solves;
            let ways = self.model.elements.present().map(|n| (self.positions[n] - start[n]).norm());
            let moved = ways.fold(0.0, f64::max);
            if moved > QUIET_DISTANCE {
                return Attempt::Failed;
            }
            if outcome == Outcome::Budget && solves < REST_SOLVES {
                if self.positions != from {
                    return Attempt::Unfinished(solves);
                }
                // A shift that a single solve did not find takes several at once.
                at_once = REST_SOLVES;
                continue;
            }
            if outcome != Outcome::Converged {
                return Attempt::Failed;
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
                return if self.feel_at_rest(loses) { Attempt::Found } else { Attempt::Failed };
            }
            if solves >= REST_SOLVES {
                break;
            }
            if solves >= after + at_once {
                return Attempt::Unfinished(solves);
            }
        }
        Attempt::Failed
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
        let [(force, correction)] = hand::corrected(&self.minimizer, [&self.minimizer.gradient]);
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
