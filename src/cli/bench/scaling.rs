//! `kesi bench scaling`: time per tick, time to rest and memory against particles, with fitted exponents.
//!
//! Sizes go up, so what a size needs beyond the memory before the first is its own; freed memory of smaller ones is used again.

use super::{Output, meter};
use crate::{
    cli::{output::progress, positive, positive_or_zero, sorted::median},
    model::Setup,
    scene::Scene,
    world::{Budget, Method, World},
};
use serde::Serialize;
use std::{error::Error, time::Instant};

/// Growth with the number of particles.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Built-in scenes.
    #[arg(long, value_delimiter = ',', default_value = "drape,hang")]
    scenes: Vec<String>,
    /// Particles along warp and weft, ascending.
    #[arg(long, value_delimiter = ',', default_value = "20,39,77,153,309")]
    particles: Vec<usize>,
    /// Length of a timed tick [s]; it has one solve.
    #[arg(long, default_value_t = 0.001, value_parser = positive, allow_negative_numbers = true)]
    tick_s: f64,
    /// Timed ticks, after as many that are not.
    #[arg(long, default_value_t = 8)]
    ticks: usize,
    /// Times that all sizes have their turn, as the speed of a machine changes: a tick's time is the median of all.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Linear solver.
    #[arg(long, value_enum, default_value = "multigrid")]
    method: Method,
    /// Wall time on the way to rest at the most [s]; 0 does not look for rest.
    #[arg(long, default_value_t = 120.0, value_parser = positive_or_zero, allow_negative_numbers = true)]
    cap_s: f64,
    /// Particles 10, 20, 39 and 77, 5 s to rest: under a minute.
    #[arg(long)]
    quick: bool,
    #[command(flatten)]
    output: Output,
}

/// One size, or the growth over all sizes of a scene: time ∝ particles^exponent.
#[derive(Serialize)]
#[serde(untagged)]
enum Row {
    Size {
        scene: String,
        particles: usize,
        tick_ms: f64,
        /// Wall time to rest; none where the cap came first.
        rest_s: Option<f64>,
        memory_bytes: Option<u64>,
    },
    Fit {
        scene: String,
        tick_exponent: Option<f64>,
        rest_exponent: Option<f64>,
        memory_exponent: Option<f64>,
    },
}

/// Time of timed ticks at the least in a round [ms].
const LEAST: f64 = 500.0;
/// Ticks to rest [s] and their solves.
const TICK: f64 = 0.02;
const SOLVES: u32 = 2;

