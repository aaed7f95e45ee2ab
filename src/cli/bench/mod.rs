//! `kesi bench`: run time against error, measured on worlds without a server. Each prints a table and, if asked, one JSON object.

mod adapt;
mod branch;
pub mod contact;
mod follow;
mod live;
mod meter;
mod scaling;
mod settle;
mod skip;
mod table;

use super::{output::Output, sorted::Sorted};
use clap::{Args, Subcommand};
use serde::Serialize;
use std::error::Error;

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
    /// Particles against force, stiffness, shape and energy: adaptive meshes beside uniform ones.
    #[command(
        mut_arg("solves", |a| a.default_value("60")),
        mut_arg("every", |a| a.default_value("24"))
    )]
    Adapt(adapt::Args),
    /// Adaptive sheets under a moving hand, beside dense ones: force errors, and jumps where the mesh changes.
    #[command(
        mut_arg("tick_s", |a| a.default_value("0.01")),
        mut_arg("every", |a| a.default_value("8"))
    )]
    Follow(follow::Args),
    /// Violent manipulations near obstacles, judged by an independent check of all gaps.
    Contact(contact::Args),
    /// Every method on the drape scene: time, particles, iterations and errors, with a report.
    Table(table::Args),
    /// Time per tick, time to rest and memory against particles.
    Scaling(scaling::Args),
    /// What skipped work saves, and that the result stays the same.
    Skip(skip::Args),
    /// Tick times and force errors under a moving hand, against the fully converged path.
    Live(live::Args),
    /// The same in ticks of 1 ms, with one solve each.
    #[command(
        mut_arg("tick_s", |a| a.default_value("0.001")),
        mut_arg("solves", |a| a.default_value("1")),
        mut_arg("scenes", |a| a.default_value("hang,drape")),
        mut_arg("particles", |a| a.default_value("39,77")),
        mut_arg("adaptive", |a| a.default_value("77")),
        mut_arg("hand", |a| a.default_value("free,pressing")),
        mut_arg("speed", |a| a.default_value("0.1,0.3")),
        mut_arg("methods", |a| a.default_value("fronts,multigrid"))
    )]
    Tick(live::Args),
}

/// Runs a bench.
pub fn run(command: &BenchCommand) -> Result<(), Box<dyn Error>> {
    match &command.which {
        Which::Adapt(args) => adapt::run(args),
        Which::Follow(args) => follow::run(args),
        Which::Scaling(args) => scaling::run(args),
        Which::Skip(args) => skip::run(args),
        Which::Table(args) => table::run(args),
        Which::Settle(args) => settle::run(args),
        Which::Contact(args) => contact::run(args),
        Which::Live(args) | Which::Tick(args) => live::run(args),
    }
}

/// Errors of the hand's force, relative.
#[derive(Serialize)]
struct ForceErrors {
    force_error_median: f64,
    force_error_p95: f64,
    force_error_max: f64,
}

impl ForceErrors {
    fn of(errors: impl IntoIterator<Item = f64>) -> ForceErrors {
        let errors = Sorted::of(errors);
        ForceErrors {
            force_error_median: errors.at(0.5),
            force_error_p95: errors.at(0.95),
            force_error_max: errors.at(1.0),
        }
    }
}
