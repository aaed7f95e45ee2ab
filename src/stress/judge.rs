//! What must hold after every step, measured apart from the solver: from positions, velocities, history and reports alone.
//!
//! Energies are summed element by element by the scalar laws, gaps come from parry's algorithms, inertia and work from differences
//! of states. Each invariant is a ratio to its allowance: above 1 it is violated.

mod course;
mod look;
mod rest;
mod rounding;
mod tally;

use super::case::{Topic, stream};
use crate::{
    math::Vec3,
    obstacle::witness::Witness,
    potential::{Potential, Pull, contact::candidates::Candidates},
    state::State,
    world::{Outcome, QUIET_SPEED, World},
};
use course::{Course, Works};
use look::not_finite;
use rand::RngExt;
use rounding::{ROUNDINGS, Strained, extent, stiffness_rounding, strained};
use std::collections::BTreeMap;

pub use look::Look;
pub use rest::Rest;
pub use rounding::rounding_of_energy;
pub use tally::{Invariant, Tally, Violation};

/// Relative allowances; each says what brackets it.
/// Sums of some thousand terms in double precision.
const SUM: f64 = 1e-11;
/// Asymmetry of the derivative of forces by central differences.
const ASYMMETRY: f64 = 1e-3;
/// Steps between looks at that derivative.
const EVERY: u64 = 16;

/// What is remembered of the moment before a step.
pub struct Before {
    /// The state.
    pub state: State,
    /// Stored energy with contact [J].
    pub potential: f64,
    /// Kinetic energy [J].
    pub kinetic: f64,
    /// Gradient of the potential energy [N].
    forces: Vec<Vec3>,
    time: f64,
    dissipated: f64,
    resting: bool,
    epoch: u32,
}

/// Measures invariants and keeps their tallies.
pub struct Judge {
    /// Tallies by invariant.
    pub tallies: BTreeMap<Invariant, Tally>,
    /// The first violation.
    pub first: Option<Violation>,
    /// Steps seen.
    pub steps: u64,
    /// Manipulation that goes on.
    pub act: usize,
    /// Steps that were rolled back because a number was not finite, and that stalled.
    pub trouble: [u64; 2],
    seed: u64,
    witnesses: Vec<Witness>,
    /// Area of the sheet [m²].
    area: f64,
    mesh_seen: Option<u32>,
    /// The last state, not to measure it twice.
    known: Option<Known>,
}

/// What was measured of a state.
struct Known {
    state: State,
    potential: f64,
    forces: Vec<Vec3>,
}

impl Judge {
    /// Nothing seen yet.
    pub fn new(seed: u64) -> Judge {
        Judge {
            tallies: BTreeMap::new(),
            first: None,
            steps: 0,
            act: 0,
            trouble: [0; 2],
            seed,
            witnesses: Vec::new(),
            area: 0.0,
            mesh_seen: None,
            known: None,
        }
    }

    /// Records a ratio to an allowance; what is no number is a violation.
    pub fn record(&mut self, invariant: Invariant, ratio: f64, note: &dyn Fn() -> String) {
        let tally = self.tallies.entry(invariant).or_default();
        tally.checks += 1;
        let ratio = if ratio.is_nan() { f64::INFINITY } else { ratio };
        tally.worst = tally.worst.max(ratio);
        if ratio > 1.0 {
            tally.violations += 1;
            if self.first.is_none() {
                let (step, act) = (self.steps, self.act);
                self.first = Some(Violation { invariant, ratio, step, act, note: note() });
            }
        }
    }

    /// A world is another one from here on.
    pub fn meet(&mut self, world: &World) {
        let setup = world.setup();
        self.witnesses = setup.obstacles.iter().map(Witness::new).collect();
        let [a, b] = setup.size;
        self.area = setup.cut.map_or(a * b, |cut| cut.covered([0.0; 2], [a, b]));
        (self.mesh_seen, self.known) = (None, None);
    }

