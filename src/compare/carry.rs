//! Carries a solution, positions and element forces, to a finer mesh, where its cost is compared with that mesh's own.
//!
//! Forces are carried as fields, not made anew from the carried shape: a shape off by a micrometre would stretch a stiff fabric by
//! newtons. So is what obstacles do, as a traction, for the same reason. What both meshes have keeps its value.

use crate::{
    cost::{self, Coefficients, CostReport, Forces},
    grid::{Elements, Grid, Interpolation},
    math::Vec3,
    model::Model,
    potential::{Potential, Pull, contact::candidates::Candidates},
    state::State,
};
use std::collections::HashMap;

/// A solution on another mesh.
#[derive(Clone, Debug)]
pub struct Carried {
    /// Positions [m].
    pub positions: Vec<Vec3>,
    /// Element forces.
    pub forces: Forces,
    /// The obstacles' forces, as pulls.
    pub contact: Pull,
}

impl Carried {
    /// Its cost on the model it was carried to.
    pub fn cost(&self, to: &Model, fixed: &[bool]) -> CostReport {
        let state = State::new(to, self.positions[..to.grid.particles()].to_vec());
        let none = Candidates::default();
        let potential = Potential { model: to, state: &state, candidates: &none, pull: &self.contact };
        cost::evaluate(&potential, &self.positions, &self.forces, fixed, &Coefficients::default())
    }
}

/// Carries a solution to the finer model `to`: its lattice is that of `from`, or refines it by a power of two.
/// `None` where it does not.
pub fn carry(from: &Model, state: &State, forces: &Forces, to: &Model) -> Option<Carried> {
    let (mesh, step) = embed(&from.grid, &to.grid)?;
    let place = |n: usize| mesh.index(from.grid.site(n).map(|k| k * step));
    let spread = |of: &dyn Fn(usize) -> Vec3| {
        let mut field = vec![Vec3::zeros(); mesh.particles()];
        from.grid.active().for_each(|n| field[place(n)] = of(n));
        mesh.interpolate(&mut field, Interpolation::Cubic);
        field
    };
    let fields = Fields::new(from, state, forces);
    let mut positions = spread(&|n| state.positions[n]);
    let membrane = spread(&|n| fields.membrane[n]);
    let bending = spread(&|n| fields.bending[n]);
    let traction = spread(&|n| fields.traction[n]);
    positions.resize(to.elements.nodes(), Vec3::zeros());
    to.elements.fill(&mut positions);
    let mut contact = Pull::none(to);
    for n in to.grid.active() {
        contact.weights[n] = 1.0;
        contact.targets[n] = positions[n] - traction[n] * to.elements.areas[n];
    }
    let known = (step == 1).then(|| Known::new(&from.elements, forces));
    let forces = elements_of(to, known, &membrane, &bending);
    Some(Carried { positions, forces, contact })
}

/// The mesh of `from` on the lattice of `to`, and how many intervals of it one of `from` is.
fn embed(from: &Grid, to: &Grid) -> Option<(Grid, usize)> {
    let steps = [0, 1].map(|k| (to.counts[k] - 1) / (from.counts[k] - 1));
    let fits = (0..2).all(|k| (from.counts[k] - 1) * steps[0] == to.counts[k] - 1);
    if !fits || !steps[0].is_power_of_two() {
        return None;
    }
    if steps[0] == 1 {
        return Some((from.clone(), 1));
    }
    let mut mesh = to.clone();
    for _ in 0..steps[0].trailing_zeros() {
        mesh = mesh.coarsened()?;
    }
    (mesh.tally()[0] == from.particles()).then_some((mesh, steps[0]))
}

/// Element forces and the obstacles' as fields over the particles.
struct Fields {
    /// Tension along warp and weft, shear force [N/m].
    membrane: Vec<Vec3>,
    /// Moment along warp and weft [N].
    bending: Vec<Vec3>,
    /// Minus what obstacles press and drag with [Pa].
    traction: Vec<Vec3>,
}

impl Fields {
    fn new(model: &Model, state: &State, forces: &Forces) -> Fields {
        let (elements, nodes) = (&model.elements, model.elements.nodes());
        let mut membrane = vec![Vec3::zeros(); nodes];
        let mut bending = vec![Vec3::zeros(); nodes];
        let (mut width, mut area) = (vec![[0.0; 2]; nodes], vec![0.0; nodes]);
        for (e, tension) in elements.edges.iter().zip(&forces.tensions) {
            for n in e.nodes.map(|n| n as usize) {
                membrane[n][e.direction] += tension * e.width;
                width[n][e.direction] += e.width;
            }
        }
        for (s, force) in elements.shears.iter().zip(&forces.shears) {
            for n in s.nodes.map(|n| n as usize) {
                membrane[n].z += force * s.area;
                area[n] += s.area;
            }
        }
        for (t, moment) in elements.triples.iter().zip(&forces.moments) {
            bending[t.site as usize][t.direction] = *moment;
        }
        let mut traction = vec![Vec3::zeros(); nodes];
        let (still, candidates) = (Pull::default(), Candidates::of(model, state));
        let potential = Potential { model, state, candidates: &candidates, pull: &still };
        potential.contact().add_gradient(&state.positions, &mut traction);
        elements.gather(&mut traction);
        for n in model.grid.active() {
            let [warp, weft] = width[n];
            for (k, sum) in [warp, weft, area[n]].into_iter().enumerate() {
                membrane[n][k] /= f64::max(sum, f64::MIN_POSITIVE);
            }
            traction[n] /= elements.areas[n];
        }
        Fields { membrane, bending, traction }
    }
}

/// Forces of elements that the next mesh may share, by their nodes.
struct Known {
    edges: HashMap<[u32; 2], f64>,
    triples: HashMap<([u32; 5], [u64; 2]), f64>,
    shears: HashMap<[u32; 4], f64>,
}

impl Known {
    fn new(elements: &Elements, forces: &Forces) -> Known {
        let key = |l: [f64; 2]| l.map(f64::to_bits);
        Known {
            edges: elements.edges.iter().map(|e| e.nodes).zip(forces.tensions.iter().copied()).collect(),
            triples: elements
                .triples
                .iter()
                .map(|t| (t.nodes, key(t.lengths)))
                .zip(forces.moments.iter().copied())
                .collect(),
            shears: elements.shears.iter().map(|s| s.nodes).zip(forces.shears.iter().copied()).collect(),
        }
    }
}

fn elements_of(to: &Model, known: Option<Known>, membrane: &[Vec3], bending: &[Vec3]) -> Forces {
    let elements = &to.elements;
    let known = known.as_ref();
    let mean = |nodes: &[u32], k: usize| {
        nodes.iter().map(|&n| membrane[n as usize][k]).sum::<f64>() / nodes.len() as f64
    };
    let key = |l: [f64; 2]| l.map(f64::to_bits);
    Forces {
        tensions: elements
            .edges
            .iter()
            .map(|e| {
                let same = known.and_then(|k| k.edges.get(&e.nodes).copied());
                same.unwrap_or_else(|| mean(&e.nodes, e.direction))
            })
            .collect(),
        moments: elements
            .triples
            .iter()
            .map(|t| {
                let same = known.and_then(|k| k.triples.get(&(t.nodes, key(t.lengths))).copied());
                same.unwrap_or_else(|| bending[t.site as usize][t.direction])
            })
            .collect(),
        shears: elements
            .shears
            .iter()
            .map(|s| {
                let same = known.and_then(|k| k.shears.get(&s.nodes).copied());
                same.unwrap_or_else(|| mean(&s.nodes, 2))
            })
            .collect(),
    }
}
