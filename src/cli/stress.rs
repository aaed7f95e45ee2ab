//! `kesi stress`: random scenes under random abuse until the time or the count is over, with a table of what was tried and what held;
//! one case again from its line; a long session whose rest energy and memory must stay.

use super::output::{Output, progress};
use crate::stress::{self, Case, Findings, Invariant, Violation, soak};
use clap::Args;
use serde::Serialize;
use std::{
    error::Error,
    sync::{
        Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

/// Abuses random scenes and judges every step; fails if an invariant is violated.
#[derive(Debug, Args)]
pub struct StressCommand {
    /// Ends after so long [s]; without `--scenes`, one minute.
    #[arg(long, value_parser = super::positive)]
    seconds: Option<f64>,
    /// Ends after so many scenes: the same seed and count give the same result.
    #[arg(long)]
    scenes: Option<u64>,
    /// Seed of the first scene; the next ones follow.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Threads.
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Runs this one case, as printed for a failure.
    #[arg(long, value_name = "LINE", value_parser = Case::parse)]
    case: Option<Case>,
    /// Prints failing cases as they were met, without making them smaller.
    #[arg(long)]
    no_reduction: bool,
    /// Prints how long each case took that took longer than so long [s].
    #[arg(long, value_parser = super::positive)]
    slow_s: Option<f64>,
    /// Instead of scenes, one session of so many simulated hours, the hand coming back again and again.
    #[arg(long, value_name = "HOURS", value_parser = super::positive)]
    soak: Option<f64>,
    /// Scene of the session.
    #[arg(long, default_value = "hang")]
    soak_scene: String,
    /// Its particles along warp and weft.
    #[arg(long, default_value_t = 13)]
    soak_particles: usize,
    /// Simulated time between the visits of its hand [s].
    #[arg(long, default_value_t = 300.0, value_parser = super::positive)]
    soak_period_s: f64,
    /// Its fabric without hysteresis.
    #[arg(long)]
    soak_elastic: bool,
    /// Farthest that its hand goes in play, over the sheet's side.
    #[arg(long, default_value_t = soak::REACH, value_parser = super::positive)]
    soak_reach: f64,
    #[command(flatten)]
    output: Output,
}

/// A row of results: what was tried, how an invariant fared, or a failure.
#[derive(Clone, Debug, Default, Serialize)]
struct Row {
    /// `tried GROUP`, `invariant`, `total`, `failure` or `soak`.
    kind: String,
    /// What of it.
    name: String,
    /// How often it was tried or measured.
    count: u64,
    /// Violations of an invariant.
    #[serde(skip_serializing_if = "Option::is_none")]
    violations: Option<u64>,
    /// Largest ratio to the allowance; none where it is not finite.
    #[serde(skip_serializing_if = "Option::is_none")]
    worst_ratio: Option<f64>,
    /// A value of a total or of the session.
    #[serde(skip_serializing_if = "Option::is_none")]
    value: Option<f64>,
    /// Line that reproduces a failure, reduced and as met.
    #[serde(skip_serializing_if = "Option::is_none")]
    case: Option<[String; 2]>,
}

/// A failure: its case, the reduced one, the violation.
struct Failure {
    case: Case,
    reduced: Case,
    violation: Violation,
}

/// Failures that are reduced in one run.
const MOST_REDUCED: usize = 12;

/// Runs the command.
pub fn run(command: &StressCommand) -> Result<(), Box<dyn Error>> {
    if let Some(hours) = command.soak {
        return session(command, hours);
    }
    let mut sum = Findings::default();
    let mut failures = Vec::new();
    let mut scenes = 1;
    if let Some(case) = &command.case {
        sum = stress::run(case);
        if let Some(violation) = sum.violation.clone() {
            failures.push(Failure { case: case.clone(), reduced: case.clone(), violation });
        }
    } else {
        scenes = many(command, &mut sum, &mut failures);
    }
    let rows = report(command, scenes, &sum, &failures);
    command.output.write(command.seed, &rows)?;
    if failures.is_empty() {
        Ok(())
    } else {
        Err(format!("{} of {scenes} scenes fail", failures.len()).into())
    }
}

/// Runs scene after scene; how many there were.
fn many(command: &StressCommand, sum: &mut Findings, failures: &mut Vec<Failure>) -> u64 {
    let start = Instant::now();
    let none = command.seconds.is_none() && command.scenes.is_none();
    let seconds = command.seconds.or(none.then_some(60.0)).unwrap_or(f64::INFINITY);
    let most = command.scenes.unwrap_or(u64::MAX);
    // Progress by whichever end is nearer: scenes, or tenths of seconds.
    let bar = progress(command.scenes.unwrap_or((10.0 * seconds) as u64) as usize);
    let (next, done) = (AtomicU64::new(0), AtomicU64::new(0));
    let found = Mutex::new((sum, failures));
    std::thread::scope(|scope| {
        for _ in 0..command.threads.clamp(1, 64) {
            scope.spawn(|| {
                while start.elapsed() < Duration::from_secs_f64(seconds.min(1e9)) {
                    let place = next.fetch_add(1, Ordering::Relaxed);
                    if place >= most {
                        break;
                    }
                    let case = Case::draw(command.seed.wrapping_add(place));
                    let begun = Instant::now();
                    let findings = stress::run(&case);
                    let took = begun.elapsed().as_secs_f64();
                    if command.slow_s.is_some_and(|slow| took > slow) {
                        bar.suspend(|| {
                            eprintln!("{took:.1} s, {} steps: {case} {}", findings.steps, case.class())
                        });
                    }
                    let scenes = done.fetch_add(1, Ordering::Relaxed) + 1;
                    bar.set_position(match command.scenes {
                        Some(_) => scenes,
                        None => (10.0 * start.elapsed().as_secs_f64()) as u64,
                    });
                    bar.set_message(format!("{scenes} scenes"));
                    keep(command, &found, case, findings, &bar);
                }
            });
        }
    });
    bar.finish_and_clear();
    let failures = found.into_inner().map(|f| f.1).unwrap_or_else(|e| e.into_inner().1);
    failures.sort_by_key(|f| f.case.seed);
    done.into_inner()
}

/// Adds the findings of a case, its failure printed and made smaller.
fn keep(
    command: &StressCommand,
    found: &Mutex<(&mut Findings, &mut Vec<Failure>)>,
    case: Case,
    findings: Findings,
    bar: &indicatif::ProgressBar,
) {
    let lock = || found.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let count = {
        let mut found = lock();
        found.0.add(&findings);
        found.1.len()
    };
    let Some(violation) = findings.violation else { return };
    let small = !command.no_reduction && count < MOST_REDUCED;
    let reduced = if small { stress::reduce(&case, violation.invariant) } else { case.clone() };
    bar.suspend(|| eprintln!("{}: kesi stress --case '{reduced}'", violation.invariant.name()));
    lock().1.push(Failure { case, reduced, violation });
}

fn report(command: &StressCommand, scenes: u64, sum: &Findings, failures: &[Failure]) -> Vec<Row> {
    let out = &command.output;
    let mut rows = Vec::new();
    out.line(&format!("{:32} {:20} {:>9}", "tried", "", "times"));
    for ((group, name), &count) in &sum.tried {
        out.line(&format!("{group:32} {name:28} {count:>8}"));
        rows.push(Row { kind: format!("tried {group}"), name: name.clone(), count, ..Row::default() });
    }
    out.line(&format!("\n{:32} {:>12} {:>10} {:>14}", "invariant", "checks", "violations", "worst ratio"));
    for invariant in Invariant::ALL {
        let tally = sum.tallies.get(invariant).copied().unwrap_or_default();
        let (name, checks) = (invariant.name(), tally.checks);
        out.line(&format!("{name:32} {checks:>12} {:>10} {:>14.3e}", tally.violations, tally.worst));
        rows.push(Row {
            kind: "invariant".into(),
            name: name.into(),
            count: checks,
            violations: Some(tally.violations),
            worst_ratio: tally.worst.is_finite().then_some(tally.worst),
            ..Row::default()
        });
    }
    out.line("");
    let [not_finite, stalled] = sum.trouble;
    for (name, value) in [
        ("scenes", scenes as f64),
        ("steps", sum.steps as f64),
        ("linear solves", sum.solves as f64),
        ("simulated time [s]", sum.simulated),
        ("changes of the mesh", sum.remeshed as f64),
        ("steps rolled back, not finite", not_finite as f64),
        ("steps that stalled", stalled as f64),
        ("scenes that fail", failures.len() as f64),
    ] {
        out.line(&format!("{name:32} {value:>12.0}"));
        rows.push(Row { kind: "total".into(), name: name.into(), value: Some(value), ..Row::default() });
    }
    for Failure { case, reduced, violation } in failures {
        let Violation { invariant, ratio, step, note, .. } = violation;
        out.line(&format!("\nkesi stress --case '{reduced}'"));
        out.line(&format!("  {} (ratio {ratio:.3e}, step {step} of '{case}'): {note}", invariant.name()));
        rows.push(Row {
            kind: "failure".into(),
            name: invariant.name().into(),
            count: 1,
            worst_ratio: ratio.is_finite().then_some(*ratio),
            case: Some([reduced.to_string(), case.to_string()]),
            ..Row::default()
        });
    }
    rows
}

/// Relative difference of rest energies, and growth of memory, that are allowed.
const SAME_ENERGY: f64 = 1e-6;
const SAME_MEMORY: f64 = 0.02;

/// A session whose hand comes back again and again.
fn session(command: &StressCommand, hours: f64) -> Result<(), Box<dyn Error>> {
    let plan = soak::Soak {
        scene: command.soak_scene.clone(),
        particles: command.soak_particles,
        hours,
        period: command.soak_period_s,
        tick: 0.02,
        elastic: command.soak_elastic,
        reach: command.soak_reach,
    };
    let start = Instant::now();
    let most = command.seconds.unwrap_or(f64::INFINITY);
    let bar = progress((3600.0 * hours / plan.period).ceil() as usize);
    let mut last = None;
    let (mut changes, mut memory, mut restless) = (Vec::new(), Vec::new(), 0_u64);
    let mut energies = Vec::new();
    soak::run(&plan, &mut |stop| {
        bar.set_position(stop.visit);
        last = Some(*stop);
        restless += u64::from(!stop.resting);
        if stop.visit >= soak::FIRST {
            changes.extend(stop.change);
            energies.push(stop.energy / stop.scale);
            memory.extend(resident());
        }
        start.elapsed().as_secs_f64() < most
    })?;
    bar.finish_and_clear();
    let stop = last.ok_or("the session ended before a visit did; allowed: more hours or a shorter period")?;
    let grown =
        memory.first().zip(memory.iter().max()).map(|(first, most)| *most as f64 / *first as f64 - 1.0);
    let worst = changes.iter().copied().fold(0.0, f64::max);
    let mut rows = Vec::new();
    for (name, value) in [
        ("simulated time [h]", stop.time / 3600.0),
        ("visits", stop.visit as f64),
        ("visits without rest after", restless as f64),
        ("steps", stop.steps as f64),
        ("linear solves", stop.solves as f64),
        ("wall time [s]", start.elapsed().as_secs_f64()),
        ("visits that are compared", energies.len() as f64),
        ("branches", (energies.len() - changes.len()) as f64),
        ("rest energy, largest change on a branch", worst),
        ("memory, largest growth, relative", grown.unwrap_or(0.0)),
        ("memory [MiB]", memory.last().map_or(0.0, |m| *m as f64 / f64::from(1 << 20))),
    ] {
        command.output.line(&format!("{name:40} {value:>14.6e}"));
        rows.push(Row { kind: "soak".into(), name: name.into(), value: Some(value), ..Row::default() });
    }
    rows.extend(energies.iter().zip(soak::FIRST..).map(|(energy, visit)| Row {
        kind: "rest energy over weight times side".into(),
        name: format!("visit {visit}"),
        value: Some(*energy),
        ..Row::default()
    }));
    command.output.write(command.seed, &rows)?;
    if restless > 0 || worst > SAME_ENERGY || grown.is_some_and(|g| g > SAME_MEMORY) {
        return Err(format!(
            "the session changed: {restless} visits without rest, energy by {worst:.1e} on a branch (allowed {SAME_ENERGY:.0e}), memory {:.1} % (allowed {:.0} %)",
            100.0 * grown.unwrap_or(0.0),
            100.0 * SAME_MEMORY
        )
        .into());
    }
    if 2 * changes.len() < energies.len() || changes.is_empty() {
        return Err(format!(
            "{} of {} visits ended where one before had, allowed: half of those after the first {}, and one at least",
            changes.len(),
            energies.len(),
            soak::FIRST - 1
        )
        .into());
    }
    Ok(())
}

/// Resident memory of this process [bytes], as far as the system tells.
fn resident() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("VmRSS:"))?;
    Some(1024 * line.split_whitespace().next()?.parse::<u64>().ok()?)
}