    /// The moment before a step.
    pub fn before(&self, world: &World) -> Before {
        let look = Look::at(world);
        let grid = world.grid();
        let known = self.known.as_ref().filter(|k| k.state == *look.state);
        let (potential, forces) = known.map_or_else(
            || {
                let candidates = look.candidates();
                let forces = look.gradient(look.state, &candidates, &look.state.positions);
                (look.potential(&candidates, &look.state.positions), forces)
            },
            |k| (k.potential, k.forces.clone()),
        );
        Before {
            state: world.state().clone(),
            potential,
            forces,
            kinetic: look.kinetic(),
            time: look.report.time,
            dissipated: look.report.dissipated,
            resting: look.report.resting,
            epoch: grid.epoch,
        }
    }

    /// Judges a step: `moves` places on the hand's path were given, `grabbed` particles taken.
    pub fn after(&mut self, world: &World, before: &Before, moves: usize, grabbed: &[usize]) {
        self.steps += 1;
        let look = Look::at(world);
        self.trouble[0] += u64::from(look.report.outcome == Outcome::NotFinite);
        self.trouble[1] += u64::from(look.report.outcome == Outcome::Stalled);
        if before.resting && look.report.resting && look.report.solves == 0 {
            // It slept: nothing may have changed.
            self.record(Invariant::Repeat, f64::from(*look.state != before.state) * 2.0, &|| {
                "the state changed at rest".into()
            });
            return;
        }
        self.state(&look);
        if self.first.as_ref().is_some_and(|v| v.invariant == Invariant::Finite) {
            return;
        }
        self.history(&look);
        self.energy(&look);
        self.gap(&look);
        let lost = look.report.dissipated - before.dissipated;
        let scale = SUM * look.report.dissipated.abs() + 1e-30;
        self.record(Invariant::Dissipation, -lost / scale, &|| format!("{lost:e} J in a step"));
        if before.epoch == world.grid().epoch {
            let now: Vec<bool> = (0..world.grid().particles())
                .map(|n| world.reaction(world.grid().site(n)).is_some())
                .collect();
            self.motion(&look, before, &now, moves, grabbed);
        }
    }

    /// Everything that a state shows without a past.
    pub fn state(&mut self, look: &Look) {
        let bad = not_finite(look);
        self.record(Invariant::Finite, if bad.is_some() { f64::INFINITY } else { 0.0 }, &|| {
            bad.clone().unwrap_or_default()
        });
        if bad.is_some() {
            return;
        }
        self.mass(look);
        self.mesh(look);
        let contact = look.report.contact;
        let allowed = (1.0 + SUM) * contact.friction_limit + f64::MIN_POSITIVE;
        let sound = look.state.anchors.iter().all(|a| a.force >= 0.0 && a.stiffness >= 0.0);
        let ratio = if sound { contact.friction / allowed } else { f64::INFINITY };
        self.record(Invariant::Friction, ratio, &|| format!("{contact:?}"));
        self.symmetry(look);
    }

    /// The energy of a step's report; a change of the mesh does not report anew.
    pub fn energy(&mut self, look: &Look) {
        let (candidates, pull) = (Candidates::default(), Pull::default());
        let potential =
            Potential { model: look.model, state: look.state, candidates: &candidates, pull: &pull };
        let stored = potential.stored(&look.state.positions);
        let allowed = rounding_of_energy(look);
        self.record(Invariant::Energy, (stored - look.report.energy).abs() / allowed, &|| {
            format!("{stored:e} J by scalar laws, {:e} J reported", look.report.energy)
        });
    }

    fn mass(&mut self, look: &Look) {
        let model = look.model;
        let sum: f64 = model.grid.active().map(|n| model.mass(n)).sum();
        let mass = model.fabric.areal_density * self.area;
        self.record(Invariant::Mass, (sum / mass - 1.0).abs() / SUM, &|| format!("{sum:e} of {mass:e} kg"));
    }

