//! `kesi bench follow`: an adaptive sheet under a moving hand, beside the dense one that gets the same commands and budget.
//!
//! A drape has many equilibria, and what friction and hysteresis remember soon leads two runs apart. As long as both are on one branch
//! their forces are compared; then the adaptive sheet goes on from the dense one's state, and that is counted.

use super::{ForceErrors, Output, adapt::Pace, branch, live};
use crate::{
    adapt::Settings,
    cli::{output::progress, positive, sorted::median},
    math::Vec3,
    scene::Scene,
    world::{Budget, Command, Method, World},
};
use serde::Serialize;
use std::{error::Error, f64::consts::TAU, thread, time::Instant};

/// Time in which the speed of a hand that slows down goes down and up [s].
const SWING: f64 = 2.0;

/// Adaptive beside dense under a moving hand.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Built-in scenes.
    #[arg(long, value_delimiter = ',', default_value = "hang,drape")]
    scenes: Vec<String>,
    /// Particles along warp and weft of the dense sheet.
    #[arg(long, default_value_t = 77)]
    particles: usize,
    /// Speeds of the hand [m/s].
    #[arg(long, value_delimiter = ',', default_value = "0.1,0.3,0.5", value_parser = positive, allow_negative_numbers = true)]
    speed: Vec<f64>,
    /// Speed that the hand goes down to and comes back from every two seconds [m/s], instead of keeping its own.
    #[arg(long, value_parser = positive, allow_negative_numbers = true)]
    slowest: Option<f64>,
    /// Simulated time at each speed [s].
    #[arg(long, default_value_t = 20.0, value_parser = positive, allow_negative_numbers = true)]
    seconds: f64,
    /// Radius of the circle that the hand goes on [m].
    #[arg(long, default_value_t = 0.02, value_parser = positive, allow_negative_numbers = true)]
    radius: f64,
    /// Linear solver of both sheets. The mesh adapts as in sessions that are solved so.
    #[arg(long, value_enum, default_value = "fronts")]
    method: Method,
    /// A second dense sheet, whose hand is this far above the first one's [m]: how well a force can be known at all.
    #[arg(long, value_parser = positive, allow_negative_numbers = true)]
    nudge: Option<f64>,
    /// Error of the force over what is felt from which on copies of both sheets come to rest on the dense mesh, the hand held where it is: where
    /// they do so in other places they were on other branches, and the adaptive one goes on from the dense one's state [1].
    #[arg(long, default_value_t = 0.03, value_parser = positive, allow_negative_numbers = true)]
    suspect: f64,
    /// Turn of a cell above which it is split [rad], whatever merging saves, instead of what sessions do.
    #[arg(long, value_parser = positive, allow_negative_numbers = true)]
    threshold: Option<f64>,
    #[command(flatten)]
    pace: Pace,
    #[command(flatten)]
    output: Output,
}

#[derive(Serialize)]
struct Row {
    scene: String,
    threshold: Option<f64>,
    method: String,
    hand_speed_m_per_s: f64,
    hand_slowest_m_per_s: Option<f64>,
    /// On the mean over ticks.
    particles_active: f64,
    /// Median times of a tick.
    tick_ms: f64,
    dense_tick_ms: f64,
    /// Over the dense force, and over a tenth of the sheet's weight where that is smaller.
    #[serde(flatten)]
    errors: ForceErrors,
    twin: Option<Twin>,
    /// What changes of the mesh did to the next force.
    jump_max_n: f64,
    jump_max_relative: f64,
    changes: u64,
    splits: u64,
    merges: u64,
    /// How often both sheets were let come to rest, and how often they did so on other branches.
    branch_tests: u64,
    branch_changes: u64,
    /// Changes of the mesh after both came to rest, in one second.
    changes_at_rest: u64,
}

/// Another dense sheet beside the dense one.
#[derive(Serialize)]
struct Twin {
    /// How far its hand is off [m].
    nudge_m: f64,
    #[serde(flatten)]
    errors: ForceErrors,
}

