//! What rounding alone may do to strains, energies and forces.

use super::Look;
use crate::{
    fabric::law::Law,
    math::Vec3,
    model::Model,
    potential::{Potential, Pull, contact::candidates::Candidates, shear, triple},
};

/// Roundings, in units of the last place, that a strain or a time goes through.
pub(super) const ROUNDINGS: f64 = 16.0;

/// An element's strain as scalar laws measure it.
pub(super) struct Strained<'a> {
    pub law: &'a Law,
    /// Largest force and enclosed area at a knot of the law.
    pub ends: [f64; 2],
    pub strain: f64,
    /// What rounding may make of the strain.
    pub off: f64,
    /// History.
    pub p: f64,
    /// Area that the element stands for [m²].
    pub area: f64,
}

/// Shows every element.
///
/// Kernels round otherwise than the scalar laws here. A strain is off by what coordinates, off by a unit in their last place, make of it by
/// its gradient in the particles (large where a cell collapsed), and by rounding of its own terms.
pub(super) fn strained<'a>(look: &Look<'a>, see: &mut dyn FnMut(Strained<'a>)) {
    let (elements, fabric, history) = (&look.model.elements, &look.model.fabric, &look.state.history);
    let x = &look.state.positions;
    let (candidates, pull) = (Candidates::default(), Pull::default());
    let potential = Potential { model: look.model, state: look.state, candidates: &candidates, pull: &pull };
    let extent = extent(x);
    let off = |gradient: f64, own: f64, strain: f64| {
        ROUNDINGS * f64::EPSILON * (gradient * extent + own + strain.abs())
    };
    let ends = |law: &Law| {
        let of = |value: &dyn Fn(f64) -> f64| law.knots().map(|x| value(x).abs()).fold(0.0, f64::max);
        [of(&|x| law.loading(x)), of(&|x| law.enclosed(x))]
    };
    let tensile = fabric.tensile.each_ref().map(ends);
    let bending = fabric.bending.each_ref().map(ends);
    let sheared = ends(&fabric.shear);
    for (e, &p) in elements.edges.iter().zip(&history.edges) {
        let (law, ends) = (&fabric.tensile[e.direction], tensile[e.direction]);
        let strain = potential.strain(e, x);
        let off = off(2.0 * strain.gradient.norm(), 1.0, strain.value);
        see(Strained { law, ends, strain: strain.value, off, p, area: e.width * e.length });
    }
    for (t, &p) in elements.triples.iter().zip(&history.triples) {
        let (law, ends) = (&fabric.bending[t.direction], bending[t.direction]);
        let weights = triple::Weights::new(t);
        let kappa = potential.bend(t, &weights, x);
        let gradient = weights.spread(&kappa.gradient).iter().map(|g| g.norm()).sum();
        // Unit tangents are subtracted, and their difference multiplied by the normal: a cross product, in which what is nearly parallel
        // cancels, to nothing where they are parallel. No shift of the particles shows that where the cloth is folded back along a line, as
        // the normal stays across it.
        let [e1, e2, b] = weights.vectors(t.nodes.map(|n| x[n as usize]));
        let a = (e1 * t.lengths[0] + e2 * t.lengths[1]) / (t.lengths[0] + t.lengths[1]);
        let (length, height) = (a.norm() * b.norm(), a.cross(&b).norm());
        let cancelled = length / height.max(f64::EPSILON * length).max(f64::MIN_POSITIVE);
        let off = off(gradient, 2.0 / t.reach * (1.0 + cancelled), kappa.value);
        see(Strained { law, ends, strain: kappa.value, off, p, area: t.area });
    }
    for (s, &p) in elements.shears.iter().zip(&history.shears) {
        let weights = shear::Weights::new(s);
        let phi = potential.angle(s, &weights, x);
        let gradient = weights.spread(&phi.gradient).iter().map(|g| g.norm()).sum();
        // An angle from its sine; what it is at rest is subtracted afterwards.
        let angle = phi.value + look.state.rests * s.rest;
        let off = off(gradient, 1.0 / angle.cos(), phi.value);
        see(Strained { law: &fabric.shear, ends: sheared, strain: phi.value, off, p, area: s.area });
    }
}

/// What rounding may do to an energy [J]: by what it makes of strains and of places that obstacles press, a part of its terms, and of the energy
/// at the ends of the curves, from which integrals count.
pub fn rounding_of_energy(look: &Look) -> f64 {
    let (model, fabric) = (look.model, &look.model.fabric);
    let mut strains = 0.0;
    strained(look, &mut |s| strains += s.law.evaluate(s.strain, s.p).force.abs() * s.off * s.area);
    let x = &look.state.positions;
    let (candidates, pull) = (look.candidates(), Pull::none(model));
    let potential = Potential { model, state: look.state, candidates: &candidates, pull: &pull };
    let mut pressed = vec![Vec3::zeros(); x.len()];
    potential.contact().add_gradient(x, &mut pressed);
    let pressed = ROUNDINGS * f64::EPSILON * extent(x) * pressed.iter().map(|f| f.norm()).sum::<f64>();
    let heights = x.iter().enumerate().map(|(n, p)| model.mass(n) * p.z.abs());
    let gravity = model.gravity * heights.sum::<f64>();
    let laws = fabric.tensile.iter().chain(&fabric.bending).chain([&fabric.shear]);
    let ends = laws.flat_map(|law| law.knots().map(|x| law.evaluate(x, law.enclosed(x)).energy.abs()));
    let curves = model.area * ends.fold(0.0, f64::max);
    strains
        + pressed
        + 1e-9 * (look.report.energy.abs() + gravity)
        + 1e-12 * (curves + model.weight_on_earth())
}

/// Force that rounding of positions of 1 m makes in stiff edges [N].
pub(super) fn stiffness_rounding(model: &Model, direction: usize) -> f64 {
    let law = &model.fabric.tensile[direction];
    let branches = law.branches(0.01);
    let half = 0.5 * (branches.loading[0] - branches.unloading[0]);
    let stiffness = branches.loading[1].abs().max(branches.unloading[1].abs()) + half * half / law.stick();
    let spacings = [0, 1].map(|d| model.grid.spacing(d));
    64.0 * f64::EPSILON * stiffness * spacings[0].max(spacings[1]) / spacings[0].min(spacings[1])
}

/// Largest coordinate [m].
pub(super) fn extent(x: &[Vec3]) -> f64 {
    x.iter().map(|p| p.amax()).fold(0.0, f64::max)
}
