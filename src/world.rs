//! `World::step`: the only door to physics. Pure and deterministic: no clock, no IO, no log.
//!
//! Same commands, same bits. A step either ends with finite numbers or leaves the state as it was and says so.

mod remesh;

use crate::{
    cost,
    grid::{Edit, Grid, Site},
    hand,
    math::Vec3,
    minimize::Minimizer,
    model::{Model, Setup},
    obstacle::{Motion, slide, with_unit_rotation, witness::Witness},
    phase::{Phase, Watch},
    potential::{Potential, Pull, contact::candidates::Candidates},
    state::{Anchor, State},
};
use std::sync::Arc;

use nalgebra::Isometry3;

pub use crate::{
    adapt::Settings as Adaptive,
    cost::CostReport,
    hand::HandReport,
    minimize::{Budget, Method, Outcome},
    model::Refused,
    potential::contact::ContactReport,
};
pub use remesh::Remeshing;

/// What a client asks of the cloth. Applied in order at the start of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Command {
    /// The hand takes the particle where it is. A particle it held before stays pinned.
    Grab { particle: Site },
    /// The hand goes to a position [m]; several in one step are its path.
    Move { position: Vec3 },
    /// The hand opens: the particle stays pinned, or is free if `let_go`.
    Release { let_go: bool },
    /// Moves a pinned particle (a clamp) to a position [m].
    Drive { particle: Site, position: Vec3 },
    /// Moves an obstacle, by its place in the setup, to a pose within a time [s]; it takes longer where cloth holds it up.
    Push { obstacle: usize, pose: Isometry3<f64>, duration: f64 },
}

/// What a step did and where the cloth is now.
#[derive(Clone, Debug)]
pub struct Report {
    /// Steps since the start.
    pub step: u64,
    /// Simulated time [s].
    pub time: f64,
    /// How the minimization ended.
    pub outcome: Outcome,
    /// True when the cloth is at rest: nothing is solved until the next command.
    pub resting: bool,
    /// Linear solves of this step.
    pub solves: u32,
    /// Largest force out of balance on a free particle [N].
    pub residual: f64,
    /// The paper's cost. It, energy and gaps are those of the last observation: `World::observe_every`.
    pub cost: CostReport,
    /// Stored energy: strain + gravity [J].
    pub energy: f64,
    /// Energy dissipated by the fabric's hysteresis and by friction since the start [J].
    pub dissipated: f64,
    /// The hand, where the scene or a client has one.
    pub hand: Option<HandReport>,
    /// Smallest gap between the surface and an obstacle [m]; infinite where it is above twice the activation distance.
    pub min_gap: f64,
    /// Deepest penetration of a particle into an obstacle [m].
    pub max_penetration: f64,
    /// What obstacles do to the cloth.
    pub contact: ContactReport,
    /// True when the set of touching pairs changed.
    pub contact_changed: bool,
    /// True when an obstacle keeps the hand from where it was told to go.
    pub hand_blocked: bool,
    /// True when the cloth, held fast, keeps a moving obstacle from where it was told to go.
    pub obstacle_blocked: bool,
    /// Particles that carry degrees of freedom.
    pub particles_active: usize,
    /// Particles slaved to others.
    pub particles_ghost: usize,
    /// What became of the mesh since the start.
    pub remeshing: Remeshing,
}

/// Simulated time between observations that is short enough for viewers [s].
pub const OBSERVATION: f64 = 1.0 / 60.0;

/// A live piece of cloth.
pub struct World {
    setup: Setup,
    model: Arc<Model>,
    method: Method,
    mesh: remesh::Mesh,
    state: State,
    minimizer: Minimizer,
    candidates: Candidates,
    pull: Pull,
    /// Positions being minimized.
    positions: Vec<Vec3>,
    /// Simulated time between observations for the report, and when the last one was [s].
    observation: f64,
    observed: f64,
    /// Particle of the hand, and whether a client holds it.
    hand: Option<usize>,
    held: bool,
    /// Where the hand still has to go [m].
    target: Option<Vec3>,
    /// How often the simulated step is halved: more after each that stalled, less after each that went well. Shorter
    /// steps are easier, and a cloth in slow motion is better than one that is stuck.
    caution: i32,
    /// Gradient that the next step of the given length [s] begins with, where it is known [N].
    ahead: Vec<Vec3>,
    ahead_of: Option<f64>,
    /// The anchors before the last commit, and memory for the next.
    anchors: Vec<Anchor>,
    /// Statics so far of the cloth that is coming to rest.
    settling: Settling,
    report: Report,
    scratch: Scratch,
}

