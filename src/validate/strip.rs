//! Strips of ideal fabric for the checks: linear laws without hysteresis, chosen so that a closed form applies.

use crate::{
    fabric::{Fabric, isotropic_twist, law::Law},
    grid::Status,
    math::Vec3,
    model::Setup,
    world::{Budget, Refused, World},
};
use std::sync::Arc;

/// Mass per area of ideal strips [kg/m²].
pub const DENSITY: f64 = 0.2;
/// Gravity [m/s²].
pub const GRAVITY: f64 = 9.81;
/// Length of ideal strips [m].
pub const LENGTH: f64 = 0.2;
/// Tensile stiffness [N/m]: own weight stretches a strip by 2e-5 on average. A stiffer one would drown balance in rounding: positions
/// of some 0.1 m are known to 1e-17 m, and rest wants 1e-7 of a particle's weight.
pub const STIFF: f64 = 1e4;
/// Air drag that brings strips to rest [kg/(m² s)].
pub const DRAG: f64 = 5.0;

/// Weight per area of ideal strips [N/m²].
pub fn weight() -> f64 {
    DENSITY * GRAVITY
}

/// Bending rigidity [N·m] of an ideal strip with Γ = w L³/B.
pub fn rigidity(gamma: f64) -> f64 {
    weight() * LENGTH.powi(3) / gamma
}

/// A strip with two particles across, along the warp through the points `place(i)` in the vertical plane of x and z [m], the weft along y. No pins.
pub fn setup(
    fabric: Fabric,
    particles: usize,
    [length, width]: [f64; 2],
    place: impl Fn(usize) -> [f64; 2],
) -> Setup {
    let at = |n: usize| {
        let [x, z] = place(n / 2);
        Vec3::new(x, (n % 2) as f64 * width, z)
    };
    Setup {
        fabric: Arc::new(fabric),
        particles: [particles, 2],
        size: [length, width],
        positions: (0..2 * particles).map(at).collect(),
        pins: Vec::new(),
        hand: None,
        obstacles: Vec::new(),
        gravity: GRAVITY,
        drag: DRAG,
        cut: None,
        particles_only: false,
    }
}

/// A strip of the usual length, clamped level at its start: `particles` from the clamp on, and one row more, as a clamp holds an edge.
/// It starts along `place(i)`, i from 0 at the clamp.
pub fn clamped(fabric: Fabric, particles: usize, place: impl Fn(usize) -> [f64; 2]) -> Setup {
    let spacing = LENGTH / (particles - 1) as f64;
    let place = |i: usize| if i == 0 { [-spacing, 0.0] } else { place(i - 1) };
    let mut setup = setup(fabric, particles + 1, [LENGTH + spacing, spacing], place);
    setup.pins = vec![[0, 0], [0, 1], [1, 0], [1, 1]];
    setup
}

/// The strip with so many particles across, its cells square.
pub fn widened(strip: Setup, across: usize) -> Setup {
    let count = strip.particles[0];
    let spacing = strip.size[0] / (count - 1) as f64;
    let at = |n: usize| {
        let p = strip.positions[2 * (n / across)];
        Vec3::new(p.x, (n % across) as f64 * spacing, p.z)
    };
    Setup {
        particles: [count, across],
        size: [strip.size[0], (across - 1) as f64 * spacing],
        positions: (0..count * across).map(at).collect(),
        pins: strip.pins.iter().filter(|p| p[1] == 0).flat_map(|p| (0..across).map(|j| [p[0], j])).collect(),
        ..strip
    }
}

/// Points of the line `j = 0` in x and z over the strip's length, from particle `from` on; those that the mesh has.
pub fn shape(world: &World, from: usize) -> Vec<[f64; 2]> {
    let grid = world.grid();
    let line = (from..grid.counts[0]).map(|i| grid.index([i, 0]));
    let line = line.filter(|&n| grid.status(n) != Status::Absent);
    line.map(|n| world.positions()[n] / LENGTH).map(|p| [p.x, p.z]).collect()
}

/// An ideal fabric: mass per area [kg/m²], tensile stiffness [N/m] and bending rigidity [N·m], the same in warp and weft.
pub fn ideal(density: f64, tensile: f64, rigidity: f64) -> Fabric {
    let [stretch, bend] = [tensile, rigidity].map(Law::linear);
    Fabric {
        name: "ideal".into(),
        areal_density: density,
        thickness: 1e-3,
        tensile: [stretch.clone(), stretch],
        bending: [bend.clone(), bend],
        shear: Law::linear(0.01 * tensile),
        twist: isotropic_twist([rigidity; 2]),
        friction: 0.0,
    }
}

/// Solves of one step at the most.
pub const SOLVES: u32 = 40;

/// Speed [m/s] and force out of balance, over the mean weight of a particle, of a cloth that counts as resting where rounding keeps `World` from
/// saying so: fine meshes of stiff strips. It must stay so for this many steps.
const STILL: [f64; 2] = [1e-9, 1e-5];
const STILL_STEPS: usize = 50;

/// Steps of `dt` [s] until the cloth rests.
pub fn settle(world: &mut World, dt: f64, most: usize) -> Result<(), Refused> {
    let balanced = STILL[1] * world.model().weight_on_earth() / world.grid().particles() as f64;
    let mut still = 0;
    for _ in 0..most {
        let report = world.step(&[], dt, Budget::solves(SOLVES));
        if report.resting {
            return Ok(());
        }
        let residual = report.residual;
        let slow = world.state().velocities.iter().all(|v| v.norm() < STILL[0]);
        still = if slow && residual < balanced { still + 1 } else { 0 };
        if still == STILL_STEPS {
            return Ok(());
        }
    }
    let r = world.report();
    Err(Refused(format!(
        "no rest after {most} steps of {dt} s: residual {:.1e} N, {:?}",
        r.residual, r.outcome
    )))
}

/// Refuses a parameter outside its range.
pub fn allow(name: &str, value: f64, [low, high]: [f64; 2]) -> Result<(), Refused> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(Refused(format!("{name}: got {value}, allowed: {low} to {high}")))
}