    /// The mesh itself where it is new, as it cannot change under its number; ghosts always.
    fn mesh(&mut self, look: &Look) {
        let grid = &look.model.grid;
        if self.mesh_seen != Some(grid.epoch) {
            self.mesh_seen = Some(grid.epoch);
            let fault = grid.validate(&look.model.elements).err();
            self.record(Invariant::Mesh, if fault.is_some() { f64::INFINITY } else { 0.0 }, &|| {
                fault.clone().unwrap_or_default()
            });
        }
        let x = &look.state.positions;
        let apart = look.model.elements.ghosts.iter().map(|ghost| {
            let masters: Vec3 = ghost.masters.iter().map(|&(n, w)| x[n as usize] * w).sum();
            (x[ghost.node as usize] - masters).norm() / (1.0 + masters.norm())
        });
        let worst = apart.fold(0.0, f64::max);
        self.record(Invariant::Mesh, worst / 1e-9, &|| format!("a ghost is {worst:e} m from its masters"));
    }

    /// Slip states and forces against their envelopes.
    pub fn history(&mut self, look: &Look) {
        let (mut worst, mut place) = (0.0_f64, [0.0; 6]);
        strained(look, &mut |Strained { law, ends, strain, off, p, .. }| {
            let [low, high] = law.envelope(strain);
            let force = law.evaluate(strain, p).force;
            let area = law.enclosed(strain);
            // Areas and forces count from the first knot, so that rounding at the ends is felt everywhere.
            let [force_end, area_end] = ends.map(|end| ROUNDINGS * f64::EPSILON * end);
            let slip = (area - p).abs() - law.stick();
            let outside = (force - high).max(low - force);
            let ratio = (slip / (SUM * (law.stick() + area.abs()) + 0.5 * (high - low) * off + area_end))
                .max(outside / (SUM * (low.abs() + high.abs()) + force_end));
            let ratio = if ratio.is_nan() { f64::INFINITY } else { ratio };
            if ratio > worst {
                worst = ratio;
                place = [strain, p, area, force, low, high];
            }
        });
        self.record(Invariant::History, worst, &|| {
            format!("strain, p, enclosed area, force, least and largest force: {place:?}")
        });
    }

    /// Symmetry of what the hand is told, and now and then of the derivative of all forces, in two random directions.
    fn symmetry(&mut self, look: &Look) {
        if let Some(hand) = look.report.hand {
            let k = hand.stiffness;
            let ratio = (k - k.transpose()).norm() / (1e-9 * k.norm() + f64::MIN_POSITIVE);
            self.record(Invariant::Symmetry, ratio, &|| format!("{k}"));
        }
        // Hysteresis and friction have kinks, and a difference across one is not symmetric.
        if !self.steps.is_multiple_of(EVERY) || !look.is_elastic() {
            return;
        }
        let (model, x) = (look.model, &look.state.positions);
        let mut random = stream(self.seed, Topic::Judge, self.steps as usize);
        let mut draw = || -> Vec<Vec3> {
            let mut v = vec![Vec3::zeros(); x.len()];
            for n in model.grid.active() {
                v[n] = Vec3::from_fn(|_, _| random.random_range(-1.0..1.0));
            }
            model.elements.fill(&mut v);
            v
        };
        let ways = [draw(), draw()];
        // Not all lengths suit stretched, collapsed and folded cells: the best counts. Where a cell is folded onto its diagonal both of its mean
        // sides vanish, and its shear is straight within 1e-9 of a side alone.
        let spacing = model.grid.spacing(0).min(model.grid.spacing(1));
        let candidates = look.candidates();
        let mut least = f64::INFINITY;
        for length in [1e-8, 1e-7, 1e-6, 1e-9, 1e-10].map(|part| part * spacing) {
            let bent = ways.each_ref().map(|way| {
                let [ahead, back] = [length, -length].map(|h| {
                    let moved: Vec<Vec3> = x.iter().zip(way).map(|(p, v)| p + v * h).collect();
                    look.gradient(look.state, &candidates, &moved)
                });
                let rates = ahead.iter().zip(&back).map(|(a, b)| (a - b) / (2.0 * length));
                rates.collect::<Vec<Vec3>>()
            });
            let asymmetry = asymmetry(&ways, &bent);
            least = if asymmetry.is_nan() { f64::INFINITY } else { least.min(asymmetry) };
            if least <= 0.1 * ASYMMETRY {
                break;
            }
        }
        self.record(Invariant::Symmetry, least / ASYMMETRY, &|| {
            format!("u K v and v K u differ by {least:e} of |u| |K v| + |v| |K u|")
        });
    }

