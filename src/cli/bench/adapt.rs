//! `kesi bench adapt`: how many particles buy how much error, on adaptive meshes and on uniform ones beside them.
//!
//! The reference is the dense sheet at rest. `from_start` adapts all the way from the scene's start, as a live session does;
//! `from_rest` begins with the dense rest, so it stays on its branch and shows the error of the mesh alone.

use super::Output;
use crate::{
    adapt::{Criterion, Settings},
    cli::{positive, sorted::median},
    grid::Interpolation,
    math::{Mat3, Vec3},
    scene::Scene,
    world::{Budget, Command, World},
};
use serde::Serialize;
use std::{error::Error, time::Instant};

/// Adaptive and uniform meshes at rest.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Built-in scenes.
    #[arg(long, value_delimiter = ',', default_value = "hang,drape")]
    scenes: Vec<String>,
    /// Particles along warp and weft of the dense sheet.
    #[arg(long, default_value_t = 77)]
    dense: usize,
    /// Uniform sheets beside it; their intervals divide or are divided by the dense one's.
    #[arg(long, value_delimiter = ',', default_value = "20,39,153")]
    uniform: Vec<usize>,
    /// Thresholds of the criterion: turn of a cell [rad], cost, or sensitivity.
    #[arg(long, value_delimiter = ',', default_value = "0.1,0.15,0.2,0.3,0.4,0.8,1.6", value_parser = positive, allow_negative_numbers = true)]
    thresholds: Vec<f64>,
    /// Size up to which cells merge, over the one of which two in a half wave just bear the compression there.
    #[arg(long, default_value_t = 2.5, value_parser = positive, allow_negative_numbers = true)]
    buckling: f64,
    /// Difference of tension along a cell above which it is split, over the hand's force per length of the shorter side; none: any will do.
    #[arg(long, value_parser = positive, allow_negative_numbers = true)]
    tension: Option<f64>,
    /// What decides: angle, bend, bend-stretch or force.
    #[arg(long, default_value = "angle")]
    criterion: String,
    /// Largest cell in intervals.
    #[arg(long, default_value_t = 4)]
    coarsest: usize,
    /// Longest cell over its shorter side; squares only with 1.
    #[arg(long, default_value_t = Settings::default().slenderest)]
    slenderest: usize,
    /// Rings of finest cells around the hand and pins.
    #[arg(long, default_value_t = 6)]
    rings: usize,
    #[command(flatten)]
    pace: Pace,
    #[command(flatten)]
    output: Output,
}

/// How a sheet is stepped, and its mesh looked at.
#[derive(Debug, clap::Args)]
pub(super) struct Pace {
    /// Length of a tick [s].
    #[arg(long, default_value_t = 0.02, value_parser = positive, allow_negative_numbers = true)]
    pub tick_s: f64,
    /// Solves per tick at the most.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..))]
    pub solves: u32,
    /// Ticks between looks at the mesh.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..))]
    pub every: u64,
}

#[derive(Serialize)]
struct Row {
    scene: String,
    mesh: String,
    threshold: f64,
    particles_active: usize,
    particles_ghost: usize,
    force_error: f64,
    stiffness_error: f64,
    shape_rms_m: f64,
    shape_max_m: f64,
    energy_error: f64,
    tick_ms: f64,
    branch_changed: bool,
    ticks: u64,
    changes: u64,
}

/// Ticks to rest at the most.
const MOST_TICKS: u64 = 3000;
/// A particle off by this part of the sheet's shorter side lies in another fold.
const OTHER_FOLD: f64 = 0.05;
/// Ticks under a moving hand of which the median time is taken.
const TIMED: usize = 41;

/// The cloth at rest.
struct Rest {
    counts: [usize; 2],
    shape: Vec<Vec3>,
    force: Vec3,
    stiffness: Mat3,
    energy: f64,
}

