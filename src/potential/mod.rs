//! The incremental potential of a step: tensile, bending, shear, gravity, inertia and drag, contact, friction.
//!
//! Its stationary point is the next state. Each term is written once per element (`edge`, `triple`, `shear`, `contact`) and
//! assembled here: energy, gradient (= minus the force) and Hessian. History and anchors are constants of a step.
//!
//! Positions go over the mesh's nodes: the lattice's particles, then the ghosts beyond. Ghosts must hold their masters' value
//! (`Elements::fill`), which linear steps keep; absent particles count nothing.

use crate::{
    fabric::law::Law,
    grid::{Edge, Shear, Triple},
    math::{Mat3, Vec3},
    model::Model,
    state::{Anchor, History, State},
};
use system::{Slot, System};

pub mod contact;
pub mod edge;
pub mod shear;
pub mod triple;
mod order;
pub mod ghosted;
pub mod system;

/// Inertia and drag as one pull per particle: ½ weight |x − target|².
#[derive(Clone, Debug, Default)]
pub struct Pull {
    /// [N/m], per particle; all zero for statics.
    pub weights: Vec<f64>,
    /// [m], per particle.
    pub targets: Vec<Vec3>,
}

impl Pull {
    /// No inertia: statics.
    pub fn none(model: &Model) -> Pull {
        let n = model.elements.nodes();
        Pull { weights: vec![0.0; n], targets: vec![Vec3::zeros(); n] }
    }

    /// Implicit Euler over `dt` [s] from the state: m/dt² towards x + dt v, and drag c A/dt towards x.
    pub fn set_inertia(&mut self, model: &Model, state: &State, dt: f64) {
        for n in model.grid.active() {
            let inertia = model.mass(n) / (dt * dt);
            let drag = model.drag * model.elements.areas[n] / dt;
            let weight = inertia + drag;
            self.weights[n] = weight;
            self.targets[n] = state.positions[n] + state.velocities[n] * (dt * inertia / weight);
        }
    }

    /// A pull of `shift` times the particle's mass [1/s²] towards the positions: pseudo-transient continuation.
    pub fn set_shift(&mut self, model: &Model, positions: &[Vec3], shift: f64) {
        for n in model.grid.active() {
            self.weights[n] = shift * model.mass(n);
        }
        self.targets.copy_from_slice(positions);
    }
}

/// Which second derivatives the Hessian holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Curvature {
    /// All of them: the true Hessian, which may be indefinite.
    Exact,
    /// Positive semidefinite parts only: tension of stretched edges, no geometric part of bending, shear, contact.
    Clamped,
}

/// The potential of one step: a model, the state it starts from, and the pull of inertia.
#[derive(Clone, Copy)]
pub struct Potential<'a> {
    /// Constants.
    pub model: &'a Model,
    /// History and anchors (its positions are not used).
    pub state: &'a State,
    /// Inertia and drag.
    pub pull: &'a Pull,
}

