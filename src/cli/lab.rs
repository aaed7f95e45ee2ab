//! `kesi lab`: the KES tests of a fabric on simulated specimens, with every parameter's error and the loops drawn.

use super::{fabric::find, output::Output, validate};
use crate::{
    fabric::Library,
    validate::{Context, Findings, kes::Tests},
};
use clap::Args;
use std::{error::Error, path::PathBuf};

/// Repeats the KES tests on simulated specimens; fails if a parameter does not come back.
#[derive(Debug, Args)]
pub struct LabCommand {
    /// Names, or paths that end in .toml; `all` for every fabric there is.
    #[arg(required = true)]
    fabric: Vec<String>,
    /// Folder with more fabric files; they go before the built-in ones.
    #[arg(long, value_name = "DIR")]
    fabrics: Option<PathBuf>,
    #[command(flatten)]
    tests: Tests,
    /// Seed of the arbitrary histories.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Draws given and simulated loops, and the histories in their envelopes, as one picture.
    #[cfg(feature = "plot")]
    #[arg(long, value_name = "FILE.svg")]
    plot: Option<PathBuf>,
    /// Writes table and pictures as one self-contained HTML file.
    #[cfg(feature = "plot")]
    #[arg(long, value_name = "FILE.html")]
    report: Option<PathBuf>,
    #[command(flatten)]
    output: Output,
}

/// Runs the lab.
pub fn run(command: &LabCommand) -> Result<(), Box<dyn Error>> {
    let library = Library { folder: command.fabrics.clone() };
    let every = command.fabric.iter().any(|name| name == "all");
    let names = if every { library.names() } else { command.fabric.clone() };
    let files = names.iter().map(|name| find(&library, name)).collect::<Result<Vec<_>, _>>()?;
    let context = Context { seed: command.seed, progress: &|_| {} };
    command.output.line(&validate::heading());
    let mut found: Vec<(String, Findings)> = Vec::new();
    for file in &files {
        let findings = command.tests.run(file, &context)?;
        findings.rows.iter().for_each(|row| command.output.line(&validate::line(row)));
        found.push((file.title.clone(), findings));
    }
    let rows: Vec<_> = found.iter().flat_map(|f| f.1.rows.clone()).collect();
    command.output.write(command.seed, &rows)?;
    #[cfg(feature = "plot")]
    draw(command, &found)?;
    let failed = rows.iter().filter(|r| !r.pass).count();
    if failed > 0 {
        return Err(format!("{failed} of {} rows fail", rows.len()).into());
    }
    command.output.line(&format!("all {} rows hold", rows.len()));
    Ok(())
}

#[cfg(feature = "plot")]
fn draw(command: &LabCommand, found: &[(String, Findings)]) -> Result<(), Box<dyn Error>> {
    use validate::report;
    let write = |file: &PathBuf, text: String| {
        std::fs::write(file, text).map_err(|e| format!("{}: {e}", file.display()))
    };
    if let Some(file) = &command.plot {
        let plots: Vec<_> = found.iter().flat_map(|f| f.1.plots.clone()).collect();
        write(file, report::sheet(&plots, 3)?)?;
    }
    if let Some(file) = &command.report {
        let named: Vec<_> = found.iter().map(|(name, findings)| (name.clone(), findings)).collect();
        write(file, report::html(&named, command.seed)?)?;
    }
    Ok(())
}
