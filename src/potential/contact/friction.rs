//! Coulomb friction by anchors that slide only at the limit: rate-independent, so that what rests does not creep.
//!
//! A touching place is tied to its anchor in the obstacle's tangent plane, elastically up to the Coulomb limit of the last
//! commit's normal force. Beyond, the force stays at the limit and the next commit drags the anchor along. Anchors live in
//! the obstacle's frame: a moving obstacle takes them with it.

use crate::{
    math::{Mat3, Vec3},
    model::Model,
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

    /// Hessian in the place [N/m]; positive semidefinite.
    pub fn hessian(&self) -> Mat3 {
        let plane = Mat3::identity() - self.normal * self.normal.transpose();
        if self.sticks() {
            plane * self.stiffness
        } else {
            let along = self.offset.normalize();
            (plane - along * along.transpose()) * (self.limit / self.offset.norm())
        }
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
