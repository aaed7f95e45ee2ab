//! Cusick drape of fabrics whose drape coefficient somebody measured: several perturbed starts each, reported as found.
//!
//! Nothing is fitted. A fabric that comes out too far from its measured coefficient is draped again with the softest shear of all, to
//! tell what bending and weight alone leave of it, and set beside what these suggest among the other fabrics.

use super::{Context, Findings, Plot, Row, Series, strip};
use crate::{
    fabric::{
        FabricFile, Library,
        units::{DEGREE, PER_CM},
    },
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
    /// Times the support shakes the specimen up and down.
    #[arg(long, default_value_t = Cusick::default().shakes)]
    pub shakes: u32,
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
            shakes: 3,
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
        strip::allow("shakes", f64::from(self.shakes), [0.0, 100.0])?;
        let mut fabrics = self.fabrics()?;
        let tests: Vec<DrapeTest> = fabrics.iter().flat_map(|f| self.tests(f, context.seed)).collect();
        let readings = drape(&tests, context.progress)?;
        for (draped, readings) in fabrics.iter_mut().zip(readings.chunks(self.starts)) {
            draped.readings = readings.to_vec();
        }
        let mut rows: Vec<Row> = fabrics.iter().flat_map(|f| self.rows(f)).collect();
        let far: Vec<&Draped> = fabrics.iter().filter(|f| f.off().abs() > POINTS).collect();
        for draped in &far {
            rows.extend(self.explanation(draped, &fabrics, context)?);
        }
        let least = (MOST * fabrics.len() as f64).ceil();
        let case = format!("of {}, means within ±{} points", fabrics.len(), 100.0 * POINTS);
        let near = (fabrics.len() - far.len()) as f64;
        rows.push(Row::at_least("Cusick fabrics as measured", &case, near, least));
        Ok(Findings { rows, plots: vec![self.outlines(&fabrics)] })
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

    fn tests(&self, draped: &Draped, seed: u64) -> Vec<DrapeTest> {
        let fabric = Arc::new(draped.file.fabric.clone());
        let test = |k: usize| DrapeTest {
            radii: [0.005 * self.specimen_cm, 0.005 * self.support_cm],
            unevenness: 1e-3 * self.unevenness_mm,
            shakes: self.shakes,
            ..DrapeTest::new(fabric.clone(), self.particles, seed + k as u64)
        };
        (0..self.starts).map(test).collect()
    }

    fn rows(&self, draped: &Draped) -> [Row; 2] {
        let case = format!("{}, {} starts", draped.file.name, self.starts);
        let [coefficient, nodes] = draped.measured;
        let found = average(&draped.readings);
        let counts: Vec<String> = draped.readings.iter().map(|r| r.nodes.to_string()).collect();
        let count = mean(draped.readings.iter().map(|r| r.nodes as f64));
        [
            Row::report("Cusick drape coefficient", &case, found, coefficient)
                .because(&spread(draped.off(), &draped.readings)),
            Row::report("Cusick nodes", &case, count, nodes).because(&counts.join(" ")),
        ]
    }

    /// Whether shear can be what sets a fabric apart, and what its bending and weight suggest among the others.
    fn explanation(
        &self,
        draped: &Draped,
        fabrics: &[Draped],
        context: &Context,
    ) -> Result<Vec<Row>, Refused> {
        let stiffness = |f: &Draped| f.file.fabric.shear.loading(DEGREE);
        let mut rows = Vec::new();
        if let Some(softest) = fabrics.iter().min_by(|a, b| stiffness(a).total_cmp(&stiffness(b)))
            && stiffness(softest) < stiffness(draped)
        {
            let mut tests = self.tests(draped, context.seed);
            for test in &mut tests {
                Arc::make_mut(&mut test.fabric).shear = softest.file.fabric.shear.clone();
            }
            let readings = drape(&tests, context.progress)?;
            let case = format!("{} with the shear of {}", draped.file.name, softest.file.name);
            let [average, measured] = [average(&readings), draped.measured[0]];
            let row = Row::report("Cusick drape coefficient", &case, average, measured);
            rows.push(row.because(&spread(average - measured, &readings)));
        }
        if let Some(suggested) = among(draped, fabrics) {
            let found = average(&draped.readings);
            let row = Row::report(
                "Cusick coefficient of such a bending length",
                &draped.file.name,
                found,
                suggested,
            );
            let why = "reference: between the measured coefficients of the other fabrics, at this one's measured bending and weight";
            rows.push(row.because(why));
        }
        Ok(rows)
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

impl Draped {
    /// Mean coefficient less the measured one.
    fn off(&self) -> f64 {
        average(&self.readings) - self.measured[0]
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

/// Mean coefficient.
fn average(readings: &[DrapeReading]) -> f64 {
    mean(readings.iter().map(|r| r.coefficient))
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
