//! What does not change in a step: fabric, lattice, obstacles, pins, coefficients.

use crate::{fabric::Fabric, grid::Site, math::Vec3, obstacle::Obstacle};
use std::sync::Arc;

/// Everything a world is made from. Scenes build it; `World::new` takes it.
#[derive(Clone, Debug)]
pub struct Setup {
    /// The cloth's fabric.
    pub fabric: Arc<Fabric>,
    /// Particles along warp and weft, `[I, J]`, each at least 2.
    pub particles: [usize; 2],
    /// Rest lengths along warp and weft [m].
    pub size: [f64; 2],
    /// Positions at the start [m], I·J of them, particle (i, j) at i·J + j.
    pub positions: Vec<Vec3>,
    /// Particles that are pinned at the start.
    pub pins: Vec<Site>,
    /// Particle that the scene gives to the hand: pinned until somebody grabs it, felt and reported from the start.
    pub hand: Option<Site>,
    /// Rigid obstacles.
    pub obstacles: Vec<Obstacle>,
    /// Gravity along -z [m/s²].
    pub gravity: f64,
    /// Air drag per area [kg/(m² s)].
    pub drag: f64,
}