/// Runs the bench.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let criterion = match args.criterion.as_str() {
        "angle" => Criterion::BendingAngle,
        "bend" => Criterion::BendingCost,
        "bend-stretch" => Criterion::BendingStretchingCost,
        "force" => Criterion::ForceSensitivity,
        other => {
            return Err(
                format!("--criterion: got {other:?}, allowed: angle, bend, bend-stretch, force").into()
            );
        }
    };
    let out = &args.output;
    out.line("scene  mesh        threshold  active ghosts | force err  stiffness  shape rms   max mm    energy | tick ms  ticks  changes");
    let mut rows: Vec<Row> = Vec::new();
    for name in &args.scenes {
        let scene = Scene::built_in(name)
            .ok_or_else(|| format!("--scenes: got {name:?}, allowed: {:?}", Scene::names()))?;
        let sheet = |n: usize| Scene { particles: [n, n], ..scene.clone() };
        let mut dense = world(&sheet(args.dense))?;
        args.pace.settle(&mut dense)?;
        let (reference, start) = (Rest::of(&dense)?, dense.snapshot());
        let mut add = |mesh: &str, threshold: f64, world: &mut World| -> Result<(), Box<dyn Error>> {
            let row = compare(name, mesh, threshold, world, &reference, args)?;
            print(out, &row);
            rows.push(row);
            Ok(())
        };
        add(&format!("uniform {}", args.dense), 0.0, &mut dense)?;
        for &n in &args.uniform {
            let mut world = world(&sheet(n))?;
            args.pace.settle(&mut world)?;
            add(&format!("uniform {n}"), 0.0, &mut world)?;
        }
        for &threshold in &args.thresholds {
            let settings = settings(args, criterion, threshold);
            let mut world = world(&sheet(args.dense))?;
            world.set_adaptive(Some(settings));
            args.pace.settle(&mut world)?;
            add("from_start", threshold, &mut world)?;
            dense.restore(&start);
            dense.set_adaptive(Some(settings));
            let hand = dense.setup().hand.ok_or("the scene has no hand")?;
            // A move too small to feel wakes it.
            let position = dense.report().hand.ok_or("no hand")?.position + Vec3::z() * 1e-9;
            let wake = [Command::Grab { particle: hand }, Command::Move { position }];
            dense.step(&wake, args.pace.tick_s, Budget::solves(args.pace.solves));
            args.pace.settle(&mut dense)?;
            add("from_rest", threshold, &mut dense)?;
        }
    }
    out.write(0, &rows)
}

fn settings(args: &Args, criterion: Criterion, threshold: f64) -> Settings {
    let &Args { buckling, coarsest, slenderest, rings, .. } = args;
    let tension = args.tension.unwrap_or(Settings::default().tension);
    let settings =
        Settings { criterion, buckling, tension, coarsest, slenderest, rings, ..Settings::default() };
    match criterion {
        Criterion::BendingAngle => Settings { angle: threshold, ..settings },
        Criterion::BendingCost | Criterion::BendingStretchingCost => Settings { cost: threshold, ..settings },
        Criterion::ForceSensitivity => Settings { sensitivity: threshold, ..settings },
    }
}

fn world(scene: &Scene) -> Result<World, Box<dyn Error>> {
    let faults =
        |f: Vec<crate::scene::SceneError>| f.iter().map(|e| e.to_string()).collect::<Vec<_>>().join("\n");
    Ok(World::new(scene.setup().map_err(faults)?)?)
}

impl Pace {
    /// A step, after which the mesh adapts where that is due; true when the cloth rests.
    pub fn tick(&self, world: &mut World, tick: u64) -> bool {
        let resting = world.step(&[], self.tick_s, Budget::solves(self.solves)).resting;
        if !resting && tick.is_multiple_of(self.every) {
            world.adapt();
        }
        resting
    }

    /// Steps until the cloth rests.
    pub fn settle(&self, world: &mut World) -> Result<(), Box<dyn Error>> {
        if (1..=MOST_TICKS).any(|tick| self.tick(world, tick)) {
            return Ok(());
        }
        Err(format!("no rest within {MOST_TICKS} ticks: {:?}", world.report()).into())
    }
}

