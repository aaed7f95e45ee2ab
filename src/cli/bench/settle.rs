//! `kesi bench settle`: from a scene's start to rest, with nobody at the hand.

use super::{super::positive, Output};
use crate::{
    fabric::document::Faults,
    scene::Scene,
    world::{Budget, Method, World},
};
use serde::Serialize;
use std::{error::Error, time::Instant};

/// From the start to rest.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Built-in scenes.
    #[arg(long, value_delimiter = ',', default_value = "drape,hang")]
    scenes: Vec<String>,
    /// Particles along warp and weft.
    #[arg(long, value_delimiter = ',', default_value = "20,39,77")]
    particles: Vec<usize>,
    /// Length of a tick [s].
    #[arg(long, default_value_t = 0.02, value_parser = positive, allow_negative_numbers = true)]
    tick_s: f64,
    /// Solves per tick at the most.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..))]
    solves: u32,
    /// Linear solvers.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "fronts,multigrid")]
    methods: Vec<Method>,
    /// Ticks at the most; a cloth that is not at rest then is reported as it is.
    #[arg(long, default_value_t = 2000)]
    most_ticks: u32,
    #[command(flatten)]
    output: Output,
}

#[derive(Serialize)]
struct Row {
    scene: String,
    particles: usize,
    solver: String,
    ticks: u64,
    solves: u64,
    wall_s: f64,
    simulated_s: f64,
    resting: bool,
    residual_n: f64,
    cost_total: f64,
    cost_newton: f64,
    cost_stretch: f64,
    cost_bend: f64,
    cost_shear: f64,
}

/// Runs the bench.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let out = &args.output;
    out.line("scene     particles  solver       ticks  solves   wall s  simulated s  rest  residual N  cost");
    let mut rows = Vec::new();
    for name in &args.scenes {
        let scene = Scene::named(name)?;
        let sheets = args.particles.iter().flat_map(|&n| args.methods.iter().map(move |&method| (n, method)));
        for (n, method) in sheets {
            let row = settle(args, name, Scene { particles: [n, n], ..scene.clone() }, method)?;
            out.line(&format!(
                "{:9} {:9}  {:9} {:7} {:7} {:8.2} {:12.2}  {:4}  {:10.1e}  {:.1e}",
                row.scene,
                row.particles,
                row.solver,
                row.ticks,
                row.solves,
                row.wall_s,
                row.simulated_s,
                if row.resting { "yes" } else { "no" },
                row.residual_n,
                row.cost_total
            ));
            rows.push(row);
        }
    }
    out.write(0, &rows)
}

fn settle(args: &Args, name: &str, scene: Scene, method: Method) -> Result<Row, Box<dyn Error>> {
    let mut world = World::with_method(scene.setup().map_err(Faults)?, method)?;
    let start = Instant::now();
    let mut solves = 0;
    for _ in 0..args.most_ticks {
        let report = world.step(&[], args.tick_s, Budget::solves(args.solves));
        solves += u64::from(report.solves);
        if report.resting {
            break;
        }
    }
    let wall_s = start.elapsed().as_secs_f64();
    let report = world.report();
    Ok(Row {
        scene: name.to_string(),
        particles: report.particles_active,
        solver: method.name(),
        ticks: report.step,
        solves,
        wall_s,
        simulated_s: report.time,
        resting: report.resting,
        residual_n: report.residual,
        cost_total: report.cost.total(),
        cost_newton: report.cost.newton,
        cost_stretch: report.cost.stretch,
        cost_bend: report.cost.bend,
        cost_shear: report.cost.shear,
    })
}
