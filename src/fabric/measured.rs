//! Measured or digitized KES curves from CSV: one file per test and direction, a `#` header, then `x,y` in time order.
//!
//! ```text
//! # fabric: denim-a
//! # test: tensile              (tensile, bending, shear)
//! # direction: warp            (warp, weft, both)
//! # x unit: %                  (tensile % or 1; bending 1/cm or 1/m; shear deg or rad)
//! # y unit: gf/cm              (tensile, shear: gf/cm or N/m; bending: gf.cm/cm or N)
//! # max load: 500 gf/cm        (tensile only)
//! # pretension: 10 gf/cm       (shear only)
//! # kind: measured             (measured, digitised)
//! # source: who, where, when
//! # licence: terms
//! x,y
//! 0,0
//! ```
//!
//! The format is this project's own: no document of the machines' export format is public. Branches come from the sign of
//! dx. Bending and shear laws are made antisymmetric from the long branch; face and back are not told apart.

use crate::fabric::{
    curve::{Curves, Knot, monotone_slopes},
    document::{Fault, Problem},
    instrument::{self, BendingReading, ShearReading, TensileReading, Unreadable},
    law::{Branches, Law, Unfit},
    parameters::{Chosen, tensile_law},
    units::*,
};

/// Which instrument drew the curve.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Test {
    /// FB1, tension.
    Tensile,
    /// FB2, bending.
    Bending,
    /// FB1, shear.
    Shear,
}

/// What the instrument would have printed for the curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reading {
    /// Of a tensile curve.
    Tensile(TensileReading),
    /// Of a bending curve, 2HB at 1.0 1/cm.
    Bending(BendingReading),
    /// Of a shear curve.
    Shear(ShearReading),
}

/// A curve from a CSV file.
#[derive(Clone, Debug)]
pub struct Curve {
    /// Fabric named in the header.
    pub fabric: String,
    /// Test.
    pub test: Test,
    /// `warp`, `weft` or `both`.
    pub direction: String,
    /// `measured` or `digitised`.
    pub kind: String,
    /// Who measured it.
    pub source: String,
    /// Terms of use.
    pub licence: String,
    /// Largest load named in the header [N/m].
    pub max_load: Option<f64>,
    /// `[strain, force]` in time order: tensile [1, N/m], bending [1/m, N], shear [rad, N/m].
    pub samples: Vec<[f64; 2]>,
    /// Parameters read from the samples.
    pub reading: Reading,
}

/// Intervals of a law made from measured branches.
const INTERVALS: usize = 64;

/// Units with their factor to SI.
type Units = &'static [(&'static str, f64)];

fn units(test: Test) -> [Units; 2] {
    match test {
        Test::Tensile => [&[("%", PERCENT), ("1", 1.0)], &[("gf/cm", GF_PER_CM), ("N/m", 1.0)]],
        Test::Bending => [&[("1/cm", PER_CM), ("1/m", 1.0)], &[("gf.cm/cm", GF_CM_PER_CM), ("N", 1.0)]],
        Test::Shear => [&[("deg", DEGREE), ("rad", 1.0)], &[("gf/cm", GF_PER_CM), ("N/m", 1.0)]],
    }
}

const KEYS: [&str; 10] = [
    "fabric",
    "test",
    "direction",
    "x unit",
    "y unit",
    "max load",
    "pretension",
    "kind",
    "source",
    "licence",
];

/// Collects the header and what is wrong with it.
struct Header<'a> {
    file: &'a str,
    entries: Vec<(usize, &'a str, &'a str)>,
    faults: Vec<Fault>,
}

impl<'a> Header<'a> {
    fn read(file: &'a str, text: &'a str) -> Header<'a> {
        let mut header = Header { file, entries: Vec::new(), faults: Vec::new() };
        for (n, line) in text.lines().enumerate() {
            let Some((key, value)) = line.strip_prefix('#').and_then(|l| l.split_once(':')) else { continue };
            let (line, key, value) = (n + 1, key.trim(), value.trim());
            if KEYS.contains(&key) {
                header.entries.push((line, key, value));
            } else {
                header.fault(line, key, Problem::Unknown(KEYS.join(", ")));
            }
        }
        header
    }

    fn fault(&mut self, line: usize, key: &str, problem: Problem) {
        self.faults.push(Fault { file: self.file.to_owned(), line, key: key.to_owned(), problem });
    }

    fn get(&mut self, key: &str, expected: &str) -> Option<(usize, &'a str)> {
        let found = self.entries.iter().find(|e| e.1 == key && !e.2.is_empty()).map(|e| (e.0, e.2));
        if found.is_none() {
            self.fault(0, key, Problem::Missing(format!("the header needs `# {key}: …` ({expected})")));
        }
        found
    }

    fn one_of<T: Copy>(&mut self, key: &str, choices: &[(&str, T)]) -> Option<T> {
        let names: Vec<&str> = choices.iter().map(|c| c.0).collect();
        let (line, value) = self.get(key, &names.join(", "))?;
        let found = choices.iter().find(|c| c.0 == value).map(|c| c.1);
        if found.is_none() {
            let problem = Problem::Range { got: format!("\"{value}\""), allowed: names.join(", ") };
            self.fault(line, key, problem);
        }
        found
    }

    /// A line force with its unit.
    fn force(&mut self, key: &str) -> Option<f64> {
        let (line, value) = self.get(key, "a number with its unit, gf/cm or N/m")?;
        let parsed = value.split_once(' ').and_then(|(number, unit)| {
            let factor = units(Test::Tensile)[1].iter().find(|u| u.0 == unit.trim())?.1;
            number.parse().ok().filter(|n: &f64| *n > 0.0 && n.is_finite()).map(|n| n * factor)
        });
        if parsed.is_none() {
            let expected = "a positive number with its unit, gf/cm or N/m".to_owned();
            self.fault(line, key, Problem::Kind { got: format!("\"{value}\""), expected });
        }
        parsed
    }
}

