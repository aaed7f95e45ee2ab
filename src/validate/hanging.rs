//! Strips that hang: between two points, against the catenary; from one end, against the tensile curve.

use super::{
    Context, Findings, Plot, Row, Series,
    mesh::{self, Mesh},
    strip,
};
use crate::{
    fabric::{self, law::Law},
    grid::Interpolation,
    world::{Refused, World},
};
use rand::SeedableRng;
use rand_pcg::Pcg64;
use strip::LENGTH;

/// A limp strip hung from two points of one height, against the elastic catenary.
#[derive(Clone, Debug, clap::Args)]
pub struct Catenary {
    /// Span over length, below 1.
    #[arg(long, value_delimiter = ',', default_values_t = Catenary::default().span)]
    pub span: Vec<f64>,
    /// Particles from end to end; none: 153, and 301 below a span of 0.1, where the bottom is narrow.
    #[arg(long)]
    pub particles: Option<usize>,
    /// Meshes; on a graded one the largest cells count as the particles' distance.
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["uniform"])]
    pub mesh: Vec<Mesh>,
}

impl Default for Catenary {
    fn default() -> Catenary {
        Catenary {
            span: vec![0.05, 0.1, 0.2, 0.35, 0.5, 0.6, 0.8, 0.9, 0.95, 0.99],
            particles: None,
            mesh: vec![Mesh::Uniform],
        }
    }
}

/// Γ = w L³/B of a strip that bends freely.
const LIMP: f64 = 1e10;
/// Tensile stiffness [N/m]: the nearly taut catenary is still within 0.1 % of the inextensible one. The reference stretches as much.
const TAUT: f64 = 1e5;

/// The elastic catenary of unit length and weight between points `span` apart, `stretch` being weight over tensile stiffness: its
/// horizontal force H, and the shape at a distance from its middle (along and up), both linear in what stretches: x = H s ε + H asinh(s/H).
struct Hung {
    force: f64,
    stretch: f64,
}

impl Hung {
    fn new(span: f64, stretch: f64) -> Hung {
        let reach = |h: f64| 2.0 * h * (0.5 / h).asinh() + h * stretch;
        let (mut low, mut high) = (1e-12_f64.ln(), 1e6_f64.ln());
        for _ in 0..200 {
            let middle = 0.5 * (low + high);
            if reach(middle.exp()) > span { high = middle } else { low = middle }
        }
        Hung { force: (0.5 * (low + high)).exp(), stretch }
    }

    fn at(&self, s: f64) -> [f64; 2] {
        let h = self.force;
        [h * (s / h).asinh() + h * s * self.stretch, (h * h + s * s).sqrt() - h + 0.5 * s * s * self.stretch]
    }
}

impl Catenary {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<Catenary> {
        let span = if quick { vec![0.3, 0.85] } else { Catenary::default().span };
        let graded = Catenary {
            span: if quick { vec![0.6] } else { vec![0.2, 0.5, 0.9] },
            particles: Some(77),
            mesh: Mesh::ALL[1..].to_vec(),
        };
        let adapted = Catenary { span: vec![0.05, 0.35], particles: None, mesh: vec![Mesh::Adapted] };
        let mut checks = vec![Catenary { span, ..Catenary::default() }, graded];
        checks.extend((!quick).then_some(adapted));
        checks
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        let mut findings = Findings::default();
        let mut shapes = Plot {
            title: "Catenary: references as lines, particles as dots".into(),
            labels: ["x/L".into(), "z/L".into()],
            square: true,
            ..Plot::default()
        };
        let cases = self.span.iter().flat_map(|span| self.mesh.iter().map(move |mesh| (*span, *mesh)));
        for (k, (span, mesh)) in cases.enumerate() {
            strip::allow("span", span, [0.04, 0.995])?;
            let particles = self.particles.unwrap_or(if span < 0.1 { 301 } else { 153 });
            strip::allow("particles", particles as f64, [5.0, 400.0])?;
            let reference = Hung::new(span, strip::weight() * LENGTH / TAUT);
            let (world, reaction) = rest(span, particles, mesh, context.seed)?;
            let shape = strip::shape(&world, 0);
            let middle = elastic_middle(&world);
            let case = format!("d/l {span}, {particles} particles{}", mesh.case());
            let end = reference.at(0.5);
            for (name, measured, reference) in [
                ("catenary horizontal reaction", reaction[0], reference.force),
                ("catenary vertical reaction", reaction[1], 0.5),
                ("catenary sag", -middle, end[1]),
            ] {
                findings.rows.push(Row::compare(name, &case, measured, reference, 1e-3));
            }
            let line = (-100..=100).map(|n| reference.at(f64::from(n) / 200.0));
            let line = line.map(|p| [p[0] + 0.5 * span, p[1] - end[1]]).collect();
            shapes.series.push(Series::line(&format!("d/l {span}{}", mesh.case()), line));
            shapes.series.push(Series::dots("", shape));
            (context.progress)((k + 1) as f64 / (self.span.len() * self.mesh.len()) as f64);
        }
        findings.plots.push(shapes);
        Ok(findings)
    }
}

