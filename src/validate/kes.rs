//! The virtual KES lab as a check: every parameter of every fabric comes back, and any history stays a continuous path within the envelope.

use super::{Context, Findings, Plot, Row, Series, strip};
use crate::{
    fabric::{FabricFile, Library, file::Origin, law::Law, measured::Test, units::*},
    lab::{
        kes::{self, Lab, Tested},
        wander::{self, Carried, Verdict},
    },
    world::Refused,
};
use std::sync::Arc;

/// KES tests of simulated specimens, and arbitrary histories of manipulation.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Kes {
    /// Fabrics; all without.
    #[arg(long, value_delimiter = ',')]
    pub fabric: Vec<String>,
    /// How they are tested.
    #[command(flatten)]
    pub tests: Tests,
}

/// How a fabric is tested.
#[derive(Clone, Debug, clap::Args)]
pub struct Tests {
    /// Intervals of particles between the clamps.
    #[arg(long, default_value_t = Tests::default().intervals)]
    pub intervals: usize,
    /// Samples per leg of a test.
    #[arg(long, default_value_t = Tests::default().samples)]
    pub samples: usize,
    /// Lets the specimens of tension and shear wrinkle.
    #[arg(long)]
    pub wrinkle: bool,
    /// Steps of 8 ms of the hand that carries a sheet about.
    #[arg(long, default_value_t = Tests::default().steps)]
    pub steps: usize,
}

impl Default for Tests {
    fn default() -> Tests {
        Tests { intervals: 8, samples: 60, wrinkle: false, steps: 300 }
    }
}

/// Largest relative error of a recovered parameter.
const TOLERANCE: f64 = 0.01;
/// Largest force outside the envelope over the largest force: an element's by rounding, a specimen's by its free sides as well.
const OUTSIDE: [f64; 2] = [1e-9, 0.01];
/// Turns of the clamp in an arbitrary history.
const TURNS: usize = 20;
/// Particles along the side of the carried sheet.
const PARTICLES: usize = 16;
/// The tests with strain and force as plotted: name, unit, SI size of one unit.
const AXES: [(Test, [(&str, f64); 2]); 3] = [
    (Test::Tensile, [("tensile strain [%]", PERCENT), ("tension [gf/cm]", GF_PER_CM)]),
    (Test::Bending, [("curvature [1/cm]", PER_CM), ("moment per width [gf.cm/cm]", GF_CM_PER_CM)]),
    (Test::Shear, [("shear angle [deg]", DEGREE), ("shear force [gf/cm]", GF_PER_CM)]),
];

impl Kes {
    /// The suite's checks: one per fabric, so that they run side by side.
    pub fn suite(quick: bool) -> Vec<Kes> {
        let one = |name: String| Kes { fabric: vec![name], tests: Tests::default() };
        let mut checks: Vec<Kes> = Library::default().names().into_iter().map(one).collect();
        if quick {
            checks.retain(|c| c.fabric[0] == "denim-c");
            checks.iter_mut().for_each(|c| c.tests = Tests { samples: 40, steps: 60, ..Tests::default() });
        }
        checks
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        let library = Library::default();
        let names = if self.fabric.is_empty() { library.names() } else { self.fabric.clone() };
        let mut findings = Findings::default();
        for (k, name) in names.iter().enumerate() {
            let file = library.read(name).map_err(|e| Refused(format!("fabric: {e}")))?;
            let own = |part: f64| (context.progress)((k as f64 + part) / names.len() as f64);
            let found = self.tests.run(&file, &Context { progress: &own, ..*context })?;
            findings.rows.extend(found.rows);
            findings.plots.extend(found.plots);
        }
        Ok(findings)
    }
}

