//! Checks of the mechanics against closed forms, integrated references and identities, all through `World`.
//!
//! A check is a struct of its parameters; it runs alone or in the suite and returns rows, which compare a measured value with its
//! reference. Nothing here prints, plots or reads a clock. A check that cannot come to a result fails with the reason in its row.

use crate::world::Refused;
use serde::Serialize;
use std::sync::{
    Mutex,
    atomic::{AtomicUsize, Ordering},
};

pub mod elastica;
pub mod strip;
pub mod mesh;
pub mod cantilever;
pub mod hanging;
pub mod loops;
pub mod buckling;
pub mod kes;
pub mod patch;
pub mod identities;
pub mod dynamics;
pub mod cusick;
pub mod convergence;

pub use buckling::{Lateral, Standing};
pub use cantilever::{Cantilever, Order, TipLoad};
pub use convergence::Convergence;
pub use cusick::Cusick;
pub use dynamics::Dynamics;
pub use hanging::{Catenary, Vertical};
pub use identities::Identities;
pub use kes::Kes;
pub use loops::Loops;
pub use patch::Patch;

/// A measured value beside its reference.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// What is compared; the same for every case of a check.
    pub name: String,
    /// The parameters of this case.
    pub case: String,
    /// Value of the simulation; none where there was no result.
    pub measured: Option<f64>,
    /// Value of the reference; a limit where a value must only stay on one side of it.
    pub reference: f64,
    /// How far the measured value is from where it must be, over the reference (over a natural scale where that is 0).
    pub relative_error: Option<f64>,
    /// Largest relative error that passes; none where the value is only reported.
    pub tolerance: Option<f64>,
    /// Whether the error is within the tolerance.
    pub pass: bool,
    /// What explains the value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

impl Row {
    /// A value against its reference, with the largest relative error that passes.
    pub fn compare(name: &str, case: &str, measured: f64, reference: f64, tolerance: f64) -> Row {
        Row::with_error(
            name,
            case,
            [measured, reference],
            (measured - reference).abs() / reference.abs(),
            tolerance,
        )
    }

    /// A relative error that ideally is 0.
    pub fn vanishes(name: &str, case: &str, error: f64, tolerance: f64) -> Row {
        Row::with_error(name, case, [error, 0.0], error.abs(), tolerance)
    }

    /// A value that must be `least` or more.
    pub fn at_least(name: &str, case: &str, measured: f64, least: f64) -> Row {
        let missing = if measured >= least { 0.0 } else { (least - measured) / least.abs() };
        Row::with_error(name, case, [measured, least], missing, 0.0)
    }

    /// A value that is reported beside its reference and judged by nothing but being finite.
    pub fn report(name: &str, case: &str, measured: f64, reference: f64) -> Row {
        let row = Row::compare(name, case, measured, reference, f64::INFINITY);
        Row { tolerance: None, ..row }
    }

    /// A check without a result.
    pub fn failed(name: &str, case: &str, why: &str) -> Row {
        let row = Row::with_error(name, case, [f64::NAN, 0.0], f64::NAN, 0.0);
        row.because(why)
    }

    /// The same with an explanation.
    pub fn because(self, note: &str) -> Row {
        Row { note: Some(note.to_owned()), ..self }
    }

    fn with_error(
        name: &str,
        case: &str,
        [measured, reference]: [f64; 2],
        error: f64,
        tolerance: f64,
    ) -> Row {
        let finite = |v: f64| v.is_finite().then_some(v);
        Row {
            name: name.to_owned(),
            case: case.to_owned(),
            measured: finite(measured),
            reference,
            relative_error: finite(error),
            tolerance: Some(tolerance),
            pass: error.is_finite() && error <= tolerance,
            note: None,
        }
    }
}

/// Curves over common axes.
#[derive(Clone, Debug, Default)]
pub struct Plot {
    /// What it shows.
    pub title: String,
    /// Abscissa and ordinate with their units.
    pub labels: [String; 2],
    /// Both axes logarithmic; else linear.
    pub logarithmic: bool,
    /// One unit of length is as long on both axes: shapes.
    pub square: bool,
    /// The curves.
    pub series: Vec<Series>,
}

/// A curve of a plot.
#[derive(Clone, Debug)]
pub struct Series {
    /// Its name in the legend.
    pub name: String,
    /// Drawn as dots (measured) or as a line (reference).
    pub dots: bool,
    /// Points.
    pub points: Vec<[f64; 2]>,
}

impl Series {
    /// A reference, drawn as a line.
    pub fn line(name: &str, points: Vec<[f64; 2]>) -> Series {
        Series { name: name.to_owned(), dots: false, points }
    }

    /// Measured points.
    pub fn dots(name: &str, points: Vec<[f64; 2]>) -> Series {
        Series { name: name.to_owned(), dots: true, points }
    }
}

/// What a check found.
#[derive(Clone, Debug, Default)]
pub struct Findings {
    /// Comparisons.
    pub rows: Vec<Row>,
    /// Pictures of them.
    pub plots: Vec<Plot>,
}

/// What a run of a check may use besides its parameters.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// Seed of everything random.
    pub seed: u64,
    /// Called with the fraction of the check that is done.
    pub progress: &'a (dyn Fn(f64) + Sync),
}