/// Memory of a step, so that a tick allocates nothing.
#[derive(Default)]
struct Scratch {
    path: Vec<Vec3>,
    stops: Vec<Vec3>,
    drives: Vec<(usize, Vec3)>,
    targets: Vec<(usize, Vec3)>,
    before: Before,
}

/// What a step that must be taken back goes back to.
#[derive(Default)]
struct Before {
    poses: Vec<Isometry3<f64>>,
    motions: Vec<Option<Motion>>,
}

/// Everything a world needs to go on from where it was; steps after `restore` depend on it and the commands alone.
#[derive(Clone)]
pub struct Snapshot {
    model: Arc<Model>,
    mesh: remesh::Mesh,
    state: State,
    hand: Option<usize>,
    held: bool,
    target: Option<Vec3>,
    fixed: Vec<bool>,
    settling: Settling,
    candidates: Candidates,
    report: Report,
}

/// How far the cloth is from rest.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Settling {
    /// It moves; so much quiet time [s] until rest is tried (again).
    Moving { patience: f64 },
    /// It is at rest.
    Resting,
}

/// The residual, relative to the weight of a mean particle, at which a live step has converged.
const LIVE_TOLERANCE: f64 = 1e-3;
/// The same for rest.
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
/// Solves of one attempt to come to rest.
const REST_SOLVES: u32 = 12;
/// Farthest coordinate of a commanded position [m].
const FARTHEST: f64 = 1e3;
/// Longest motion of an obstacle [s].
const LONGEST: f64 = 3600.0;
/// Distance from obstacles that the hand keeps, over the activation distance: there the cloth it holds is pressed hard.
const CLEARANCE: f64 = 0.02;
/// Way [m] below which the hand counts as not getting on.
const NO_WAY: f64 = 1e-6;
/// Farthest the hand goes per solve of the budget [m]; what is left of its path comes in the next steps. One linear solve
/// cannot follow a farther move on sheets like ours; 5 mm cost some 2 % of force error.
const TRAVEL: f64 = 5e-3;
/// Such ways in one step at the most, however large the budget.
const MOST_TRAVELS: u32 = 4;
/// Halvings of a step at the most.
const MOST_CAUTION: i32 = 6;
/// Sub-steps of one step at the most, when the hand's path turns back within it.
const TURNS: usize = 3;
/// Validity of the force model around the continued path, relative to the shorter side of the sheet.
const RADIUS: f64 = 0.01;
/// Rate [1/s²] at which what leaves an equilibrium may speed up, over its way: nothing turns a sheet that hangs from one pin about the
/// vertical, nor back, and rounding makes a slow instability of that.
const REST_DRIFT: f64 = 1e-2;
/// Horizon of the force model at rest [s].
const REST_HORIZON: f64 = 0.01;

impl World {
    /// A world at its start; refuses sizes, positions and coefficients that make no cloth.
    pub fn new(setup: Setup) -> Result<World, Refused> {
        World::with_method(setup, Method::default())
    }

    /// The same with a chosen linear solver.
    pub fn with_method(setup: Setup, method: Method) -> Result<World, Refused> {
        World::with_mesh(setup, method, &[])
    }