impl Rest {
    fn of(world: &World) -> Result<Rest, Box<dyn Error>> {
        let hand = world.report().hand.ok_or("the scene has no hand")?;
        let mut shape = world.positions().to_vec();
        world.grid().interpolate(&mut shape, Interpolation::Cubic);
        Ok(Rest {
            counts: world.grid().counts,
            shape,
            force: hand.force,
            stiffness: hand.stiffness,
            energy: world.report().energy,
        })
    }
}

fn compare(
    scene: &str,
    mesh: &str,
    threshold: f64,
    world: &mut World,
    reference: &Rest,
    args: &Args,
) -> Result<Row, Box<dyn Error>> {
    let rest = Rest::of(world)?;
    let report = world.report().clone();
    let offsets = offsets(&rest, reference);
    let rms = (offsets.iter().map(|d| d * d).sum::<f64>() / offsets.len() as f64).sqrt();
    let max = offsets.iter().copied().fold(0.0, f64::max);
    let side = world.grid().size[0].min(world.grid().size[1]);
    let tick_ms = time_ticks(world, args);
    Ok(Row {
        scene: scene.into(),
        mesh: mesh.into(),
        threshold,
        particles_active: report.particles_active,
        particles_ghost: report.particles_ghost,
        force_error: (rest.force - reference.force).norm() / reference.force.norm(),
        stiffness_error: (rest.stiffness - reference.stiffness).norm() / reference.stiffness.norm(),
        shape_rms_m: rms,
        shape_max_m: max,
        energy_error: (rest.energy - reference.energy).abs() / reference.energy.abs(),
        tick_ms,
        branch_changed: max > OTHER_FOLD * side,
        ticks: report.step,
        changes: report.remeshing.changes,
    })
}

/// Distances between particles that both lattices know [m].
fn offsets(a: &Rest, b: &Rest) -> Vec<f64> {
    let steps = [0, 1].map(|k| {
        let [n, m] = [a.counts[k] - 1, b.counts[k] - 1];
        let common = gcd(n, m);
        [n / common, m / common, common]
    });
    let mut offsets = Vec::new();
    for i in 0..=steps[0][2] {
        for j in 0..=steps[1][2] {
            let at = |rest: &Rest, k: usize| rest.shape[i * steps[0][k] * rest.counts[1] + j * steps[1][k]];
            offsets.push((at(a, 0) - at(b, 1)).norm());
        }
    }
    offsets
}

fn gcd(a: usize, b: usize) -> usize {
    if b == 0 { a } else { gcd(b, a % b) }
}

/// Median time [ms] of a tick of 8 ms with one solve, the hand moving at 0.05 m/s and the mesh kept.
fn time_ticks(world: &mut World, args: &Args) -> f64 {
    let before = world.snapshot();
    let Some(hand) = world.report().hand else { return 0.0 };
    let mut commands = vec![Command::Grab { particle: hand.particle }];
    let times: Vec<f64> = (0..TIMED)
        .map(|tick| {
            let up = Vec3::z() * (0.0004 * (tick + 1) as f64);
            commands.push(Command::Move { position: hand.position + up });
            let start = Instant::now();
            world.step(&commands, 0.4 * args.pace.tick_s, Budget::solves(1));
            commands.clear();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    world.restore(&before);
    median(times)
}

fn print(out: &Output, row: &Row) {
    out.line(&format!(
        "{:6} {:11} {:9.3} {:7} {:6} | {:9.5}  {:9.5}  {:9.5} {:8.4}  {:8.6} | {:7.2} {:6} {:8} {}",
        row.scene,
        row.mesh,
        row.threshold,
        row.particles_active,
        row.particles_ghost,
        row.force_error,
        row.stiffness_error,
        row.shape_rms_m * 1e3,
        row.shape_max_m * 1e3,
        row.energy_error,
        row.tick_ms,
        row.ticks,
        row.changes,
        if row.branch_changed { "other fold" } else { "" }
    ));
}
