//! `World::step`: the only door to physics. Pure and deterministic: no clock, no IO, no log.

use crate::{
    grid::{Grid, Site},
    math::{Mat3, Vec3},
    model::Setup,
};

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
}

/// How much a step may cost.
#[derive(Clone, Copy)]
pub struct Budget<'a> {
    /// Linear solves at the most.
    pub solves: u32,
    /// Asked between solves; `true` ends the step. The caller owns the clock.
    pub stop: Option<&'a dyn Fn() -> bool>,
}

/// How the minimization of a step ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The residual is below the tolerance.
    Converged,
    /// Out of budget; the residual goes into the next step.
    Budget,
    /// No step lowers the residual any more.
    Stalled,
    /// A number was not finite: the step was rolled back.
    NotFinite,
}

/// The paper's cost, term by term, dimensionless and averaged over the area.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CostReport {
    /// Violation of Newton's law.
    pub newton: f64,
    /// Violation of the tensile envelope.
    pub stretch: f64,
    /// Violation of the bending envelope.
    pub bend: f64,
    /// Violation of the shear envelope.
    pub shear: f64,
}

impl CostReport {
    /// Sum of the terms.
    pub fn total(&self) -> f64 {
        self.newton + self.stretch + self.bend + self.shear
    }
}

/// What the hand feels: F(p, t) = force + rate·τ − stiffness (p − position − velocity τ), τ from 0 to the horizon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandReport {
    /// The held particle.
    pub particle: Site,
    /// True while a client's hand holds it; false while it is merely pinned.
    pub held: bool,
    /// Position [m].
    pub position: Vec3,
    /// Velocity [m/s].
    pub velocity: Vec3,
    /// Force of the cloth on the hand [N].
    pub force: Vec3,
    /// Bound on the error of the force from incomplete minimization [N].
    pub force_error: f64,
    /// Rate of the force along the continued path [N/s].
    pub rate: Vec3,
    /// Condensed stiffness within the horizon [N/m], symmetric; not yet clamped to a device.
    pub stiffness: Mat3,
    /// Validity: distance from the continued path [m].
    pub radius: f64,
    /// Validity: time from the state [s].
    pub horizon: f64,
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
    /// The paper's cost.
    pub cost: CostReport,
    /// Stored energy: strain + gravity [J].
    pub energy: f64,
    /// Energy dissipated by the fabric's hysteresis since the start [J].
    pub dissipated: f64,
    /// The hand, where the scene or a client has one.
    pub hand: Option<HandReport>,
    /// Smallest gap between a particle and an obstacle [m]; infinite without obstacles.
    pub min_gap: f64,
    /// Deepest penetration of the surface (particles, edges against box edges) [m]; 0 when none.
    pub max_penetration: f64,
    /// True when the set of touching particles changed.
    pub contact_changed: bool,
    /// Particles that carry degrees of freedom.
    pub particles_active: usize,
    /// Particles slaved to others.
    pub particles_ghost: usize,
}

/// Why a setup or command was refused.
#[derive(Debug, thiserror::Error, PartialEq)]
#[error("{0}")]
pub struct Refused(pub String);

/// A live piece of cloth.
pub struct World {
    grid: Grid,
    setup: Setup,
    positions: Vec<Vec3>,
    hand: Option<Site>,
    held: bool,
    home: Vec3,
    report: Report,
}

impl World {
    /// A world at its start; refuses sizes, positions and coefficients that make no cloth.
    pub fn new(setup: Setup) -> Result<World, Refused> {
        let grid = Grid::uniform(setup.particles, setup.size);
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
            contact_changed: false,
            particles_active: grid.particles(),
            particles_ghost: 0,
        };
        let hand = setup.hand;
        let home = hand.map_or(Vec3::zeros(), |s| setup.positions[grid.index(s)]);
        Ok(World { positions: setup.positions.clone(), grid, setup, hand, held: false, home, report })
    }

    /// Whether a command would be taken now; says why not.
    pub fn check(&self, _command: &Command) -> Result<(), Refused> {
        Ok(())
    }

    /// Advances the cloth by `dt` [s].
    pub fn step(&mut self, commands: &[Command], dt: f64, _budget: Budget) -> &Report {
        // SKELETON: a lone spring stands in for the cloth until the mechanics lands.
        for c in commands {
            match *c {
                Command::Grab { particle } => (self.hand, self.held) = (Some(particle), true),
                Command::Move { position } => {
                    if let Some(h) = self.hand {
                        self.positions[self.grid.index(h)] = position
                    }
                }
                Command::Release { .. } => self.held = false,
                Command::Drive { .. } => {}
            }
        }
        self.report.step += 1;
        self.report.time += dt;
        self.report.hand = self.hand.map(|particle| {
            let position = self.positions[self.grid.index(particle)];
            HandReport {
                particle,
                held: self.held,
                position,
                velocity: Vec3::zeros(),
                force: (self.home - position) * 10.0 - Vec3::z() * self.setup.gravity * 0.03,
                force_error: 0.0,
                rate: Vec3::zeros(),
                stiffness: Mat3::identity() * 10.0,
                radius: 0.01,
                horizon: dt,
            }
        });
        &self.report
    }

    /// The newest report.
    pub fn report(&self) -> &Report {
        &self.report
    }
    /// The lattice and its mesh.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }
    /// What the world was made from.
    pub fn setup(&self) -> &Setup {
        &self.setup
    }
    /// Positions of all particles [m], ghosts included.
    pub fn positions(&self) -> &[Vec3] {
        &self.positions
    }
    /// Force of the cloth on a pinned or held particle [N]; `None` for a free one.
    pub fn reaction(&self, _particle: Site) -> Option<Vec3> {
        None
    }
    /// Checksum over the state's bits: equal for equal command histories.
    pub fn checksum(&self) -> u64 {
        0
    }
}