/// Runs the bench.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let particles = if args.quick { vec![10, 20, 39, 77] } else { args.particles.clone() };
    let cap = if args.quick { args.cap_s.min(5.0) } else { args.cap_s };
    if args.ticks == 0 || !particles.is_sorted() || particles.is_empty() {
        return Err(format!(
            "got --particles {particles:?} and --ticks {}, allowed: ascending, at least 1",
            args.ticks
        )
        .into());
    }
    let out = &args.output;
    let before = meter::resident();
    let bar = progress(particles.len() * args.scenes.len() * args.rounds as usize);
    let mut series: Vec<Series> = Vec::new();
    for round in 0..args.rounds {
        let scenes = particles.iter().flat_map(|&n| args.scenes.iter().map(move |name| (name, n)));
        for (at, (name, n)) in scenes.enumerate() {
            bar.set_message(format!("{name}, {n} × {n}"));
            if round == 0 {
                series.push(Series::begin(args, name, n, cap, before)?);
            } else {
                series[at].time(args, Vec::new())?;
            }
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    let mut sizes: Vec<Row> = series.into_iter().map(Series::row).collect();
    out.line("scene     particles    tick ms    rest s  memory MB");
    sizes.iter().for_each(|size| out.line(&line(size)));
    let mut rows = Vec::new();
    for name in &args.scenes {
        let of = |value: &dyn Fn(&Row) -> Option<f64>| {
            let points = sizes.iter().filter_map(|row| match row {
                Row::Size { scene, particles, .. } if scene == name => Some((*particles as f64, value(row)?)),
                _ => None,
            });
            exponent(&points.collect::<Vec<_>>())
        };
        let fit = Row::Fit {
            scene: name.clone(),
            tick_exponent: of(&|r| if let Row::Size { tick_ms, .. } = r { Some(*tick_ms) } else { None }),
            rest_exponent: of(&|r| if let Row::Size { rest_s, .. } = r { *rest_s } else { None }),
            memory_exponent: of(&|r| match r {
                Row::Size { memory_bytes, .. } => memory_bytes.filter(|b| *b > 0).map(|b| b as f64),
                Row::Fit { .. } => None,
            }),
        };
        out.line(&line(&fit));
        rows.push(fit);
    }
    sizes.extend(rows);
    out.write(0, &sizes)
}

/// What is measured of one size.
struct Series {
    scene: String,
    setup: Setup,
    particles: usize,
    /// Times of ticks [ms].
    times: Vec<f64>,
    rest_s: Option<f64>,
    memory_bytes: Option<u64>,
}

impl Series {
    /// Measures all that is measured once, and times the first round of ticks.
    fn begin(
        args: &Args,
        name: &str,
        n: usize,
        cap: f64,
        before: Option<u64>,
    ) -> Result<Series, Box<dyn Error>> {
        let scene = Scene::built_in(name)
            .ok_or_else(|| format!("--scenes: got {name:?}, allowed: {:?}", Scene::names()))?;
        let faults =
            |f: Vec<crate::scene::SceneError>| f.iter().map(|e| e.to_string()).collect::<Vec<_>>().join("\n");
        let setup = Scene { particles: [n, n], ..scene }.setup().map_err(faults)?;
        let cost = meter::Meter::start();
        let mut world = World::with_method(setup.clone(), args.method)?;
        let particles = world.report().particles_active;
        let times = ticks(args, &mut world);
        let memory = cost.stop().peak_bytes.zip(before).map(|(peak, before)| peak.saturating_sub(before));
        drop(world);
        let rest_s = if cap > 0.0 { settle(World::new(setup.clone())?, cap) } else { None };
        let mut series = Series {
            scene: name.to_owned(),
            setup,
            particles,
            times: Vec::new(),
            rest_s,
            memory_bytes: memory,
        };
        series.time(args, times)?;
        Ok(series)
    }

    /// A round of ticks, of which these are done. Those of small meshes are over before a machine shows how fast it is, so their sheets
    /// fall again.
    fn time(&mut self, args: &Args, mut times: Vec<f64>) -> Result<(), Box<dyn Error>> {
        while times.iter().sum::<f64>() < LEAST {
            times.extend(ticks(args, &mut World::with_method(self.setup.clone(), args.method)?));
        }
        self.times.extend(times);
        Ok(())
    }

    fn row(self) -> Row {
        let Series { scene, particles, times, rest_s, memory_bytes, .. } = self;
        Row::Size { scene, particles, tick_ms: median(times), rest_s, memory_bytes }
    }
}

/// The times of a falling sheet's timed ticks [ms].
fn ticks(args: &Args, world: &mut World) -> Vec<f64> {
    let tick = |_| {
        let start = Instant::now();
        world.step(&[], args.tick_s, Budget::solves(1));
        start.elapsed().as_secs_f64() * 1e3
    };
    (0..2 * args.ticks).map(tick).skip(args.ticks).collect()
}

/// Wall time to rest [s].
fn settle(mut world: World, cap: f64) -> Option<f64> {
    let start = Instant::now();
    while start.elapsed().as_secs_f64() < cap {
        if world.step(&[], TICK, Budget::solves(SOLVES)).resting {
            return Some(start.elapsed().as_secs_f64());
        }
    }
    None
}

/// The exponent of the power law through the points, by least squares of the logarithms.
fn exponent(points: &[(f64, f64)]) -> Option<f64> {
    let logs: Vec<(f64, f64)> = points.iter().map(|(x, y)| (x.ln(), y.ln())).collect();
    let n = logs.len() as f64;
    let [x, y] = [logs.iter().map(|p| p.0).sum::<f64>() / n, logs.iter().map(|p| p.1).sum::<f64>() / n];
    let spread: f64 = logs.iter().map(|p| (p.0 - x).powi(2)).sum();
    let along: f64 = logs.iter().map(|p| (p.0 - x) * (p.1 - y)).sum();
    (logs.len() > 1 && spread > 0.0).then(|| along / spread)
}

fn line(row: &Row) -> String {
    let some = |v: Option<f64>| v.map_or("-".to_owned(), |v| format!("{v:.2}"));
    match row {
        Row::Size { scene, particles, tick_ms, rest_s, memory_bytes } => format!(
            "{scene:9} {particles:9} {tick_ms:10.2} {:>9} {:>10}",
            some(*rest_s),
            some(memory_bytes.map(|b| b as f64 / 1e6))
        ),
        Row::Fit { scene, tick_exponent, rest_exponent, memory_exponent } => format!(
            "{scene:9} exponents {:>10} {:>9} {:>10}",
            some(*tick_exponent),
            some(*rest_exponent),
            some(*memory_exponent)
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponent_of_a_power_law_comes_back() {
        let points: Vec<(f64, f64)> = [400.0, 1521.0, 5929.0].map(|n: f64| (n, 3.0 * n.powf(1.2))).to_vec();
        assert!((exponent(&points).unwrap() - 1.2).abs() < 1e-12);
        assert_eq!(exponent(&points[..1]), None);
    }
}
