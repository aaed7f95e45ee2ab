//! Patch tests: meshes must reproduce constant strain and constant shear exactly, and the energy of a cylinder.
//!
//! On graded meshes too: linear ghosts keep constant strain, cubic ones curvature. What is bent is compared with what the mesh covers.

use super::{
    Context, Findings, Row,
    mesh::{self, Mesh},
    strip,
};
use crate::{
    adapt::Settings,
    batch::Measures,
    fabric::{self, Fabric, isotropic_twist, law::Law},
    grid::{Cell, Direction, Grid, Site},
    math::Vec3,
    minimize::Method,
    model::Setup,
    potential::{Potential, Pull, contact::candidates::Candidates, triple},
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
    /// Meshes.
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["uniform"])]
    pub mesh: Vec<Mesh>,
    /// Bending angle per cell, the largest, of the cylinders [rad].
    #[arg(long, default_value_t = Patch::default().turn)]
    pub turn: f64,
}

impl Default for Patch {
    fn default() -> Patch {
        Patch {
            particles: vec![13, 10],
            strain: vec![0.02, 0.01],
            shear: 5.0,
            mesh: vec![Mesh::Uniform],
            turn: 0.1,
        }
    }
}

/// Size along warp and weft [m]: cells are not square.
const SIZE: [f64; 2] = [0.12, 0.11];
/// Tensile stiffness along warp and weft, shear stiffness [N/m], bending rigidity [N·m].
const TENSILE: [f64; 2] = [1000.0, 2500.0];
const SHEAR: f64 = 60.0;
const BENDING: f64 = 1e-4;
/// Force out of balance, over Bκ and the cells' sides, that is allowed at straight jumps and at corners of cells of different sizes on a cylinder.
const JUMP: f64 = 0.06;
const CORNER: f64 = 0.2;
/// The same where cells of all shapes meet: ghosts of wide cells load particles of ones that are up to four times as narrow.
const SLENDER: f64 = 4.0 * CORNER;
/// How far particles inside start from their place, over the spacing.
const ASTRAY: f64 = 0.2;

impl Patch {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<Patch> {
        let mesh = if quick { Mesh::ALL[2..].to_vec() } else { Mesh::ALL[1..].to_vec() };
        let graded = Patch { particles: vec![49, 45], mesh, turn: 0.3, ..Patch::default() };
        vec![Patch::default(), graded]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        let counts = [self.particles[0], self.particles[1]];
        counts.iter().try_for_each(|n| strip::allow("particles", *n as f64, [6.0, 100.0]))?;
        self.strain.iter().try_for_each(|e| strip::allow("strain", *e, [1e-4, 0.5]))?;
        strip::allow("shear", self.shear, [-45.0, 45.0])?;
        strip::allow("turn", self.turn, [1e-3, 1.0])?;
        let mut findings = Findings::default();
        let mut random = Pcg64::seed_from_u64(context.seed);
        let strain = [self.strain[0], self.strain[1]];
        for (k, &mesh) in self.mesh.iter().enumerate() {
            for (name, angle) in [("constant strain", 0.0), ("constant shear", self.shear.to_radians())] {
                let plane = Plane::new(strain, angle, &mut random);
                let sheet = Sheet { mesh, counts, name };
                findings.rows.push(sheet.balanced(&plane, &mut random)?);
                match sheet.solved(&plane, &mut random) {
                    Ok(rows) => findings.rows.extend(rows),
                    Err(why) => findings.rows.push(Row::failed(name, mesh.case(), &why.0)),
                }
                findings.rows.push(sheet.kept(&plane, &mut random)?);
            }
            for direction in 0..2 {
                findings.rows.extend(self.cylinder(mesh, direction, &mut random)?);
            }
            findings.rows.extend(self.bias(mesh, &mut random)?);
            (context.progress)((k + 1) as f64 / self.mesh.len() as f64);
        }
        Ok(findings)
    }