/// Reads a curve; all faults of the file at once.
pub fn read(file: &str, text: &str) -> Result<Curve, Vec<Fault>> {
    let mut header = Header::read(file, text);
    let tests = [("tensile", Test::Tensile), ("bending", Test::Bending), ("shear", Test::Shear)];
    let test = header.one_of("test", &tests);
    let [x_unit, y_unit] = match test {
        Some(test) => {
            let [x, y] = units(test);
            [header.one_of("x unit", x), header.one_of("y unit", y)]
        }
        None => [None, None],
    };
    let max_load = if test == Some(Test::Tensile) { header.force("max load") } else { None };
    if test == Some(Test::Shear) {
        header.force("pretension");
    }
    let fabric = header.get("fabric", "its name");
    let direction = header.one_of("direction", &[("warp", "warp"), ("weft", "weft"), ("both", "both")]);
    let kind = header.one_of("kind", &[("measured", "measured"), ("digitised", "digitised")]);
    let source = header.get("source", "who measured it");
    let licence = header.get("licence", "the terms of use");
    let samples = samples(&mut header, text, [x_unit.unwrap_or(1.0), y_unit.unwrap_or(1.0)]);

    let reading = test.filter(|_| header.faults.is_empty()).and_then(|test| {
        let reading = match test {
            Test::Tensile => instrument::read_tensile(&samples).map(Reading::Tensile),
            Test::Bending => instrument::read_bending(&samples, PER_CM).map(Reading::Bending),
            Test::Shear => instrument::read_shear(&samples).map(Reading::Shear),
        };
        reading.map_err(|e: Unreadable| header.fault(0, "x,y", Problem::Contradiction(e.to_string()))).ok()
    });
    let (Some(test), Some(reading), Some(direction), Some(kind)) = (test, reading, direction, kind) else {
        return Err(header.faults);
    };
    let text = |entry: Option<(usize, &str)>| entry.map_or_else(String::new, |e| e.1.to_owned());
    Ok(Curve {
        fabric: text(fabric),
        test,
        direction: direction.to_owned(),
        kind: kind.to_owned(),
        source: text(source),
        licence: text(licence),
        max_load,
        samples,
        reading,
    })
}

fn samples(header: &mut Header, text: &str, scale: [f64; 2]) -> Vec<[f64; 2]> {
    let mut reader = csv::ReaderBuilder::new()
        .comment(Some(b'#'))
        .trim(csv::Trim::All)
        .flexible(true)
        .from_reader(text.as_bytes());
    match reader.headers() {
        Ok(names) if names.iter().eq(["x", "y"]) => {}
        names => {
            let got = names.map_or_else(|e| e.to_string(), |n| n.iter().collect::<Vec<_>>().join(","));
            header.fault(
                0,
                "x,y",
                Problem::Kind { got: format!("`{got}`"), expected: "the line `x,y`".to_owned() },
            );
            return Vec::new();
        }
    }
    let mut samples = Vec::new();
    for record in reader.records() {
        let record = match record {
            Ok(record) => record,
            Err(e) => {
                header.fault(0, "x,y", Problem::Unreadable(e.to_string()));
                break;
            }
        };
        let numbers: Vec<f64> =
            record.iter().filter_map(|f| f.parse().ok()).filter(|n: &f64| n.is_finite()).collect();
        if let ([x, y], 2) = (&numbers[..], record.len()) {
            samples.push([x * scale[0], y * scale[1]]);
        } else {
            let line = record.position().map_or(0, |p| p.line() as usize);
            let got = format!("`{}`", record.iter().collect::<Vec<_>>().join(","));
            header.fault(line, "x,y", Problem::Kind { got, expected: "two finite numbers".to_owned() });
        }
    }
    samples
}

