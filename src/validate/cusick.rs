//! Cusick drape of fabrics whose drape coefficient somebody measured: several perturbed starts each, reported as found.
//!
//! Nothing is fitted. A fabric that comes out too far from its measured coefficient is set beside what its own measured bending and
//! weight suggest among the other fabrics.

use super::{Context, Findings, Plot, Row, Series, strip};
use crate::{
    fabric::{FabricFile, Library, units::PER_CM},
    lab::drape::{DrapeReading, DrapeTest},
    world::Refused,
};
use std::{
    f64::consts::TAU,
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
    },
};

/// Cusick drape of fabrics whose coefficient was measured.
#[derive(Clone, Debug, clap::Args)]
pub struct Cusick {
    /// Fabrics; without, all whose drape was measured.
    #[arg(long, value_delimiter = ',')]
    pub fabric: Vec<String>,
    /// Perturbed starts of each.
    #[arg(long, default_value_t = Cusick::default().starts)]
    pub starts: usize,
    /// Particles along the diameter.
    #[arg(long, default_value_t = Cusick::default().particles)]
    pub particles: usize,
    /// Diameter of the specimen [cm].
    #[arg(long, default_value_t = Cusick::default().specimen_cm)]
    pub specimen_cm: f64,
    /// Diameter of the support [cm].
    #[arg(long, default_value_t = Cusick::default().support_cm)]
    pub support_cm: f64,
    /// Largest height of the start's unevenness [mm].
    #[arg(long, default_value_t = Cusick::default().unevenness_mm)]
    pub unevenness_mm: f64,
    /// Gives every fabric the shear of this one.
    #[arg(long, value_name = "FABRIC")]
    pub shear_of: Option<String>,
}

impl Default for Cusick {
    fn default() -> Cusick {
        Cusick {
            fabric: Vec::new(),
            starts: 10,
            particles: 61,
            specimen_cm: 30.0,
            support_cm: 18.0,
            unevenness_mm: 1.0,
            shear_of: None,
        }
    }
}

/// How far a mean coefficient may be from the measured one.
const POINTS: f64 = 0.08;
/// Part of the fabrics that must be as near.
const MOST: f64 = 0.75;
/// Threads.
const THREADS: usize = 2;

/// A fabric with its measured drape, and what the lab found.
struct Draped {
    file: FabricFile,
    measured: [f64; 2],
    readings: Vec<DrapeReading>,
}

impl Cusick {
    /// The suite's checks. The reduced suite has none: a coarse drape is no drape.
    pub fn suite(quick: bool) -> Option<Cusick> {
        (!quick).then(Cusick::default)
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        strip::allow("starts", self.starts as f64, [1.0, 1000.0])?;
        strip::allow("particles", self.particles as f64, [11.0, 301.0])?;
        strip::allow("specimen_cm", self.specimen_cm, [5.0, 100.0])?;
        strip::allow("support_cm", self.support_cm, [0.2 * self.specimen_cm, 0.9 * self.specimen_cm])?;
        strip::allow("unevenness_mm", self.unevenness_mm, [1e-6, 50.0])?;
        let mut fabrics = self.fabrics()?;
        let tests: Vec<DrapeTest> = fabrics
            .iter()
            .flat_map(|f| (0..self.starts).map(|k| self.test(f, context.seed + k as u64)))
            .collect();
        let readings = drape(&tests, context.progress)?;
        for (draped, readings) in fabrics.iter_mut().zip(readings.chunks(self.starts)) {
            draped.readings = readings.to_vec();
        }
        Ok(self.findings(&fabrics))
    }

    fn fabrics(&self) -> Result<Vec<Draped>, Refused> {
        let library = Library::default();
        let read = |name: &String| library.read(name).map_err(|e| Refused(format!("fabric: {e}")));
        let shear = self.shear_of.as_ref().map(read).transpose()?.map(|file| file.fabric.shear);
        let mut found = Vec::new();
        let names = if self.fabric.is_empty() { library.names() } else { self.fabric.clone() };
        for name in &names {
            let mut file = read(name)?;
            let value = |key: &str| file.quantities.iter().find(|q| q.key == key).map(|q| q.value_si);
            if let (Some(coefficient), Some(nodes)) = (value("drape.coefficient"), value("drape.nodes")) {
                if let Some(shear) = &shear {
                    file.fabric.shear = shear.clone();
                }
                found.push(Draped { file, measured: [coefficient, nodes], readings: Vec::new() });
            } else if !self.fabric.is_empty() {
                return Err(Refused(format!("fabric: got {name}, allowed: one with a measured drape")));
            }
        }
        Ok(found)
    }

    fn test(&self, draped: &Draped, seed: u64) -> DrapeTest {
        DrapeTest {
            radii: [0.005 * self.specimen_cm, 0.005 * self.support_cm],
            unevenness: 1e-3 * self.unevenness_mm,
            ..DrapeTest::new(Arc::new(draped.file.fabric.clone()), self.particles, seed)
        }
    }

