//! What kesi is compared with: the paper's own minimizers and methods of its related work, each as small as it can be, and the
//! measures that make their results comparable. Only benches use it.

mod carry;
mod descent;
mod refinement;

pub use carry::{Carried, carry};
pub use descent::{Descent, Rule};
pub use refinement::{Refinement, Sign, coarsened};

use crate::{
    fabric::{
        Fabric,
        law::{Branches, Law, Unfit},
    },
    math::Vec3,
};

/// The fabric without hysteresis: every law goes along the middle of its envelope, as elastic cloth models do. What dissipates
/// nothing also holds no curl.
pub fn without_hysteresis(fabric: &Fabric) -> Result<Fabric, Unfit> {
    let middle = |law: &Law| {
        let middle = |x: f64| {
            let b = law.branches(x);
            let of = [0, 1].map(|k| 0.5 * (b.loading[k] + b.unloading[k]));
            Branches { x, loading: of, unloading: of }
        };
        Law::from_envelope(&law.knots().map(middle).collect::<Vec<_>>(), law.stick(), 0.0)
    };
    let both = |[warp, weft]: &[Law; 2]| Ok([middle(warp)?, middle(weft)?]);
    Ok(Fabric {
        tensile: both(&fabric.tensile)?,
        bending: both(&fabric.bending)?,
        shear: middle(&fabric.shear)?,
        ..fabric.clone()
    })
}

/// Distances of two shapes on one lattice [m]: root of the mean square, and the largest.
pub fn shape_error(a: &[Vec3], b: &[Vec3]) -> [f64; 2] {
    let squares = || a.iter().zip(b).map(|(a, b)| (a - b).norm_squared());
    [(squares().sum::<f64>() / a.len() as f64).sqrt(), squares().fold(0.0, f64::max).sqrt()]
}
