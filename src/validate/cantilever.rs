//! Strips clamped level at one end, against the elastica: under their own weight, under a tip load, and over meshes.

use super::{
    Context, Findings, Plot, Row, Series, elastica,
    mesh::{self, Mesh},
    strip,
};
use crate::{
    math::Vec3,
    world::{Budget, Command, Refused, World},
};
use rand::SeedableRng;
use rand_pcg::Pcg64;
use strip::LENGTH;

/// A strip clamped level, bent by its own weight.
#[derive(Clone, Debug, clap::Args)]
pub struct Cantilever {
    /// Γ = w L³/B, weight against bending.
    #[arg(long, value_delimiter = ',', default_values_t = Cantilever::default().gamma)]
    pub gamma: Vec<f64>,
    /// Particles from the clamp to the tip.
    #[arg(long, default_value_t = Cantilever::default().particles)]
    pub particles: usize,
    /// Meshes; on a graded one the largest cells count as the particles' distance.
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["uniform"])]
    pub mesh: Vec<Mesh>,
}

impl Default for Cantilever {
    fn default() -> Cantilever {
        Cantilever {
            gamma: vec![0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0],
            particles: 77,
            mesh: vec![Mesh::Uniform],
        }
    }
}

impl Cantilever {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<Cantilever> {
        let gamma = if quick { vec![0.3, 7.0, 100.0] } else { Cantilever::default().gamma };
        let graded = if quick { vec![20.0] } else { vec![0.3, 10.0, 100.0, 1000.0] };
        vec![
            Cantilever { gamma, ..Cantilever::default() },
            Cantilever { gamma: graded, mesh: Mesh::ALL[1..].to_vec(), ..Cantilever::default() },
        ]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        strip::allow("particles", self.particles as f64, [3.0, 2000.0])?;
        let mut findings = Findings::default();
        let mut shapes = Plot {
            title: "Self-weight cantilever: references as lines, particles as dots".into(),
            labels: ["x/L".into(), "z/L".into()],
            square: true,
            ..Plot::default()
        };
        let cases = self.gamma.iter().flat_map(|gamma| self.mesh.iter().map(move |mesh| (*gamma, *mesh)));
        for (k, (gamma, mesh)) in cases.enumerate() {
            strip::allow("gamma", gamma, [1e-3, 1e5])?;
            let shape = rest(gamma, strip::STIFF, self.particles, mesh, context.seed)?;
            let reference = elastica::self_weight(gamma, 0.0);
            let tip = shape[shape.len() - 1];
            let case = format!("Γ {gamma}, {} particles{}", self.particles, mesh.case());
            for (name, measured, reference) in
                [("cantilever H/L", -tip[1], reference.drop), ("cantilever W/L", tip[0], reference.reach)]
            {
                findings.rows.push(match tolerance(gamma) {
                    Some(tolerance) => Row::compare(name, &case, measured, reference, tolerance),
                    None => Row::report(name, &case, measured, reference).because(BEYOND),
                });
            }
            let line = reference.shape.iter().step_by(10).map(|p| [p[0], -p[1]]).collect();
            shapes.series.push(Series::line(&format!("Γ {gamma}{}", mesh.case()), line));
            shapes.series.push(Series::dots("", shape));
            (context.progress)((k + 1) as f64 / (self.gamma.len() * self.mesh.len()) as f64);
        }
        findings.plots.push(shapes);
        Ok(findings)
    }
}

/// Why a limp strip is only reported.
const BEYOND: &str =
    "past 1,000 the bent part at the clamp, L/√Γ long, is shorter than three cells of the usual mesh";

/// Largest cells across graded strips. Jumps of a cell's width load the three rows beside a border, and a strip of two cells is all border.
const ACROSS: usize = 4;

fn tolerance(gamma: f64) -> Option<f64> {
    match gamma {
        g if g <= 100.0 => Some(1e-3),
        g if g <= 1000.0 => Some(1e-2),
        _ => None,
    }
}

/// The strip at rest, from the clamp to the tip, over its length. It starts straight.
fn rest(gamma: f64, tensile: f64, particles: usize, mesh: Mesh, seed: u64) -> Result<Vec<[f64; 2]>, Refused> {
    let setup = mesh.strip(particles, ACROSS, |particles| {
        let spacing = LENGTH / (particles - 1) as f64;
        let fabric = strip::ideal(strip::DENSITY, tensile, strip::rigidity(gamma));
        strip::clamped(fabric, particles, |i| [i as f64 * spacing, 0.0])
    });
    let mut world = mesh.world(setup, |_| false, &mut Pcg64::seed_from_u64(seed))?;
    mesh::settle(&mut world, 0.05, 3000)?;
    Ok(strip::shape(&world, 1))
}