/// Largest cells across graded strips. Random meshes of more differ more from row to row, and no bending evens out their chords.
const ACROSS: usize = 2;

/// The strip at rest, and its horizontal and vertical pull on its first end over its weight. It starts as a V.
fn rest(span: f64, particles: usize, mesh: Mesh, seed: u64) -> Result<(World, [f64; 2]), Refused> {
    let (half, deep) = (0.5 * span * LENGTH, 0.5 * LENGTH * (1.0 - span * span).sqrt());
    let setup = mesh.strip(particles, ACROSS, |particles| {
        let intervals = (particles - 1) as f64;
        let place = |i: usize| {
            let part = i as f64 / intervals;
            [2.0 * half * part, -deep * (1.0 - (2.0 * part - 1.0).abs())]
        };
        let fabric = strip::ideal(strip::DENSITY, TAUT, strip::rigidity(LIMP));
        let mut setup = strip::setup(fabric, particles, [LENGTH, LENGTH / intervals], place);
        setup.pins = vec![[0, 0], [0, 1], [particles - 1, 0], [particles - 1, 1]];
        setup
    });
    let mut world = mesh.world(setup, |_| false, &mut Pcg64::seed_from_u64(seed))?;
    mesh::settle(&mut world, 0.05, 3000)?;
    let pull = (0..world.grid().counts[1]).filter_map(|j| world.reaction([0, j]));
    let pull = pull.fold([0.0, 0.0], |sum, f| [sum[0] + f.x, sum[1] - f.z]);
    let weight = world.model().weight();
    Ok((world, pull.map(|f| f / weight)))
}

/// Height of a strip's middle over its length.
fn elastic_middle(world: &World) -> f64 {
    let (grid, mut places) = (world.grid(), world.positions()[..world.grid().particles()].to_vec());
    // The middle need not be a particle of the mesh.
    grid.interpolate(&mut places, Interpolation::Cubic);
    let at = |i: usize| places[grid.index([i, 0])].z / LENGTH;
    let count = grid.counts[0];
    let half = count / 2;
    if count % 2 == 1 {
        return at(half);
    }
    // Between two particles: the lowest point of the parabola through the four around it.
    (9.0 * (at(half - 1) + at(half)) - at(half - 2) - at(half + 1)) / 16.0
}

/// A strip of a real fabric hung from one end: the strain at each height follows from the weight below.
#[derive(Clone, Debug, clap::Args)]
pub struct Vertical {
    /// Fabrics, as in `kesi fabric list`.
    #[arg(long, value_delimiter = ',', default_values_t = Vertical::default().fabric)]
    pub fabric: Vec<String>,
    /// Length [m].
    #[arg(long, default_value_t = Vertical::default().length)]
    pub length: f64,
    /// Gravity [m/s²]; many times the usual reaches far into the tensile curve.
    #[arg(long, value_delimiter = ',', default_values_t = Vertical::default().gravity)]
    pub gravity: Vec<f64>,
    /// Particles from end to end.
    #[arg(long, default_value_t = Vertical::default().particles)]
    pub particles: usize,
}

impl Default for Vertical {
    fn default() -> Vertical {
        Vertical {
            fabric: vec!["denim-a".into(), "denim-f".into()],
            length: 0.3,
            gravity: vec![strip::GRAVITY, 100.0 * strip::GRAVITY],
            particles: 77,
        }
    }
}