impl Tests {
    /// Tests one fabric.
    pub fn run(&self, file: &FabricFile, context: &Context) -> Result<Findings, Refused> {
        strip::allow("steps", self.steps as f64, [1.0, 1e5])?;
        let lab = Lab { intervals: self.intervals, samples: self.samples, flat: !self.wrinkle };
        let mut findings = Findings::default();
        for (k, test) in kes::TESTS.into_iter().enumerate() {
            let tested = [lab.test(file, test, 0)?, lab.test(file, test, 1)?];
            findings.rows.extend(tested.iter().flat_map(|t| parameters(file, t)));
            findings.plots.push(loops(file, &tested));
            (context.progress)(0.2 * (k + 1) as f64);
        }
        for (k, test) in kes::TESTS.into_iter().enumerate() {
            let path =
                wander::in_machine(&file.fabric, test, self.intervals, [TURNS, self.samples], context.seed)?;
            let law = law(file, test);
            findings.rows.extend(verdict(file, test, "specimen", wander::judge(law, &path), OUTSIDE[1]));
            findings.plots.push(history(file, test, "specimen, clamp turned at random", &path));
            (context.progress)(0.6 + 0.05 * (k + 1) as f64);
        }
        let fabric = Arc::new(file.fabric.clone());
        let carried = Carried { fabric, particles: PARTICLES, steps: self.steps, seed: context.seed };
        let carry = carried.run()?;
        for ((test, verdicts), path) in kes::TESTS.into_iter().zip(carry.verdicts).zip(&carry.paths) {
            let case = format!("every element of {} in a carried sheet", carry.elements);
            findings.rows.extend(verdict(file, test, &case, verdicts, OUTSIDE[0]));
            findings.plots.push(history(file, test, "the element that lost most in a carried sheet", path));
        }
        Ok(findings)
    }
}

fn law(file: &FabricFile, test: Test) -> &Law {
    match test {
        Test::Tensile => &file.fabric.tensile[0],
        Test::Bending => &file.fabric.bending[0],
        Test::Shear => &file.fabric.shear,
    }
}

fn parameters(file: &FabricFile, tested: &Tested) -> Vec<Row> {
    let way = ["warp", "weft"][tested.direction];
    let row = |p: &kes::Parameter| {
        let case = format!("{} {way} [{}]", file.name, p.unit);
        let row = Row::compare(&format!("KES {}", p.name), &case, p.measured, p.reference, TOLERANCE);
        Row { note: p.note.clone(), ..row }
    };
    tested.parameters.iter().map(row).collect()
}

/// Rows of a verdict: within the envelope, and without jumps.
fn verdict(file: &FabricFile, test: Test, what: &str, verdict: Verdict, outside: f64) -> [Row; 2] {
    let case = format!("{} {}, {what}", file.name, kes::name(test));
    [
        Row::vanishes("KES history outside envelope", &case, verdict.outside, outside),
        Row::vanishes("KES history jump", &case, (verdict.jump - 1.0).max(0.0), 0.0),
    ]
}

fn plot(file: &FabricFile, test: Test, title: &str, series: Vec<Series>) -> Plot {
    let axes = AXES.iter().find(|a| a.0 == test).map_or(AXES[0].1, |a| a.1);
    let scaled = |s: Series| Series {
        points: s.points.iter().map(|p| [p[0] / axes[0].1, p[1] / axes[1].1]).collect(),
        ..s
    };
    Plot {
        title: format!("{} {}: {title}", file.name, kes::name(test)),
        labels: axes.map(|a| a.0.to_owned()),
        series: series.into_iter().map(scaled).collect(),
        ..Plot::default()
    }
}

/// Simulated loops of both directions over the given one.
fn loops(file: &FabricFile, tested: &[Tested; 2]) -> Plot {
    let test = tested[0].test;
    let origin = file.origins.iter().find(|o| o.0.starts_with(kes::name(test)));
    let given = origin.map_or_else(String::new, |o| match &o.1 {
        Origin::Parameters { provenance } => format!("made from {} parameters", provenance.name()),
        curve => curve.words(),
    });
    let [warp, weft] = tested;
    let series = vec![
        Series::line(&format!("given: {given}"), warp.given.clone()),
        Series::dots("simulated, warp", warp.samples.clone()),
        Series::dots("simulated, weft", weft.samples.clone()),
    ];
    plot(file, test, "given and simulated loop", series)
}

/// A path in the envelope of its law.
fn history(file: &FabricFile, test: Test, title: &str, path: &[[f64; 2]]) -> Plot {
    let law = law(file, test);
    let ends = path.iter().fold([f64::MAX, f64::MIN], |[l, h], s| [l.min(s[0]), h.max(s[0])]);
    let branch = |side: usize| {
        let even = (0..=200).map(|k| ends[0] + (ends[1] - ends[0]) * f64::from(k) / 200.0);
        even.map(|x| [x, law.envelope(x)[side]]).collect()
    };
    let series = vec![
        Series::line("envelope", branch(0)),
        Series::line("", branch(1)),
        Series::line("path", path.to_vec()),
    ];
    plot(file, test, title, series)
}
