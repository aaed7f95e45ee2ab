//! Results of a command: a table for people and, if asked, one JSON object for machines.

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use std::{
    error::Error,
    io::{ErrorKind, Write},
    path::PathBuf,
};

/// Where results go.
#[derive(Clone, Debug, Args)]
pub(super) struct Output {
    /// Writes the rows as one JSON object; `-` is stdout, and the table then goes to stderr.
    #[arg(long, value_name = "FILE", global = true, value_parser = placed)]
    json: Option<PathBuf>,
}

/// A file in a folder that is there: else a long command would lose its results in the end.
fn placed(text: &str) -> Result<PathBuf, String> {
    let file = PathBuf::from(text);
    let folder = file.parent().filter(|f| !f.as_os_str().is_empty());
    match folder.filter(|f| !f.is_dir()) {
        Some(missing) => Err(format!("there is no folder {}", missing.display())),
        None => Ok(file),
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
    /// Prints a line of the table. Whoever closes the pipe early has read enough; files that were asked for are still written.
    pub(super) fn line(&self, text: &str) {
        if self.json.as_ref().is_some_and(|f| f.as_os_str() == "-") {
            eprintln!("{text}");
        } else if let Err(e) = writeln!(std::io::stdout(), "{text}")
            && e.kind() != ErrorKind::BrokenPipe
        {
            panic!("stdout: {e}");
        }
    }

    /// Writes the rows where they were asked for, with the seed of what was random (0 where nothing was).
    pub(super) fn write<Row: Serialize>(&self, seed: u64, rows: &[Row]) -> Result<(), Box<dyn Error>> {
        let Some(file) = &self.json else { return Ok(()) };
        let results = Results {
            command: command(),
            version: env!("CARGO_PKG_VERSION"),
            machine: machine(),
            seed,
            rows,
        };
        let text = serde_json::to_string_pretty(&results)?;
        if file.as_os_str() == "-" {
            writeln!(std::io::stdout(), "{text}")?;
        } else {
            std::fs::write(file, text + "\n").map_err(|e| format!("{}: {e}", file.display()))?;
        }
        Ok(())
    }
}

/// A progress bar with the time left; indicatif hides it where stderr is no terminal.
pub(super) fn progress(steps: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} {elapsed}, {eta} left {msg}")
        .expect("a valid template");
    ProgressBar::new(steps as u64).with_style(style)
}

/// The command line without the program's name.
pub(super) fn command() -> String {
    std::env::args().skip(1).collect::<Vec<_>>().join(" ")
}

/// Processor and cores, as far as the system tells.
pub(super) fn machine() -> String {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model =
        text.lines().find_map(|l| l.strip_prefix("model name")?.split_once(':').map(|(_, m)| m.trim()));
    format!("{}, {cores} cores, {}", model.unwrap_or(std::env::consts::ARCH), std::env::consts::OS)
}
