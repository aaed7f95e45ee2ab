//! Buckling under own weight, bisected: a strip standing on a clamp [Greenhill 1881], and one on edge, which turns over sideways.
//!
//! A load is carried if a strip that is bent a little goes back.

use super::{Context, Findings, Row, elastica::runge_kutta, strip};
use crate::{
    math::Vec3,
    model::Setup,
    world::{Budget, Refused, World},
};
use strip::LENGTH;

/// A strip standing on a clamp: the Γ at which it buckles, bisected.
#[derive(Clone, Debug, clap::Args)]
pub struct Standing {
    /// Particles from the clamp to the tip.
    #[arg(long, value_delimiter = ',', default_values_t = Standing::default().particles)]
    pub particles: Vec<usize>,
}

impl Default for Standing {
    fn default() -> Standing {
        Standing { particles: vec![39, 77] }
    }
}

/// Bisections: the answer is known to 1e-5.
const HALVINGS: usize = 18;
/// Bend at the tip, over the length.
const BEND: f64 = 1e-6;
/// Drag [kg/(m² s)], length [s] and number of the steps in which it goes back or on.
const SLOW: f64 = 100.0;
const STEP: f64 = 2.0;
const STEPS: usize = 60;

impl Standing {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<Standing> {
        vec![if quick { Standing { particles: vec![39] } } else { Standing::default() }]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        let mut findings = Findings::default();
        let reference = greenhill();
        for (k, &particles) in self.particles.iter().enumerate() {
            strip::allow("particles", particles as f64, [5.0, 400.0])?;
            let spacing = LENGTH / (particles - 1) as f64;
            let carried = |gamma: f64| {
                let fabric = strip::ideal(strip::DENSITY, strip::STIFF, strip::rigidity(gamma));
                let mut setup = strip::clamped(fabric, particles, |i| [i as f64 * spacing, 0.0]);
                // Upright: the strip's way out of the clamp is up.
                setup.positions.iter_mut().for_each(|p| *p = Vec3::new(0.0, p.y, p.x));
                stands(setup, Vec3::x())
            };
            let found = bisect([0.5 * reference, 2.0 * reference], &carried)?;
            let case = format!("{particles} particles");
            findings.rows.push(Row::compare("standing strip, buckling Γ", &case, found, reference, 5e-3));
            (context.progress)((k + 1) as f64 / self.particles.len() as f64);
        }
        Ok(findings)
    }
}

/// A strip clamped on edge: the w L³/√(EI·GJ) at which it turns over, bisected.
#[derive(Clone, Debug, clap::Args)]
pub struct Lateral {
    /// Particles from the clamp to the tip.
    #[arg(long, default_value_t = Lateral::default().particles)]
    pub particles: usize,
    /// Twist rigidity over bending rigidity.
    #[arg(long, value_delimiter = ',', default_values_t = Lateral::default().twist)]
    pub twist: Vec<f64>,
    /// Depth over length.
    #[arg(long, default_value_t = Lateral::default().depth)]
    pub depth: f64,
}

impl Default for Lateral {
    fn default() -> Lateral {
        Lateral { particles: 77, twist: vec![1.0, 2.0], depth: 0.01 }
    }
}

/// Tensile and shear stiffness of the strip on edge [N/m]: stiff, as the closed form knows no bending in its plane.
const STIFF: f64 = 1e6;

impl Lateral {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<Lateral> {
        let full = Lateral::default();
        vec![if quick { Lateral { particles: 39, twist: vec![2.0], ..full } } else { full }]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        strip::allow("particles", self.particles as f64, [5.0, 400.0])?;
        strip::allow("depth", self.depth, [1e-3, 0.1])?;
        let mut findings = Findings::default();
        let reference = turning_over();
        for (k, &ratio) in self.twist.iter().enumerate() {
            strip::allow("twist", ratio, [0.1, 3.0])?;
            let carried = |load: f64| stands(self.on_edge(load, ratio), Vec3::y());
            let found = bisect([0.5 * reference, 2.0 * reference], &carried)?;
            let case = format!("twist {ratio} B, {} particles", self.particles);
            findings.rows.push(Row::compare(
                "lateral buckling, w L³/√(EI GJ)",
                &case,
                found,
                reference,
                0.02,
            ));
            (context.progress)((k + 1) as f64 / self.twist.len() as f64);
        }
        Ok(findings)
    }