    /// A sheet that clamps hold bent to a cylinder along warp or weft: its energy, and how bending and forces stray.
    fn cylinder(&self, mesh: Mesh, direction: Direction, random: &mut Pcg64) -> Result<[Row; 3], Refused> {
        let counts = [self.particles[0], self.particles[1]];
        let spacing = SIZE[direction] / (counts[direction] - 1) as f64;
        let curvature = self.turn / (spacing * mesh.coarsest() as f64);
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
        let clamped = |n: usize| n < 2 || n + 2 >= counts[direction];
        setup.pins = sites(counts).filter(|site| clamped(site[direction])).collect();
        // As where a mesh adapts: ghosts see nothing of what is straight beyond the clamps.
        let fine = |site: Site| site[direction] < 4 || site[direction] + 5 >= counts[direction];
        let mut world = mesh.world(setup, fine, random)?;
        while world.adapt() {}
        let bent = Bent::of(&world);
        let crossing = |d: &Direction| *d != direction;
        let spurious = bent.curvatures.iter().filter(|(d, _)| crossing(d));
        let spurious = spurious.map(|(_, k)| k.abs() / curvature).fold(0.0, f64::max);
        // One-sided ghosts at the border and at clamps are of lower order: forces are judged inside.
        let (part, forced) = match mesh {
            Mesh::Slender => (5, SLENDER),
            Mesh::Random => (6, CORNER),
            _ => (4, JUMP),
        };
        let margin = counts.map(|n| n / part);
        let inside = |site: Site| (0..2).all(|k| site[k] >= margin[k] && site[k] + margin[k] < counts[k]);
        let worst = (0..world.grid().particles()).filter(|n| inside(world.grid().site(*n)));
        let widest = |n: usize| {
            let cells = world.grid().cells_at(world.grid().site(n));
            let ratio = |cell: Cell| cell.size[1 - direction] as f64 / cell.size[direction] as f64;
            cells.map(ratio).fold(0.0, f64::max)
        };
        let across = SIZE[1 - direction] / (counts[1 - direction] - 1) as f64;
        let unit = |n: usize| BENDING * curvature * widest(n) * across / spacing;
        let worst = worst.map(|n| bent.forces[n].norm() / unit(n)).fold(0.0, f64::max);
        let free = (SIZE[direction] - 2.0 * spacing) * SIZE[1 - direction];
        let reference = 0.5 * BENDING * curvature * curvature * free;
        let (case, along) = (self.case(mesh), ["warp", "weft"][direction]);
        Ok([
            Row::compare(
                &format!("bending energy, cylinder along the {along}"),
                &case,
                bent.energy,
                reference,
                5e-3,
            ),
            Row::vanishes(&format!("curvature across, cylinder along the {along}"), &case, spurious, 0.06),
            Row::vanishes(&format!("forces over Bκ, cylinder along the {along}"), &case, worst, forced),
        ])
    }

    /// Energy of a free sheet on a cylinder whose axis lies at 45° to warp and weft.
    fn bias(&self, mesh: Mesh, random: &mut Pcg64) -> Result<[Row; 2], Refused> {
        let counts = [self.particles[0], self.particles[1]];
        let spacing = [0, 1].map(|k| SIZE[k] / (counts[k] - 1) as f64);
        let curvature = self.turn / (spacing[0].min(spacing[1]) * mesh.coarsest() as f64);
        let place = |at: [f64; 2]| {
            let [s, t] = [at[0] + at[1], at[1] - at[0]].map(|v| v * std::f64::consts::FRAC_1_SQRT_2);
            let angle = s * curvature;
            Vec3::new(angle.sin() / curvature, t, angle.cos() / curvature)
        };
        let mut world = mesh.world(sheet(limp(), counts, place), |_| false, random)?;
        while world.adapt() {}
        let elements = &world.model().elements;
        // Half of the curvature lies along the warp, half along the weft, and half is twist.
        let half = 0.5 * (0.5 * curvature).powi(2);
        let bent: f64 = elements.triples.iter().map(|t| t.area).sum();
        let turned: f64 = elements.shears.iter().map(|s| s.area).sum();
        let [twist, energy] = [world.model().fabric.twist, Bent::of(&world).energy];
        let covered = half * (BENDING * bent + twist * turned);
        let whole = 0.5 * BENDING * curvature * curvature * SIZE[0] * SIZE[1];
        let case = self.case(mesh);
        let name = "bending energy, cylinder on the bias";
        let row = if mesh == Mesh::Uniform {
            Row::compare(name, &case, energy, covered, 5e-3)
        } else {
            Row::report(name, &case, energy, covered)
                .because("cells of different sizes turn differently along the bias")
        };
        Ok([
            row,
            Row::report("bending energy on the bias, whole sheet", &case, energy, whole).because(
                "triples do not bend the outer half cells of a free sheet; without twist it would be half",
            ),
        ])
    }

    fn case(&self, mesh: Mesh) -> String {
        let [warp, weft] = [self.particles[0], self.particles[1]];
        format!("{warp} × {weft} particles, {} rad per cell{}", self.turn, mesh.case())
    }
}

/// What a shape costs, statically.
struct Bent {
    energy: f64,
    /// Direction and curvature [1/m] of every bending element.
    curvatures: Vec<(Direction, f64)>,
    /// Force out of balance by particle [N]: of the active ones.
    forces: Vec<Vec3>,
}

