//! Contact of particles with obstacles and Coulomb friction, as potentials per particle.
//!
//! Contact presses with ½ k A (d − gap)² below the activation distance d. Friction is elastic up to the Coulomb limit of the last
//! commit's normal force and slides at it; its anchor is part of the state. Both act on particles, not yet on edges and faces.

use super::Curvature;
use crate::{
    math::{Mat3, Vec3},
    model::Model,
    obstacle::Gap,
    state::{Anchor, State},
};

/// The gaps of a point that are below the activation distance.
fn touching(model: &Model, point: Vec3) -> impl Iterator<Item = Gap> {
    let d = model.contact.activation;
    model.obstacles.iter().filter(move |o| o.distance(point) < d).map(move |o| o.gap(point))
}

fn stiffness(model: &Model, particle: usize) -> f64 {
    model.contact.stiffness * model.elements.areas[particle]
}

/// Energy of contact [J].
pub fn energy(model: &Model, particle: usize, point: Vec3) -> f64 {
    let k = stiffness(model, particle);
    touching(model, point).map(|g| 0.5 * k * (model.contact.activation - g.value).powi(2)).sum()
}

/// Gradient of contact [N]: minus the obstacles' push.
pub fn gradient(model: &Model, particle: usize, point: Vec3) -> Vec3 {
    let k = stiffness(model, particle);
    touching(model, point).map(|g| g.normal * (k * (g.value - model.contact.activation))).sum()
}

/// Hessian of contact [N/m].
pub fn hessian(model: &Model, particle: usize, point: Vec3, kind: Curvature) -> Mat3 {
    let k = stiffness(model, particle);
    touching(model, point)
        .map(|g| {
            let normal = g.normal * g.normal.transpose() * k;
            match kind {
                Curvature::Exact => normal + g.hessian * (k * (g.value - model.contact.activation)),
                Curvature::Clamped => normal,
            }
        })
        .sum()
}

/// Slip from the anchor in its tangent plane [m], the stiffness [N/m] and the Coulomb limit [N].
fn slip(model: &Model, anchor: &Anchor, particle: usize, point: Vec3) -> (Vec3, f64, f64) {
    let offset = point - anchor.point;
    let slip = offset - anchor.normal * anchor.normal.dot(&offset);
    let k = model.contact.tangential * model.elements.areas[particle];
    (slip, k, model.contact.friction * anchor.force)
}

/// Energy of friction [J].
pub fn friction_energy(model: &Model, state: &State, particle: usize, point: Vec3) -> f64 {
    state.anchors[particle].as_ref().map_or(0.0, |anchor| {
        let (slip, k, limit) = slip(model, anchor, particle, point);
        let u = slip.norm();
        if k * u < limit { 0.5 * k * u * u } else { limit * u - 0.5 * limit * limit / k }
    })
}

/// Gradient of friction [N].
pub fn friction_gradient(model: &Model, state: &State, particle: usize, point: Vec3) -> Vec3 {
    state.anchors[particle].as_ref().map_or(Vec3::zeros(), |anchor| {
        let (slip, k, limit) = slip(model, anchor, particle, point);
        let u = slip.norm();
        if k * u < limit { slip * k } else { slip * (limit / u.max(f64::MIN_POSITIVE)) }
    })
}

/// Hessian of friction [N/m]; positive semidefinite.
pub fn friction_hessian(model: &Model, state: &State, particle: usize, point: Vec3) -> Mat3 {
    state.anchors[particle].as_ref().map_or(Mat3::zeros(), |anchor| {
        let (slip, k, limit) = slip(model, anchor, particle, point);
        let u = slip.norm();
        let plane = Mat3::identity() - anchor.normal * anchor.normal.transpose();
        if k * u < limit {
            plane * k
        } else if limit > 0.0 {
            (plane - slip * slip.transpose() / (u * u)) * (limit / u)
        } else {
            Mat3::zeros()
        }
    })
}

/// The anchor after a step that ended at `point`, and the energy the slide dissipated [J].
pub fn commit(model: &Model, old: Option<&Anchor>, particle: usize, point: Vec3) -> (Option<Anchor>, f64) {
    let deepest = touching(model, point).min_by(|a, b| a.value.total_cmp(&b.value));
    let (held, lost) = old.map_or((Vec3::zeros(), 0.0), |anchor| {
        let (slip, k, limit) = slip(model, anchor, particle, point);
        let u = slip.norm();
        if k * u <= limit { (slip, 0.0) } else { (slip * (limit / (k * u)), limit * (u - limit / k)) }
    });
    let anchor = deepest.map(|gap| {
        let held = held - gap.normal * gap.normal.dot(&held);
        let force = stiffness(model, particle) * (model.contact.activation - gap.value);
        Anchor { point: point - held, normal: gap.normal, force }
    });
    (anchor, lost)
}