impl Curve {
    /// The law along the measured branches, resampled and made monotone.
    pub fn law(&self, chosen: &Chosen) -> Result<Law, Unfit> {
        let branches = instrument::branches(&self.samples);
        match self.test {
            Test::Tensile => tensile(branches[0], branches[1], chosen),
            Test::Bending => antisymmetric(branches[1], chosen.bending_stick),
            Test::Shear => antisymmetric(branches[1], chosen.shear_stick),
        }
    }
}

/// A branch at `count` + 1 equal steps between two strains, forces made never to fall with the strain.
fn resample(branch: &[[f64; 2]], [low, high]: [f64; 2], count: usize) -> [Vec<f64>; 2] {
    let mut sorted = branch.to_vec();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let strains: Vec<f64> = (0..=count).map(|i| low + (high - low) * i as f64 / count as f64).collect();
    let [first, last] = [sorted[0], sorted[sorted.len() - 1]];
    let mut highest = f64::NEG_INFINITY;
    let forces = strains
        .iter()
        .map(|&x| {
            let at = x.clamp(first[0], last[0]);
            let force =
                instrument::force_at(&sorted, at).unwrap_or(if x < last[0] { first[1] } else { last[1] });
            highest = highest.max(force);
            highest
        })
        .collect();
    [strains, forces]
}

fn through(strains: &[f64], forces: &[f64]) -> Curves<1> {
    let slopes = monotone_slopes(strains, forces);
    let knots: Vec<Knot<1>> = (0..strains.len())
        .map(|i| Knot { x: strains[i], values: [forces[i]], slopes: [slopes[i]] })
        .collect();
    Curves::through(&knots)
}

fn tensile(up: &[[f64; 2]], down: &[[f64; 2]], chosen: &Chosen) -> Result<Law, Unfit> {
    let [emt, max_load] = up[up.len() - 1];
    let [strains, mut loading] = resample(up, [0.0, emt], INTERVALS);
    let [_, mut unloading] = resample(down, [0.0, emt], INTERVALS);
    loading[0] = 0.0;
    loading[INTERVALS] = max_load;
    unloading[INTERVALS] = max_load;
    // The stick takes its part of the loop (see `Tensile::law`): the envelope is wider by as much.
    for (low, high) in unloading.iter_mut().zip(&loading) {
        *low = (high - (high - *low).max(0.0) / (1.0 - chosen.tensile_stick)).max(0.0);
    }
    for i in 1..=INTERVALS {
        unloading[i] = unloading[i].max(unloading[i - 1]);
    }
    let slack = unloading.iter().rposition(|&f| f <= 1e-4 * max_load).unwrap_or(0);
    let residual = strains[slack].max(0.25 * strains[1]);
    let [upper, lower] = [through(&strains, &loading), through(&strains, &unloading)];
    let at = |curve: &Curves<1>, x: f64| [curve.at(x)[0].value, curve.at(x)[0].slope];
    let below = |x: f64| if at(&lower, x)[0] < at(&upper, x)[0] { at(&lower, x) } else { at(&upper, x) };
    tensile_law([emt, residual], |x| at(&upper, x), below, chosen)
}

/// Part of the range behind a turn that shows the stick, not the envelope: there the width is continued.
const TURN: f64 = 0.2;

fn antisymmetric(long: &[[f64; 2]], stick: f64) -> Result<Law, Unfit> {
    let ends = [long[long.len() - 1][0], long[0][0]];
    let end = ends[1].min(-ends[0]);
    let [strains, lower] = resample(long, [-end, end], INTERVALS);
    let upper: Vec<f64> = lower.iter().rev().map(|f| -f).collect();
    let width = |i: usize| (upper[i] - lower[i]).max(0.0);
    let turn = (INTERVALS as f64 * TURN / 2.0).ceil() as usize;
    let [first, last] = [turn, INTERVALS - turn];
    let lower: Vec<f64> =
        (0..=INTERVALS).map(|i| if i > last { upper[i] - width(last) } else { lower[i] }).collect();
    let upper: Vec<f64> = (0..=INTERVALS)
        .map(|i| if i < first { lower[i] + width(first) } else { upper[i].max(lower[i]) })
        .collect();
    let [upper_slopes, lower_slopes] = [&upper, &lower].map(|forces| monotone_slopes(&strains, forces));
    let envelope: Vec<Branches> = (0..=INTERVALS)
        .map(|i| Branches {
            x: strains[i],
            loading: [upper[i], upper_slopes[i]],
            unloading: [lower[i], lower_slopes[i]],
        })
        .collect();
    let way = Law::from_envelope(&envelope, 1.0, 0.0)?.enclosed(stick);
    Law::from_envelope(&envelope, if way > 0.0 { way } else { 1.0 }, 0.0)
}
