//! `kesi bench live`: a hand on a circle, the budget of a live tick, and the force against the fully converged path.
//!
//! Two worlds get the same hand: one with the budget under test, one that solves every tick to convergence. Their forces
//! are compared tick by tick; only the first is timed. Each budget is measured with each linear solver.

use super::{super::positive, Output, quantile};
use crate::{
    fabric::document::Faults,
    math::Vec3,
    phase::{Phase, Stopwatch, Watch},
    scene::Scene,
    world::{Budget, Command, Method, World},
};
use serde::Serialize;
use std::{collections::BTreeMap, error::Error, time::Instant};

/// Ticks under a moving hand.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Built-in scenes.
    #[arg(long, value_delimiter = ',', default_value = "hang")]
    scenes: Vec<String>,
    /// Particles along warp and weft.
    #[arg(long, value_delimiter = ',', default_value = "39")]
    particles: Vec<usize>,
    /// Speeds of the hand [m/s].
    #[arg(long, value_delimiter = ',', default_value = "0.1", value_parser = positive, allow_negative_numbers = true)]
    speed: Vec<f64>,
    /// Radius of the hand's circle [m].
    #[arg(long, default_value_t = 0.02, value_parser = positive, allow_negative_numbers = true)]
    radius: f64,
    /// Length of a tick [s].
    #[arg(long, default_value_t = 0.008, value_parser = positive, allow_negative_numbers = true)]
    tick_s: f64,
    /// Solves per tick.
    #[arg(long, value_delimiter = ',', default_value = "1,2", value_parser = clap::value_parser!(u32).range(1..))]
    solves: Vec<u32>,
    /// Linear solvers.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "fronts,faer,multigrid")]
    methods: Vec<Method>,
    /// Ticks.
    #[arg(long, default_value_t = 400, value_parser = clap::value_parser!(u32).range(1..))]
    ticks: u32,
    #[command(flatten)]
    output: Output,
}

#[derive(Serialize)]
struct Row {
    scene: String,
    variant: String,
    particles_active: usize,
    particles: usize,
    hand_speed_m_per_s: f64,
    tick_s: f64,
    tick_ms_p50: f64,
    tick_ms_p95: f64,
    tick_ms_p99: f64,
    tick_ms_max: f64,
    force_error_median: f64,
    force_error_p95: f64,
    force_error_max: f64,
    /// Iterations of conjugate gradients per tick.
    iterations_mean: f64,
    iterations_max: u32,
    /// Mean time per tick by phase [ms].
    phase_ms: BTreeMap<&'static str, f64>,
}

/// Time over which the hand gets to its speed [s].
const RAMP: f64 = 0.05;
/// Solves of a tick of the reference.
const CONVERGED: u32 = 40;

impl Row {
    /// What was measured; the rest is the caller's to fill in.
    fn new(world: &World, ticks: &Ticks, reference: &[Vec3]) -> Row {
        let Ticks { forces, iterations, phase_ms, .. } = ticks;
        let mut times = ticks.times.clone();
        let per_tick = 1.0 / forces.len() as f64;
        let pairs = forces.iter().zip(reference);
        let mut errors: Vec<f64> = pairs.map(|(f, r)| (f - r).norm() / r.norm()).collect();
        times.sort_by(f64::total_cmp);
        errors.sort_by(f64::total_cmp);
        Row {
            scene: String::new(),
            variant: String::new(),
            hand_speed_m_per_s: 0.0,
            tick_s: 0.0,
            particles_active: world.report().particles_active,
            particles: world.grid().particles(),
            tick_ms_p50: quantile(&times, 0.5),
            tick_ms_p95: quantile(&times, 0.95),
            tick_ms_p99: quantile(&times, 0.99),
            tick_ms_max: quantile(&times, 1.0),
            force_error_median: quantile(&errors, 0.5),
            force_error_p95: quantile(&errors, 0.95),
            force_error_max: quantile(&errors, 1.0),
            iterations_mean: f64::from(iterations.iter().sum::<u32>()) * per_tick,
            iterations_max: iterations.iter().copied().max().unwrap_or(0),
            phase_ms: Phase::ALL
                .into_iter()
                .zip(phase_ms)
                .filter(|(_, sum)| **sum > 0.0)
                .map(|(phase, sum)| (phase.name(), sum * per_tick))
                .collect(),
        }
    }

    /// Mean times of the phases, the longest first, and iterations.
    fn phases(&self) -> String {
        let mut phases: Vec<_> = self.phase_ms.iter().filter(|(_, ms)| **ms >= 5e-4).collect();
        phases.sort_by(|a, b| b.1.total_cmp(a.1));
        let phases: Vec<String> = phases.into_iter().map(|(name, ms)| format!("{name} {ms:.3}")).collect();
        format!("        {:.1} iterations; mean ms: {}", self.iterations_mean, phases.join(", "))
    }

