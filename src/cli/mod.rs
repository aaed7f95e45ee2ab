//! The command line: `serve` (the default), `drive`, `fabric`, `bench`, `validate`, `lab`, `stress`.

pub mod bench;
#[cfg(feature = "client")]
mod drive;
mod fabric;
mod lab;
mod output;
#[cfg(feature = "server")]
mod serve;
mod sorted;
mod stress;
mod validate;

use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// Live cloth with Kawabata (KES) mechanics that a hand can feel. Without a command: serve.
#[derive(Debug, Parser)]
#[command(name = "kesi", version, args_conflicts_with_subcommands = true)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[cfg(feature = "server")]
    #[command(flatten)]
    serve: serve::Args,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Serves live sessions over HTTP and WebSocket.
    #[cfg(feature = "server")]
    Serve(serve::Args),
    /// Moves a hand along a path on a running server; records poses, forces and round trips.
    #[cfg(feature = "client")]
    Drive(drive::Args),
    /// Measures run time against error.
    Bench(bench::BenchCommand),
    /// Checks the mechanics against closed forms and identities; fails if one check fails.
    Validate(validate::ValidateCommand),
    /// Abuses random scenes and judges every step; fails if an invariant is violated.
    Stress(stress::StressCommand),
    /// Repeats the KES tests on simulated specimens; fails if a parameter does not come back.
    Lab(lab::LabCommand),
    /// Lists, shows, checks and plots fabrics.
    Fabric(fabric::FabricCommand),
}

/// Runs the command of this process's arguments.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let done = match cli.command {
        #[cfg(feature = "server")]
        Some(Command::Serve(args)) => serve::run(&args),
        #[cfg(feature = "client")]
        Some(Command::Drive(args)) => drive::run(&args),
        Some(Command::Bench(command)) => bench::run(&command),
        Some(Command::Validate(command)) => validate::run(&command),
        Some(Command::Stress(command)) => stress::run(&command),
        Some(Command::Lab(command)) => lab::run(&command),
        Some(Command::Fabric(command)) => fabric::run(&command),
        #[cfg(feature = "server")]
        None => serve::run(&cli.serve),
        #[cfg(not(feature = "server"))]
        None => Err("this build has no server; see `kesi --help`".into()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("kesi: {e}");
            ExitCode::FAILURE
        }
    }
}

/// A size, time or speed on the command line.
fn positive(text: &str) -> Result<f64, String> {
    number(text, "above 0", |value| value > 0.0)
}

/// The same, where none has a meaning as well.
fn positive_or_zero(text: &str) -> Result<f64, String> {
    number(text, "0 or more", |value| value >= 0.0)
}

fn number(text: &str, allowed: &str, fits: fn(f64) -> bool) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|e| format!("{e}"))?;
    if fits(value) && value <= 1e5 { Ok(value) } else { Err(format!("allowed: {allowed}, at most 100000")) }
}

/// How a command ends: all right, or with the words for the user.
#[cfg(any(feature = "server", feature = "client"))]
type Done = Result<(), Box<dyn std::error::Error>>;

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn serve_is_the_default_command() {
        assert!(Cli::try_parse_from(["kesi"]).unwrap().command.is_none());
        #[cfg(feature = "server")]
        assert!(Cli::try_parse_from(["kesi", "--listen", "127.0.0.1:0"]).unwrap().command.is_none());
    }
}
