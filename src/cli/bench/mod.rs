//! `kesi bench`: run time against error, measured on worlds without a server. Each prints a table and, if asked, one JSON object.

mod live;
mod settle;

use clap::{Args, Subcommand};
use serde::Serialize;
use std::{error::Error, io::Write, path::PathBuf};

/// Measures run time against error.
#[derive(Debug, Args)]
pub struct BenchCommand {
    #[command(subcommand)]
    which: Which,
}

#[derive(Debug, Subcommand)]
enum Which {
    /// Time, ticks and solves from the scene's start to rest.
    Settle(settle::Args),
    /// Tick times and force errors under a moving hand, against the fully converged path.
    Live(live::Args),
}

/// Where results go.
#[derive(Clone, Debug, Args)]
struct Output {
    /// Writes the rows as one JSON object; `-` is stdout, and the table then goes to stderr.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Runs a bench.
pub fn run(command: &BenchCommand) -> Result<(), Box<dyn Error>> {
    match &command.which {
        Which::Settle(args) => settle::run(args),
        Which::Live(args) => live::run(args),
    }
}

/// One JSON object of results.
#[derive(Serialize)]
struct Results<'a, Row> {
    command: String,
    version: &'static str,
    machine: String,
    seed: u64,
    rows: &'a [Row],
}

impl Output {
    /// Prints a line of the table.
    fn line(&self, text: &str) {
        if self.json.as_ref().is_some_and(|f| f.as_os_str() == "-") {
            eprintln!("{text}");
        } else {
            println!("{text}");
        }
    }

    /// Writes the rows where they were asked for. Nothing here is random: the seed is 0.
    fn write<Row: Serialize>(&self, rows: &[Row]) -> Result<(), Box<dyn Error>> {
        let Some(file) = &self.json else { return Ok(()) };
        let command = std::env::args().skip(1).collect::<Vec<_>>().join(" ");
        let version = env!("CARGO_PKG_VERSION");
        let text =
            serde_json::to_string_pretty(&Results { command, version, machine: machine(), seed: 0, rows })?;
        if file.as_os_str() == "-" {
            writeln!(std::io::stdout(), "{text}")?;
        } else {
            std::fs::write(file, text + "\n").map_err(|e| format!("{}: {e}", file.display()))?;
        }
        Ok(())
    }
}

/// Processor and cores, as far as the system tells.
fn machine() -> String {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model =
        text.lines().find_map(|l| l.strip_prefix("model name")?.split_once(':').map(|(_, m)| m.trim()));
    format!("{}, {cores} cores, {}", model.unwrap_or(std::env::consts::ARCH), std::env::consts::OS)
}

/// The value below which the fraction `q` of sorted values lies (nearest rank).
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let rank = (q * sorted.len() as f64).ceil() as usize;
    sorted[rank.clamp(1, sorted.len()) - 1]
}