/// Lists the checks once: variant, name on the command line, and what it is.
macro_rules! checks {
    ($($(#[$doc:meta])* $check:ident = $name:literal,)*) => {
        /// A check with its parameters; `kesi validate CHECK --help` lists them.
        #[derive(Clone, Debug, clap::Subcommand)]
        pub enum Check {
            $($(#[$doc])* #[command(name = $name)] $check($check),)*
        }

        impl Check {
            /// Name on the command line.
            pub fn name(&self) -> &'static str {
                match self {
                    $(Check::$check(_) => $name,)*
                }
            }

            /// Runs the check; refuses parameters outside their range.
            pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
                match self {
                    $(Check::$check(check) => check.run(context),)*
                }
            }
        }

        /// All checks with the parameters of the suite, or those of the reduced one.
        pub fn suite(quick: bool) -> Vec<Check> {
            let mut checks = Vec::new();
            $(checks.extend($check::suite(quick).into_iter().map(Check::$check));)*
            checks
        }
    };
}

checks! {
    /// A strip clamped level, bent by its own weight, against the elastica.
    Cantilever = "cantilever",
    /// KES tests of simulated specimens, and arbitrary histories of manipulation.
    Kes = "kes",
    /// Cusick drape of fabrics whose coefficient was measured.
    Cusick = "cusick",
    /// The cantilever over meshes: order of convergence, and the half cell at the clamp.
    Order = "order",
    /// Error of force and shape of several cloths and fabrics over meshes, and the rule for choosing one.
    Convergence = "convergence",
    /// A weightless strip clamped level, bent by a load at its tip, against the elastica.
    TipLoad = "tip-load",
    /// A limp strip hung from two points, against the elastic catenary.
    Catenary = "catenary",
    /// A strip of real fabric hung from one end, against its tensile curve.
    Vertical = "vertical",
    /// Pear, heart and ring, weightless and heavy, against the elastica.
    Loops = "loops",
    /// A strip standing on a clamp: the weight at which it buckles.
    Standing = "standing",
    /// A strip clamped on edge: the weight at which it turns over.
    Lateral = "lateral",
    /// Constant strain, constant shear, cylinders along warp, weft and bias.
    Patch = "patch",
    /// Balance, force and stiffness against differences, symmetries, dissipation, energy, at random poses of random fabrics.
    Identities = "identities",
    /// Free fall, terminal velocity, periods, order of the time integrator.
    Dynamics = "dynamics",
}

/// Runs the checks on some threads; calls `progress` with a check's place and the done fraction, and `found` in order. A check that
/// is refused makes a failed row.
pub fn run(
    checks: &[Check],
    threads: usize,
    seed: u64,
    progress: &(dyn Fn(usize, f64) + Sync),
    found: &mut (dyn FnMut(&Check, &Findings) + Send),
) -> Vec<Findings> {
    let next = AtomicUsize::new(0);
    let done = Mutex::new((vec![None; checks.len()], 0, found));
    std::thread::scope(|scope| {
        for _ in 0..threads.clamp(1, checks.len().max(1)) {
            scope.spawn(|| {
                loop {
                    let place = next.fetch_add(1, Ordering::Relaxed);
                    let Some(check) = checks.get(place) else { return };
                    let tell = |fraction: f64| progress(place, fraction);
                    let findings = check.run(&Context { seed, progress: &tell }).unwrap_or_else(|e| {
                        Findings { rows: vec![Row::failed(check.name(), "", &e.0)], plots: Vec::new() }
                    });
                    progress(place, 1.0);
                    let mut done = done.lock().expect("no check panics");
                    let (results, told, found) = &mut *done;
                    results[place] = Some(findings);
                    while let Some(Some(findings)) = results.get(*told) {
                        found(&checks[*told], findings);
                        *told += 1;
                    }
                }
            });
        }
    });
    let (results, ..) = done.into_inner().expect("no check panics");
    results.into_iter().map(|r| r.expect("every check has run")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_passes_only_within_its_tolerance_and_with_finite_numbers() {
        assert!(Row::compare("a", "", 1.001, 1.0, 2e-3).pass);
        assert!(!Row::compare("a", "", 1.003, 1.0, 2e-3).pass);
        assert!(!Row::compare("a", "", f64::NAN, 1.0, 2e-3).pass);
        assert!(Row::at_least("a", "", 1.95, 1.9).pass && !Row::at_least("a", "", 1.85, 1.9).pass);
        assert!(Row::report("a", "", 2.0, 1.0).pass && !Row::report("a", "", f64::INFINITY, 1.0).pass);
        assert!(!Row::failed("a", "", "no rest").pass);
    }

    #[test]
    fn a_refused_check_fails_and_the_order_of_checks_is_kept() {
        let bad = Cantilever { gamma: vec![-1.0], ..Cantilever::default() };
        let good = Cantilever { gamma: vec![3.0], particles: 9, ..Cantilever::default() };
        let checks = [Check::Cantilever(good), Check::Cantilever(bad)];
        let mut order = Vec::new();
        let findings = run(&checks, 2, 0, &|_, _| {}, &mut |_, f| order.push(f.rows.len()));
        assert_eq!(order, [2, 1]);
        assert!(!findings[1].rows[0].pass && findings[1].rows[0].note.as_ref().unwrap().contains("gamma"));
    }
}