    /// Gaps by parry's algorithms.
    pub fn gap(&mut self, look: &Look) {
        if self.witnesses.is_empty() {
            return;
        }
        let x = &look.state.positions;
        let activation = look.model.contact.barrier.activation;
        let mut smallest = activation;
        for (witness, pose) in self.witnesses.iter().zip(&look.state.poses) {
            let distance = witness.distance(pose, x, &look.model.surface.triangles, smallest);
            smallest = if distance.is_nan() { distance } else { smallest.min(distance) };
        }
        // An open gap is within its allowance however small: the ratio says how much of the barrier was used.
        let ratio = if smallest > 0.0 { 1.0 - smallest / activation } else { f64::INFINITY };
        self.record(Invariant::Gap, ratio, &|| format!("the smallest gap is {smallest:e} m"));
    }

    /// Momentum and energy over a step on one mesh, whose hand's path had so many places.
    fn motion(&mut self, look: &Look, before: &Before, fixed: &[bool], moves: usize, grabbed: &[usize]) {
        let (model, state) = (look.model, look.state);
        let x = &state.positions;
        let candidates = look.candidates();
        let still = look.gradient(state, &candidates, x);
        // A path that turns back is made of several steps; a step that was undone, or that found rest, is none.
        let whole = moves <= 1 && look.report.outcome != Outcome::NotFinite && !look.report.resting;
        let dt = look.report.time - before.time;
        // What holds or misses besides elements and contact.
        let rest = |n: usize| {
            if !whole {
                return -before.state.load(n);
            }
            let (v1, v0) = (state.velocities[n], before.state.velocities[n]);
            // A hand that takes a particle stops it.
            let v0 = if grabbed.contains(&n) { Vec3::zeros() } else { v0 };
            let drag = model.drag * model.elements.areas[n];
            (v1 - v0) * (model.mass(n) / dt) + v1 * drag - before.state.load(n)
        };
        let balance = |mut forces: Vec<Vec3>| {
            model.grid.active().for_each(|n| forces[n] += rest(n));
            forces
        };
        // As in the step, friction holds by the anchors of before.
        let in_step = State { anchors: before.state.anchors.clone(), ..state.clone() };
        let out = balance(look.gradient(&in_step, &candidates, x));
        if whole {
            let residual = |out: &[Vec3]| {
                model.grid.active().filter(|n| !fixed[*n]).map(|n| out[n].norm()).fold(0.0, f64::max)
            };
            let told = look.report.residual;
            // A vain attempt at rest measures with the new anchors.
            let off = (residual(&out) - told).abs().min((residual(&balance(still.clone())) - told).abs());
            let sizes = model.grid.active().map(|n| {
                let speed = state.velocities[n].norm().max(before.state.velocities[n].norm());
                speed * model.mass(n) / dt + out[n].norm()
            });
            // The step's length is a difference of times.
            let of_dt = SUM + ROUNDINGS * f64::EPSILON * look.report.time / dt;
            // Rounding of positions: of elements that pull hard on each other, and of the velocities made of them.
            let stiff = (0..2).map(|d| stiffness_rounding(model, d)).fold(0.0, f64::max);
            let heaviest = model.grid.active().map(|n| model.mass(n)).fold(0.0, f64::max);
            let inert = ROUNDINGS * f64::EPSILON * heaviest / (dt * dt);
            let rounding = (stiff + inert) * (1.0 + extent(x));
            let allowed = of_dt * sizes.fold(0.0, f64::max) + rounding + f64::MIN_POSITIVE;
            self.record(Invariant::Motion, off / allowed, &|| {
                format!("{off:e} N off the reported {told:e} N, step {dt:e} s, {:?}", look.report.outcome)
            });
        }
        let potential = look.potential(&candidates, x);
        if moves <= 1 {
            self.growth(look, before, fixed, &out, potential);
        }
        self.known = Some(Known { state: state.clone(), potential, forces: still });
    }

