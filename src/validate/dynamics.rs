//! Cloth in motion: free fall, terminal velocity, periods of strips, order of the time integrator.

use super::{Context, Findings, Plot, Row, Series, strip};
use crate::{
    math::Vec3,
    model::Setup,
    world::{Budget, Refused, World},
};
use std::f64::consts::TAU;
use strip::LENGTH;

/// Free fall, terminal velocity, pendulums, a clamped strip, the order of the time integrator.
#[derive(Clone, Debug, clap::Args)]
pub struct Dynamics {
    /// Time step [s].
    #[arg(long, default_value_t = Dynamics::default().step)]
    pub step: f64,
    /// Particles along the strips.
    #[arg(long, default_value_t = Dynamics::default().particles)]
    pub particles: usize,
    /// Γ = w L³/B of the clamped strip (it swings without weight).
    #[arg(long, default_value_t = Dynamics::default().gamma)]
    pub gamma: f64,
    /// Air drag per area of the sheet that falls to its terminal velocity [kg/(m² s)].
    #[arg(long, default_value_t = Dynamics::default().drag)]
    pub drag: f64,
}

impl Default for Dynamics {
    fn default() -> Dynamics {
        Dynamics { step: 1e-3, particles: 39, gamma: 10.0, drag: 0.5 }
    }
}

/// Γ of a strip that bends freely, and of one that does not bend.
const LIMP: f64 = 1e7;
const RIGID: f64 = 1e-2;
/// Deflection of swinging strips at the tip, over the length.
const SWING: f64 = 0.05;
/// Half periods that are timed.
const HALVES: usize = 6;
/// First zero of the Bessel function J0.
const J0_ZERO: f64 = 2.404_825_557_695_773;
/// Solves of a step.
const SOLVES: u32 = 6;

impl Dynamics {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<Dynamics> {
        let full = Dynamics::default();
        vec![if quick { Dynamics { step: 2e-3, particles: 20, ..full } } else { full }]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        strip::allow("step", self.step, [1e-4, 1e-2])?;
        strip::allow("particles", self.particles as f64, [5.0, 200.0])?;
        strip::allow("gamma", self.gamma, [0.1, 1000.0])?;
        strip::allow("drag", self.drag, [1e-3, 100.0])?;
        let mut findings = Findings::default();
        findings.rows.extend(self.fall()?);
        findings.rows.push(self.terminal()?);
        (context.progress)(0.2);
        let mut plot = Plot {
            title: "Tips of swinging strips".into(),
            labels: ["time over period".into(), "x/L".into()],
            ..Plot::default()
        };
        for (k, swing) in [Swing::Chain, Swing::Rod, Swing::Clamped].into_iter().enumerate() {
            let reference = swing.period(self.gamma);
            let path = self.swing(swing, reference)?;
            let measured =
                period(&path).ok_or_else(|| Refused(format!("{}: it does not swing", swing.name())))?;
            let case = format!("{} particles, steps of {} s", self.particles, self.step);
            findings.rows.push(Row::compare(swing.name(), &case, measured, reference, 5e-3));
            let points = path.iter().map(|p| [p[0] / reference, p[1]]).collect();
            plot.series.push(Series::line(swing.name(), points));
            (context.progress)(0.4 + 0.2 * k as f64);
        }
        findings.plots.push(plot);
        findings.rows.push(self.order()?);
        Ok(findings)
    }

    /// A free sheet falls as g t and ½ g t²; implicit Euler is ahead by half a step.
    fn fall(&self) -> Result<[Row; 2], Refused> {
        let steps = (0.3 / self.step).ceil();
        let time = steps * self.step;
        let world = self.drop(0.0, steps as usize)?;
        let [speed, depth] = [&world.state().velocities, world.positions()]
            .map(|v| -v.iter().map(|v| v.z).sum::<f64>() / v.len() as f64);
        let case = format!("{time:.3} s in steps of {} s", self.step);
        let reference = 0.5 * strip::GRAVITY * time * time;
        Ok([
            Row::compare("free fall, speed", &case, speed, strip::GRAVITY * time, 1e-6),
            Row::compare("free fall, depth", &case, depth, reference, 1.01 * self.step / time),
        ])
    }

    /// It falls at last with weight over drag.
    fn terminal(&self) -> Result<Row, Refused> {
        // Until e⁻²⁰ is left, by steps as long as that takes.
        let steps = (20.0 * strip::DENSITY / self.drag / self.step).ceil().min(20_000.0);
        let world = self.drop(self.drag, steps as usize)?;
        let speed = world.state().velocities[0].norm();
        let case = format!("drag {} kg/(m² s)", self.drag);
        Ok(Row::compare("terminal velocity", &case, speed, strip::weight() / self.drag, 1e-5))
    }

    fn drop(&self, drag: f64, steps: usize) -> Result<World, Refused> {
        let fabric = strip::ideal(strip::DENSITY, 1e3, strip::rigidity(self.gamma));
        let mut setup = strip::setup(fabric, 6, [LENGTH, LENGTH], |i| [i as f64 * LENGTH / 5.0, 0.0]);
        setup.drag = drag;
        let mut world = World::new(setup)?;
        (0..steps).for_each(|_| {
            world.step(&[], self.step, Budget::solves(SOLVES));
        });
        Ok(world)
    }