/// Order of convergence of the self-weight cantilever, and the half cell at its clamp.
#[derive(Clone, Debug, clap::Args)]
pub struct Order {
    /// Γ = w L³/B, weight against bending.
    #[arg(long, value_delimiter = ',', default_values_t = Order::default().gamma)]
    pub gamma: Vec<f64>,
    /// Particles from the clamp to the tip, at least two meshes.
    #[arg(long, value_delimiter = ',', default_values_t = Order::default().particles)]
    pub particles: Vec<usize>,
}

impl Default for Order {
    fn default() -> Order {
        Order { gamma: vec![1.0, 10.0, 100.0], particles: vec![20, 39, 77, 153] }
    }
}

/// Tensile stiffness [N/m]: soft, so that rounding does not hide the error of fine meshes. The reference stretches as much.
const SOFT: f64 = 1e3;

impl Order {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<Order> {
        let full = Order::default();
        vec![if quick { Order { gamma: vec![10.0], particles: vec![20, 39, 77] } } else { full }]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        strip::allow("particles: meshes", self.particles.len() as f64, [2.0, 20.0])?;
        let mut findings = Findings::default();
        let mut plot = Plot {
            title: "Error of H/L over the mesh".into(),
            labels: ["intervals".into(), "relative error".into()],
            logarithmic: true,
            ..Plot::default()
        };
        for (k, &gamma) in self.gamma.iter().enumerate() {
            strip::allow("gamma", gamma, [1e-3, 1e5])?;
            let reference = elastica::self_weight(gamma, strip::weight() * LENGTH / SOFT);
            let mut errors = Vec::new();
            for (m, &particles) in self.particles.iter().enumerate() {
                strip::allow("particles", particles as f64, [3.0, 400.0])?;
                let shape = rest(gamma, SOFT, particles, Mesh::Uniform, 0)?;
                let tip = shape[shape.len() - 1];
                let intervals = (particles - 1) as f64;
                errors.push([
                    intervals,
                    (-tip[1] / reference.drop - 1.0).abs(),
                    (tip[0] / reference.reach - 1.0).abs(),
                ]);
                if particles == self.particles[self.particles.len() - 1] {
                    let end = elastica::at(&reference.shape, 1.0 / intervals);
                    let slopes = [-shape[1][1] / shape[1][0], end[1] / end[0]];
                    let case = format!("Γ {gamma}, {particles} particles");
                    let name = "slope of the first cell";
                    // A full bending cell at the clamp would double it.
                    findings.rows.push(Row::compare(name, &case, slopes[0], slopes[1], 0.03));
                }
                let meshes = self.particles.len();
                (context.progress)((k * meshes + m + 1) as f64 / (self.gamma.len() * meshes) as f64);
            }
            let [first, last] = [errors[0], errors[errors.len() - 1]];
            let case = format!("Γ {gamma}, {:?} particles", self.particles);
            for (column, name) in [(1, "order of H/L"), (2, "order of W/L")] {
                let order = (first[column] / last[column]).ln() / (last[0] / first[0]).ln();
                findings.rows.push(Row::at_least(name, &case, order, 1.9));
            }
            plot.series
                .push(Series::dots(&format!("Γ {gamma}"), errors.iter().map(|e| [e[0], e[1]]).collect()));
            let second = |n: f64| [n, last[1] * (last[0] / n).powi(2)];
            plot.series.push(Series::line("", vec![second(first[0]), second(last[0])]));
        }
        findings.plots.push(plot);
        Ok(findings)
    }
}

/// A weightless strip clamped level, bent by a load at its tip.
#[derive(Clone, Debug, clap::Args)]
pub struct TipLoad {
    /// a = P L²/B, load against bending.
    #[arg(long, value_delimiter = ',', default_values_t = TipLoad::default().load)]
    pub load: Vec<f64>,
    /// Particles from the clamp to the tip.
    #[arg(long, default_value_t = TipLoad::default().particles)]
    pub particles: usize,
}

impl Default for TipLoad {
    fn default() -> TipLoad {
        TipLoad { load: vec![0.2, 0.5, 1.0, 2.0, 5.0, 10.0], particles: 77 }
    }
}

/// Rigidity of the strip, as Γ of its weight were it heavy.
const STIFFNESS: f64 = 10.0;
/// Shift of the tip for differences [m]: far less than what makes a bent strip taut.
const SHIFT: f64 = 1e-7;
/// Newton's steps at the most, and the force off the load, relative, that ends them.
const NEWTONS: usize = 30;
const BALANCED: f64 = 1e-6;

