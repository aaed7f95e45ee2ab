//! The KES tests of a fabric repeated in the lab: loops, the parameters read from them, and their errors against what was given.

use super::specimen::{self, Specimen};
use crate::{
    fabric::{
        FabricFile, instrument,
        instrument::{ShearReading, TensileReading, Unreadable},
        measured::Test,
        units::PER_CM,
    },
    grid::Direction,
    model::Refused,
};

/// How near the load comes to that at which the tensile test turns, over it.
const LOADED: f64 = 1e-6;

/// How a lab tests.
#[derive(Clone, Copy, Debug)]
pub struct Lab {
    /// Intervals of particles between the clamps.
    pub intervals: usize,
    /// Samples per leg of a path.
    pub samples: usize,
    /// Whether FB1 specimens are kept from wrinkling.
    pub flat: bool,
}

impl Default for Lab {
    fn default() -> Lab {
        Lab { intervals: 10, samples: 100, flat: true }
    }
}

/// A parameter that the lab read, beside the one that the fabric was made from.
#[derive(Clone, Debug)]
pub struct Parameter {
    /// KES name.
    pub name: &'static str,
    /// Unit of both values, SI.
    pub unit: &'static str,
    /// What the lab read.
    pub measured: f64,
    /// What the fabric's file says.
    pub reference: f64,
    /// What explains the values.
    pub note: Option<String>,
}

/// One test of one direction.
#[derive(Clone, Debug)]
pub struct Tested {
    /// Test.
    pub test: Test,
    /// Direction that was pulled, bent, or lay between the clamps in shear.
    pub direction: Direction,
    /// Strain and force in time order, SI.
    pub samples: Vec<[f64; 2]>,
    /// The fabric's law alone on the same path: what was given.
    pub given: Vec<[f64; 2]>,
    /// Parameters beside those given.
    pub parameters: Vec<Parameter>,
}

/// Tests in the order of the report.
pub const TESTS: [Test; 3] = [Test::Tensile, Test::Bending, Test::Shear];

/// Name of a test in keys.
pub fn name(test: Test) -> &'static str {
    match test {
        Test::Tensile => "tensile",
        Test::Bending => "bending",
        Test::Shear => "shear",
    }
}

impl Lab {
    /// All tests of a fabric, warp and weft.
    pub fn run(&self, file: &FabricFile) -> Result<Vec<Tested>, Refused> {
        let all = TESTS.iter().flat_map(|&test| [0, 1].map(|direction| (test, direction)));
        all.map(|(test, direction)| self.test(file, test, direction)).collect()
    }

    /// One test in one direction.
    pub fn test(&self, file: &FabricFile, test: Test, direction: Direction) -> Result<Tested, Refused> {
        if !(20..=10_000).contains(&self.samples) {
            return Err(Refused(format!("samples: got {}, allowed: 20 to 10000", self.samples)));
        }
        let mut specimen = Specimen::new(&file.fabric, test, direction, self.intervals, self.flat)?;
        let given = Given { file, test, direction };
        let mut loops = [Vec::new(), Vec::new()];
        match test {
            Test::Tensile => loops[0] = self.pull(&mut specimen, given.max_load()),
            Test::Bending | Test::Shear => {
                for strain in instrument::path(specimen::turns(test), self.samples) {
                    loops[0].push([strain, specimen.drive(strain)]);
                    loops[1].push([strain, specimen.whole_clamp()]);
                }
            }
        }
        let driven = self.drive_law(&specimen, given.max_load());
        let [samples, whole] = loops;
        let unreadable = |e| Refused(format!("{} {}: {e}", file.name, name(test)));
        let mut parameters = given.parameters(&samples, &driven).map_err(unreadable)?;
        if test == Test::Shear {
            tell_whole_clamp(&mut parameters, &whole);
        }
        if specimen.is_troubled() {
            parameters.iter_mut().for_each(|p| p.note = Some("some samples are out of balance".to_owned()));
        }
        Ok(Tested { test, direction, samples, given: driven, parameters })
    }

    /// The tensile path: the clamp pulls until the load is there, and goes home.
    fn pull(&self, specimen: &mut Specimen, load: f64) -> Vec<[f64; 2]> {
        let stride = specimen.law().strains(load)[0] / self.samples as f64;
        let mut samples = vec![[0.0, specimen.drive(0.0)]];
        let [mut strain, mut force] = samples[0];
        // The load is approached from below with the stiffness just met. Ten lengths of the path are enough for any cloth.
        while force < load * (1.0 - LOADED) && samples.len() < 10 * self.samples {
            let slope = match samples[..] {
                [.., a, b] => (b[1] - a[1]) / (b[0] - a[0]),
                _ => f64::INFINITY,
            };
            let way = 0.9 * (load - force) / slope.max(f64::MIN_POSITIVE);
            strain += if samples.len() > 1 { way.min(stride) } else { stride };
            force = specimen.drive(strain);
            samples.push([strain, force]);
        }
        for k in (0..self.samples).rev() {
            let home = strain * k as f64 / self.samples as f64;
            samples.push([home, specimen.drive(home)]);
        }
        samples
    }

