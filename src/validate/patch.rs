//! Patch tests: meshes must reproduce constant strain and constant shear exactly, and the energy of a cylinder.
//!
//! Places come from each particle's material coordinates and references from the areas of the elements, so that a graded mesh
//! needs nothing but a setup of its own.

use super::{Context, Findings, Row, strip};
use crate::{
    fabric::{self, Fabric, isotropic_twist, law::Law},
    math::Vec3,
    model::Setup,
    world::{Refused, World},
};
use nalgebra::Rotation3;
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::sync::Arc;

/// Constant strain and shear, and cylinders bent along warp, weft and bias.
#[derive(Clone, Debug, clap::Args)]
pub struct Patch {
    /// Particles along warp and weft.
    #[arg(long, num_args = 2, default_values_t = Patch::default().particles)]
    pub particles: Vec<usize>,
    /// Tensile strain along warp and weft; above 0, as cloth under compression wrinkles.
    #[arg(long, num_args = 2, default_values_t = Patch::default().strain)]
    pub strain: Vec<f64>,
    /// Shear angle [deg].
    #[arg(long, default_value_t = Patch::default().shear)]
    pub shear: f64,
    /// Bending angle per cell of the cylinders [rad].
    #[arg(long, default_value_t = Patch::default().turn)]
    pub turn: f64,
}

impl Default for Patch {
    fn default() -> Patch {
        Patch { particles: vec![13, 10], strain: vec![0.02, 0.01], shear: 5.0, turn: 0.1 }
    }
}

/// Size along warp and weft [m]: cells are not square.
const SIZE: [f64; 2] = [0.12, 0.11];
/// Tensile stiffness along warp and weft, shear stiffness [N/m], bending rigidity [N·m].
const TENSILE: [f64; 2] = [1000.0, 2500.0];
const SHEAR: f64 = 60.0;
const BENDING: f64 = 1e-4;
/// How far particles inside start from their place, over the spacing.
const ASTRAY: f64 = 0.2;

impl Patch {
    /// The suite's checks.
    pub fn suite(_quick: bool) -> Vec<Patch> {
        vec![Patch::default()]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        let counts = [self.particles[0], self.particles[1]];
        counts.iter().try_for_each(|n| strip::allow("particles", *n as f64, [6.0, 60.0]))?;
        self.strain.iter().try_for_each(|e| strip::allow("strain", *e, [1e-4, 0.5]))?;
        strip::allow("shear", self.shear, [-45.0, 45.0])?;
        strip::allow("turn", self.turn, [1e-3, 1.0])?;
        let mut findings = Findings::default();
        let mut random = Pcg64::seed_from_u64(context.seed);
        let strain = [self.strain[0], self.strain[1]];
        for (name, angle) in [("constant strain", 0.0), ("constant shear", self.shear.to_radians())] {
            let plane = Plane::new(strain, angle, &mut random);
            findings.rows.extend(solved(name, counts, &plane, &mut random)?);
            findings.rows.push(kept(name, counts, &plane)?);
        }
        (context.progress)(0.5);
        for direction in 0..2 {
            findings.rows.push(self.cylinder(counts, direction)?);
        }
        findings.rows.extend(self.bias(counts)?);
        Ok(findings)
    }

    /// Energy of a sheet that clamps hold bent to a cylinder along warp or weft.
    fn cylinder(&self, counts: [usize; 2], direction: usize) -> Result<Row, Refused> {
        let spacing = SIZE[direction] / (counts[direction] - 1) as f64;
        let curvature = self.turn / spacing;
        let last = SIZE[direction] - spacing;
        // Between the clamps on the circle; a clamped edge goes straight on from its end.
        let place = |at: [f64; 2]| {
            let s = at[direction].clamp(spacing, last);
            let (beyond, angle) = (at[direction] - s, s * curvature);
            let along = [0.0, 1.0].map(|quarter: f64| (angle + quarter * std::f64::consts::FRAC_PI_2).sin());
            let [x, z] = [along[0] / curvature + beyond * along[1], along[1] / curvature - beyond * along[0]];
            if direction == 0 { Vec3::new(x, at[1], z) } else { Vec3::new(at[0], x, z) }
        };
        let mut setup = sheet(limp(), counts, place);
        let border = |n: usize| n < 2 || n + 2 >= counts[direction];
        setup.pins = sites(counts).filter(|site| border(site[direction])).collect();
        let world = World::new(setup)?;
        let bent = (SIZE[direction] - 2.0 * spacing) * SIZE[1 - direction];
        let reference = 0.5 * BENDING * curvature * curvature * bent;
        let name =
            ["bending energy, cylinder along the warp", "bending energy, cylinder along the weft"][direction];
        Ok(Row::compare(name, &self.case(), world.report().energy, reference, 5e-3))
    }

    /// Energy of a free sheet on a cylinder whose axis lies at 45° to warp and weft.
    fn bias(&self, counts: [usize; 2]) -> Result<[Row; 2], Refused> {
        let spacing = [0, 1].map(|k| SIZE[k] / (counts[k] - 1) as f64);
        let curvature = self.turn / spacing[0].min(spacing[1]);
        let place = |at: [f64; 2]| {
            let [s, t] = [at[0] + at[1], at[1] - at[0]].map(|v| v * std::f64::consts::FRAC_1_SQRT_2);
            let angle = s * curvature;
            Vec3::new(angle.sin() / curvature, t, angle.cos() / curvature)
        };
        let world = World::new(sheet(limp(), counts, place))?;
        let elements = &world.model().elements;
        // Half of the curvature lies along the warp, half along the weft, and half is twist.
        let half = 0.5 * (0.5 * curvature).powi(2);
        let bent: f64 = elements.triples.iter().map(|t| t.area).sum();
        let turned: f64 = elements.shears.iter().map(|s| s.area).sum();
        let [twist, energy] = [world.model().fabric.twist, world.report().energy];
        let covered = half * (BENDING * bent + twist * turned);
        let whole = 0.5 * BENDING * curvature * curvature * SIZE[0] * SIZE[1];
        Ok([
            Row::compare("bending energy, cylinder on the bias", &self.case(), energy, covered, 5e-3),
            Row::report("bending energy on the bias, whole sheet", &self.case(), energy, whole).because(
                "triples do not bend the outer half cells of a free sheet; without twist it would be half",
            ),
        ])
    }

