//! Strips of ideal fabric for the checks: linear laws without hysteresis, chosen so that a closed form applies.

use crate::{
    fabric::{Fabric, law::Law},
    grid::Site,
    math::Vec3,
    model::Setup,
    world::{Budget, Refused, World},
};
use std::sync::Arc;

/// Mass per area of ideal strips [kg/m²] and gravity [m/s²].
pub const DENSITY: f64 = 0.2;
/// Gravity [m/s²].
pub const GRAVITY: f64 = 9.81;
/// Tensile stiffness [N/m]: own weight stretches a strip by 2e-5 on average. A stiffer one would drown balance in rounding: positions
/// of some 0.1 m are known to 1e-17 m, and rest wants 1e-7 of a particle's weight.
pub const STIFF: f64 = 1e4;

/// Weight per area of ideal strips [N/m²].
pub fn weight() -> f64 {
    DENSITY * GRAVITY
}

/// A strip along x with two particles across, flat and horizontal, for a world with gravity.
pub fn setup(fabric: Fabric, particles: usize, length: f64, place: impl Fn(Site) -> Vec3) -> Setup {
    let width = length / (particles - 1) as f64;
    let positions = (0..2 * particles).map(|n| place([n / 2, n % 2])).collect();
    Setup {
        fabric: Arc::new(fabric),
        particles: [particles, 2],
        size: [length, width],
        positions,
        pins: Vec::new(),
        hand: None,
        obstacles: Vec::new(),
        gravity: GRAVITY,
        drag: 0.0,
        cut: None,
        particles_only: false,
    }
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
        friction: 0.0,
    }
}

/// Solves of one step at the most.
const SOLVES: u32 = 40;

/// Steps of `dt` [s] until the cloth rests.
pub fn settle(world: &mut World, dt: f64, most: usize) -> Result<(), Refused> {
    for _ in 0..most {
        if world.step(&[], dt, Budget::solves(SOLVES)).resting {
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
