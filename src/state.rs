//! What a step changes: positions, velocities, hysteresis, friction anchors, poses of obstacles.

use crate::{
    grid::{Elements, Interpolation},
    math::Vec3,
    model::Model,
    obstacle::Motion,
};
use nalgebra::Isometry3;

/// Internal variable of every element's law.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct History {
    /// Per edge [J/m²].
    pub edges: Vec<f64>,
    /// Per triple [J/m²].
    pub triples: Vec<f64>,
    /// Per shear cell [J/m²].
    pub shears: Vec<f64>,
}

/// Which piece of cloth touches which part of which obstacle. Ordered: kinds in the order of their declaration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Pair {
    /// Place in the model's list of obstacles.
    pub obstacle: u32,
    /// What meets what.
    pub kind: Meeting,
    /// Particle, edge or triangle of the surface.
    pub cloth: u32,
    /// Patch of faces, ridge or corner of the obstacle; 0 for a shape as a whole.
    pub part: u32,
}

/// What meets what in a contact.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Meeting {
    /// A particle and a shape or one of its faces.
    ParticleFace,
    /// An edge of the cloth and a ridge.
    EdgeRidge,
    /// A triangle of the cloth and a corner.
    TriangleCorner,
}

/// Where a touching piece of cloth sticks: friction pulls it back to `point` until the Coulomb limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Anchor {
    /// What touches what.
    pub pair: Pair,
    /// Particles of the piece, with their weights in the place that touches; an unused one has weight 0.
    pub nodes: [u32; 3],
    /// Weights of `nodes`; their sum is 1.
    pub weights: [f64; 3],
    /// Anchor in the obstacle's frame [m].
    pub point: Vec3,
    /// Outward normal of the obstacle there, in its frame.
    pub normal: Vec3,
    /// Normal force at the last commit [N]; it sets the Coulomb limit of the next step.
    pub force: f64,
    /// Friction per slip [N/m].
    pub stiffness: f64,
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
    /// Friction anchors of all contacts, ordered by pair; advance only in a commit.
    pub anchors: Vec<Anchor>,
    /// Poses of the obstacles, world from obstacle.
    pub poses: Vec<Isometry3<f64>>,
    /// What moves them, where something does.
    pub motions: Vec<Option<Motion>>,
    /// Dead loads [N] that a change of the mesh left behind; they fade.
    pub loads: Vec<Vec3>,
    /// Dead loads [N] for what merged elements of a quiet cloth do not see; they stay until it moves on, and then fade like the others.
    pub held: Vec<Vec3>,
    /// Part of the elements' rests that counts: all until the cloth moves on, and then less and less.
    pub rests: f64,
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
            anchors: Vec::new(),
            poses: model.obstacles.iter().map(|o| o.pose).collect(),
            motions: vec![None; model.obstacles.len()],
            loads: vec![Vec3::zeros(); positions.len()],
            held: vec![Vec3::zeros(); positions.len()],
            rests: 0.0,
            history: History {
                edges: edges.iter().map(|e| fabric.tensile[e.direction].virgin()).collect(),
                triples: triples.iter().map(|t| fabric.bending[t.direction].virgin()).collect(),
                shears: vec![fabric.shear.virgin(); shears.len()],
            },
            positions,
        }
    }

    /// Dead load on a particle [N].
    pub fn load(&self, n: usize) -> Vec3 {
        self.loads[n] + self.held[n]
    }

    /// Dead loads [N].
    pub fn all_loads(&self) -> Vec<Vec3> {
        (0..self.loads.len()).map(|n| self.load(n)).collect()
    }

    /// All vectors of the nodes.
    fn vectors(&self) -> impl Iterator<Item = &Vec3> {
        self.positions.iter().chain(&self.velocities).chain(&self.loads).chain(&self.held)
    }

    /// True when every number is finite.
    pub fn is_finite(&self) -> bool {
        let history = self.history.edges.iter().chain(&self.history.triples).chain(&self.history.shears);
        self.vectors().flat_map(|v| v.iter()).chain(history).chain([&self.rests]).all(|v| v.is_finite())
    }

    /// Checksum over the bits of the state.
    pub fn checksum(&self) -> u64 {
        let mut hash = xxhash_rust::xxh3::Xxh3::new();
        let mut feed = |v: f64| hash.update(&v.to_bits().to_le_bytes());
        self.vectors().flat_map(|v| v.iter()).for_each(|v| feed(*v));
        feed(self.rests);
        let history = self.history.edges.iter().chain(&self.history.triples).chain(&self.history.shears);
        history.for_each(|v| feed(*v));
        for anchor in &self.anchors {
            feed(f64::from(anchor.pair.cloth));
            anchor.point.iter().chain(anchor.normal.iter()).for_each(|v| feed(*v));
            feed(anchor.force);
        }
        for pose in &self.poses {
            pose.translation.vector.iter().chain(pose.rotation.coords.iter()).for_each(|v| feed(*v));
        }
        hash.digest()
    }
}