    fn case(&self) -> String {
        format!("{} × {} particles, {} rad per cell", self.particles[0], self.particles[1], self.turn)
    }
}

/// A plane of constant strain and shear, anyhow in space.
struct Plane {
    warp: Vec3,
    weft: Vec3,
    strain: [f64; 2],
    angle: f64,
}

impl Plane {
    fn new(strain: [f64; 2], angle: f64, random: &mut impl Rng) -> Plane {
        let turns: [f64; 3] = std::array::from_fn(|_| random.random_range(-3.0..3.0));
        let turn = Rotation3::from_euler_angles(turns[0], turns[1], turns[2]);
        let [warp, weft] = [Vec3::x(), Vec3::new(angle.sin(), angle.cos(), 0.0)];
        Plane { warp: turn * warp * (1.0 + strain[0]), weft: turn * weft * (1.0 + strain[1]), strain, angle }
    }

    fn place(&self, at: [f64; 2]) -> Vec3 {
        self.warp * at[0] + self.weft * at[1]
    }
}

/// The border is held in the plane, what is inside starts astray: it must come to rest in the plane, with the energy of constant strain.
fn solved(name: &str, counts: [usize; 2], plane: &Plane, random: &mut impl Rng) -> Result<[Row; 2], Refused> {
    let fabric = Fabric {
        tensile: TENSILE.map(Law::linear),
        shear: Law::linear(SHEAR),
        ..strip::ideal(strip::DENSITY, 1.0, BENDING)
    };
    let mut setup = sheet(fabric, counts, |at| plane.place(at));
    let on_border = |site: &[usize; 2]| (0..2).any(|k| site[k] == 0 || site[k] + 1 == counts[k]);
    setup.pins = sites(counts).filter(on_border).collect();
    let known = setup.positions.clone();
    let spacing = SIZE[0] / (counts[0] - 1) as f64;
    for (site, p) in sites(counts).zip(&mut setup.positions) {
        if !on_border(&site) {
            *p += Vec3::from_fn(|_, _| random.random_range(-ASTRAY..ASTRAY)) * spacing;
        }
    }
    let mut world = World::new(setup)?;
    strip::settle(&mut world, 0.05, 1000)?;
    let density = 0.5
        * (TENSILE[0] * plane.strain[0].powi(2)
            + TENSILE[1] * plane.strain[1].powi(2)
            + SHEAR * plane.angle.powi(2));
    let case = format!("{} × {} particles", counts[0], counts[1]);
    let energy = world.report().energy;
    Ok([
        Row::vanishes(&format!("{name}, place"), &case, astray(&world, &known), 1e-9),
        Row::compare(&format!("{name}, energy"), &case, energy, density * SIZE[0] * SIZE[1], 1e-9),
    ])
}

/// A real fabric, whose place depends on its history: put in the plane it must stay there.
fn kept(name: &str, counts: [usize; 2], plane: &Plane) -> Result<Row, Refused> {
    const FABRIC: &str = "denim-a";
    let fabric = fabric::load(FABRIC).map_err(|e| Refused(e.to_string()))?;
    let mut setup = sheet(fabric, counts, |at| plane.place(at));
    let on_border = |site: &[usize; 2]| (0..2).any(|k| site[k] == 0 || site[k] + 1 == counts[k]);
    setup.pins = sites(counts).filter(on_border).collect();
    let known = setup.positions.clone();
    let mut world = World::new(setup)?;
    strip::settle(&mut world, 0.05, 1000)?;
    let case = format!("{FABRIC}, {} × {} particles", counts[0], counts[1]);
    Ok(Row::vanishes(&format!("{name}, place"), &case, astray(&world, &known), 1e-9))
}

/// Farthest way of a particle from its place, over the size.
fn astray(world: &World, known: &[Vec3]) -> f64 {
    world.positions().iter().zip(known).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max) / SIZE[0]
}

/// A fabric that only bends and twists.
fn limp() -> Fabric {
    Fabric { twist: isotropic_twist([BENDING; 2]), ..strip::ideal(strip::DENSITY, 1e-12, BENDING) }
}

fn sites(counts: [usize; 2]) -> impl Iterator<Item = [usize; 2]> {
    (0..counts[0]).flat_map(move |i| (0..counts[1]).map(move |j| [i, j]))
}

/// A weightless sheet, its particles placed by their lengths along warp and weft.
fn sheet(fabric: Fabric, counts: [usize; 2], place: impl Fn([f64; 2]) -> Vec3) -> Setup {
    let material = |site: [usize; 2]| [0, 1].map(|k| SIZE[k] * site[k] as f64 / (counts[k] - 1) as f64);
    Setup {
        fabric: Arc::new(fabric),
        particles: counts,
        size: SIZE,
        positions: sites(counts).map(|site| place(material(site))).collect(),
        pins: Vec::new(),
        hand: None,
        obstacles: Vec::new(),
        gravity: 0.0,
        drag: strip::DRAG,
        cut: None,
        particles_only: false,
    }
}