impl TipLoad {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<TipLoad> {
        let load = if quick { vec![3.0] } else { TipLoad::default().load };
        vec![TipLoad { load, ..TipLoad::default() }]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        strip::allow("particles", self.particles as f64, [3.0, 400.0])?;
        let mut findings = Findings::default();
        for (k, &load) in self.load.iter().enumerate() {
            strip::allow("load", load, [1e-2, 100.0])?;
            let rigidity = strip::rigidity(STIFFNESS);
            let stretch = load * rigidity / (LENGTH * LENGTH * strip::STIFF);
            let reference = elastica::tip_load(load, stretch);
            let shape = self.rest(load, &reference)?;
            let [last, tip] = [shape[shape.len() - 2], shape[shape.len() - 1]];
            let slope = (last[1] - tip[1]).atan2(tip[0] - last[0]);
            let case = format!("a {load}, {} particles", self.particles);
            for (name, measured, reference) in [
                ("tip load, drop/L", -tip[1], reference.drop),
                ("tip load, loss of reach/L", 1.0 - tip[0], 1.0 - reference.reach),
                ("tip load, slope", slope, reference.tip),
            ] {
                findings.rows.push(Row::compare(name, &case, measured, reference, 1e-3));
            }
            (context.progress)((k + 1) as f64 / self.load.len() as f64);
        }
        Ok(findings)
    }

    /// The strip where its tip is held such that it pulls with the load, straight up.
    fn rest(&self, load: f64, start: &elastica::Cantilever) -> Result<Vec<[f64; 2]>, Refused> {
        let intervals = (self.particles - 1) as f64;
        let place = |i: usize| {
            let [reach, drop] = elastica::at(&start.shape, i as f64 / intervals);
            [reach * LENGTH, -drop * LENGTH]
        };
        let fabric = strip::ideal(strip::DENSITY, strip::STIFF, strip::rigidity(STIFFNESS));
        let mut setup = strip::clamped(fabric, self.particles, place);
        setup.gravity = 0.0;
        setup.pins.extend([[self.particles, 0], [self.particles, 1]]);
        let width = setup.size[1];
        let wanted = load * strip::rigidity(STIFFNESS) / (LENGTH * LENGTH) * width;
        let mut world = World::new(setup)?;
        strip::settle(&mut world, 0.05, 1000)?;
        let mut tip = place(self.particles - 1);
        for _ in 0..NEWTONS {
            let here = self.pull(&mut world, tip)?;
            let off = [here[0], here[1] - wanted];
            if off[0].abs() + off[1].abs() < BALANCED * wanted {
                return Ok(strip::shape(&world, 1));
            }
            let [[a, c], [b, d]] = [
                self.slope(&mut world, tip, [SHIFT, 0.0], here)?,
                self.slope(&mut world, tip, [0.0, SHIFT], here)?,
            ];
            let determinant = a * d - b * c;
            let step = [(d * off[0] - b * off[1]) / determinant, (a * off[1] - c * off[0]) / determinant];
            let slack = (1.0 - start.reach) * LENGTH;
            let shorter = (0.2 * slack / step[0].hypot(step[1])).min(1.0);
            (0..2).for_each(|k| tip[k] -= shorter * step[k]);
        }
        Err(Refused(format!("the tip finds no place where it pulls with a = {load}")))
    }

    /// Force of the strip on what holds its tip at a place, in x and z [N].
    fn pull(&self, world: &mut World, [x, z]: [f64; 2]) -> Result<[f64; 2], Refused> {
        let width = world.grid().size[1];
        let ends = [[self.particles, 0], [self.particles, 1]];
        let to = |particle: [usize; 2]| Command::Drive {
            particle,
            position: Vec3::new(x, particle[1] as f64 * width, z),
        };
        world.step(&ends.map(to), 0.05, Budget::solves(40));
        strip::settle(world, 0.05, 1000)?;
        let force: Vec3 = ends.iter().filter_map(|end| world.reaction(*end)).sum();
        Ok([force.x, force.z])
    }

    fn slope(
        &self,
        world: &mut World,
        tip: [f64; 2],
        by: [f64; 2],
        here: [f64; 2],
    ) -> Result<[f64; 2], Refused> {
        let there = self.pull(world, [tip[0] + by[0], tip[1] + by[1]])?;
        Ok([0, 1].map(|k| (there[k] - here[k]) / SHIFT))
    }
}
