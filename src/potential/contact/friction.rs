//! Coulomb friction by anchors that slide only at the limit: rate-independent, so that what rests does not creep.
//!
//! A touching place is tied to its anchor in the obstacle's tangent plane, elastically up to the Coulomb limit of the last
//! commit's normal force. Beyond, the force stays at the limit and the next commit drags the anchor along. Anchors live in
//! the obstacle's frame: a moving obstacle takes them with it.

use crate::{
    math::{Mat3, Vec3},
    model::Model,
    potential::Curvature,
    state::{Anchor, State},
};
use nalgebra::Point3;

/// A stretched anchor.
pub struct Slip {
    offset: Vec3,
    normal: Vec3,
    stiffness: f64,
    /// Coulomb limit [N].
    limit: f64,
}

impl Slip {
    /// The slip of an anchor with the cloth at `x`.
    pub fn new(model: &Model, state: &State, anchor: &Anchor, x: &[Vec3]) -> Slip {
        let pose = &state.poses[anchor.pair.obstacle as usize];
        let place: Vec3 = anchor.nodes.iter().zip(anchor.weights).map(|(&n, w)| x[n as usize] * w).sum();
        let normal = pose.rotation * anchor.normal;
        let away = place - pose.transform_point(&Point3::from(anchor.point)).coords;
        let limit = model.friction(anchor.pair.obstacle) * anchor.force;
        Slip { offset: away - normal * normal.dot(&away), normal, stiffness: anchor.stiffness, limit }
    }

    /// From the anchor to the cloth's place, in the tangent plane [m].
    pub fn offset(&self) -> Vec3 {
        self.offset
    }

    /// Energy [J].
    pub fn energy(&self) -> f64 {
        let (k, u) = (self.stiffness, self.offset.norm());
        if self.sticks() { 0.5 * k * u * u } else { self.limit * u - 0.5 * self.limit * self.limit / k }
    }

    /// Gradient in the place [N].
    pub fn gradient(&self) -> Vec3 {
        if self.sticks() {
            self.offset * self.stiffness
        } else {
            self.offset * (self.limit / self.offset.norm())
        }
    }

    /// Hessian in the place [N/m]; positive semidefinite. The bounding one is that of the parabola that touches the energy and is nowhere
    /// below it: what slides may turn within a step.
    pub fn hessian(&self, kind: Curvature) -> Mat3 {
        let plane = Mat3::identity() - self.normal * self.normal.transpose();
        if self.sticks() {
            return plane * self.stiffness;
        }
        let across = match kind {
            Curvature::Exact | Curvature::Clamped => {
                let along = self.offset.normalize();
                plane - along * along.transpose()
            }
            Curvature::Bounding => plane,
        };
        across * (self.limit / self.offset.norm())
    }

    /// Coulomb limit [N].
    pub fn limit(&self) -> f64 {
        self.limit
    }

    /// Whether the force is below the limit.
    pub fn sticks(&self) -> bool {
        self.stiffness * self.offset.norm() <= self.limit
    }

    /// The elastic part of the slip [m], and what sliding the rest dissipated [J].
    pub fn held(&self) -> (Vec3, f64) {
        if self.sticks() {
            return (self.offset, 0.0);
        }
        let (elastic, slip) = (self.limit / self.stiffness, self.offset.norm());
        (self.offset * (elastic / slip), self.limit * (slip - elastic))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    #[test]
    fn no_energy_of_friction_lies_above_its_bounding_parabola() {
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        let mut tangents = 0;
        for _ in 0..2000 {
            let [from, to] =
                [(); 2].map(|()| Vec3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), 0.0));
            let slip = |offset: Vec3| Slip { offset, normal: Vec3::z(), stiffness: 4.0, limit: 1.0 };
            let way = to - from;
            let above = |kind| {
                let slip = slip(from);
                slip.energy() + slip.gradient().dot(&way) + 0.5 * way.dot(&(slip.hessian(kind) * way))
            };
            assert!(slip(to).energy() <= above(Curvature::Bounding) + 1e-12, "{from} to {to}");
            tangents += u32::from(slip(to).energy() > above(Curvature::Exact) + 1e-12);
        }
        assert!(tangents > 500, "{tangents} lie above the tangent's");
    }
}
