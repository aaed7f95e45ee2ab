//! `kesi bench skip`: what work that is skipped saves, and that skipping it leaves the result within a stated tolerance.
//!
//! Each kind runs twice from the same state, once skipping and once made to work: a cloth at rest is kept awake by a hand that
//! moves by picometres, a foreseen gradient is forgotten, an obstacle stands where nothing meets it, a bent sheet keeps its flat
//! regions dense, coarse levels are built anew at every solve, a term gets a weight too small to count, every state is encoded or recorded.

#[cfg(feature = "server")]
mod service;

use super::Output;
use crate::{
    cli::sorted::median,
    fabric::Fabric,
    math::Vec3,
    model::Setup,
    obstacle::{Obstacle, Shape},
    scene::Scene,
    world::{Adaptive, Budget, Command, Method, World},
};
use nalgebra::Translation3;
use serde::Serialize;
use std::{error::Error, sync::Arc, time::Instant};

/// Work that is skipped.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Particles along warp and weft.
    #[arg(long, default_value_t = 33)]
    particles: usize,
    /// Timed ticks.
    #[arg(long, default_value_t = 60)]
    ticks: usize,
    /// 17 × 17 particles, 20 ticks: some seconds.
    #[arg(long)]
    quick: bool,
    #[command(flatten)]
    output: Output,
}

#[derive(Serialize)]
struct Row {
    kind: &'static str,
    /// Median time of a tick with the work skipped, and with the work done.
    skipping_ms: f64,
    working_ms: f64,
    saved_fraction: f64,
    /// Difference of the hand's force, relative, the largest of all ticks.
    result_difference: f64,
    tolerance: f64,
    holds: bool,
}

/// Forces on the hand [N] and times [ms] of ticks.
struct Run {
    forces: Vec<Vec3>,
    times: Vec<f64>,
}

/// Length of a tick [s].
const TICK: f64 = 0.008;
/// Ticks to rest at the most.
const MOST_TICKS: usize = 3000;
/// Ticks between looks at an adaptive mesh.
const EVERY: usize = 5;

/// A kind of skipped work, on so many particles a side, over so many ticks.
type Kind = fn(usize, usize) -> Result<Row, Box<dyn Error>>;

const KINDS: &[Kind] = &[
    sleeping,
    foreseen_gradient,
    stale_levels,
    no_candidates,
    flat_regions,
    weightless_terms,
    #[cfg(feature = "server")]
    service::no_viewers,
    #[cfg(feature = "recording")]
    service::no_recording,
];

/// Runs the bench.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let (n, ticks) = if args.quick { (17, 20) } else { (args.particles, args.ticks) };
    if ticks == 0 {
        return Err("--ticks: got 0, allowed: at least 1".into());
    }
    let out = &args.output;
    out.line("kind                  skipping ms  working ms   saved  difference  tolerance");
    let mut rows = Vec::new();
    for kind in KINDS {
        let row = kind(n, ticks)?;
        out.line(&format!(
            "{:20} {:12.4} {:11.4} {:6.1}% {:11.1e} {:10.0e}{}",
            row.kind,
            row.skipping_ms,
            row.working_ms,
            100.0 * row.saved_fraction,
            row.result_difference,
            row.tolerance,
            if row.holds { "" } else { "  FAILS" }
        ));
        rows.push(row);
    }
    out.write(0, &rows)?;
    let failed = rows.iter().filter(|r| !r.holds).count();
    if failed > 0 {
        Err(format!("{failed} of {} kinds change the result", rows.len()).into())
    } else {
        Ok(())
    }
}

fn compare(kind: &'static str, skipping: Run, working: Run, tolerance: f64) -> Row {
    let pairs = skipping.forces.iter().zip(&working.forces);
    let result_difference =
        pairs.map(|(a, b)| (a - b).norm() / b.norm().max(f64::MIN_POSITIVE)).fold(0.0, f64::max);
    let [skipping_ms, working_ms] = [skipping.times, working.times].map(median);
    Row {
        kind,
        skipping_ms,
        working_ms,
        saved_fraction: 1.0 - skipping_ms / working_ms,
        result_difference,
        tolerance,
        holds: result_difference <= tolerance,
    }
}

