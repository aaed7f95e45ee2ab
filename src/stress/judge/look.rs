//! A state as the judge sees it: energies and forces by the scalar laws.

use crate::{
    batch::Measures,
    math::Vec3,
    model::Model,
    potential::{Potential, Pull, contact::candidates::Candidates},
    state::State,
    world::{Report, World},
};

/// A state with the constants and the report that belong to it.
#[derive(Clone, Copy)]
pub struct Look<'a> {
    /// Constants.
    pub model: &'a Model,
    /// State.
    pub state: &'a State,
    /// Report.
    pub report: &'a Report,
}

impl<'a> Look<'a> {
    /// A world as it is.
    pub fn at(world: &'a World) -> Look<'a> {
        Look { model: world.model(), state: world.state(), report: world.report() }
    }

    /// Stored, contact and kinetic energy [J].
    pub fn whole(&self) -> f64 {
        self.potential(&self.candidates(), &self.state.positions) + self.kinetic()
    }

    /// The same and what dead loads do: while they stay, this falls until the cloth rests, though the other may grow.
    pub fn under_loads(&self) -> f64 {
        let work = |n: usize| self.state.load(n).dot(&self.state.positions[n]);
        self.whole() - self.model.grid.active().map(work).sum::<f64>()
    }

    pub(super) fn kinetic(&self) -> f64 {
        let speeds = self.model.grid.active().map(|n| (n, self.state.velocities[n]));
        speeds.map(|(n, v)| 0.5 * self.model.mass(n) * v.norm_squared()).sum()
    }

    /// Whether laws have no hysteresis and nothing touches.
    pub fn is_elastic(&self) -> bool {
        let fabric = &self.model.fabric;
        let mut laws = fabric.tensile.iter().chain(&fabric.bending).chain([&fabric.shear]);
        laws.all(|law| law.knots().all(|x| law.enclosed(x) == 0.0)) && self.state.anchors.is_empty()
    }

    /// What may touch here.
    pub fn candidates(&self) -> Candidates {
        Candidates::of(self.model, self.state)
    }

    /// Stored energy and that of contact [J] at positions.
    pub fn potential(&self, candidates: &Candidates, x: &[Vec3]) -> f64 {
        let pull = Pull::none(self.model);
        let potential = Potential { model: self.model, state: self.state, candidates, pull: &pull };
        potential.energy(x)
    }

    /// Gradient [N] at positions, with the anchors of a state and no inertia.
    pub(super) fn gradient(&self, state: &State, candidates: &Candidates, x: &[Vec3]) -> Vec<Vec3> {
        let pull = Pull::none(self.model);
        let mut gradient = vec![Vec3::zeros(); x.len()];
        let potential = Potential { model: self.model, state, candidates, pull: &pull };
        potential.gradient(x, &mut gradient, &mut Measures::new(&self.model.elements));
        gradient
    }
}

/// What of a state or its report is no finite number.
pub(super) fn not_finite(look: &Look) -> Option<String> {
    if !look.state.is_finite() {
        return Some("state".into());
    }
    let r = look.report;
    let cost = [r.cost.newton, r.cost.stretch, r.cost.bend, r.cost.shear];
    let numbers = [r.time, r.residual, r.energy, r.dissipated, r.max_penetration];
    let contact = [r.contact.friction, r.contact.friction_limit];
    let mut all: Vec<f64> = cost.into_iter().chain(numbers).chain(contact).collect();
    all.extend(r.contact.force.iter());
    for pose in &look.state.poses {
        all.extend(pose.translation.vector.iter().chain(pose.rotation.coords.iter()));
    }
    for a in &look.state.anchors {
        all.extend(a.point.iter().chain(a.normal.iter()));
        all.push(a.force);
    }
    if let Some(hand) = r.hand {
        let vectors = [hand.position, hand.velocity, hand.force, hand.rate];
        all.extend(vectors.iter().flat_map(|v| v.iter()));
        all.extend(hand.stiffness.iter());
        all.push(hand.force_error);
    }
    let bad = all.iter().any(|v| !v.is_finite()) || r.min_gap.is_nan();
    bad.then(|| format!("report {r:?}"))
}