impl Vertical {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<Vertical> {
        let full = Vertical::default();
        vec![if quick { Vertical { fabric: vec!["denim-b".into()], ..full } } else { full }]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        strip::allow("particles", self.particles as f64, [3.0, 400.0])?;
        strip::allow("length", self.length, [0.01, 10.0])?;
        let mut findings = Findings::default();
        let mut plot = Plot {
            title: "Vertical strip: strain over the distance from the top".into(),
            labels: ["s/L".into(), "strain".into()],
            ..Plot::default()
        };
        let runs = (self.fabric.len() * self.gravity.len()) as f64;
        for (f, name) in self.fabric.iter().enumerate() {
            for (g, &gravity) in self.gravity.iter().enumerate() {
                strip::allow("gravity", gravity, [0.1, 2000.0])?;
                let fabric = fabric::load(name).map_err(|e| Refused(e.to_string()))?;
                let weight = fabric.areal_density * gravity * self.length;
                let law = fabric.tensile[0].clone();
                let strains = self.rest(fabric, gravity)?;
                let intervals = strains.len() as f64;
                let known: Vec<f64> = (0..strains.len())
                    .map(|k| loaded(&law, weight * (1.0 - (k as f64 + 0.5) / intervals)))
                    .collect();
                let most = known[0].abs();
                let off = strains.iter().zip(&known).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                let case = format!("{name}, {gravity} m/s², {} particles", self.particles);
                let [longer, should] = [&strains, &known].map(|e| e.iter().sum::<f64>() / intervals);
                findings.rows.push(Row::compare("vertical strip, elongation", &case, longer, should, 1e-4));
                findings.rows.push(Row::vanishes("vertical strip, strain anywhere", &case, off / most, 1e-4));
                let along = |e: &[f64]| {
                    e.iter().enumerate().map(|(k, e)| [(k as f64 + 0.5) / intervals, *e]).collect()
                };
                plot.series.push(Series::line(&format!("{name}, {gravity} m/s²"), along(&known)));
                plot.series.push(Series::dots("", along(&strains)));
                (context.progress)((f * self.gravity.len() + g + 1) as f64 / runs);
            }
        }
        findings.plots.push(plot);
        Ok(findings)
    }

    /// Strains of the strip's edges at rest, from the top down. Drag is so strong that it comes down without ever going back up, as history remembers that.
    fn rest(&self, fabric: fabric::Fabric, gravity: f64) -> Result<Vec<f64>, Refused> {
        let spacing = self.length / (self.particles - 1) as f64;
        let mut setup =
            strip::setup(fabric, self.particles, [self.length, spacing], |i| [0.0, -(i as f64) * spacing]);
        setup.gravity = gravity;
        setup.drag = 1e4;
        setup.pins = vec![[0, 0], [0, 1]];
        let mut world = World::new(setup)?;
        strip::settle(&mut world, 0.02, 5000)?;
        let at = |i: usize| world.positions()[world.grid().index([i, 0])];
        Ok((1..self.particles).map(|i| (at(i) - at(i - 1)).norm() / spacing - 1.0).collect())
    }
}

/// Strain [1] at which a virgin law that only ever loads answers with a tension [N/m].
fn loaded(law: &Law, tension: f64) -> f64 {
    let answer = |strain: f64| law.evaluate(strain, law.commit(strain, law.virgin())).force;
    let (mut low, mut high) = (0.0, 2.0);
    for _ in 0..100 {
        let middle = 0.5 * (low + high);
        if answer(middle) > tension { high = middle } else { low = middle }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Span over length, a over length, sag over length.
    #[test]
    fn catenary_agrees_with_known_values() {
        for [span, a, sag] in [
            [0.2, 0.027947, 0.472834],
            [0.5, 0.114820, 0.398194],
            [0.8, 0.338202, 0.265438],
            [0.95, 0.851862, 0.135898],
            [0.99, 2.013739, 0.061145],
        ] {
            let hung = Hung::new(span, 0.0);
            assert!((hung.force - a).abs() < 1e-6 && (hung.at(0.5)[1] - sag).abs() < 1e-6, "{span}");
        }
    }

    #[test]
    fn loading_is_inverted_up_to_rounding() {
        let law = fabric::load("denim-a").unwrap().tensile[0].clone();
        for tension in [0.1, 3.0, 90.0, 400.0] {
            let strain = loaded(&law, tension);
            assert!(strain > 0.0 && strain <= law.strains(tension)[1] + 1e-12);
        }
    }
}
