//! Runs one method on the scene, from the start until it arrives or its time is over.

use crate::{
    cli::bench::meter::{Meter, Spent},
    compare::{Descent, Rule},
    cost::{self, Coefficients, CostReport, Forces},
    math::{Mat3, Vec3},
    model::{Model, Setup},
    potential::{Potential, Pull, contact::candidates::Candidates},
    state::State,
    world::{Budget, World},
};
use serde::Serialize;
use std::error::Error;

/// Where a method ended, and what it took.
pub(super) struct Solution {
    pub model: Model,
    pub state: State,
    pub forces: Forces,
    pub fixed: Vec<bool>,
    pub hand_force: Vec3,
    /// Only Newton's method knows it.
    pub stiffness: Option<Mat3>,
    pub residual: f64,
    pub cost: CostReport,
    /// Iterations of a descent, ticks of a world.
    pub iterations: u64,
    /// Linear solves; a descent has none.
    pub solves: u64,
    /// Active particles at the start, at the end, and on the mean over iterations.
    pub particles: [f64; 3],
    pub penetration: f64,
    pub dissipated: Option<f64>,
    pub converged: bool,
    pub capped: bool,
    pub spent: Spent,
    pub curve: Vec<Moment>,
}

/// Where a method was on its way.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Moment {
    /// Wall time [s].
    pub wall_s: f64,
    /// Iterations of a descent, ticks of a world.
    pub iterations: u64,
    /// Active particles.
    pub particles: u64,
    /// Largest residual [N].
    pub residual_n: f64,
    /// Cost.
    pub cost: f64,
}

/// Length of a tick [s] and solves in it: those of a live session.
const TICK: f64 = 0.02;
const SOLVES: u32 = 2;
/// Cost at which a descent has arrived: violations of 1e-4 on the mean.
const ARRIVED: f64 = 1e-8;
/// Iterations of a descent between commits of the friction anchors.
const ROUND: u64 = 200;
/// Points of a curve at the most.
const POINTS: usize = 400;

/// Mixed Newton through a world; `remesh` may change the mesh after every tick.
pub(super) fn newton(
    mut world: World,
    cap: f64,
    remesh: &mut dyn FnMut(&mut World, u64),
) -> Result<Solution, Box<dyn Error>> {
    let meter = Meter::start();
    let start = world.report().particles_active as f64;
    let (mut solves, mut ticks, mut sum, mut curve) = (0, 0, 0.0, Curve::default());
    loop {
        let report = world.step(&[], TICK, Budget::solves(SOLVES));
        solves += u64::from(report.solves);
        ticks += 1;
        sum += report.particles_active as f64;
        curve.push(Moment {
            wall_s: meter.wall(),
            iterations: ticks,
            particles: report.particles_active as u64,
            residual_n: report.residual,
            cost: report.cost.total(),
        });
        if report.resting || meter.wall() > cap {
            break;
        }
        remesh(&mut world, ticks);
    }
    let spent = meter.stop();
    let report = world.report().clone();
    let hand = report.hand.ok_or("the scene has no hand")?;
    let (model, state) = (world.model().clone(), world.state().clone());
    let still = Pull::none(&model);
    let none = Candidates::default();
    let potential = Potential { model: &model, state: &state, candidates: &none, pull: &still };
    let forces = cost::forces(&potential, &state.positions);
    Ok(Solution {
        fixed: fixed(world.setup(), &model),
        hand_force: hand.force,
        stiffness: report.resting.then_some(hand.stiffness),
        residual: report.residual,
        cost: report.cost,
        iterations: ticks,
        solves,
        particles: [start, report.particles_active as f64, sum / ticks as f64],
        penetration: report.max_penetration,
        dissipated: Some(report.dissipated),
        converged: report.resting,
        capped: !report.resting,
        spent,
        curve: curve.0,
        model,
        state,
        forces,
    })
}

/// A descent on the paper's cost. `phases` are weights of the terms, one round each in turn; the cost that is reported has
/// those of the paper.
pub(super) fn descent(
    setup: &Setup,
    rule: Rule,
    phases: &[Coefficients],
    cap: f64,
) -> Result<Solution, Box<dyn Error>> {
    let meter = Meter::start();
    let model = Model::new(setup)?;
    let fixed = fixed(setup, &model);
    let state = State::new(&model, setup.positions.clone());
    let mut descent = Descent::new(&model, state, &fixed, rule, phases[0]);
    let mut curve = Curve::default();
    let (mut stuck, mut converged) = (0, false);
    let mut round = 0;
    while meter.wall() < cap && stuck < phases.len() && !converged {
        let mut moved = false;
        for _ in 0..ROUND {
            if meter.wall() > cap || descent.cost().total() <= ARRIVED || !descent.step() {
                break;
            }
            moved = true;
        }
        // A phase alone may arrive where the whole cost is far from its bottom.
        descent.weigh(Coefficients::default());
        converged = descent.cost().total() <= ARRIVED;
        curve.push(Moment {
            wall_s: meter.wall(),
            iterations: descent.iterations,
            particles: model.grid.tally()[0] as u64,
            residual_n: descent.residual(),
            cost: descent.cost().total(),
        });
        stuck = if moved { 0 } else { stuck + 1 };
        round += 1;
        if phases.len() > 1 {
            descent.weigh(phases[round % phases.len()]);
        }
        if !converged {
            descent.commit();
        }
    }
    let spent = meter.stop();
    descent.weigh(Coefficients::default());
    let hand = model.grid.index(setup.hand.ok_or("the scene has no hand")?);
    let particles = model.grid.tally()[0] as f64;
    Ok(Solution {
        hand_force: -descent.residuals()[hand],
        stiffness: None,
        residual: descent.residual(),
        cost: descent.cost(),
        iterations: descent.iterations,
        solves: 0,
        particles: [particles; 3],
        penetration: deepest(&model, &descent.state().positions),
        dissipated: None,
        capped: !converged,
        converged,
        spent,
        curve: curve.0,
        state: descent.state().clone(),
        forces: descent.forces().clone(),
        model: model.clone(),
        fixed,
    })
}

fn fixed(setup: &Setup, model: &Model) -> Vec<bool> {
    let mut fixed = vec![false; model.elements.nodes()];
    setup.pins.iter().chain(&setup.hand).for_each(|site| fixed[model.grid.index(*site)] = true);
    fixed
}

/// Deepest penetration of particles [m].
fn deepest(model: &Model, x: &[Vec3]) -> f64 {
    let depth = |n: usize| model.obstacles.iter().map(move |o| -o.gap(x[n]).value).fold(0.0, f64::max);
    model.grid.active().map(depth).fold(0.0, f64::max)
}

/// Points on the way, thinned out where there are many.
#[derive(Default)]
struct Curve(Vec<Moment>);

impl Curve {
    fn push(&mut self, point: Moment) {
        if self.0.len() >= POINTS {
            let mut keep = false;
            self.0.retain(|_| {
                keep = !keep;
                keep
            });
        }
        self.0.push(point);
    }
}