/// Runs the bench.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let out = &args.output;
    if let (Some(slowest), Some(speed)) = (args.slowest, args.speed.iter().copied().reduce(f64::min))
        && slowest > speed
    {
        return Err(format!("--slowest {slowest}: must be above 0 and at most --speed {speed} m/s").into());
    }
    out.line("scene    m/s  particles  tick ms  dense | force error median   p95     max | jump max mN  relative | changes  splits  merges  other branches  at rest");
    let mut rows = Vec::new();
    for name in &args.scenes {
        let scene = Scene { particles: [args.particles; 2], ..Scene::named(name)? };
        let settled = live::at_rest(&scene)?;
        let mut dense = World::with_method(settled.setup().clone(), args.method)?;
        let rest = settled.snapshot();
        for &speed in &args.speed {
            dense.restore(&rest);
            let mut row = compare(args, &mut dense, speed)?;
            row.scene.clone_from(name);
            print(out, &row);
            rows.push(row);
        }
    }
    out.write(0, &rows)
}

fn compare(args: &Args, dense: &mut World, speed: f64) -> Result<Row, Box<dyn Error>> {
    let mut adaptive = Adaptive { sheet: branch::copy_of(dense)?, has_failed: false, jumps: [0.0; 2] };
    let mut twin = args.nudge.map(|nudge| branch::copy_of(dense).map(|world| (world, nudge))).transpose()?;
    let in_sessions = Settings::of(args.method);
    let settings = args.threshold.map_or(in_sessions, |angle| Settings { angle, ..Settings::default() });
    adaptive.sheet.set_adaptive(Some(settings));
    let ticks = (args.seconds / args.pace.tick_s).round().max(1.0) as u32;
    let path = live::circle(
        dense,
        args.radius,
        |time| speed_at(time, args.slowest.unwrap_or(speed), speed),
        args.pace.tick_s,
        ticks,
    );
    let (mut errors, mut twin_errors) = (Vec::new(), Vec::new());
    let (mut times, mut dense_times) = (Vec::new(), Vec::new());
    let (mut particles, mut tests, mut branches, mut counts) = (0.0, 0, 0, [0; 3]);
    let bar = progress(path.len());
    for (k, &position) in (0..).zip(&path) {
        let is_due = u64::is_multiple_of(k, args.pace.every);
        // Beside each other: on two cores that takes as long as the slower.
        let ((force, ms), (truth, dense_ms)) = thread::scope(|scope| {
            let own = scope.spawn(|| adaptive.tick(&args.pace, position, is_due));
            let truth = step(dense, &args.pace, position);
            (own.join().expect("a tick does not panic"), truth)
        });
        let felt = dense.model().felt_scale(truth.norm());
        let error = (force - truth).norm() / felt;
        dense_times.push(dense_ms);
        times.push(ms);
        if let Some((twin, nudge)) = &mut twin {
            let (force, _) = step(twin, &args.pace, position + Vec3::z() * *nudge);
            twin_errors.push((force - truth).norm() / felt);
        }
        let sheet = &mut adaptive.sheet;
        particles += sheet.report().particles_active as f64;
        let is_suspect = error > args.suspect;
        tests += u64::from(is_suspect);
        if is_suspect && branch::is_another(sheet, dense)? == Some(true) {
            branches += 1;
            add(&mut counts, sheet);
            // The dense sheet's counts are zero.
            sheet.restore(&dense.snapshot());
            sheet.set_adaptive(Some(settings));
        } else {
            errors.push(error);
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    let Adaptive { mut sheet, jumps, .. } = adaptive;
    let changes_at_rest = settle(args, &mut sheet)?;
    add(&mut counts, &sheet);
    Ok(Row {
        scene: String::new(),
        threshold: args.threshold,
        method: args.method.name(),
        hand_speed_m_per_s: speed,
        hand_slowest_m_per_s: args.slowest,
        particles_active: particles / path.len() as f64,
        tick_ms: median(times),
        dense_tick_ms: median(dense_times),
        errors: ForceErrors::of(errors),
        twin: args.nudge.map(|nudge_m| Twin { nudge_m, errors: ForceErrors::of(twin_errors) }),
        jump_max_n: jumps[0],
        jump_max_relative: jumps[1],
        changes: counts[0],
        splits: counts[1],
        merges: counts[2],
        branch_tests: tests,
        branch_changes: branches,
        changes_at_rest,
    })
}

/// Speed of the hand [m/s] after this time [s]: slowest at first.
fn speed_at(time: f64, slowest: f64, fastest: f64) -> f64 {
    let swung = 0.5 - 0.5 * f64::cos(TAU * time / SWING);
    slowest + (fastest - slowest) * swung
}

/// A step with the hand told to be here: its force, and how long that took [ms].
fn step(world: &mut World, pace: &Pace, position: Vec3) -> (Vec3, f64) {
    let start = Instant::now();
    let report = world.step(&[Command::Move { position }], pace.tick_s, Budget::solves(pace.solves));
    (report.hand.expect("a held hand").force, start.elapsed().as_secs_f64() * 1e3)
}

/// The sheet whose mesh changes as in a session: a copy on the new mesh makes the next step too and takes over then, unless the force would
/// jump; after one that did not, the next change is made at once.
struct Adaptive {
    sheet: World,
    has_failed: bool,
    /// The largest jumps [N] and over what is felt [1].
    jumps: [f64; 2],
}

impl Adaptive {
    fn tick(&mut self, pace: &Pace, position: Vec3, is_due: bool) -> (Vec3, f64) {
        let prepared = if is_due { self.sheet.probe().and_then(|probe| probe.prepare()) } else { None };
        let Some(prepared) = prepared else {
            if is_due {
                self.sheet.keep_mesh();
            }
            return step(&mut self.sheet, pace, position);
        };
        let at_once = std::mem::take(&mut self.has_failed);
        let changed = self.sheet.fork().on(prepared);
        let (without, ms) = step(&mut self.sheet, pace, position);
        let mut heir = match changed {
            Ok(heir) => heir,
            Err(declined) => {
                self.sheet.decline(declined);
                self.has_failed = !at_once;
                return (without, ms);
            }
        };
        let (force, heir_ms) = step(&mut heir, pace, position);
        if at_once {
            std::mem::swap(&mut self.sheet, &mut heir);
        } else if !self.sheet.succeed(&mut heir) {
            self.has_failed = true;
            return (without, ms);
        }
        let jump = (force - without).norm();
        let felt = self.sheet.model().felt_scale(without.norm());
        self.jumps = [self.jumps[0].max(jump), self.jumps[1].max(jump / felt)];
        (force, heir_ms)
    }
}

/// Adds what became of a sheet's mesh.
fn add(counts: &mut [u64; 3], sheet: &World) {
    let made = sheet.report().remeshing;
    let made = [made.changes, made.splits, made.merges];
    counts.iter_mut().zip(made).for_each(|(sum, n)| *sum += n);
}

/// Lets the sheet come to rest; how often its mesh changes in a second after that.
fn settle(args: &Args, sheet: &mut World) -> Result<u64, Box<dyn Error>> {
    args.pace.settle(sheet)?;
    let before = sheet.report().remeshing.changes;
    for tick in 1..=(1.0 / args.pace.tick_s) as u64 {
        args.pace.tick(sheet, tick);
        sheet.adapt();
    }
    Ok(sheet.report().remeshing.changes - before)
}

fn print(out: &Output, row: &Row) {
    out.line(&format!(
        "{:6} {:5.2}  {:9.0}  {:7.1} {:6.1} | {:18.5} {:8.5} {:8.5} | {:11.3} {:9.5} | {:7} {:7} {:7} {:8} of {:3} {:8}",
        row.scene,
        row.hand_speed_m_per_s,
        row.particles_active,
        row.tick_ms,
        row.dense_tick_ms,
        row.errors.force_error_median,
        row.errors.force_error_p95,
        row.errors.force_error_max,
        row.jump_max_n * 1e3,
        row.jump_max_relative,
        row.changes,
        row.splits,
        row.merges,
        row.branch_changes,
        row.branch_tests,
        row.changes_at_rest
    ));
    if let Some(twin) = &row.twin {
        out.line(&format!(
            "        a dense sheet whose hand is off by {:e} m errs by {:.5} {:.5} {:.5}",
            twin.nudge_m,
            twin.errors.force_error_median,
            twin.errors.force_error_p95,
            twin.errors.force_error_max
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::speed_at;

    #[test]
    fn a_hand_that_slows_down_goes_from_one_speed_to_the_other_and_back() {
        let speeds = [0.0, 0.5, 1.0, 1.5, 2.0].map(|time| speed_at(time, 0.1, 0.5));
        for (speed, wanted) in speeds.iter().zip([0.1, 0.3, 0.5, 0.3, 0.1]) {
            assert!((speed - wanted).abs() < 1e-12, "{speeds:?}");
        }
        assert_eq!(speed_at(0.7, 0.3, 0.3), 0.3);
    }
}