    /// The same on the mesh that edits make of the uniform one; refuses those that do not fit, and pins between its particles.
    pub fn with_mesh(setup: Setup, method: Method, edits: &[Edit]) -> Result<World, Refused> {
        let mut model = Model::new(&setup)?;
        model.remesh(edits).map_err(|unfit| Refused(format!("mesh: {unfit}")))?;
        let held = setup.pins.iter().chain(&setup.hand);
        if let Some(site) = held.copied().find(|site| !model.grid.is_active(model.grid.index(*site))) {
            return Err(Refused(format!("mesh: particle {site:?} is held, and no particle of the mesh")));
        }
        let model = Arc::new(model);
        let state = State::new(&model, setup.positions.clone());
        let mut minimizer = Minimizer::new(&model, method);
        for &site in &setup.pins {
            minimizer.system.fixed[model.grid.index(site)] = true;
        }
        let hand = setup.hand.map(|site| model.grid.index(site));
        if let Some(n) = hand {
            minimizer.system.fixed[n] = true;
            minimizer.system.hand = Some(n as u32);
        }
        let report = Report {
            step: 0,
            time: 0.0,
            outcome: Outcome::Budget,
            resting: false,
            solves: 0,
            residual: 0.0,
            cost: CostReport::default(),
            energy: 0.0,
            dissipated: 0.0,
            hand: None,
            min_gap: f64::INFINITY,
            max_penetration: 0.0,
            contact: ContactReport::default(),
            contact_changed: false,
            hand_blocked: false,
            obstacle_blocked: false,
            particles_active: model.grid.tally()[0],
            particles_ghost: model.grid.tally()[1],
            remeshing: Remeshing { by_level: remesh::by_level(&model.grid), ..Remeshing::default() },
        };
        let mut world = World {
            candidates: Candidates::new(&model),
            pull: Pull::none(&model),
            positions: state.positions.clone(),
            settling: Settling::Moving { patience: PATIENCE },
            held: false,
            target: None,
            observation: 0.0,
            observed: 0.0,
            caution: 0,
            ahead: vec![Vec3::zeros(); state.positions.len()],
            ahead_of: None,
            anchors: Vec::new(),
            setup,
            model,
            method,
            mesh: remesh::Mesh::default(),
            state,
            minimizer,
            hand,
            report,
            scratch: Scratch::default(),
        };
        world.candidates.update(&world.model, &world.state.poses, &world.state.positions, 0.0);
        if meets_obstacles(&world.model, &world.state) {
            return Err(Refused("positions: the sheet starts in an obstacle".into()));
        }
        let potential = Potential {
            model: &world.model,
            state: &world.state,
            candidates: &world.candidates,
            pull: &world.pull,
        };
        world.minimizer.measure(&potential, &world.positions, Watch::default());
        world.report.residual = world.minimizer.residual();
        world.observe();
        Ok(world)
    }

    /// Makes the iterative solver build everything anew at every solve, or keep what lasts, on the present mesh: for comparison.
    pub fn solve_afresh(&mut self, afresh: bool) {
        self.minimizer.solve_afresh(afresh);
    }

    /// Whether a command would be taken now; says why not.
    pub fn check(&self, command: &Command) -> Result<(), Refused> {
        let refuse = |text: String| Err(Refused(text));
        let grid = &self.model.grid;
        match *command {
            Command::Grab { particle } | Command::Drive { particle, .. } if !grid.contains(particle) => {
                refuse(format!("particle: got {particle:?}, allowed: below {:?}", grid.counts))
            }
            Command::Grab { particle } | Command::Drive { particle, .. }
                if grid.is_cut_away(grid.index(particle)) =>
            {
                refuse(format!("particle: got {particle:?}, which is cut away"))
            }
            Command::Move { position } | Command::Drive { position, .. }
                if !position.iter().all(|v| v.abs() <= FARTHEST) =>
            {
                refuse(format!(
                    "position_m: got {:?}, allowed: -{FARTHEST} to {FARTHEST}",
                    position.as_slice()
                ))
            }
            Command::Move { .. } if !self.held => {
                refuse("move: the hand holds no particle; grab one first".into())
            }
            Command::Push { obstacle, .. } if obstacle >= self.model.obstacles.len() => {
                refuse(format!("obstacle: got {obstacle}, allowed: below {}", self.model.obstacles.len()))
            }
            Command::Push { pose, duration, .. }
                if !(pose.translation.vector.iter().all(|v| v.abs() <= FARTHEST)
                    && (pose.rotation.coords.norm() - 1.0).abs() < 1e-6
                    && (0.0..=LONGEST).contains(&duration)) =>
            {
                refuse(format!(
                    "pose, duration: got {pose:?} in {duration} s, allowed: up to {FARTHEST} m away, a unit quaternion, 0 to {LONGEST} s"
                ))
            }
            Command::Drive { particle, .. } if !self.minimizer.system.fixed[grid.index(particle)] => {
                refuse(format!("drive: particle {particle:?} is not pinned"))
            }
            _ => Ok(()),
        }
    }

    /// Advances the cloth by `dt` [s]; commands that `check` refuses are passed over.
    pub fn step(&mut self, commands: &[Command], dt: f64, budget: Budget) -> &Report {
        let mut scratch = std::mem::take(&mut self.scratch);
        self.step_with(commands, dt, budget, &mut scratch);
        self.scratch = scratch;
        &self.report
    }

