//! Fabrics: what a cloth is made of, in SI units, as the mechanics needs it.

pub mod units;
pub mod curve;
pub mod law;
pub mod instrument;
pub mod parameters;
pub mod document;
pub mod measured;
pub mod kes;
pub mod library;

use crate::fabric::law::Law;
pub use crate::fabric::library::{FabricError, Library};

/// A fabric as the mechanics sees it: SI units, one hysteretic law per mode of deformation and direction.
#[derive(Clone, Debug)]
pub struct Fabric {
    /// Name, as in `kes_data/NAME.toml`.
    pub name: String,
    /// Mass per area [kg/m²].
    pub areal_density: f64,
    /// Thickness [m].
    pub thickness: f64,
    /// Line force per width [N/m] over tensile strain [1], along the warp and along the weft.
    pub tensile: [Law; 2],
    /// Bending moment per width [N] over curvature [1/m], along the warp and along the weft.
    pub bending: [Law; 2],
    /// Shear line force per width [N/m] over shear angle [rad].
    pub shear: Law,
    /// Coulomb friction coefficient against obstacles [1].
    pub friction: f64,
}

/// Names of the built-in fabrics.
pub fn list() -> Vec<String> {
    Library::default().names()
}

/// A built-in fabric.
pub fn load(name: &str) -> Result<Fabric, FabricError> {
    Library::default().load(name)
}