    /// The strip on edge: the weft upright. EI is B and GJ is T per width.
    fn on_edge(&self, load: f64, ratio: f64) -> Setup {
        let spacing = LENGTH / (self.particles - 1) as f64;
        let rigidity = strip::weight() * LENGTH.powi(3) / (load * ratio.sqrt());
        let mut fabric = strip::ideal(strip::DENSITY, STIFF, rigidity);
        fabric.twist = ratio * rigidity;
        fabric.shear = crate::fabric::law::Law::linear(STIFF);
        let size = [LENGTH + spacing, self.depth * LENGTH];
        let place = |i: usize| [(i as f64 - 1.0) * spacing, 0.0];
        let mut setup = strip::setup(fabric, self.particles + 1, size, place);
        setup.positions.iter_mut().for_each(|p| *p = Vec3::new(p.x, 0.0, p.y));
        setup.pins = vec![[0, 0], [0, 1], [1, 0], [1, 1]];
        setup
    }
}

/// Whether a strip stands: bent a little across its plane, it goes back. Drag and long steps leave of the bend only what goes back slowest.
fn stands(mut setup: Setup, across: Vec3) -> Result<bool, Refused> {
    let straight = setup.positions.clone();
    let clamp = setup.pins.iter().map(|pin| pin[0]).max().unwrap_or(0);
    for (n, p) in setup.positions.iter_mut().enumerate() {
        let part = (n / 2).saturating_sub(clamp) as f64 / setup.particles[0] as f64;
        *p += across * (BEND * LENGTH * part * part);
    }
    setup.drag = SLOW;
    let mut world = World::new(setup)?;
    let bend = |world: &World| -> f64 {
        world.positions().iter().zip(&straight).map(|(a, b)| (a - b).dot(&across).powi(2)).sum::<f64>().sqrt()
    };
    let mut midway = 0.0;
    for k in 0..STEPS {
        world.step(&[], STEP, Budget::solves(20));
        if k == STEPS / 2 {
            midway = bend(&world);
        }
        if !world.state().is_finite() {
            return Err(Refused("the strip blew up".into()));
        }
    }
    Ok(bend(&world) <= midway)
}

/// The load between two at which a strip no longer stands.
fn bisect(
    [mut low, mut high]: [f64; 2],
    carried: &dyn Fn(f64) -> Result<bool, Refused>,
) -> Result<f64, Refused> {
    if !carried(low)? || carried(high)? {
        return Err(Refused(format!("the strip does not go over between {low:.3} and {high:.3}")));
    }
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if carried(middle)? { low = middle } else { high = middle }
    }
    Ok(0.5 * (low + high))
}

/// Γ of a standing strip that buckles: φ″ + Γ s φ = 0 from the free tip, φ′(0) = 0, first has φ(1) = 0.
fn greenhill() -> f64 {
    smallest([1.0, 20.0], &|load, s, y| [y[1], -load * s * y[0]])
}

/// w L³/√(EI·GJ) of a strip on edge that turns over: φ″ + ¼ Λ² s⁴ φ = 0 from the free tip, φ′(0) = 0, first has φ(1) = 0.
fn turning_over() -> f64 {
    smallest([1.0, 25.0], &|load, s, y| [y[1], -0.25 * (load * s * s).powi(2) * y[0]])
}

/// The smallest load at which the solution from φ(0) = 1, φ′(0) = 0 is 0 at 1.
fn smallest([mut low, mut high]: [f64; 2], f: &impl Fn(f64, f64, &[f64; 2]) -> [f64; 2]) -> f64 {
    let end = |load: f64| {
        let mut y = [1.0, 0.0];
        for k in 0..2000 {
            y = runge_kutta(&|s, y| f(load, s, y), f64::from(k) / 2000.0, &y, 1.0 / 2000.0);
        }
        y[0]
    };
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if end(middle) > 0.0 { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn critical_loads_agree_with_zeros_of_bessel_functions() {
        assert!((greenhill() - 7.837347).abs() < 1e-6, "{}", greenhill());
        assert!((turning_over() - 12.85).abs() < 0.01, "{}", turning_over());
    }
}