impl Bent {
    fn of(world: &World) -> Bent {
        let (model, state) = (world.model(), world.state());
        let (still, candidates) = (Pull::none(model), Candidates::new(model));
        let potential = Potential { model, state, candidates: &candidates, pull: &still };
        let x = &state.positions;
        let mut forces = vec![Vec3::zeros(); model.elements.nodes()];
        potential.gradient(x, &mut forces, &mut Measures::new(&model.elements));
        let curvature = |t| potential.bend(t, &triple::Weights::new(t), x).value;
        Bent {
            energy: potential.stored(x),
            curvatures: model.elements.triples.iter().map(|t| (t.direction, curvature(t))).collect(),
            forces,
        }
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

/// A sheet whose border is held in a plane.
struct Sheet {
    mesh: Mesh,
    counts: [usize; 2],
    name: &'static str,
}

impl Sheet {
    /// The sheet in the plane, what is inside so far astray, over the spacing.
    fn world(
        &self,
        fabric: Fabric,
        plane: &Plane,
        astray: f64,
        random: &mut Pcg64,
    ) -> Result<World, Refused> {
        let mut setup = sheet(fabric, self.counts, |at| plane.place(at));
        let edits = self.mesh.edits(&setup, |_| false, random);
        let mut grid = Grid::uniform(self.counts, SIZE);
        grid.edit(&edits).map_err(|e| Refused(e.to_string()))?;
        let on_border = |site: &Site| (0..2).any(|k| site[k] == 0 || site[k] + 1 == self.counts[k]);
        setup.pins = sites(self.counts).filter(|s| on_border(s) && grid.is_active(grid.index(*s))).collect();
        let spacing = SIZE[0] / (self.counts[0] - 1) as f64;
        for (site, p) in sites(self.counts).zip(&mut setup.positions) {
            if !on_border(&site) {
                *p += Vec3::from_fn(|_, _| random.random_range(-1.0..1.0)) * (astray * spacing);
            }
        }
        let mut world = World::with_mesh(setup, Method::default(), &edits)?;
        world.set_adaptive((self.mesh == Mesh::Adapted).then(Settings::default));
        Ok(world)
    }

    /// In the plane nothing inside is out of balance.
    fn balanced(&self, plane: &Plane, random: &mut Pcg64) -> Result<Row, Refused> {
        let mut world = self.world(elastic(), plane, 0.0, random)?;
        while world.adapt() {}
        let forces = Bent::of(&world).forces;
        let held = |n: &usize| world.reaction(world.grid().site(*n)).is_some();
        let (outer, inner): (Vec<usize>, Vec<usize>) = (0..world.grid().particles()).partition(held);
        let worst = |of: &[usize]| of.iter().map(|&n| forces[n].norm()).fold(0.0, f64::max);
        let name = format!("{}, forces over those at the border", self.name);
        Ok(Row::vanishes(&name, &self.case(&world), worst(&inner) / worst(&outer), 1e-10))
    }

    /// What starts astray comes to rest in the plane, with the energy of constant strain.
    fn solved(&self, plane: &Plane, random: &mut Pcg64) -> Result<[Row; 2], Refused> {
        let mut world = self.world(elastic(), plane, ASTRAY, random)?;
        mesh::settle(&mut world, 0.05, 1000)?;
        let density = 0.5
            * (TENSILE[0] * plane.strain[0].powi(2)
                + TENSILE[1] * plane.strain[1].powi(2)
                + SHEAR * plane.angle.powi(2));
        let (energy, case) = (world.report().energy, self.case(&world));
        Ok([
            Row::vanishes(&format!("{}, place", self.name), &case, self.astray(&world, plane), 1e-9),
            Row::compare(&format!("{}, energy", self.name), &case, energy, density * SIZE[0] * SIZE[1], 1e-9),
        ])
    }

    /// A real fabric, whose place depends on its history: put in the plane it must stay there.
    fn kept(&self, plane: &Plane, random: &mut Pcg64) -> Result<Row, Refused> {
        const FABRIC: &str = "denim-a";
        let fabric = fabric::load(FABRIC).map_err(|e| Refused(e.to_string()))?;
        let mut world = self.world(fabric, plane, 0.0, random)?;
        mesh::settle(&mut world, 0.05, 1000)?;
        let case = format!("{FABRIC}, {}", self.case(&world));
        Ok(Row::vanishes(&format!("{}, place", self.name), &case, self.astray(&world, plane), 1e-9))
    }

    fn case(&self, world: &World) -> String {
        let (active, mesh) = (world.grid().tally()[0], self.mesh.case());
        format!("{} of {} × {} particles{mesh}", active, self.counts[0], self.counts[1])
    }

    /// Farthest way of a particle from its place, over the size.
    fn astray(&self, world: &World, plane: &Plane) -> f64 {
        let place = |n: usize| plane.place(material(self.counts, world.grid().site(n)));
        mesh::particles(world).map(|(n, p)| (p - place(n)).norm()).fold(0.0, f64::max) / SIZE[0]
    }
}

/// A fabric of linear laws.
fn elastic() -> Fabric {
    Fabric {
        tensile: TENSILE.map(Law::linear),
        shear: Law::linear(SHEAR),
        ..strip::ideal(strip::DENSITY, 1.0, BENDING)
    }
}

/// Lengths along warp and weft [m] of a particle from the corner.
fn material(counts: [usize; 2], site: Site) -> [f64; 2] {
    [0, 1].map(|k| SIZE[k] * site[k] as f64 / (counts[k] - 1) as f64)
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
    Setup {
        fabric: Arc::new(fabric),
        particles: counts,
        size: SIZE,
        positions: sites(counts).map(|site| place(material(counts, site))).collect(),
        pins: Vec::new(),
        hand: None,
        obstacles: Vec::new(),
        gravity: 0.0,
        drag: strip::DRAG,
        cut: None,
        particles_only: false,
    }
}