/// A resting cloth solves nothing.
fn sleeping(n: usize, ticks: usize) -> Result<Row, Box<dyn Error>> {
    let mut world = at_rest(hang(n)?)?;
    let rest = world.snapshot();
    let skipping = follow(&mut world, ticks, &mut |_, _| Vec::new());
    world.restore(&rest);
    let working = follow(&mut world, ticks, &mut |start, tick| {
        vec![Command::Move { position: start + Vec3::z() * (1e-12 * (1.0 + (tick % 2) as f64)) }]
    });
    Ok(compare("sleeping", skipping, working, 1e-3))
}

/// The last step already measured the gradient that the next begins with. The two sum in another order: 1e-12, until rounding decides
/// whether a Hessian is definite, and with it which one a step takes: hence 1e-4.
fn foreseen_gradient(n: usize, ticks: usize) -> Result<Row, Box<dyn Error>> {
    let [mut world, mut forgetful] = [at_rest(hang(n)?)?, at_rest(hang(n)?)?];
    let forget = &mut |world: &mut World| world.forget_foreseen();
    let [skipping, working] = in_turn_with([&mut world, &mut forgetful], ticks, [&mut |_| (), forget]);
    Ok(compare("foreseen gradient", skipping, working, 1e-4))
}

/// The iterative solver keeps the preconditioner's coarse levels for some solves and the soft elements' part of the Hessian while the cloth
/// hardly moves, and renews a column of the response in turn, which tells it when the force is exact enough. The tolerance bounds what was seen in the worst tick (1.7e-2, in ticks of 1 ms too); nothing derives it.
fn stale_levels(n: usize, ticks: usize) -> Result<Row, Box<dyn Error>> {
    let rest = at_rest(hang(n)?)?.snapshot();
    let mut worlds = Vec::new();
    for fresh in [false, true] {
        let mut world = World::with_method(hang(n)?, Method::Multigrid)?;
        world.restore(&rest);
        world.solve_afresh(fresh);
        worlds.push(world);
    }
    let [stale, fresh] = &mut worlds[..] else { unreachable!("two worlds were made") };
    let [skipping, working] = in_turn([stale, fresh], 5 * ticks);
    Ok(compare("stale levels", skipping, working, 2e-2))
}

/// A fabric without twist rigidity has no twist elements; one so small that nothing changes makes them work.
fn weightless_terms(n: usize, ticks: usize) -> Result<Row, Box<dyn Error>> {
    let with = |twist: f64| -> Result<World, Box<dyn Error>> {
        let setup = hang(n)?;
        at_rest(Setup { fabric: Arc::new(Fabric { twist, ..Fabric::clone(&setup.fabric) }), ..setup })
    };
    let [mut without, mut weightless] = [with(0.0)?, with(1e-300)?];
    let [skipping, working] = in_turn([&mut without, &mut weightless], 5 * ticks);
    Ok(compare("weightless terms", skipping, working, 1e-9))
}

/// Without obstacles no particle looks for contact; with one that is 1 m away, what is saved is all that contact costs then. Both sheets
/// come to rest by themselves, which ends within a tolerance and leaves a history of rounding: hence 1e-4 here.
fn no_candidates(n: usize, ticks: usize) -> Result<Row, Box<dyn Error>> {
    let mut free = at_rest(hang(n)?)?;
    let lowest = free.positions().iter().copied().min_by(|a, b| a.z.total_cmp(&b.z)).ok_or("no particles")?;
    let far = Obstacle {
        name: "far".into(),
        shape: Shape::Cuboid { half: [0.1; 3] },
        pose: Translation3::from(lowest - Vec3::z() * 1.1).into(),
        friction: None,
    };
    let mut beside = at_rest(Setup { obstacles: vec![far], ..hang(n)? })?;
    // A difference this small shows only when many ticks of both are timed in turn.
    let [skipping, working] = in_turn([&mut free, &mut beside], 5 * ticks);
    Ok(compare("no candidates", skipping, working, 1e-4))
}

