//! Sheets, fabrics and obstacles of a case. What is drawn may be refused by `World`; then it is drawn plainer, never left untried.

use super::case::{Case, SYNTHETIC, Topic, logarithmic, stream};
use crate::{
    cut::Cut,
    fabric::{
        self, Fabric, isotropic_twist,
        law::{Branches, Law},
    },
    math::Vec3,
    model::Setup,
    obstacle::{Obstacle, Polyhedron, Shape, Unfit, witness::Witness},
    world::{Refused, World},
};
use nalgebra::{Isometry3, Rotation3, Translation3, UnitQuaternion};
use rand::RngExt;
use rand_pcg::Pcg64;
use std::{f64::consts::TAU, sync::Arc};

/// Longer side of a sheet [m].
const SIDE: [f64; 2] = [0.05, 1.0];
/// Mass per area of synthetic fabrics [kg/m²].
const DENSITY: [f64; 2] = [0.01, 5.0];
/// Tensile stiffness of synthetic fabrics [N/m].
const TENSION: [f64; 2] = [30.0, 1e5];
/// Tension times the sheet's side squared over bending of synthetic fabrics [1].
const RATIO: [f64; 2] = [10.0, 1e7];
/// Drag over mass [1/s].
const DRAG: [f64; 2] = [1.0, 20.0];
/// Half breadth of the envelope of synthetic laws over the force at the largest strain or curvature.
const BREADTH: [f64; 2] = [1e-4, 1e-2];
/// Steepness of a sticking synthetic law over its slope.
const STICKING: f64 = 10.0;
/// Strain and curvature [1/m] up to which synthetic laws are given; beyond they go on straight.
const STRAIN: f64 = 1.0;
const CURVATURE: f64 = 300.0;

/// A world at its start, and what it is made of, for tables.
pub struct Scene {
    /// The world.
    pub world: World,
    /// Kinds of its obstacles.
    pub obstacles: Vec<&'static str>,
    /// Whether gravity and a level floor, or a fixed particle, keep the sheet from falling or drifting for ever.
    pub floor: bool,
}

/// The scene of a case.
pub fn build(case: &Case) -> Result<Scene, Refused> {
    let fabric = Arc::new(fabric_of(case, 0)?);
    let mut setup = sheet(case, fabric);
    let mut kinds = Vec::new();
    let mut floor = false;
    let bare = setup.clone();
    for &place in &case.obstacles {
        let (kind, obstacle, level) = obstacle(case, place, &setup);
        kinds.push(kind);
        floor |= level;
        setup.obstacles.push(obstacle);
    }
    // A cut that leaves nothing of a pin, or an obstacle in the sheet after all.
    let world = World::with_method(setup.clone(), case.solver)
        .or_else(|_| World::with_method(Setup { cut: None, ..setup }, case.solver))
        .or_else(|_| {
            kinds.clear();
            floor = false;
            World::with_method(Setup { cut: None, ..bare }, case.solver)
        })?;
    Ok(Scene { world, obstacles: kinds, floor })
}

/// The fabric of a case; `place` numbers those that follow in flight, which are synthetic.
pub fn fabric_of(case: &Case, place: usize) -> Result<Fabric, Refused> {
    if case.fabric != SYNTHETIC && place == 0 {
        return fabric::load(&case.fabric).map_err(|e| Refused(e.to_string()));
    }
    let mut random = stream(case.seed, Topic::Fabric, place);
    synthetic(&mut random)
}

fn synthetic(random: &mut Pcg64) -> Result<Fabric, Refused> {
    let tension = logarithmic(random, TENSION);
    // Bending for a sheet of 0.3 m.
    let rigidity = 0.09 * tension / logarithmic(random, RATIO);
    let hysteretic = random.random_bool(0.6);
    let mut law = |slope: f64, range: f64| -> Result<Law, Refused> {
        if !hysteretic {
            return Ok(Law::linear(slope));
        }
        let half = slope * range * logarithmic(random, BREADTH);
        let branch =
            |x: f64| Branches { x, loading: [slope * x + half, slope], unloading: [slope * x - half, slope] };
        let stick = half * half / (STICKING * slope);
        Law::from_envelope(&[-range, 0.0, range].map(branch), stick, 0.0).map_err(|e| Refused(e.to_string()))
    };
    let tensile = [law(tension, STRAIN)?, law(tension, STRAIN)?];
    let bending = [law(rigidity, CURVATURE)?, law(rigidity, CURVATURE)?];
    let shear = law(0.02 * tension, STRAIN)?;
    Ok(Fabric {
        name: SYNTHETIC.into(),
        areal_density: logarithmic(random, DENSITY),
        thickness: logarithmic(random, [2e-4, 3e-3]),
        tensile,
        bending,
        shear,
        twist: isotropic_twist([rigidity; 2]) * if random.random_bool(0.8) { 1.0 } else { 0.0 },
        friction: random.random_range(0.0..1.0),
    })
}

