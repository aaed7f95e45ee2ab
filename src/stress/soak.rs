//! A long session in accelerated time: the same visit of a hand again and again, with rest between. The rest energy must come back.
//!
//! Hysteresis remembers, and a sheet that snaps from fold to fold magnifies small differences. But laws of play close their loops: under
//! the same visit again and again the sheet comes to walk the same way each time, if every step is solved to its end. (With two solves a
//! step, what they leave is never the same twice, and rest energies scatter by 1e-5 to 4e-3 of themselves; with what a hand does not feel
//! left over, by 1e-5 on some machines.) A sheet has several ways to hang: visits are compared that ended on the same branch. Memory is
//! measured by the caller.

use crate::{
    compare::without_hysteresis,
    math::Vec3,
    scene::Scene,
    world::{Budget, Command, Refused, World},
};
use std::{f64::consts::TAU, sync::Arc};

/// A session.
#[derive(Clone, Debug)]
pub struct Soak {
    /// Built-in scene.
    pub scene: String,
    /// Particles along warp and weft.
    pub particles: usize,
    /// Simulated hours.
    pub hours: f64,
    /// Simulated time from visit to visit [s].
    pub period: f64,
    /// Length of a step [s].
    pub tick: f64,
    /// Whether the fabric has no hysteresis.
    pub elastic: bool,
    /// Farthest that the hand goes, over the sheet's side.
    pub reach: f64,
}

/// The cloth at rest after a visit.
#[derive(Clone, Copy, Debug)]
pub struct Stop {
    /// Number of the visit.
    pub visit: u64,
    /// Simulated time [s].
    pub time: f64,
    /// Whether it rests.
    pub resting: bool,
    /// Stored energy [J].
    pub energy: f64,
    /// Difference from the energy at which this branch was met first, over the scale; none where it was not met before, and before
    /// visit `FIRST`.
    pub change: Option<f64>,
    /// Energy from the lowest particle up, and strain: the scale of the energy [J].
    pub scale: f64,
    /// Steps and solves so far.
    pub steps: u64,
    /// Linear solves so far.
    pub solves: u64,
}

/// Visits after which the loops of hysteresis are closed.
pub const FIRST: u64 = 16;
/// Branches that are remembered.
const MOST_BRANCHES: usize = 1000;
/// Simulated time of a visit's movement [s].
const MOVES: f64 = 12.0;
/// Steps are solved to their end.
const WHOLE: Budget = Budget { residual: 1e-6, ..Budget::solves(100) };
/// Farthest that the hand goes unless told otherwise, over the sheet's side.
pub const REACH: f64 = 0.15;
/// Rests are on the same branch where no particle is farther apart than this part of the sheet's side.
const BRANCH: f64 = 1e-3;
/// Part of a visit in which the hand plays; then it draws the sheet taut, to this part of its side, and lets it hang again: folds and
/// history of the play are wiped out, and rest must be the same.
const PLAY: f64 = 0.4;
const TAUT: f64 = 1.01;

/// Runs a session; `see` gets the cloth after every visit and ends the session by false.
pub fn run(soak: &Soak, see: &mut dyn FnMut(&Stop) -> bool) -> Result<(), Refused> {
    let scene = Scene::built_in(&soak.scene)
        .ok_or_else(|| Refused(format!("scene: got {:?}, which is not built in", soak.scene)))?;
    let scene = Scene { particles: [soak.particles; 2], ..scene };
    let mut setup = scene
        .setup()
        .map_err(|faults| Refused(faults.iter().map(|e| e.to_string()).collect::<Vec<_>>().join("\n")))?;
    let hand = setup.hand.ok_or_else(|| Refused("scene: it has no hand".into()))?;
    if soak.elastic {
        let fabric = without_hysteresis(&setup.fabric).map_err(|unfit| Refused(unfit.to_string()))?;
        setup.fabric = Arc::new(fabric);
    }
    let mut world = World::new(setup)?;
    let mut solves = 0;
    let mut step = |world: &mut World, commands: &[Command]| {
        let report = world.step(commands, soak.tick, WHOLE);
        solves += u64::from(report.solves);
        (report.resting, solves)
    };
    step(&mut world, &[Command::Grab { particle: hand }]);
    let home = world.report().hand.map_or(Vec3::zeros(), |h| h.position);
    let side = world.grid().size[0].min(world.grid().size[1]);
    let others = super::abuse::fixed(&world).into_iter().filter(|site| *site != hand);
    let places: Vec<Vec3> = others.map(|site| world.positions()[world.grid().index(site)]).collect();
    // Away from what else holds the sheet, until it is taut.
    let away = match places.first() {
        Some(pin) => (home - pin).normalize() * (TAUT * side - (home - pin).norm()).max(0.0),
        None => Vec3::zeros(),
    };
    let scale = world.model().weight_on_earth() * side;
    let [moves, visits] = [MOVES, soak.period.max(2.0 * MOVES)].map(|time| (time / soak.tick) as usize);
    let mut visit = 0;
    let mut branches: Vec<(Vec<Vec3>, f64)> = Vec::new();
    while world.report().time < 3600.0 * soak.hours {
        visit += 1;
        // By steps, not by time, so that every visit is the same.
        for tick in 1..=moves {
            let part = tick as f64 / moves as f64;
            let position = home + way(part / PLAY) * (soak.reach * side) + away * pull(part);
            step(&mut world, &[Command::Move { position }]);
        }
        let mut last = step(&mut world, &[Command::Move { position: home }]);
        for _ in moves + 1..visits {
            last = step(&mut world, &[]);
        }
        let report = world.report();
        let mut change = None;
        if visit >= FIRST {
            let here = world.positions();
            let apart =
                |shape: &[Vec3]| shape.iter().zip(here).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
            let known = branches.iter().position(|(shape, _)| apart(shape) <= BRANCH * side);
            if known.is_none() && branches.len() < MOST_BRANCHES {
                branches.push((here.to_vec(), report.energy));
            }
            change = known.map(|k| (report.energy - branches[k].1).abs() / scale);
        }
        let stop = Stop {
            visit,
            change,
            time: report.time,
            resting: last.0,
            energy: report.energy,
            scale,
            steps: report.step,
            solves: last.1,
        };
        if !see(&stop) {
            break;
        }
    }
    Ok(())
}

/// Where the hand is in a part of its play, over its reach: rounds that grow and shrink, shaking.
fn way(part: f64) -> Vec3 {
    let part = part.min(1.0);
    // From nothing, with a gentle start and end.
    let size = (1.0 - part) * (8.0 * part).min(1.0);
    let round = TAU * 5.0 * part;
    let shake = 0.05 * (TAU * 40.0 * part).sin();
    Vec3::new(round.sin(), 0.7 * (round.cos() - 1.0), 0.5 * (2.0 * round).sin() + shake) * size
}

/// How taut the sheet is in a part of the visit: not in the play, then wholly, held so, and slowly slack again.
fn pull(part: f64) -> f64 {
    let smooth = |t: f64| {
        let t = t.clamp(0.0, 1.0);
        t * t * (3.0 - 2.0 * t)
    };
    smooth((part - PLAY) / 0.1) * smooth((1.0 - part) / 0.3)
}