impl Potential<'_> {
    fn at(x: &[Vec3], node: u32) -> Vec3 {
        x[node as usize]
    }

    /// Strain of an edge.
    pub fn strain(&self, e: &Edge, x: &[Vec3]) -> edge::Strain {
        edge::strain(Self::at(x, e.nodes[1]) - Self::at(x, e.nodes[0]), e.length)
    }

    /// Curvature of a triple.
    pub fn bend(&self, t: &Triple, weights: &triple::Weights, x: &[Vec3]) -> triple::Curvature {
        weights.curvature(weights.vectors(t.nodes.map(|n| Self::at(x, n))))
    }

    /// Shear angle of a cell.
    pub fn angle(&self, s: &Shear, weights: &shear::Weights, x: &[Vec3]) -> shear::Angle {
        shear::angle(weights.vectors(s.nodes.map(|n| Self::at(x, n))))
    }

    /// Energy stored in fabric and gravity [J].
    pub fn stored(&self, x: &[Vec3]) -> f64 {
        let (model, history) = (self.model, &self.state.history);
        let fabric = &model.fabric;
        let mut energy = 0.0;
        for (e, &p) in model.elements.edges.iter().zip(&history.edges) {
            energy +=
                e.width * e.length * fabric.tensile[e.direction].evaluate(self.strain(e, x).value, p).energy;
        }
        for (t, &p) in model.elements.triples.iter().zip(&history.triples) {
            let kappa = self.bend(t, &triple::Weights::new(t), x).value;
            energy += t.area * fabric.bending[t.direction].evaluate(kappa, p).energy;
        }
        for (s, &p) in model.elements.shears.iter().zip(&history.shears) {
            let phi = self.angle(s, &shear::Weights::new(s), x).value;
            energy += s.area * fabric.shear.evaluate(phi, p).energy;
        }
        let heights: f64 = x.iter().enumerate().map(|(n, p)| model.mass(n) * p.z).sum();
        energy + model.gravity * heights
    }

    /// The whole potential [J]: stored energy, contact, friction, pull of inertia.
    pub fn energy(&self, x: &[Vec3]) -> f64 {
        let mut energy = self.stored(x);
        for n in self.model.grid.active() {
            let p = &x[n];
            energy += 0.5 * self.pull.weights[n] * (p - self.pull.targets[n]).norm_squared();
            energy +=
                contact::energy(self.model, n, *p) + contact::friction_energy(self.model, self.state, n, *p);
        }
        energy
    }

    /// Gradient of the potential in every particle [N], fixed ones included, into `out`; zero where no particle is active.
    pub fn gradient(&self, x: &[Vec3], out: &mut [Vec3]) {
        let (model, history) = (self.model, &self.state.history);
        let fabric = &model.fabric;
        out.fill(Vec3::zeros());
        for n in model.grid.active() {
            let g = &mut out[n];
            *g = (x[n] - self.pull.targets[n]) * self.pull.weights[n];
            g.z += model.mass(n) * model.gravity;
            *g += contact::gradient(model, n, x[n]) + contact::friction_gradient(model, self.state, n, x[n]);
        }
        for (e, &p) in model.elements.edges.iter().zip(&history.edges) {
            let strain = self.strain(e, x);
            let tension = fabric.tensile[e.direction].evaluate(strain.value, p).force;
            let pull = strain.gradient * (tension * e.width * e.length);
            out[e.nodes[0] as usize] -= pull;
            out[e.nodes[1] as usize] += pull;
        }
        for (t, &p) in model.elements.triples.iter().zip(&history.triples) {
            let weights = triple::Weights::new(t);
            let kappa = self.bend(t, &weights, x);
            let moment = t.area * fabric.bending[t.direction].evaluate(kappa.value, p).force;
            for (n, g) in t.nodes.iter().zip(weights.spread(&kappa.gradient)) {
                out[*n as usize] += g * moment;
            }
        }
        for (s, &p) in model.elements.shears.iter().zip(&history.shears) {
            let weights = shear::Weights::new(s);
            let phi = self.angle(s, &weights, x);
            let force = s.area * fabric.shear.evaluate(phi.value, p).force;
            for (n, g) in s.nodes.iter().zip(weights.spread(&phi.gradient)) {
                out[*n as usize] += g * force;
            }
        }
        model.elements.gather(out);
    }

    /// History and anchors after a step that ended at `x`, and the energy it dissipated [J].
    pub fn commit(&self, x: &[Vec3]) -> (History, Vec<Option<Anchor>>, f64) {
        let (model, elements) = (self.model, &self.model.elements);
        let fabric = &model.fabric;
        let mut history = self.state.history.clone();
        let mut lost = 0.0;
        let mut advance = |law: &Law, p: &mut f64, strain: f64, area: f64| {
            let next = law.commit(strain, *p);
            lost += area * law.dissipated(*p, next);
            *p = next;
        };
        for (e, p) in elements.edges.iter().zip(&mut history.edges) {
            advance(&fabric.tensile[e.direction], p, self.strain(e, x).value, e.width * e.length);
        }
        for (t, p) in elements.triples.iter().zip(&mut history.triples) {
            let kappa = self.bend(t, &triple::Weights::new(t), x);
            advance(&fabric.bending[t.direction], p, kappa.value, t.area);
        }
        for (s, p) in elements.shears.iter().zip(&mut history.shears) {
            let phi = self.angle(s, &shear::Weights::new(s), x);
            advance(&fabric.shear, p, phi.value, s.area);
        }
        let mut anchors = vec![None; x.len()];
        if !model.obstacles.is_empty() {
            for n in model.grid.active() {
                let slid;
                (anchors[n], slid) = contact::commit(model, self.state.anchors[n].as_ref(), n, x[n]);
                lost += slid;
            }
        }
        (history, anchors, lost)
    }

    /// Assembles the Hessian at `x` into `system`, whose right-hand side already holds the gradient.
    ///
    /// `strains` are the independent tension unknowns of the mixed Newton step, one strain per edge: the geometric stiffness
    /// takes its tension from them and the right-hand side gets the linearized tension. The edges' own strains give plain Newton.
    pub fn hessian(&self, x: &[Vec3], strains: &[f64], kind: Curvature, system: &mut System) {
        let (model, history) = (self.model, &self.state.history);
        let fabric = &model.fabric;
        for (k, (e, &p)) in model.elements.edges.iter().zip(&history.edges).enumerate() {
            let strain = self.strain(e, x);
            let law = &fabric.tensile[e.direction];
            let response = law.evaluate(strains[k], p);
            let scale = e.width * e.length;
            let tension = if kind == Curvature::Clamped { response.force.max(0.0) } else { response.force };
            let t = strain.gradient;
            let block = (t * t.transpose() * response.stiffness + strain.hessian() * tension) * scale;
            let linear = response.force + response.stiffness * (strain.value - strains[k]);
            let excess = linear - law.evaluate(strain.value, p).force;
            let extra = t * (scale * excess);
            match k.checked_sub(model.elements.regular[0]) {
                None => system.add_edge(k, &block, extra),
                Some(k) => {
                    let stencil = &system.pattern.clone().ghosted.edges[k];
                    stencil.push(&[extra], system);
                    stencil.add(&[[block]], system);
                }
            }
        }
        let [_, triples, shears] = model.elements.regular;
        for (k, &p) in history.triples[..triples].iter().enumerate() {
            self.triple_hessian(k, p, x, kind, system);
        }
        for (k, &p) in history.shears[..shears].iter().enumerate() {
            self.shear_hessian(k, p, x, kind, system);
        }
        self.ghosted_hessian(x, kind, system);
        for n in model.grid.active() {
            let p = &x[n];
            let mut block = contact::hessian(model, n, *p, kind);
            block += contact::friction_hessian(model, self.state, n, *p);
            block += Mat3::identity() * self.pull.weights[n];
            system.add_diagonal(n as u32, &block);
        }
    }

    fn triple_hessian(&self, k: usize, p: f64, x: &[Vec3], kind: Curvature, system: &mut System) {
        let t = &self.model.elements.triples[k];
        let stencil = &system.pattern.triples[k];
        let (nodes, weights, slots): ([u32; 5], triple::Weights, [Slot; 10]) =
            (stencil.nodes, stencil.weights, stencil.slots);
        let kappa = weights.curvature(weights.vectors(nodes.map(|n| Self::at(x, n))));
        let response = self.model.fabric.bending[t.direction].evaluate(kappa.value, p);
        let gradient = weights.spread(&kappa.gradient);
        let stiffness = t.area * response.stiffness;
        if kind == Curvature::Clamped {
            system.add_element(&nodes, &slots, |m, n| gradient[m] * (gradient[n] * stiffness).transpose());
            return;
        }
        let moment = t.area * response.force;
        let [h11, h12, h1b, h22, h2b, hbb] = kappa.hessian().map(|h| h * moment);
        let vector = [[h11, h12, h1b], [h12.transpose(), h22, h2b], [h1b.transpose(), h2b.transpose(), hbb]];
        // All nodes but the centre have a weight in one vector only: leaving out the zeros halves the work.
        let w: [[f64; 3]; 5] = std::array::from_fn(|n| weights.of(n));
        let mut rows = [[Mat3::zeros(); 3]; 5];
        for (row, w) in rows.iter_mut().zip(&w) {
            for v in (0..3).filter(|&v| w[v] != 0.0) {
                for u in 0..3 {
                    row[u] += vector[u][v] * w[v];
                }
            }
        }
        system.add_element(&nodes, &slots, |m, n| {
            let mut block = gradient[m] * (gradient[n] * stiffness).transpose();
            for u in (0..3).filter(|&u| w[m][u] != 0.0) {
                block += rows[n][u] * w[m][u];
            }
            block
        });
    }

    fn shear_hessian(&self, k: usize, p: f64, x: &[Vec3], kind: Curvature, system: &mut System) {
        let s = &self.model.elements.shears[k];
        let stencil = &system.pattern.shears[k];
        let (nodes, weights, slots): ([u32; 4], shear::Weights, [Slot; 6]) =
            (stencil.nodes, stencil.weights, stencil.slots);
        let phi = shear::angle(weights.vectors(nodes.map(|n| Self::at(x, n))));
        let response = self.model.fabric.shear.evaluate(phi.value, p);
        let gradient = weights.spread(&phi.gradient);
        let stiffness = s.area * response.stiffness;
        if kind == Curvature::Clamped {
            system.add_element(&nodes, &slots, |m, n| gradient[m] * (gradient[n] * stiffness).transpose());
            return;
        }
        let w = &weights.0;
        let [aa, ab, bb] = phi.hessian().map(|h| h * (s.area * response.force));
        let rows: [[Mat3; 2]; 4] =
            std::array::from_fn(|n| [aa * w[0][n] + ab * w[1][n], ab.transpose() * w[0][n] + bb * w[1][n]]);
        system.add_element(&nodes, &slots, |m, n| {
            rows[n][0] * w[0][m] + rows[n][1] * w[1][m] + gradient[m] * (gradient[n] * stiffness).transpose()
        });
    }

    /// Triples and shear cells that name ghosts: their Hessian in their vectors, spread over the masters.
    fn ghosted_hessian(&self, x: &[Vec3], kind: Curvature, system: &mut System) {
        let (elements, history, fabric) = (&self.model.elements, &self.state.history, &self.model.fabric);
        let pattern = system.pattern.clone();
        let [_, triples, shears] = elements.regular;
        for (k, stencil) in pattern.ghosted.triples.iter().enumerate() {
            let t = &elements.triples[triples + k];
            let kappa = self.bend(t, &triple::Weights::new(t), x);
            let response = fabric.bending[t.direction].evaluate(kappa.value, history.triples[triples + k]);
            let (g, stiffness) = (&kappa.gradient, t.area * response.stiffness);
            let mut hessian: [[Mat3; 3]; 3] =
                std::array::from_fn(|u| std::array::from_fn(|v| g[u] * (g[v] * stiffness).transpose()));
            if kind == Curvature::Exact {
                let [h11, h12, h1b, h22, h2b, hbb] = kappa.hessian().map(|h| h * (t.area * response.force));
                let bend =
                    [[h11, h12, h1b], [h12.transpose(), h22, h2b], [h1b.transpose(), h2b.transpose(), hbb]];
                hessian.iter_mut().flatten().zip(bend.iter().flatten()).for_each(|(h, b)| *h += b);
            }
            stencil.add(&hessian, system);
        }
        for (k, stencil) in pattern.ghosted.shears.iter().enumerate() {
            let s = &elements.shears[shears + k];
            let phi = self.angle(s, &shear::Weights::new(s), x);
            let response = fabric.shear.evaluate(phi.value, history.shears[shears + k]);
            let area = s.area;
            let (g, stiffness) = (&phi.gradient, area * response.stiffness);
            let mut hessian: [[Mat3; 2]; 2] =
                std::array::from_fn(|u| std::array::from_fn(|v| g[u] * (g[v] * stiffness).transpose()));
            if kind == Curvature::Exact {
                let [aa, ab, bb] = phi.hessian().map(|h| h * (area * response.force));
                let turn = [[aa, ab], [ab.transpose(), bb]];
                hessian.iter_mut().flatten().zip(turn.iter().flatten()).for_each(|(h, b)| *h += b);
            }
            stencil.add(&hessian, system);
        }
    }
}