/// The sheet without obstacles.
fn sheet(case: &Case, fabric: Arc<Fabric>) -> Setup {
    let mut random = stream(case.seed, Topic::Sheet, 0);
    let random = &mut random;
    let [i, j] = case.mesh;
    let cells = [i - 1, j - 1].map(|n| n as f64);
    let side = logarithmic(random, SIDE);
    let aspect = logarithmic(random, [0.6, 1.7]);
    let spacing = side / cells[0].max(cells[1]);
    let size = [spacing * cells[0], spacing * aspect * cells[1]];
    let level = random.random_bool(0.5);
    let turns: [f64; 3] = std::array::from_fn(|_| random.random_range(-3.0..3.0));
    let turn = if level {
        Rotation3::identity()
    } else {
        Rotation3::from_euler_angles(turns[0], turns[1], turns[2])
    };
    // Flat, wavy, or stretched and noisy from the start.
    let (wave, noise, stretch) = match random.random_range(0..10) {
        0..6 => (0.0, 0.0, 1.0),
        6..9 => (0.03, 0.0, 1.0),
        _ => (0.05, 0.2, random.random_range(0.5..1.5)),
    };
    let mut at = |n: usize| {
        let [x, y] = [n / j, n % j].map(|k| k as f64);
        let [x, y] = [x / cells[0] * size[0], y / cells[1] * size[1]];
        let jitter = Vec3::from_fn(|_, _| random.random_range(-1.0..1.0)) * (noise * spacing);
        let z = wave * side * (TAU * (1.3 * x + 0.7 * y) / side).sin();
        turn * (Vec3::new(x * stretch, y * stretch, z) + jitter)
    };
    let positions = (0..i * j).map(&mut at).collect();
    let corners = [[0, 0], [0, j - 1], [i - 1, 0], [i - 1, j - 1]];
    let pins = match random.random_range(0..8) {
        0 => Vec::new(),
        1 => vec![corners[1]],
        2..4 => vec![corners[0], corners[1]],
        4 => corners.to_vec(),
        5 => (0..j).map(|k| [0, k]).collect(),
        // A clamp holds the tangent too.
        6 => (0..2 * j).map(|k| [k / j, k % j]).collect(),
        _ => (0..3).map(|_| [random.random_range(0..i), random.random_range(0..j)]).collect(),
    };
    let gravity = [9.81, 9.81, 9.81, 9.81, 9.81, 9.81, 0.0, 1.62, 100.0][random.random_range(0..9)];
    let drag = logarithmic(random, DRAG) * fabric.areal_density;
    Setup {
        fabric,
        particles: case.mesh,
        size,
        positions,
        pins,
        hand: random.random_bool(0.7).then(|| corners[random.random_range(0..4)]),
        obstacles: Vec::new(),
        gravity,
        drag,
        cut: random.random_bool(0.1).then(|| Cut {
            center: size.map(|s| s * random.random_range(0.3..0.7)),
            radius: 0.5 * size[0].min(size[1]) * random.random_range(0.5..1.2),
        }),
        particles_only: false,
    }
}

