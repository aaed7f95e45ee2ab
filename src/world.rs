//! `World::step`: the only door to physics. Pure and deterministic: no clock, no IO, no log.
//!
//! Same commands, same bits. A step either ends with finite numbers or leaves the state as it was and says so.

mod advance;
mod fork;
mod hand;
mod remesh;
mod rest;
mod snapshot;

use crate::{
    cores, cost,
    grid::{Edit, Grid, Site},
    math::Vec3,
    minimize::Minimizer,
    model::{Model, Setup},
    obstacle::{Motion, with_unit_rotation, witness::Witness},
    phase::Phase,
    potential::{Potential, Pull, contact::candidates::Candidates},
    state::{Anchor, State},
};
use nalgebra::Isometry3;
use rest::Settling;
use std::sync::Arc;

pub use crate::{
    adapt::Settings as Adaptive,
    cost::CostReport,
    hand::HandReport,
    minimize::{Budget, Method, Outcome},
    model::Refused,
    potential::contact::ContactReport,
};
pub use fork::{Declined, Fork};
pub use remesh::Remeshing;
pub use rest::QUIET_SPEED;
pub use snapshot::Snapshot;

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
    setup: Arc<Setup>,
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
    /// The gradient that the last step began with [N].
    begun: Vec<Vec3>,
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

/// Farthest coordinate of a commanded position [m].
const FARTHEST: f64 = 1e3;
/// Longest motion of an obstacle [s].
const LONGEST: f64 = 3600.0;

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
            settling: Settling::STIRRED,
            held: false,
            target: None,
            observation: 0.0,
            observed: 0.0,
            caution: 0,
            ahead: vec![Vec3::zeros(); state.positions.len()],
            begun: vec![Vec3::zeros(); state.positions.len()],
            ahead_of: None,
            anchors: Vec::new(),
            setup: Arc::new(setup),
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
        world.measure();
        world.report.residual = world.minimizer.residual();
        world.observe();
        Ok(world)
    }

    /// Makes the iterative solver build everything anew at every solve, or keep what lasts, on the present mesh: for comparison.
    pub fn solve_afresh(&mut self, afresh: bool) {
        self.minimizer.solve_afresh(afresh);
    }

    /// Forgets the gradient that the last step foresaw, so that the next one measures it: for comparison.
    pub fn forget_foreseen(&mut self) {
        self.ahead_of = None;
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
        let _at_work = cores::at_work();
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
            self.settling = Settling::STIRRED;
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
            self.try_rest(dt, budget);
            budget.watch.ended(Phase::Rest);
        }
        self.report.residual = self.minimizer.residual();
        self.report.resting = self.settling == Settling::Resting;
        if self.report.resting || self.report.time - self.observed >= self.observation {
            self.observe();
        }
        budget.watch.ended(Phase::Observe);
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

    /// Changes gravity [m/s²] from the next step on and wakes the cloth: as if what holds it were accelerated up or down.
    pub fn set_gravity(&mut self, gravity: f64) {
        Arc::make_mut(&mut self.model).gravity = gravity;
        (self.ahead_of, self.settling) = (None, Settling::STIRRED);
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
    /// Lets live steps be solved by conjugate gradients, to a method's accuracy, or not; factors stay those the world was made with.
    pub fn set_method(&mut self, method: Method) {
        self.method = method;
        self.minimizer.iterate(&self.model, method);
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
