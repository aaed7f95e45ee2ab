//! `kesi bench live`: a hand on a circle, the budget of a live tick, and the force against the fully converged path.
//!
//! Two worlds get the same hand: one with the budget under test, one on the dense mesh that solves every tick to convergence. Their
//! forces and stiffness are compared tick by tick, and each force with what the rate of the tick before foretold; only the first is
//! timed. Each budget is measured with each linear solver. An adaptive mesh changes as in a session: a world on the new one catches up
//! beside the ticks, which its copy and its company slow down, or the mesh changes at once, which counts to the tick before. What its force
//! errs by against the dense mesh is mostly the mesh's; a third world, as adaptive and solved to convergence, tells what is the solves'.

use super::{ForceErrors, Output, adapt::Pace};
use crate::{
    adapt::Settings,
    cli::{
        positive,
        sorted::{Sorted, median},
    },
    fabric::document::Faults,
    hand::HandReport,
    math::Vec3,
    obstacle::{Gap, Obstacle},
    phase::{Phase, Stopwatch, Watch},
    scene::Scene,
    successor::Changes,
    world::{Budget, Command, Method, OBSERVATION, Snapshot, World},
};
use serde::Serialize;
use std::{
    collections::BTreeMap,
    error::Error,
    thread,
    time::{Duration, Instant},
};

/// Ticks under a moving hand.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Built-in scenes.
    #[arg(long, value_delimiter = ',', default_value = "hang")]
    scenes: Vec<String>,
    /// Particles along warp and weft.
    #[arg(long, value_delimiter = ',', default_value = "39")]
    particles: Vec<usize>,
    /// Particles along warp and weft of dense sheets that adaptive ones start from.
    #[arg(long, value_delimiter = ',')]
    adaptive: Vec<usize>,
    /// What the hand does.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "free")]
    hand: Vec<Hand>,
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
    /// Times that each variant goes along the path. A tick's time is the median of those it took, which leaves out most of what other
    /// programs take from one of them.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    runs: u32,
    #[command(flatten)]
    output: Output,
}

/// What the hand does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "snake_case")]
enum Hand {
    /// It goes on a circle from where the cloth came to rest.
    Free,
    /// It presses the cloth against the nearest obstacle, where the cloth comes to rest again, and goes on a circle along its surface.
    Pressing,
}

