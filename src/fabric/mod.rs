//! Fabrics: what a cloth is made of, in SI units, as the mechanics needs it.

pub mod units;
pub mod curve;
pub mod law;
pub mod instrument;
pub mod parameters;
pub mod document;
pub mod measured;
pub mod file;
pub mod kes;
pub mod library;
pub mod sheet;
#[cfg(feature = "plot")]
pub mod plot;

use crate::fabric::law::Law;
pub use crate::fabric::{
    file::FabricFile,
    library::{FabricError, Library},
};

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
    /// Twisting moment per width [N] over the twist of the sheet [1/m]: rigidity [N·m]. No KES test measures it.
    pub twist: f64,
    /// Coulomb friction coefficient against obstacles [1].
    pub friction: f64,
}

impl Fabric {
    /// B along a direction [N·m]: slope of the middle between the branches where the instrument reads it.
    pub fn rigidity(&self, direction: usize) -> f64 {
        rigidity(&self.bending[direction])
    }
}

/// B of a bending law [N·m].
fn rigidity(law: &Law) -> f64 {
    let [near, far] = instrument::BENDING_SLOPE;
    let middle = |curvature: f64| 0.5 * (law.loading(curvature) + law.unloading(curvature));
    (middle(far) - middle(near)) / (far - near)
}

/// Twist rigidity [N·m] of a sheet with these bending rigidities that resists bending alike in all directions, were they equal.
pub fn isotropic_twist([warp, weft]: [f64; 2]) -> f64 {
    2.0 * (warp * weft).sqrt()
}

/// Names of the built-in fabrics.
pub fn list() -> Vec<String> {
    Library::default().names()
}

/// A built-in fabric.
pub fn load(name: &str) -> Result<Fabric, FabricError> {
    Library::default().load(name)
}