    /// Time [s] and the tip's deflection over the length, until enough half periods are over.
    fn swing(&self, swing: Swing, period: f64) -> Result<Vec<[f64; 2]>, Refused> {
        let mut world = World::new(swing.setup(self.particles, self.gamma))?;
        let steps = (period * (0.5 * HALVES as f64 + 0.5) / self.step) as usize;
        let mut path = Vec::with_capacity(steps);
        for k in 1..=steps {
            world.step(&[], self.step, Budget::solves(SOLVES));
            let tip = world.positions()[world.positions().len() - 1];
            path.push([k as f64 * self.step, swing.across().dot(&tip) / LENGTH]);
        }
        Ok(path)
    }

    /// Order of the time integrator: differences of the places at one time, over steps halved twice.
    fn order(&self) -> Result<Row, Refused> {
        let time = 0.128;
        let at = |halvings: i32| -> Result<Vec<Vec3>, Refused> {
            let step = 8e-3 * 0.5_f64.powi(halvings);
            let mut setup = Swing::Chain.setup(self.particles, self.gamma);
            // Far out: the motion is not linear.
            setup.positions.iter_mut().for_each(|p| *p = Vec3::new(-0.8 * p.z, p.y, 0.6 * p.z));
            let mut world = World::new(setup)?;
            for _ in 0..(time / step).round() as usize {
                world.step(&[], step, Budget::solves(20));
            }
            Ok(world.positions().to_vec())
        };
        let [coarse, middle, fine] = [at(1)?, at(2)?, at(3)?];
        let distance =
            |a: &[Vec3], b: &[Vec3]| a.iter().zip(b).map(|(a, b)| (a - b).norm_squared()).sum::<f64>().sqrt();
        let order = (distance(&coarse, &middle) / distance(&middle, &fine)).log2();
        Ok(Row::at_least("order of the time integrator", "steps of 4, 2 and 1 ms", order, 0.9))
    }
}

/// A strip that swings.
#[derive(Clone, Copy)]
enum Swing {
    /// Limp, hung from one end.
    Chain,
    /// Rigid, hung from one end.
    Rod,
    /// Clamped level, without weight.
    Clamped,
}

impl Swing {
    fn name(self) -> &'static str {
        match self {
            Swing::Chain => "period of a limp hanging strip",
            Swing::Rod => "period of a rigid pendulum",
            Swing::Clamped => "period of a clamped strip",
        }
    }

    /// Period of small swings [s].
    fn period(self, gamma: f64) -> f64 {
        match self {
            // First zero of the Bessel function J0: ω = ½ j √(g/L).
            Swing::Chain => TAU / (0.5 * J0_ZERO * (strip::GRAVITY / LENGTH).sqrt()),
            // A rod turning about its end; the next term of the amplitude's series.
            Swing::Rod => TAU * (2.0 * LENGTH / (3.0 * strip::GRAVITY)).sqrt() * (1.0 + SWING * SWING / 16.0),
            // Euler–Bernoulli: cos k cosh k = −1, ω = k² √(B/(ρ L⁴)).
            Swing::Clamped => {
                TAU / (1.875_104_068_7_f64.powi(2) * (strip::rigidity(gamma) / strip::DENSITY).sqrt())
                    * LENGTH.powi(2)
            }
        }
    }

    /// Direction in which it swings.
    fn across(self) -> Vec3 {
        match self {
            Swing::Clamped => Vec3::z(),
            _ => Vec3::x(),
        }
    }

    /// Deflected about as it swings and let go.
    fn setup(self, particles: usize, gamma: f64) -> Setup {
        let spacing = LENGTH / (particles - 1) as f64;
        let part = |i: usize| i as f64 / (particles - 1) as f64;
        let mut setup = match self {
            Swing::Clamped => {
                let fabric = strip::ideal(strip::DENSITY, strip::STIFF, strip::rigidity(gamma));
                let mode = |s: f64| s * s * (6.0 - 4.0 * s + s * s) / 3.0;
                let place = |i: usize| [i as f64 * spacing, SWING * LENGTH * mode(part(i))];
                let setup = strip::clamped(fabric, particles, place);
                Setup { gravity: 0.0, ..setup }
            }
            _ => {
                let limp = matches!(self, Swing::Chain);
                let fabric = strip::ideal(
                    strip::DENSITY,
                    strip::STIFF,
                    strip::rigidity(if limp { LIMP } else { RIGID }),
                );
                let mode = |s: f64| if limp { bessel(0.5 * J0_ZERO * (1.0 - s).sqrt()) } else { s };
                let place = |i: usize| [SWING * LENGTH * mode(part(i)), -(i as f64) * spacing];
                let mut setup = strip::setup(fabric, particles, [LENGTH, spacing], place);
                setup.pins = vec![[0, 0], [0, 1]];
                setup
            }
        };
        setup.drag = 0.0;
        setup
    }
}

/// The Bessel function J0 at twice `half`, by its series.
fn bessel(half: f64) -> f64 {
    let (mut term, mut sum) = (1.0, 1.0);
    for k in 1..30 {
        term *= -half * half / f64::from(k * k);
        sum += term;
    }
    sum
}

/// Period [s] of a path of time and deflection, from the times at which it passes 0; none if it hardly does.
fn period(path: &[[f64; 2]]) -> Option<f64> {
    let crossings: Vec<f64> = path
        .windows(2)
        .filter(|w| w[0][1].signum() != w[1][1].signum())
        .map(|w| w[0][0] + (w[1][0] - w[0][0]) * w[0][1] / (w[0][1] - w[1][1]))
        .collect();
    let [first, last] = [*crossings.first()?, *crossings.get(HALVES - 1)?];
    Some(2.0 * (last - first) / (HALVES - 1) as f64)
}