/// Cells merge where the sheet is flat.
fn flat_regions(n: usize, ticks: usize) -> Result<Row, Box<dyn Error>> {
    let mut dense = at_rest(hang(n)?)?;
    let mut merged = World::new(hang(n)?)?;
    merged.set_adaptive(Some(Adaptive::default()));
    settle(&mut merged)?;
    let [working, skipping] = in_turn([&mut dense, &mut merged], ticks);
    Ok(compare("flat regions", skipping, working, 0.05))
}

impl Run {
    /// A tick and what is done after it.
    fn tick(&mut self, world: &mut World, commands: &[Command], after: &mut dyn FnMut(&mut World)) {
        let start = Instant::now();
        let report = world.step(commands, TICK, Budget::solves(2));
        let force = report.hand.map_or(Vec3::zeros(), |h| h.force);
        after(world);
        self.times.push(start.elapsed().as_secs_f64() * 1e3);
        self.forces.push(force);
    }
}

/// Two worlds on the same path, tick by tick, each the first every other time.
fn in_turn(worlds: [&mut World; 2], ticks: usize) -> [Run; 2] {
    in_turn_with(worlds, ticks, [&mut |_| (), &mut |_| ()])
}

/// The same, and what is done after each tick of each.
fn in_turn_with(
    worlds: [&mut World; 2],
    ticks: usize,
    mut after: [&mut dyn FnMut(&mut World); 2],
) -> [Run; 2] {
    let start = position(worlds[0]);
    let mut runs = [(); 2].map(|()| Run { forces: Vec::new(), times: Vec::new() });
    for tick in 0..ticks {
        for k in [tick % 2, 1 - tick % 2] {
            runs[k].tick(worlds[k], &circle(start, tick), &mut after[k]);
        }
    }
    runs
}

fn follow(world: &mut World, ticks: usize, commands: &mut dyn FnMut(Vec3, usize) -> Vec<Command>) -> Run {
    let start = position(world);
    let mut run = Run { forces: Vec::new(), times: Vec::new() };
    (0..ticks).for_each(|tick| run.tick(world, &commands(start, tick), &mut |_| ()));
    run
}

/// A slow circle of 1 cm.
fn circle(start: Vec3, tick: usize) -> Vec<Command> {
    let turned = 0.05 * TICK / 0.01 * (tick + 1) as f64;
    let position = start + Vec3::new(0.0, turned.sin(), 1.0 - turned.cos()) * 0.01;
    vec![Command::Move { position }]
}

fn position(world: &World) -> Vec3 {
    world.report().hand.map_or(Vec3::zeros(), |h| h.position)
}

fn hang(n: usize) -> Result<Setup, Box<dyn Error>> {
    let scene = Scene::built_in("hang").ok_or("no scene hang")?;
    let faults =
        |f: Vec<crate::scene::SceneError>| f.iter().map(|e| e.to_string()).collect::<Vec<_>>().join("\n");
    Ok(Scene { particles: [n, n], ..scene }.setup().map_err(faults)?)
}

/// At rest in the hand.
fn at_rest(setup: Setup) -> Result<World, Box<dyn Error>> {
    let mut world = World::new(setup)?;
    settle(&mut world)?;
    Ok(world)
}

fn settle(world: &mut World) -> Result<(), Box<dyn Error>> {
    let hand = world.setup().hand.ok_or("the scene has no hand")?;
    for tick in 1..=MOST_TICKS {
        if world.step(&[], 0.02, Budget::solves(4)).resting {
            world.step(&[Command::Grab { particle: hand }], 0.02, Budget::solves(4));
            return Ok(());
        }
        if tick % EVERY == 0 {
            world.adapt();
        }
    }
    Err("the scene did not come to rest".into())
}