    /// What energy a step gained, beyond the work of what moved and of what was left out of balance.
    ///
    /// A step ends where the incremental potential is stationary. Were the potential convex on the way, energy could only fall. Where it is
    /// not (a sheet that buckles), the incremental potential's own minimum bounds what is gained: its Hessian, the potential's plus m/dt²,
    /// is positive there, so the potential lies at the most ½ m/dt² |dx|² above its tangent. That is the kinetic energy after the step.
    /// Short of that minimum, of what is out of balance at either end only the sizes count: where it pointed on the way, nobody knows.
    ///
    /// A step that finds rest moves first and does not tell how that ended: as if short of the minimum, and at the speed below which rest is tried.
    ///
    /// What is moved may lift the cloth over any hump on the way. Then every strain and gap counts by what it changed (`Course`).
    fn growth(&mut self, look: &Look, before: &Before, fixed: &[bool], out: &[Vec3], potential: f64) {
        let model = look.model;
        let mut work = Works::default();
        let found_rest = look.report.resting;
        let converged = look.report.outcome == Outcome::Converged && !found_rest;
        let course = Course::new(look, before);
        // A step begins with what its elements measure from: of rests that fade, less than before.
        let mut forces = None;
        if look.state.rests != before.state.rests {
            let begun = State { rests: look.state.rests, ..before.state.clone() };
            let (look, x) = (Look { state: &begun, ..*look }, &begun.positions);
            let candidates = look.candidates();
            work.faded = look.potential(&candidates, x) - before.potential;
            forces = Some(look.gradient(&begun, &candidates, x));
        }
        let forces = forces.as_ref().unwrap_or(&before.forces);
        let is_moved = |n: usize| fixed[n] && course.way[n] != Vec3::zeros();
        let input = look.state.poses != before.state.poses || model.grid.active().any(is_moved);
        for n in model.grid.active() {
            let way = course.way[n];
            let felt = out[n].dot(&way);
            if fixed[n] {
                work.held += felt;
            } else if input || converged {
                work.unbalanced += felt;
            } else {
                let (v0, dt) = (before.state.velocities[n], look.report.time - before.time);
                let pull = v0 * (model.mass(n) / dt) + before.state.load(n);
                work.unbalanced += out[n].norm().max((forces[n] - pull).norm()) * way.norm();
            }
            work.loads += before.state.load(n).dot(&way);
        }
        if input {
            work.turned = course.bent(look, before) + course.pressed(look, before);
        } else {
            work.unbalanced = work.unbalanced.abs();
        }
        let kinetic = look.kinetic();
        let lost = look.report.dissipated - before.dissipated;
        let had = before.potential + before.kinetic;
        let given = work.held + work.loads + work.unbalanced + work.turned + work.faded;
        let gain = potential + kinetic + lost - had - given;
        let mass: f64 = model.grid.active().map(|n| model.mass(n)).sum();
        let moved = if found_rest { 0.5 * mass * QUIET_SPEED * QUIET_SPEED } else { kinetic };
        // What was lost is a difference of sums over all steps.
        let allowed = moved + rounding_of_energy(look) + f64::EPSILON * look.report.dissipated.abs();
        let invariant = if input { Invariant::Work } else { Invariant::Growth };
        self.record(invariant, gain / allowed, &|| {
            format!(
                "gained {gain:e} J: potential {:e} to {potential:e}, kinetic {:e} to {kinetic:e}, lost {lost:e}, {work:?}, {:?}",
                before.potential, before.kinetic, look.report.outcome
            )
        });
    }
}

/// Difference of u K v and v K u over the sizes of their factors, from K u and K v.
fn asymmetry(ways: &[Vec<Vec3>; 2], bent: &[Vec<Vec3>; 2]) -> f64 {
    let dot = |a: &[Vec3], b: &[Vec3]| a.iter().zip(b).map(|(a, b)| a.dot(b)).sum::<f64>();
    let norm = |v: &[Vec3]| dot(v, v).sqrt();
    let [[u, v], [ku, kv]] = [ways, bent];
    (dot(u, kv) - dot(v, ku)).abs() / (norm(u) * norm(kv) + norm(v) * norm(ku) + f64::MIN_POSITIVE)
}