/// Obstacle number `place` of a case beside the sheet: its kind, itself, and whether it is a level floor.
pub fn obstacle(case: &Case, place: usize, setup: &Setup) -> (&'static str, Obstacle, bool) {
    let mut random = stream(case.seed, Topic::Obstacle, place);
    let random = &mut random;
    let side = setup.size[0].max(setup.size[1]);
    let (kind, shape) = shape(random, side);
    let low = setup.positions.iter().map(|p| p.z).fold(f64::INFINITY, f64::min);
    let middle = setup.positions.iter().sum::<Vec3>() / setup.positions.len() as f64;
    let level = kind == "plane" && random.random_bool(0.7);
    let turn = if level {
        UnitQuaternion::identity()
    } else {
        let scale = if kind == "plane" { 0.3 } else { 1.5 };
        UnitQuaternion::from_scaled_axis(Vec3::from_fn(|_, _| random.random_range(-scale..scale)))
    };
    let thickness = setup.fabric.thickness;
    let start = if kind == "plane" {
        Vec3::new(middle.x, middle.y, low - 2.0 * thickness - side * random.random_range(0.0..0.4))
    } else {
        middle + Vec3::from_fn(|_, _| random.random_range(-0.4..0.4)) * side
    };
    let friction = [None, None, Some(0.0), Some(0.3), Some(1.0)][random.random_range(0..5)];
    let mut found = Obstacle {
        name: format!("{kind} {place}"),
        shape,
        pose: Isometry3::from_parts(Translation3::from(start), turn),
        friction,
    };
    // Out of the sheet, mostly downwards.
    let away = Vec3::new(random.random_range(-0.3..0.3), random.random_range(-0.3..0.3), -1.0).normalize();
    for step in 1..60 {
        if is_clear(&found, setup) {
            break;
        }
        found.pose.translation.vector = start + away * (0.05 * side * f64::from(step));
    }
    (kind, found, level)
}

fn is_clear(obstacle: &Obstacle, setup: &Setup) -> bool {
    let witness = Witness::new(obstacle);
    let columns = setup.particles[1];
    let room = 1.1 * setup.fabric.thickness;
    let cells = (0..setup.particles[0] - 1).flat_map(|i| (0..columns - 1).map(move |j| [i, j]));
    // Both ways of cutting a cell, as meshes do.
    let triangles: Vec<[u32; 3]> = cells
        .flat_map(|[i, j]| {
            let at = |u: usize, v: usize| ((i + u) * columns + j + v) as u32;
            let [a, b, c, d] = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
            [[a, b, d], [a, d, c], [a, b, c], [b, d, c]]
        })
        .collect();
    witness.distance(&obstacle.pose, &setup.positions, &triangles, 2.0 * room) > room
}

fn shape(random: &mut Pcg64, side: f64) -> (&'static str, Shape) {
    let mut length = |low: f64, high: f64| side * random.random_range(low..high);
    let [a, b, c] = [(); 3].map(|()| length(0.04, 0.3));
    match random.random_range(0..7) {
        0 => ("box", Shape::Cuboid { half: [a, b, c] }),
        1 => ("sphere", Shape::Sphere { radius: a }),
        2 => ("capsule", Shape::Capsule { half: a, radius: 0.5 * b }),
        3 | 4 => ("plane", Shape::Plane),
        5 => {
            let points: Vec<Vec3> =
                (0..12).map(|_| Vec3::from_fn(|_, _| random.random_range(-1.0..1.0)) * a).collect();
            let hull = Polyhedron::hull(&points).map(|solid| ("hull", Shape::Polyhedron(Arc::new(solid))));
            hull.unwrap_or(("sphere", Shape::Sphere { radius: a }))
        }
        _ => {
            let ring =
                ring((a + 0.05 * side) / 0.07).map(|solid| ("ring", Shape::Polyhedron(Arc::new(solid))));
            ring.unwrap_or(("sphere", Shape::Sphere { radius: a }))
        }
    }
}

/// A ring around the z axis, so many times as large as one of 7 cm radius, with a square section: as a mesh neither convex nor simply connected.
pub fn ring(scale: f64) -> Result<Polyhedron, Unfit> {
    const SIDES: u32 = 12;
    let corner = |k: u32, c: usize| {
        let angle = f64::from(k) / f64::from(SIDES) * TAU;
        let [r, z] = [[0.03, -0.02], [0.07, -0.02], [0.07, 0.02], [0.03, 0.02]][c].map(|v| v * scale);
        Vec3::new(r * angle.cos(), r * angle.sin(), z)
    };
    let points = (0..SIDES).flat_map(|k| (0..4).map(move |c| corner(k, c))).collect();
    let faces = (0..SIDES).flat_map(|k| {
        (0..4).flat_map(move |c| {
            let at = |k: u32, c: u32| 4 * (k % SIDES) + c % 4;
            let [a, b, d, e] = [at(k, c), at(k, c + 1), at(k + 1, c), at(k + 1, c + 1)];
            [[a, d, e], [a, e, b]]
        })
    });
    Polyhedron::mesh(points, faces.collect())
}
