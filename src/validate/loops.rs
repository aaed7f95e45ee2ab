//! Loops of a strip with both ends clamped at one place: pear, heart and ring, weightless and heavy, against the elastica.

use super::{
    Context, Findings, Plot, Row, Series,
    elastica::{self, Shape},
    strip,
};
use crate::world::{Refused, World};
use strip::LENGTH;

/// Loops hanging from a clamp that holds both ends of a strip.
#[derive(Clone, Debug, clap::Args)]
pub struct Loops {
    /// Shapes.
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = Loops::default().shape)]
    pub shape: Vec<Shape>,
    /// β = w L³/B, weight against bending; 0 is weightless. The heart takes 200 at the most, the others 1,000.
    #[arg(long, value_delimiter = ',', default_values_t = Loops::default().beta)]
    pub beta: Vec<f64>,
    /// Particles from clamp to clamp, an odd number.
    #[arg(long, default_value_t = Loops::default().particles)]
    pub particles: usize,
}

impl Default for Loops {
    fn default() -> Loops {
        Loops {
            shape: vec![Shape::Pear, Shape::Heart, Shape::Ring],
            beta: vec![0.0, 10.0, 50.0, 100.0],
            particles: 153,
        }
    }
}

/// Rigidity of weightless loops, as β of their weight were they heavy.
const STIFFNESS: f64 = 10.0;

impl Loops {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<Loops> {
        let full = Loops::default();
        if quick {
            return vec![Loops { beta: vec![0.0, 30.0], ..full }];
        }
        let only =
            |shape: Shape, beta: f64| Loops { shape: vec![shape], beta: vec![beta], ..Loops::default() };
        vec![full, only(Shape::Heart, 200.0), only(Shape::Pear, 1000.0)]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        strip::allow("particles", self.particles as f64, [9.0, 400.0])?;
        if self.particles.is_multiple_of(2) {
            return Err(Refused(format!(
                "particles: got {}, allowed: an odd number, so that one is the lowest",
                self.particles
            )));
        }
        let mut findings = Findings::default();
        let mut plot = Plot {
            title: "Loops: references as lines, particles as dots".into(),
            labels: ["x/L".into(), "z/L".into()],
            square: true,
            ..Plot::default()
        };
        let cases: Vec<(Shape, f64)> =
            self.shape.iter().flat_map(|s| self.beta.iter().map(move |b| (*s, *b))).collect();
        for (k, &(shape, beta)) in cases.iter().enumerate() {
            strip::allow("beta", beta, [0.0, if shape == Shape::Heart { 200.0 } else { 1000.0 }])?;
            let none = || Refused(format!("{}: no reference found for β {beta}", shape.name()));
            let reference = shape.solve(beta).ok_or_else(none)?;
            let start = shape.solve(0.0).ok_or_else(none)?;
            let found = self.rest(beta, &start)?;
            let height = -found[self.particles / 2][1];
            let name = format!("{} loop, height/L", shape.name());
            let case = format!("β {beta}, {} particles", self.particles);
            findings.rows.push(Row::compare(&name, &case, height, reference.height, 2e-3));
            // Side by side.
            let aside = 0.5 * k as f64;
            let line = whole(&reference.half).into_iter().step_by(20).map(|p| [p[0] + aside, p[1]]).collect();
            plot.series.push(Series::line(&format!("{} β {beta}", shape.name()), line));
            plot.series.push(Series::dots("", found.iter().map(|p| [p[0] + aside, p[1]]).collect()));
            (context.progress)((k + 1) as f64 / cases.len() as f64);
        }
        findings.plots.push(plot);
        Ok(findings)
    }

    /// The loop at rest, over its length from the clamp. It starts along the weightless loop.
    fn rest(&self, beta: f64, start: &elastica::Loop) -> Result<Vec<[f64; 2]>, Refused> {
        let intervals = self.particles - 1;
        let spacing = LENGTH / intervals as f64;
        let along = whole(&start.half);
        let point = |i: usize| elastica::at(&along, i as f64 / intervals as f64).map(|v| v * LENGTH);
        // Each clamp holds an edge, which goes straight on from the loop's end.
        let ends = [[0, 1], [intervals, intervals - 1]].map(|[end, next]| {
            let ([x, z], [u, v]) = (point(end), point(next));
            let direction = shape_direction([x - u, z - v]);
            [x + spacing * direction[0], z + spacing * direction[1]]
        });
        let place = |i: usize| match i {
            0 => ends[0],
            i if i == self.particles + 1 => ends[1],
            i => point(i - 1),
        };
        let gamma = if beta > 0.0 { beta } else { STIFFNESS };
        let fabric = strip::ideal(strip::DENSITY, strip::STIFF, strip::rigidity(gamma));
        let rows = self.particles + 2;
        let mut setup = strip::setup(fabric, rows, [LENGTH + 2.0 * spacing, spacing], place);
        setup.pins = [0, 1, rows - 2, rows - 1].iter().flat_map(|&i| [[i, 0], [i, 1]]).collect();
        setup.gravity = if beta > 0.0 { strip::GRAVITY } else { 0.0 };
        let mut world = World::new(setup)?;
        strip::settle(&mut world, 0.05, 3000)?;
        let shape = strip::shape(&world, 1);
        Ok(shape[..self.particles].to_vec())
    }
}

/// The nearest of the four directions along the axes: those in which clamps point.
fn shape_direction([x, z]: [f64; 2]) -> [f64; 2] {
    if x.abs() > z.abs() { [x.signum(), 0.0] } else { [0.0, z.signum()] }
}

/// The whole loop from clamp to clamp, the clamp in the origin.
fn whole(half: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let height = half[half.len() - 1][1];
    let left = half.iter().rev().map(|p| [-p[0], p[1] - height]);
    left.chain(half[1..].iter().map(|p| [p[0], p[1] - height])).collect()
}