    fn step_with(&mut self, commands: &[Command], dt: f64, budget: Budget, scratch: &mut Scratch) {
        let Scratch { path, stops, drives, targets, before } = scratch;
        path.clear();
        drives.clear();
        let mut woken = false;
        for command in commands {
            if self.check(command).is_err() {
                continue;
            }
            match *command {
                Command::Grab { particle } => woken |= self.grab(particle),
                Command::Move { position } => path.push(position),
                Command::Release { let_go } => woken |= self.release(let_go),
                Command::Drive { particle, position } => {
                    drives.push((self.model.grid.index(particle), position))
                }
                Command::Push { obstacle, pose, duration } => {
                    woken = true;
                    let (from, pose) = (self.state.poses[obstacle], with_unit_rotation(&pose));
                    self.state.motions[obstacle] =
                        (from != pose).then_some(Motion { from, to: pose, duration, done: 0.0 });
                }
            }
        }
        self.report.step += 1;
        self.report.solves = 0;
        self.report.contact_changed = false;
        self.report.obstacle_blocked = false;
        self.hand_stops(path, budget, stops);
        let still = stops.is_empty()
            && self.state.motions.iter().all(Option::is_none)
            && drives.iter().all(|(n, p)| self.state.positions[*n] == *p);
        if self.settling == Settling::Resting && still && !woken {
            self.report.time += dt;
            return;
        }
        if self.settling == Settling::Resting || !still || woken {
            self.settling = Settling::Moving { patience: PATIENCE };
            self.stir_mesh();
        }
        let share = dt / stops.len().max(1) as f64;
        for k in 0..stops.len().max(1) {
            targets.clear();
            if k == 0 {
                targets.extend_from_slice(drives);
            }
            targets.extend(self.hand.zip(stops.get(k).copied()));
            self.advance(targets, share, budget, before);
        }
        self.see_to_hand(stops.last().copied());
        if still && self.report.outcome != Outcome::NotFinite {
            self.try_rest(dt);
            budget.watch.ended(Phase::Rest);
        }
        self.report.residual = self.minimizer.residual();
        self.report.resting = self.settling == Settling::Resting;
        if self.report.resting || self.report.time - self.observed >= self.observation {
            self.observe();
        }
        budget.watch.ended(Phase::Observe);
    }

