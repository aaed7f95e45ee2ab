//! `kesi validate`: the checks of `validate`, with a progress bar, a table, JSON and a report with plots.

#[cfg(feature = "plot")]
pub(super) mod report;

use super::output::Output;
use crate::validate::{self, Check, Context, Findings, Row};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use std::{error::Error, sync::Mutex};

/// Checks the mechanics against closed forms and identities; fails if one check fails.
#[derive(Debug, Args)]
pub struct ValidateCommand {
    /// One check alone, with its own parameters; without it, the whole suite.
    #[command(subcommand)]
    check: Option<Check>,
    /// The reduced suite of `make test`.
    #[arg(long)]
    quick: bool,
    /// Seed of everything random.
    #[arg(long, global = true, default_value_t = 1)]
    seed: u64,
    /// Threads.
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Writes a report with plots, one self-contained HTML file.
    #[cfg(feature = "plot")]
    #[arg(long, global = true, value_name = "FILE")]
    html: Option<std::path::PathBuf>,
    #[command(flatten)]
    output: Output,
}

/// Steps of the progress bar per check.
const FINE: u64 = 100;

/// Runs the checks.
pub fn run(command: &ValidateCommand) -> Result<(), Box<dyn Error>> {
    let (checks, findings) = match &command.check {
        Some(check) => alone(command, check)?,
        None => suite(command),
    };
    let rows: Vec<Row> = findings.iter().flat_map(|f| f.rows.clone()).collect();
    let failed = rows.iter().filter(|r| !r.pass).count();
    command.output.line(&format!("{} of {} rows hold", rows.len() - failed, rows.len()));
    command.output.write(command.seed, &rows)?;
    #[cfg(feature = "plot")]
    if let Some(file) = &command.html {
        let named: Vec<_> = checks.iter().map(|c| c.name().to_owned()).zip(&findings).collect();
        let text = report::html(&named, command.seed)?;
        std::fs::write(file, text).map_err(|e| format!("{}: {e}", file.display()))?;
    }
    #[cfg(not(feature = "plot"))]
    drop(checks);
    if failed > 0 { Err(format!("{failed} of {} rows fail", rows.len()).into()) } else { Ok(()) }
}

fn alone(command: &ValidateCommand, check: &Check) -> Result<(Vec<Check>, Vec<Findings>), Box<dyn Error>> {
    if command.quick {
        return Err("--quick: goes with the whole suite, not with one check".into());
    }
    let bar = bar(1);
    let progress = |fraction: f64| bar.set_position((FINE as f64 * fraction) as u64);
    let findings = check.run(&Context { seed: command.seed, progress: &progress })?;
    bar.finish_and_clear();
    command.output.line(&heading());
    findings.rows.iter().for_each(|row| command.output.line(&line(row)));
    Ok((vec![check.clone()], vec![findings]))
}

fn suite(command: &ValidateCommand) -> (Vec<Check>, Vec<Findings>) {
    let checks = validate::suite(command.quick);
    let bar = bar(checks.len() as u64);
    let places = Mutex::new(vec![0.0; checks.len()]);
    let progress = |place: usize, fraction: f64| {
        let mut places = places.lock().expect("nothing panics here");
        places[place] = fraction;
        bar.set_position((FINE as f64 * places.iter().sum::<f64>()) as u64);
    };
    command.output.line(&heading());
    let mut found = |check: &Check, findings: &Findings| {
        bar.suspend(|| findings.rows.iter().for_each(|row| command.output.line(&line(row))));
        bar.set_message(check.name());
    };
    let findings = validate::run(&checks, command.threads, command.seed, &progress, &mut found);
    bar.finish_and_clear();
    (checks, findings)
}

/// A progress bar over so many checks; indicatif hides it where stderr is no terminal.
fn bar(checks: u64) -> ProgressBar {
    let style =
        ProgressStyle::with_template("{bar:40} {percent:>3} % {elapsed} {msg}").expect("a valid template");
    ProgressBar::new(FINE * checks).with_style(style)
}

/// Heads of the table.
pub(super) fn heading() -> String {
    format!(
        "      {:32} {:34} {:>13} {:>13} {:>9} {:>9}",
        "", "", "measured", "reference", "error", "allowed"
    )
}

/// A row of the table.
pub(super) fn line(row: &Row) -> String {
    let number = |v: Option<f64>| v.map_or("-".to_owned(), |v| format!("{v:.6e}"));
    let short = |v: Option<f64>| v.map_or("-".to_owned(), |v| format!("{v:.1e}"));
    let pass = if row.pass { "ok" } else { "FAIL" };
    let [measured, reference] = [row.measured, Some(row.reference)].map(number);
    let [error, tolerance] = [row.relative_error, row.tolerance].map(short);
    let note = row.note.as_ref().map_or(String::new(), |n| format!("  {n}"));
    let (name, case) = (&row.name, &row.case);
    format!("{pass:5} {name:32} {case:34} {measured:>13} {reference:>13} {error:>9} {tolerance:>9}{note}")
}