#[derive(Serialize)]
struct Row {
    scene: String,
    hand: Hand,
    adaptive: bool,
    variant: String,
    particles_active: usize,
    particles: usize,
    hand_speed_m_per_s: f64,
    tick_s: f64,
    /// Times along the path; a tick's time is the median over them.
    runs: u32,
    tick_ms_p50: f64,
    tick_ms_p95: f64,
    tick_ms_p99: f64,
    tick_ms_max: f64,
    /// Over the reference's force.
    #[serde(flatten)]
    errors: ForceErrors,
    /// Of an adaptive sheet, over the force of one that adapts alike and solves every tick to convergence.
    of_solves: Option<ForceErrors>,
    /// How far the stiffness is off the reference's, and the next tick's force off what the rate foretells, relative to them.
    stiffness_error_median: f64,
    stiffness_error_p95: f64,
    foretold_error_median: f64,
    foretold_error_p95: f64,
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
/// How far inside the obstacle a pressing hand wants to be [m], and the way it takes per tick to get there [m].
const PRESS: f64 = 5e-3;
const APPROACH: f64 = 2e-3;
/// How far above the obstacle it comes there, at least [m].
const CLEARANCE: f64 = 1e-2;
/// Simulated time between looks at an adaptive mesh [s].
const LOOK: f64 = 0.08;
/// How a cloth comes to rest.
const PACE: Pace = Pace { tick_s: 0.02, solves: 8, every: 4 };

impl Row {
    /// What was measured of a case.
    fn new<'a>(
        case: &Case,
        variant: String,
        runs: &'a [Ticks],
        reference: &'a [HandReport],
        converged: Option<&'a [HandReport]>,
    ) -> Row {
        let times = Sorted::of((0..reference.len()).map(|k| median(runs.iter().map(|run| run.times[k]))));
        let iterations = || runs.iter().flat_map(|run| run.iterations.iter().copied());
        let per_tick = 1.0 / (runs.len() * reference.len()) as f64;
        let pairs = |from: &'a [HandReport]| runs.iter().flat_map(move |run| run.felt.iter().zip(from));
        let errors =
            |from| ForceErrors::of(pairs(from).map(|(f, r)| (f.force - r.force).norm() / r.force.norm()));
        let stiffness = Sorted::of(
            pairs(reference).map(|(f, r)| (f.stiffness - r.stiffness).norm() / r.stiffness.norm()),
        );
        let missed = |now: &HandReport, next: &HandReport| now.force + now.rate * case.tick_s - next.force;
        let next = runs.iter().flat_map(|run| run.felt.iter().zip(&run.felt[1..]));
        let foretold = Sorted::of(next.map(|(now, next)| missed(now, next).norm() / next.force.norm()));
        Row {
            scene: case.scene.clone(),
            hand: case.hand,
            adaptive: case.adaptive,
            variant,
            hand_speed_m_per_s: case.speed,
            tick_s: case.tick_s,
            runs: runs.len() as u32,
            particles_active: runs.last().map_or(0, |run| run.particles_active),
            particles: case.particles,
            tick_ms_p50: times.at(0.5),
            tick_ms_p95: times.at(0.95),
            tick_ms_p99: times.at(0.99),
            tick_ms_max: times.at(1.0),
            errors: errors(reference),
            of_solves: converged.map(errors),
            stiffness_error_median: stiffness.at(0.5),
            stiffness_error_p95: stiffness.at(0.95),
            foretold_error_median: foretold.at(0.5),
            foretold_error_p95: foretold.at(0.95),
            iterations_mean: f64::from(iterations().sum::<u32>()) * per_tick,
            iterations_max: iterations().max().unwrap_or(0),
            phase_ms: Phase::ALL
                .into_iter()
                .enumerate()
                .map(|(phase, name)| (name, runs.iter().map(|run| run.phase_ms[phase]).sum::<f64>()))
                .filter(|(_, sum)| *sum > 0.0)
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

    /// What else the force model tells.
    fn model(&self) -> String {
        format!(
            "        stiffness error median {:.5}, p95 {:.5}; next force off what was foretold by {:.5}, {:.5}",
            self.stiffness_error_median,
            self.stiffness_error_p95,
            self.foretold_error_median,
            self.foretold_error_p95
        )
    }

    /// What an adaptive sheet's solves err by.
    fn solves(&self) -> Option<String> {
        self.of_solves.as_ref().map(|of| {
            format!(
                "        against such a mesh solved to convergence: force error median {:.5}, p95 {:.5}, max {:.5}",
                of.force_error_median, of.force_error_p95, of.force_error_max
            )
        })
    }

    fn line(&self) -> String {
        format!(
            "{:6} {:9} {:5.2} {:9} {:20} {:7.2} {:7.2} {:7.2} {:7.2}    | {:18.5} {:8.5} {:8.5}",
            self.scene,
            self.particles_active,
            self.hand_speed_m_per_s,
            if self.hand == Hand::Free { "" } else { "pressing" },
            self.variant,
            self.tick_ms_p50,
            self.tick_ms_p95,
            self.tick_ms_p99,
            self.tick_ms_max,
            self.errors.force_error_median,
            self.errors.force_error_p95,
            self.errors.force_error_max
        )
    }
}

/// One scene, mesh and motion of the hand.
struct Case {
    scene: String,
    hand: Hand,
    adaptive: bool,
    particles: usize,
    speed: f64,
    tick_s: f64,
}

/// Runs the bench.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let out = &args.output;
    out.line("scene  particles   m/s hand      variant                  p50     p95     p99     max ms | force error median    p95      max");
    let mut rows = Vec::new();
    for name in &args.scenes {
        let scene = Scene::named(name)?;
        let mut sizes: Vec<usize> = args.particles.iter().chain(&args.adaptive).copied().collect();
        sizes.sort_unstable();
        sizes.dedup();
        for n in sizes {
            let mut dense = at_rest(&Scene { particles: [n, n], ..scene.clone() })?;
            let free = dense.snapshot();
            for &hand in &args.hand {
                dense.restore(&free);
                if hand == Hand::Pressing && !press(&mut dense)? {
                    continue;
                }
                rows.extend(measure(args, name, hand, n, &mut dense)?);
            }
        }
    }
    out.write(0, &rows)
}

/// Rows of a dense sheet at rest in a hand, and of the adaptive one that starts from it.
fn measure(
    args: &Args,
    name: &str,
    hand: Hand,
    n: usize,
    dense: &mut World,
) -> Result<Vec<Row>, Box<dyn Error>> {
    let mut starts = Vec::new();
    let start = dense.snapshot();
    if args.particles.contains(&n) {
        starts.push((None, start.clone()));
    }
    if args.adaptive.contains(&n) {
        for &method in &args.methods {
            dense.restore(&start);
            starts.push((Some(method), adapted(dense, Settings::of(method))?));
        }
    }
    let mut rows = Vec::new();
    for &speed in &args.speed {
        dense.restore(&start);
        let mut path = circle(dense, args.radius, |_| speed, args.tick_s, args.ticks);
        if hand == Hand::Pressing {
            path.iter_mut().for_each(|p| *p = pressed(dense, *p).expect("an obstacle"));
        }
        let reference = follow(dense, &path, args.tick_s, CONVERGED).felt;
        for (adapted_to, from) in &starts {
            let is_meant = |method: &&Method| adapted_to.is_none_or(|to| to == **method);
            let methods: Vec<Method> = args.methods.iter().filter(is_meant).copied().collect();
            let going = |method: Method, solves: u32| -> Result<Ticks, Box<dyn Error>> {
                let mut world = World::with_method(dense.setup().clone(), method)?;
                world.restore(from);
                Ok(follow(&mut world, &path, args.tick_s, solves))
            };
            let converged = adapted_to.map(|method| going(method, CONVERGED)).transpose()?;
            for (&solves, &method) in args.solves.iter().flat_map(|s| methods.iter().map(move |m| (s, m))) {
                let mut runs = Vec::new();
                for _ in 0..args.runs {
                    runs.push(going(method, solves)?);
                }
                let case = Case {
                    scene: name.into(),
                    hand,
                    adaptive: adapted_to.is_some(),
                    particles: dense.grid().particles(),
                    speed,
                    tick_s: args.tick_s,
                };
                let variant = format!("{}, {solves} solves", method.name());
                let converged = converged.as_ref().map(|ticks| &ticks.felt[..]);
                let row = Row::new(&case, variant, &runs, &reference, converged);
                args.output.line(&row.line());
                row.solves().into_iter().for_each(|line| args.output.line(&line));
                args.output.line(&row.model());
                args.output.line(&row.phases());
                rows.push(row);
            }
        }
    }
    Ok(rows)
}

/// The adaptive sheet that the dense one becomes at rest.
fn adapted(world: &mut World, settings: Settings) -> Result<Snapshot, Box<dyn Error>> {
    world.set_adaptive(Some(settings));
    // A move too small to feel wakes it; a smaller one would be none along an obstacle.
    let position = world.report().hand.ok_or("no hand")?.position + Vec3::z() * 2e-6;
    world.step(&[Command::Move { position }], PACE.tick_s, Budget::solves(PACE.solves));
    PACE.settle(world)?;
    Ok(world.snapshot())
}

/// The obstacle nearest to a place, and the gap to it; none without obstacles.
fn nearest(world: &World, place: Vec3) -> Option<(&Obstacle, Gap)> {
    let gaps = world.setup().obstacles.iter().map(|obstacle| (obstacle, obstacle.gap(place)));
    gaps.min_by(|a, b| a.1.value.total_cmp(&b.1.value))
}

/// The place `PRESS` inside the nearest obstacle under a place; none without obstacles.
fn pressed(world: &World, place: Vec3) -> Option<Vec3> {
    nearest(world, place).map(|(_, gap)| place - gap.normal * (gap.value + PRESS))
}

/// Lets the hand press the cloth against the nearest obstacle and the cloth come to rest there; false without obstacles. It presses half way
/// between where the obstacle is nearest and its middle, as on an edge or a corner the last bits would decide along which face it slides.
fn press(world: &mut World) -> Result<bool, Box<dyn Error>> {
    let start = world.report().hand.ok_or("no hand")?.position;
    let Some((obstacle, gap)) = nearest(world, start) else { return Ok(false) };
    let surface = start - gap.normal * gap.value;
    let inwards = (obstacle.pose.translation.vector - surface) * 0.5;
    let above = surface + Vec3::new(inwards.x, inwards.y, CLEARANCE);
    let end = pressed(world, above).ok_or("no obstacle")?;
    let mut from = start;
    for to in [above, end] {
        let steps = ((to - from).norm() / APPROACH).ceil();
        for k in 1..=steps as u32 {
            let position = from + (to - from) * (f64::from(k) / steps);
            world.step(&[Command::Move { position }], PACE.tick_s, Budget::solves(PACE.solves));
        }
        from = to;
    }
    PACE.settle(world)?;
    Ok(true)
}

/// The scene at rest with its hand held.
pub(super) fn at_rest(scene: &Scene) -> Result<World, Box<dyn Error>> {
    let mut world = World::new(scene.setup().map_err(Faults)?)?;
    let hand = world.setup().hand.ok_or("the scene has no hand")?;
    PACE.settle(&mut world)?;
    world.step(&[Command::Grab { particle: hand }], PACE.tick_s, Budget::solves(PACE.solves));
    Ok(world)
}

/// A circle of this radius [m] through the corner, in the plane of the sheet's normal and of (0.8 along the held edge, 0.6 up), at a speed
/// [m/s] that may change with time [s]: where the hand is after each tick.
pub(super) fn circle(
    world: &World,
    radius: f64,
    speed: impl Fn(f64) -> f64,
    tick_s: f64,
    ticks: u32,
) -> Vec<Vec3> {
    let hand = world.report().hand.expect("a held hand").position;
    let [_, columns] = world.grid().counts;
    let other = world.positions()[world.grid().index([0, columns - 1])];
    let edge = (other - hand).normalize();
    let normal = edge.cross(&Vec3::z()).normalize();
    let rise = edge * 0.8 + Vec3::z() * 0.6;
    let mut turned = 0.0;
    (1..=ticks)
        .map(|k| {
            let time = (f64::from(k) - 0.5) * tick_s;
            turned += speed(time) * (time / RAMP).min(1.0) * tick_s / radius;
            hand + (rise * (1.0 - f64::cos(turned)) + normal * f64::sin(turned)) * radius
        })
        .collect()
}

/// What ticks along a path gave.
#[derive(Default)]
struct Ticks {
    /// What the hand felt.
    felt: Vec<HandReport>,
    /// Times [ms].
    times: Vec<f64>,
    /// Iterations of conjugate gradients.
    iterations: Vec<u32>,
    /// Sum of the times in each phase [ms].
    phase_ms: [f64; Phase::ALL.len()],
    /// Particles of the mesh in the end.
    particles_active: usize,
}

/// Steps the world along the path.
fn follow(world: &mut World, path: &[Vec3], dt: f64, solves: u32) -> Ticks {
    let stopwatch = Stopwatch::default();
    let ended = |phase| stopwatch.ended(phase);
    let budget = Budget { watch: Watch(Some(&ended)), ..Budget::solves(solves) };
    let mut ticks = Ticks::default();
    world.observe_every(OBSERVATION);
    let every = (LOOK / dt).round().max(1.0) as usize;
    let mut changes = Changes::default();
    for (k, &position) in path.iter().enumerate() {
        let commands = [Command::Move { position }];
        let start = Instant::now();
        // What is left behind is freed when the tick is over, as sessions do.
        let old = changes.before_step(world, &commands, dt, solves);
        stopwatch.start();
        let report = world.step(&commands, dt, budget).clone();
        let mut time = start.elapsed();
        drop(old);
        if (k + 1) % every == 0
            && !changes.is_under_way()
            && let Some(prepared) = world.probe().and_then(|probe| probe.prepare())
        {
            let usual = median(ticks.times.iter().copied().chain([time.as_secs_f64() * 1e3]));
            let start = Instant::now();
            let old = changes.begin(world, prepared, usual * 1e-3, dt);
            time += start.elapsed();
            drop(old);
        }
        ticks.times.push(time.as_secs_f64() * 1e3);
        if changes.is_under_way() {
            // Ticks come no faster than in a session.
            thread::sleep(Duration::from_secs_f64(dt).saturating_sub(time));
        }
        ticks.felt.push(report.hand.expect("a held hand"));
        ticks.iterations.push(stopwatch.lap(Phase::Iteration).count);
        let laps = Phase::ALL.map(|phase| stopwatch.lap(phase).seconds * 1e3);
        ticks.phase_ms.iter_mut().zip(laps).for_each(|(sum, ms)| *sum += ms);
    }
    ticks.particles_active = world.report().particles_active;
    ticks
}