    fn findings(&self, fabrics: &[Draped]) -> Findings {
        let mut rows = Vec::new();
        let mut near = 0;
        for draped in fabrics {
            let name = format!("{}, {} starts", draped.file.name, self.starts);
            let [coefficient, nodes] = draped.measured;
            let average = mean(draped.readings.iter().map(|r| r.coefficient));
            let off = average - coefficient;
            near += usize::from(off.abs() <= POINTS);
            let row = Row::report("Cusick drape coefficient", &name, average, coefficient);
            rows.push(row.because(&spread(off, &draped.readings)));
            let counts: Vec<String> = draped.readings.iter().map(|r| r.nodes.to_string()).collect();
            let count = mean(draped.readings.iter().map(|r| r.nodes as f64));
            rows.push(Row::report("Cusick nodes", &name, count, nodes).because(&counts.join(" ")));
            if off.abs() > POINTS
                && let Some(suggested) = among(draped, fabrics)
            {
                let row =
                    Row::report("Cusick coefficient of such a bending length", &name, average, suggested);
                let why = "reference: between the measured coefficients of the other fabrics, at this one's measured bending and weight";
                rows.push(row.because(why));
            }
        }
        let least = (MOST * fabrics.len() as f64).ceil();
        let case = format!("of {}, means within ±{} points", fabrics.len(), 100.0 * POINTS);
        rows.push(Row::at_least("Cusick fabrics as measured", &case, near as f64, least));
        Findings { rows, plots: vec![self.outlines(fabrics)] }
    }

    /// Shadows of the first start of each fabric.
    fn outlines(&self, fabrics: &[Draped]) -> Plot {
        let circle = |radius: f64| (0..=180).map(|k| at(f64::from(k) / 180.0, radius)).collect();
        let mut series = vec![
            Series::line("support and specimen", circle(0.5 * self.support_cm)),
            Series::line("", circle(0.5 * self.specimen_cm)),
        ];
        for draped in fabrics {
            let points = draped.readings.first().map_or(Vec::new(), |r| {
                let count = r.shadow.len();
                (0..=count)
                    .step_by(5)
                    .map(|k| at(k as f64 / count as f64, 100.0 * r.shadow[k % count]))
                    .collect()
            });
            series.push(Series::line(&draped.file.name, points));
        }
        Plot {
            title: "Cusick drape: shadows of the first starts".into(),
            labels: ["along the warp [cm]".into(), "along the weft [cm]".into()],
            square: true,
            series,
            ..Plot::default()
        }
    }
}

/// A point at so much of a turn.
fn at(turn: f64, radius: f64) -> [f64; 2] {
    [radius * (TAU * turn).cos(), radius * (TAU * turn).sin()]
}

/// Runs the tests on some threads.
fn drape(tests: &[DrapeTest], progress: &(dyn Fn(f64) + Sync)) -> Result<Vec<DrapeReading>, Refused> {
    let (next, done) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..THREADS {
            scope.spawn(|| {
                loop {
                    let k = next.fetch_add(1, Ordering::Relaxed);
                    let Some(test) = tests.get(k) else { return };
                    let reading = test.run();
                    let mut done = done.lock().expect("no test panics");
                    done.push((k, reading));
                    progress(done.len() as f64 / tests.len() as f64);
                }
            });
        }
    });
    let mut readings = done.into_inner().expect("no test panics");
    readings.sort_by_key(|r| r.0);
    readings.into_iter().map(|r| r.1).collect()
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), v| (sum + v, count + 1.0));
    sum / count
}

/// Deviation, scatter and range of the coefficients in words.
fn spread(off: f64, readings: &[DrapeReading]) -> String {
    let all: Vec<f64> = readings.iter().map(|r| 100.0 * r.coefficient).collect();
    let middle = mean(all.iter().copied());
    let scatter = mean(all.iter().map(|c| (c - middle).powi(2))).sqrt();
    let [low, high] = all.iter().fold([f64::MAX, f64::MIN], |[l, h], c| [l.min(*c), h.max(*c)]);
    let awake = readings.iter().filter(|r| !r.resting).count();
    let rest = if awake > 0 { format!("; {awake} not at rest") } else { String::new() };
    format!("{:+.1} points; {middle:.1} ± {scatter:.1} %, {low:.1} to {high:.1} %{rest}", 100.0 * off)
}

/// Bending length [m] on the loading branch at 1 1/cm: what the cloth's own weight works against.
fn bending_length(file: &FabricFile) -> f64 {
    let fabric = &file.fabric;
    let rigidity = mean(fabric.bending.iter().map(|law| law.loading(PER_CM) / PER_CM));
    (rigidity / (9.81 * fabric.areal_density)).cbrt()
}

/// Measured coefficient that the bending length suggests: linear between the nearest of the other fabrics; none outside them.
fn among(draped: &Draped, fabrics: &[Draped]) -> Option<f64> {
    let length = bending_length(&draped.file);
    let others = fabrics.iter().filter(|f| f.file.name != draped.file.name);
    let mut known: Vec<[f64; 2]> = others.map(|f| [bending_length(&f.file), f.measured[0]]).collect();
    known.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let pair = known.windows(2).find(|k| k[0][0] <= length && length <= k[1][0])?;
    Some(pair[0][1] + (pair[1][1] - pair[0][1]) * (length - pair[0][0]) / (pair[1][0] - pair[0][0]))
}