    /// Where the hand goes in this step: the turns of its path and its end, no farther than the budget can follow. What is left
    /// stays the hand's target for the next steps.
    fn hand_stops(&mut self, path: &[Vec3], budget: Budget, stops: &mut Vec<Vec3>) {
        stops.clear();
        let Some(h) = self.hand else { return };
        self.target = path.last().copied().or(self.target);
        let from = self.state.positions[h];
        if path.is_empty() {
            stops.extend(self.target);
        } else {
            turns(from, path, stops);
        }
        let mut left = TRAVEL * f64::from(budget.solves.clamp(1, MOST_TRAVELS));
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
    fn see_to_hand(&mut self, stop: Option<Vec3>) {
        let (Some(h), Some(stop)) = (self.hand, stop) else { return };
        let missing = stop - self.state.positions[h];
        if missing.norm() <= NO_WAY {
            return;
        }
        self.report.hand_blocked = true;
        let velocity = self.state.velocities[h];
        self.target = (velocity.norm() > 0.0).then_some(self.target.unwrap_or(stop));
    }

    fn grab(&mut self, particle: Site) -> bool {
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

    fn release(&mut self, let_go: bool) -> bool {
        let was_held = std::mem::take(&mut self.held);
        self.target = None;
        let Some(n) = self.hand.filter(|_| let_go && was_held) else { return false };
        self.minimizer.system.fixed[n] = false;
        self.minimizer.system.hand = None;
        self.hand = None;
        true
    }

    /// Share of a step that is gone at once: less after trouble.
    fn prudence(&self) -> f64 {
        0.5_f64.powi(self.caution)
    }

    /// One dynamic step of `dt`, or less after trouble, with fixed particles going to their targets; rolled back if a number is not finite.
    fn advance(&mut self, targets: &[(usize, Vec3)], dt: f64, budget: Budget, before: &mut Before) {
        let dt = dt * self.prudence();
        let watch = budget.watch;
        self.report.time += dt;
        before.poses.clone_from(&self.state.poses);
        before.motions.clone_from(&self.state.motions);
        self.positions.copy_from_slice(&self.state.positions);
        let travel = self.expected_travel(targets, dt);
        self.push_obstacles(dt, budget);
        watch.ended(Phase::Setup);
        self.candidates.update(&self.model, &self.state.poses, &self.positions, travel);
        watch.ended(Phase::Contact);
        self.pull.set_inertia(&self.model, &self.state, dt);
        self.minimizer.system.shift.fill(Vec3::zeros());
        for &(n, target) in targets {
            self.minimizer.system.shift[n] = target - self.positions[n];
        }
        let potential = Potential {
            model: &self.model,
            state: &self.state,
            candidates: &self.candidates,
            pull: &self.pull,
        };
        let tolerance = LIVE_TOLERANCE * self.mean_weight();
        self.minimizer.solves = 0;
        // Where obstacles stand nothing but pull and anchors has changed since the last step foresaw this gradient.
        let foreseen = self.ahead_of == Some(dt) && before.poses == self.state.poses;
        if foreseen {
            self.minimizer.gradient.copy_from_slice(&self.ahead);
            potential.contact().change_anchors(&self.anchors, &self.positions, &mut self.minimizer.gradient);
        } else {
            watch.ended(Phase::Setup);
            self.minimizer.measure(&potential, &self.positions, watch);
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
        let positions = &self.positions;
        for (n, v) in self.state.velocities.iter_mut().enumerate() {
            *v = (positions[n] - self.state.positions[n]) / dt;
        }
        watch.ended(Phase::Advance);
        self.commit();
        watch.ended(Phase::Commit);
        self.fade_loads(dt);
        self.feel(dt);
        watch.ended(Phase::Feel);
    }

    /// How far a particle may want to go in a step [m]: as in the last one, with gravity and the hand; and a bit.
    fn expected_travel(&self, targets: &[(usize, Vec3)], dt: f64) -> f64 {
        let speed = self.state.velocities.iter().map(|v| v.norm_squared()).fold(0.0, f64::max).sqrt();
        let shift = targets.iter().map(|(n, p)| (p - self.positions[*n]).norm()).fold(0.0, f64::max);
        1.5 * (speed * dt + self.model.gravity * dt * dt)
            + 2.0 * shift
            + self.model.contact.barrier.activation
    }

    /// Moves the obstacles on, and the cloth in their way with them: as far as cloth that is held allows.
    fn push_obstacles(&mut self, dt: f64, budget: Budget) {
        if self.state.motions.iter().all(Option::is_none) {
            return;
        }
        let travel = TRAVEL * f64::from(budget.solves.clamp(1, MOST_TRAVELS));
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
            if let Some(carried) =
                candidates.carry(model, &self.positions, &poses, &self.minimizer.system.fixed)
            {
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
    fn roll_back(&mut self) {
        self.state.velocities.fill(Vec3::zeros());
        self.positions.copy_from_slice(&self.state.positions);
        self.candidates.update(&self.model, &self.state.poses, &self.positions, 0.0);
        self.minimizer.forget();
        self.pull = Pull::none(&self.model);
        let potential = Potential {
            model: &self.model,
            state: &self.state,
            candidates: &self.candidates,
            pull: &self.pull,
        };
        self.minimizer.measure(&potential, &self.positions, Watch::default());
    }

    /// Makes the minimized positions the state: history and anchors advance.
    fn commit(&mut self) {
        let potential = Potential {
            model: &self.model,
            state: &self.state,
            candidates: &self.candidates,
            pull: &self.pull,
        };
        let (slid, contact) = potential.contact().commit(&self.positions, &mut self.anchors);
        self.report.contact_changed |=
            !self.anchors.iter().map(|a| a.pair).eq(self.state.anchors.iter().map(|a| a.pair));
        self.report.contact = contact;
        std::mem::swap(&mut self.state.anchors, &mut self.anchors);
        let lost = self.state.history.advance(&self.model, &self.minimizer.measures);
        self.report.dissipated += lost + slid;
        self.state.positions.copy_from_slice(&self.positions);
    }

    /// Force model of a moving cloth. The horizon is the step just taken, so its factor serves the prediction of the next one.
    fn feel(&mut self, dt: f64) {
        let Some(n) = self.hand else {
            self.report.hand = None;
            return;
        };
        let (force, correction) = hand::corrected(&self.minimizer, &self.minimizer.gradient);
        let stiffness = hand::stiffness(&self.minimizer);
        // The cloth's gradient if the next step ended where this one did: the pull of inertia moves on to x + dt v.
        let velocity = self.state.velocities[n];
        self.ahead.copy_from_slice(&self.minimizer.gradient);
        for k in self.model.grid.active() {
            let x = self.positions[k];
            let now = (x - self.pull.targets[k]) * self.pull.weights[k];
            let (weight, target) = Pull::of_inertia(&self.model, &self.state, dt, k);
            self.ahead[k] += (x - target) * weight - now;
        }
        self.ahead_of = Some(dt);
        let (future, _) = hand::corrected(&self.minimizer, &self.ahead);
        let rate = -(future + stiffness * velocity * dt - force) / dt;
        self.report.hand = Some(HandReport {
            particle: self.model.grid.site(n),
            held: self.held,
            position: self.positions[n],
            velocity,
            force: -force,
            force_error: correction.norm(),
            rate,
            stiffness,
            radius: RADIUS * self.model.grid.size[0].min(self.model.grid.size[1]),
            horizon: dt,
        });
    }

    /// Tries to find the static equilibrium when the cloth is quiet, after a step of `dt` [s]. If it is near, the cloth rests there.
    fn try_rest(&mut self, dt: f64) {
        let speed = self.state.velocities.iter().map(|v| v.norm()).fold(0.0, f64::max);
        let Settling::Moving { patience } = self.settling else { return };
        if speed > QUIET_SPEED {
            return;
        }
        // Rounded to whole steps.
        if patience > 0.5 * dt {
            self.settling = Settling::Moving { patience: patience - dt };
            return;
        }
        if self.mesh_works(dt) {
            return;
        }
        self.settling = Settling::Moving { patience: PATIENCE };
        self.ahead_of = None;
        let before = self.state.clone();
        let (dissipated, changed) = (self.report.dissipated, self.report.contact_changed);
        if self.find_rest() {
            self.settling = Settling::Resting;
            self.report.outcome = Outcome::Converged;
        } else {
            self.state = before;
            self.positions.copy_from_slice(&self.state.positions);
            (self.report.dissipated, self.report.contact_changed) = (dissipated, changed);
            let potential = Potential {
                model: &self.model,
                state: &self.state,
                candidates: &self.candidates,
                pull: &self.pull,
            };
            self.minimizer.measure(&potential, &self.positions, Watch::default());
        }
    }

    /// Static equilibrium from the present state; false when it is far or does not converge.
    fn find_rest(&mut self) -> bool {
        let tolerance = REST_TOLERANCE * self.mean_weight();
        let still = Pull::none(&self.model);
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
            let moved = start.iter().zip(&self.positions).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
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
                return self.feel_at_rest();
            }
            if solves >= REST_SOLVES {
                return false;
            }
        }
        false
    }

    /// Force model at rest, with the static stiffness; false where the equilibrium is not stable or not quite reached.
    fn feel_at_rest(&mut self) -> bool {
        self.minimizer.solves = 0;
        self.minimizer.system.shift.fill(Vec3::zeros());
        let mut pull = Pull::none(&self.model);
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
        let may_creep = self.minimizer.residual() > REST_TOLERANCE * self.mean_weight();
        if !stable || may_creep && self.minimizer.longest_step() > REST_STEP {
            return false;
        }
        self.report.solves += self.minimizer.solves;
        self.pull = Pull::none(&self.model);
        let (force, correction) = hand::corrected(&self.minimizer, &self.minimizer.gradient);
        let stiffness = hand::stiffness(&self.minimizer);
        self.report.hand = self.hand.map(|n| HandReport {
            particle: self.model.grid.site(n),
            held: self.held,
            position: self.positions[n],
            velocity: Vec3::zeros(),
            force: -force,
            force_error: correction.norm(),
            rate: Vec3::zeros(),
            stiffness,
            radius: RADIUS * self.model.grid.size[0].min(self.model.grid.size[1]),
            horizon: REST_HORIZON,
        });
        true
    }

    /// Measures the state for the report.
    fn observe(&mut self) {
        let potential = Potential {
            model: &self.model,
            state: &self.state,
            candidates: &self.candidates,
            pull: &self.pull,
        };
        let Minimizer { gradient, system, measures, .. } = &self.minimizer;
        (self.report.cost, self.report.energy) =
            cost::of_state(&potential, &self.state.positions, gradient, &system.fixed, measures);
        let gap = potential.contact().min_gap(&self.state.positions);
        (self.report.min_gap, self.report.max_penetration) = (gap, (-gap).max(0.0));
        self.observed = self.report.time;
    }

    /// Measures cost, energy and gaps for the report only as often as this [simulated s], and at rest; at first in every step.
    pub fn observe_every(&mut self, seconds: f64) {
        self.observation = seconds;
    }

    /// Weight of a mean particle [N]: the scale of residuals.
    fn mean_weight(&self) -> f64 {
        self.model.weight_on_earth() / self.model.present as f64
    }

    /// The present, to come back to.
    pub fn snapshot(&self) -> Snapshot {
        Snapshot {
            model: self.model.clone(),
            mesh: self.mesh.clone(),
            state: self.state.clone(),
            hand: self.hand,
            held: self.held,
            target: self.target,
            fixed: self.minimizer.system.fixed.clone(),
            settling: self.settling,
            candidates: self.candidates.clone(),
            report: self.report.clone(),
        }
    }

    /// Goes back to a snapshot of this world.
    pub fn restore(&mut self, snapshot: &Snapshot) {
        let Snapshot { model, mesh, state, hand, held, target, fixed, settling, candidates, report } =
            snapshot.clone();
        self.restore_mesh(&model);
        self.mesh = mesh;
        self.candidates = candidates;
        self.minimizer.system.hand = hand.map(|n| n as u32);
        self.minimizer.system.fixed = fixed;
        self.minimizer.forget();
        self.ahead_of = None;
        self.caution = 0;
        self.target = target;
        (self.state, self.hand, self.held, self.settling, self.report) =
            (state, hand, held, settling, report);
        self.positions.copy_from_slice(&self.state.positions);
        self.observed = self.report.time;
    }

    /// Changes gravity [m/s²] from the next step on and wakes the cloth: as if what holds it were accelerated up or down.
    pub fn set_gravity(&mut self, gravity: f64) {
        Arc::make_mut(&mut self.model).gravity = gravity;
        self.settling = Settling::Moving { patience: PATIENCE };
    }

    /// The newest report.
    pub fn report(&self) -> &Report {
        &self.report
    }
    /// The lattice and its mesh.
    pub fn grid(&self) -> &Grid {
        &self.model.grid
    }
    /// The constants.
    pub fn model(&self) -> &Model {
        &self.model
    }
    /// Lets live steps be solved by multigrid, or not; factors stay those the world was made with.
    pub fn set_method(&mut self, method: Method) {
        self.method = method;
        self.minimizer.iterate(&self.model, method == Method::Multigrid);
    }

    /// Who solves the linear systems of live steps.
    pub fn method(&self) -> Method {
        self.method
    }
    /// What the world was made from.
    pub fn setup(&self) -> &Setup {
        &self.setup
    }
    /// The state.
    pub fn state(&self) -> &State {
        &self.state
    }
    /// Positions of all particles [m], ghosts included.
    pub fn positions(&self) -> &[Vec3] {
        &self.state.positions[..self.model.grid.particles()]
    }
    /// Force of the cloth on a pinned or held particle [N]; `None` for a free one.
    pub fn reaction(&self, particle: Site) -> Option<Vec3> {
        let n = self.model.grid.index(particle);
        self.minimizer.system.fixed[n].then(|| -self.minimizer.gradient[n])
    }
    /// Checksum over the state's bits: equal for equal command histories.
    pub fn checksum(&self) -> u64 {
        self.state.checksum()
    }
}

/// Whether the surface of a state meets an obstacle, by an independent check.
fn meets_obstacles(model: &Model, state: &State) -> bool {
    let particles_only = model.contact.particles_only;
    model.obstacles.iter().zip(&state.poses).any(|(obstacle, pose)| {
        let (x, triangles) = (&state.positions, &model.surface.triangles);
        let mut particles = (0..model.surface.areas.len()).filter(|&n| model.surface.areas[n] > 0.0);
        if particles_only {
            particles.any(|n| obstacle.distance_at(pose, x[n]) <= 0.0)
        } else {
            Witness::new(obstacle).distance(pose, x, triangles, 1e-3) <= 0.0
        }
    })
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
