//! What a step changes: positions, velocities, hysteresis, friction anchors.

use crate::{
    grid::{Elements, Interpolation},
    math::Vec3,
    model::Model,
};

/// Internal variable of every element's law.
#[derive(Clone, Debug, PartialEq)]
pub struct History {
    /// Per edge [J/m²].
    pub edges: Vec<f64>,
    /// Per triple [J/m²].
    pub triples: Vec<f64>,
    /// Per shear cell [J/m²].
    pub shears: Vec<f64>,
}

/// Where a touching particle sticks: friction pulls it back to `point` until the Coulomb limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Anchor {
    /// Anchor [m].
    pub point: Vec3,
    /// Outward normal of the obstacle there.
    pub normal: Vec3,
    /// Normal force at the last commit [N]; it sets the Coulomb limit of the next step.
    pub force: f64,
}

/// The state of a cloth.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Positions [m] of the mesh's nodes: all particles of the lattice, then the ghosts beyond it.
    pub positions: Vec<Vec3>,
    /// Velocities of the same [m/s].
    pub velocities: Vec<Vec3>,
    /// Hysteresis; advances only in a commit.
    pub history: History,
    /// Friction anchors of touching particles; advance only in a commit.
    pub anchors: Vec<Option<Anchor>>,
    /// Dead loads [N] that a change of the mesh left behind; they fade.
    pub loads: Vec<Vec3>,
}

impl State {
    /// A virgin cloth at rest with its active particles at these positions of the lattice.
    pub fn new(model: &Model, mut positions: Vec<Vec3>) -> State {
        model.grid.interpolate(&mut positions, Interpolation::Linear);
        positions.resize(model.elements.nodes(), Vec3::zeros());
        model.elements.fill(&mut positions);
        let Elements { edges, triples, shears, .. } = &model.elements;
        let fabric = &model.fabric;
        State {
            velocities: vec![Vec3::zeros(); positions.len()],
            anchors: vec![None; positions.len()],
            loads: vec![Vec3::zeros(); positions.len()],
            history: History {
                edges: edges.iter().map(|e| fabric.tensile[e.direction].virgin()).collect(),
                triples: triples.iter().map(|t| fabric.bending[t.direction].virgin()).collect(),
                shears: vec![fabric.shear.virgin(); shears.len()],
            },
            positions,
        }
    }

    /// True when every number is finite.
    pub fn is_finite(&self) -> bool {
        let vectors = self.positions.iter().chain(&self.velocities).chain(&self.loads);
        let history = self.history.edges.iter().chain(&self.history.triples).chain(&self.history.shears);
        vectors.flat_map(|v| v.iter()).chain(history).all(|v| v.is_finite())
    }

    /// Checksum over the bits of the state.
    pub fn checksum(&self) -> u64 {
        let mut hash = xxhash_rust::xxh3::Xxh3::new();
        let mut feed = |v: f64| hash.update(&v.to_bits().to_le_bytes());
        let vectors = self.positions.iter().chain(&self.velocities).chain(&self.loads);
        vectors.flat_map(|v| v.iter()).for_each(|v| feed(*v));
        let history = self.history.edges.iter().chain(&self.history.triples).chain(&self.history.shears);
        history.for_each(|v| feed(*v));
        for (n, anchor) in self.anchors.iter().enumerate() {
            if let Some(a) = anchor {
                feed(n as f64);
                a.point.iter().chain(a.normal.iter()).for_each(|v| feed(*v));
                feed(a.force);
            }
        }
        hash.digest()
    }
}