    fn line(&self) -> String {
        format!(
            "{:6} {:9} {:5.2}  {:20} {:7.2} {:7.2} {:7.2} {:7.2}    | {:18.5} {:8.5} {:8.5}",
            self.scene,
            self.particles_active,
            self.hand_speed_m_per_s,
            self.variant,
            self.tick_ms_p50,
            self.tick_ms_p95,
            self.tick_ms_p99,
            self.tick_ms_max,
            self.force_error_median,
            self.force_error_p95,
            self.force_error_max
        )
    }
}

/// Runs the bench.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let out = &args.output;
    out.line("scene  particles   m/s  variant                  p50     p95     p99     max ms | force error median    p95      max");
    let mut rows = Vec::new();
    for name in &args.scenes {
        let scene = Scene::named(name)?;
        for &n in &args.particles {
            let sheet = Scene { particles: [n, n], ..scene.clone() };
            let mut world = at_rest(&sheet)?;
            let rest = world.snapshot();
            for &speed in &args.speed {
                world.restore(&rest);
                let path = circle(&world, [args.radius, speed], args.tick_s, args.ticks);
                let reference = follow(&mut world, &path, args.tick_s, CONVERGED).forces;
                for (&solves, &method) in
                    args.solves.iter().flat_map(|s| args.methods.iter().map(move |m| (s, m)))
                {
                    let mut world = World::with_method(world.setup().clone(), method)?;
                    world.restore(&rest);
                    let ticks = follow(&mut world, &path, args.tick_s, solves);
                    let row = Row {
                        scene: name.clone(),
                        variant: format!("{method:?}, {solves} solves").to_lowercase(),
                        hand_speed_m_per_s: speed,
                        tick_s: args.tick_s,
                        ..Row::new(&world, &ticks, &reference)
                    };
                    out.line(&row.line());
                    out.line(&row.phases());
                    rows.push(row);
                }
            }
        }
    }
    out.write(0, &rows)
}

/// The scene at rest with its hand held.
pub(super) fn at_rest(scene: &Scene) -> Result<World, Box<dyn Error>> {
    let mut world = World::new(scene.setup().map_err(Faults)?)?;
    let hand = world.setup().hand.ok_or("the scene has no hand")?;
    for _ in 0..2000 {
        if world.step(&[], 0.02, Budget::solves(8)).resting {
            world.step(&[Command::Grab { particle: hand }], 0.02, Budget::solves(8));
            return Ok(world);
        }
    }
    Err(format!("{} did not come to rest", scene.name).into())
}

/// A circle of this radius [m] through the corner at this speed [m/s], in the plane of the sheet's normal and of (0.8 along the held
/// edge, 0.6 up): where the hand is after each tick.
pub(super) fn circle(world: &World, [radius, speed]: [f64; 2], tick_s: f64, ticks: u32) -> Vec<Vec3> {
    let hand = world.report().hand.expect("a held hand").position;
    let [_, columns] = world.grid().counts;
    let other = world.positions()[world.grid().index([0, columns - 1])];
    let edge = (other - hand).normalize();
    let normal = edge.cross(&Vec3::z()).normalize();
    let rise = edge * 0.8 + Vec3::z() * 0.6;
    let mut turned = 0.0;
    (1..=ticks)
        .map(|k| {
            let speed = speed * ((f64::from(k) - 0.5) * tick_s / RAMP).min(1.0);
            turned += speed * tick_s / radius;
            hand + (rise * (1.0 - f64::cos(turned)) + normal * f64::sin(turned)) * radius
        })
        .collect()
}

/// What ticks along a path gave.
#[derive(Default)]
struct Ticks {
    /// Forces on the hand [N].
    forces: Vec<Vec3>,
    /// Times [ms].
    times: Vec<f64>,
    /// Iterations of conjugate gradients.
    iterations: Vec<u32>,
    /// Sum of the times in each phase [ms].
    phase_ms: [f64; Phase::ALL.len()],
}

/// Steps the world along the path.
fn follow(world: &mut World, path: &[Vec3], dt: f64, solves: u32) -> Ticks {
    let stopwatch = Stopwatch::default();
    let ended = |phase| stopwatch.ended(phase);
    let budget = Budget { watch: Watch(Some(&ended)), ..Budget::solves(solves) };
    let mut ticks = Ticks::default();
    for &position in path {
        let start = Instant::now();
        stopwatch.start();
        let report = world.step(&[Command::Move { position }], dt, budget);
        ticks.times.push(start.elapsed().as_secs_f64() * 1e3);
        ticks.forces.push(report.hand.expect("a held hand").force);
        ticks.iterations.push(stopwatch.lap(Phase::Iteration).count);
        let laps = Phase::ALL.map(|phase| stopwatch.lap(phase).seconds * 1e3);
        ticks.phase_ms.iter_mut().zip(laps).for_each(|(sum, ms)| *sum += ms);
    }
    ticks
}