    /// The fabric's law alone on the same path: the reference where a file gives no number.
    fn drive_law(&self, specimen: &Specimen, load: f64) -> Vec<[f64; 2]> {
        let law = specimen.law();
        let turns = specimen::turns(specimen.test());
        let turns = if turns.is_empty() { vec![law.strains(load)[0], 0.0] } else { turns.to_vec() };
        instrument::drive(law, &instrument::path(&turns, 2000))
    }
}

/// What a fabric's file gives for one test.
#[derive(Clone, Copy)]
struct Given<'a> {
    file: &'a FabricFile,
    test: Test,
    direction: Direction,
}

impl Given<'_> {
    /// A parameter [SI] of this test, where the file has it.
    fn value(&self, parameter: &str) -> Option<f64> {
        let ways =
            ["both", ["warp", "weft"][self.direction]].map(|way| format!("{}.{way}.", name(self.test)));
        let plain = format!("{}.", name(self.test));
        let of = |key: &str| {
            let rest = ways.iter().chain([&plain]).find_map(|prefix| key.strip_prefix(prefix.as_str()));
            rest == Some(parameter)
        };
        self.file.quantities.iter().find(|q| of(&q.key)).map(|q| q.value_si)
    }

    /// Load at which the tensile test turns [N/m].
    fn max_load(&self) -> f64 {
        let law = &self.file.fabric.tensile[self.direction];
        let last = law.knots().last().map_or(0.0, |x| law.loading(x));
        self.value("max_load").filter(|_| self.test == Test::Tensile).unwrap_or(last)
    }

    /// Every parameter of a loop, and of the loop that the law alone would give.
    fn parameters(&self, samples: &[[f64; 2]], driven: &[[f64; 2]]) -> Result<Vec<Parameter>, Unreadable> {
        Ok(match self.test {
            Test::Tensile => {
                self.tensile(instrument::read_tensile(samples)?, instrument::read_tensile(driven)?)
            }
            Test::Bending => {
                let station = self.value("read_at").unwrap_or(PER_CM);
                let [got, law] = [samples, driven].map(|s| instrument::read_bending(s, station));
                let (got, law) = (got?, law?);
                vec![
                    self.parameter("B", "N.m", [got.b, law.b]),
                    self.parameter("2HB", "N", [got.width, law.width]),
                ]
            }
            Test::Shear => {
                let [got, law] = [samples, driven].map(instrument::read_shear);
                let (got, law) = (got?, law?);
                vec![
                    self.parameter("G", "N/(m.rad)", [got.g, law.g]),
                    self.parameter("2HG", "N/m", [got.width, law.width]),
                    self.parameter("2HG5", "N/m", [got.width5, law.width5]),
                ]
            }
        })
    }

    fn tensile(&self, got: TensileReading, law: TensileReading) -> Vec<Parameter> {
        // WT is no parameter of its own: it follows from the load, EMT and LT, and published ones may contradict these.
        let follows = match (self.value("EMT"), self.value("LT")) {
            (Some(emt), Some(lt)) => 0.5 * lt * emt * self.max_load(),
            _ => law.wt,
        };
        let published = self.value("WT").map(|wt| wt / follows - 1.0).filter(|off| off.abs() > 1e-3);
        let note = published
            .map(|off| format!("the published WT is {:+.1} % off its own load, EMT and LT", 100.0 * off));
        vec![
            self.parameter("EMT", "1", [got.emt, law.emt]),
            self.parameter("LT", "1", [got.lt, law.lt]),
            self.parameter("RT", "1", [got.rt, law.rt]),
            Parameter { name: "WT", unit: "J/m2", measured: got.wt, reference: follows, note },
        ]
    }

    /// A parameter beside the one given, or else beside what the law alone gives.
    fn parameter(&self, name: &'static str, unit: &'static str, [measured, law]: [f64; 2]) -> Parameter {
        let given = self.value(name);
        let note = given.is_none().then(|| "not given; read from the given curve".to_owned());
        Parameter { name, unit, measured, reference: given.unwrap_or(law), note }
    }
}

/// Notes what the whole clamp would have shown, free sides included.
fn tell_whole_clamp(parameters: &mut [Parameter], whole: &[[f64; 2]]) {
    let Ok(ShearReading { g, width, width5 }) = instrument::read_shear(whole) else { return };
    for (parameter, value) in parameters.iter_mut().zip([g, width, width5]) {
        let off = 100.0 * (value / parameter.reference - 1.0);
        parameter.note.get_or_insert_with(|| format!("over the whole clamp {off:+.1} %"));
    }
}
