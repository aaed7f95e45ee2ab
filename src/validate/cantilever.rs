//! The self-weight cantilever: a strip clamped level at one end, against the elastica.

use super::{Context, Findings, Plot, Row, Series, elastica, strip};
use crate::{
    math::Vec3,
    world::{Refused, World},
};

/// A strip clamped level, bent by its own weight.
#[derive(Clone, Debug, clap::Args)]
pub struct Cantilever {
    /// Γ = w L³/B, weight against bending.
    #[arg(long, value_delimiter = ',', default_values_t = Cantilever::default().gamma)]
    pub gamma: Vec<f64>,
    /// Particles from the clamp to the tip.
    #[arg(long, default_value_t = Cantilever::default().particles)]
    pub particles: usize,
}

impl Default for Cantilever {
    fn default() -> Cantilever {
        Cantilever {
            gamma: vec![0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 10000.0],
            particles: 77,
        }
    }
}

/// Length of the strip [m].
const LENGTH: f64 = 0.2;

impl Cantilever {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Option<Cantilever> {
        let gamma = if quick { vec![1.0, 30.0] } else { Cantilever::default().gamma };
        Some(Cantilever { gamma, ..Cantilever::default() })
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        strip::allow("particles", self.particles as f64, [3.0, 2000.0])?;
        let mut findings = Findings::default();
        let mut shapes = Plot {
            title: "Self-weight cantilever".into(),
            labels: ["x/L".into(), "z/L".into()],
            square: true,
            ..Plot::default()
        };
        for (k, &gamma) in self.gamma.iter().enumerate() {
            strip::allow("gamma", gamma, [1e-3, 1e5])?;
            let shape = rest(gamma, self.particles)?;
            let reference = elastica::self_weight(gamma);
            let tip = shape[shape.len() - 1];
            let case = format!("Γ {gamma}, {} particles", self.particles);
            let tolerance = tolerance(gamma);
            findings.rows.push(Row::compare("cantilever H/L", &case, -tip[1], reference.drop, tolerance));
            findings.rows.push(Row::compare("cantilever W/L", &case, tip[0], reference.reach, tolerance));
            let line = reference.shape.iter().map(|p| [p[0], -p[1]]).collect();
            shapes.series.push(Series::line(&format!("Γ {gamma}"), line));
            shapes.series.push(Series::dots("", shape));
            (context.progress)((k + 1) as f64 / self.gamma.len() as f64);
        }
        findings.plots.push(shapes);
        Ok(findings)
    }
}

/// A mesh whose spacing is a small part of the length over which weight bends the strip is within 0.1 %, a coarser one within 1 %; past
/// Γ = 1,000 the boundary layer at the clamp has only a few particles at the usual mesh.
fn tolerance(gamma: f64) -> f64 {
    match gamma {
        g if g <= 100.0 => 1e-3,
        g if g <= 1000.0 => 1e-2,
        _ => 5e-2,
    }
}

/// The strip at rest, from the clamp to the tip, over its length.
pub fn rest(gamma: f64, particles: usize) -> Result<Vec<[f64; 2]>, Refused> {
    let spacing = LENGTH / (particles - 1) as f64;
    let rigidity = strip::weight() * LENGTH.powi(3) / gamma;
    let fabric = strip::ideal(strip::DENSITY, strip::STIFF, rigidity);
    // Two rows are held: the edge between them is the clamp, so the strip starts at the second.
    let place = |[i, j]: [usize; 2]| Vec3::new((i as f64 - 1.0) * spacing, j as f64 * spacing, 0.0);
    let mut setup = strip::setup(fabric, particles + 1, LENGTH + spacing, place);
    setup.pins = vec![[0, 0], [0, 1], [1, 0], [1, 1]];
    setup.drag = 5.0;
    let mut world = World::new(setup)?;
    strip::settle(&mut world, 0.05, 3000)?;
    let x = world.positions();
    Ok((1..=particles).map(|i| x[world.grid().index([i, 0])] / LENGTH).map(|p| [p.x, p.z]).collect())
}
