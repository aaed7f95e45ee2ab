//! The incremental potential of a step: tensile, bending, shear, twist, gravity, inertia and drag, contact, friction.
//!
//! Its stationary point is the next state. Each term is written once per element (`edge`, `triple`, `shear`, `twist`, `contact`) and
//! assembled here: energy, gradient (= minus the force) and Hessian. History and anchors are constants of a step.
//!
//! Positions go over the mesh's nodes: the lattice's particles, then the ghosts beyond. Ghosts must hold their masters' value
//! (`Elements::fill`), which linear steps keep; absent particles count nothing.

use crate::{
    batch::{Measures, Planes},
    cores::Team,
    grid::{Edge, Shear, Triple},
    math::{Mat3, Vec3, pack::dispatch},
    model::Model,
    state::{History, State},
};
use contact::{Contact, Touches, candidates::Candidates, room::Room};
use halves::add_parts;
use kernels::{
    Given, edges,
    energy::Energy,
    laws::{self, Commit},
    shears, triples, twists,
};
use pattern::Pattern;
use system::System;
use values::Values;

pub mod contact;
pub mod edge;
pub mod shear;
pub mod triple;
pub mod twist;
mod order;
pub mod fade;
mod rounded;
pub mod ghosted;
pub mod halves;
pub mod made;
mod product;
pub mod pattern;
pub mod system;
pub mod values;
pub mod kernels;

/// Inertia and drag as one pull per particle: ½ weight |x − target|².
#[derive(Clone, Debug, Default)]
pub struct Pull {
    /// [N/m], per particle; all zero for statics.
    pub weights: Vec<f64>,
    /// [m], per particle.
    pub targets: Vec<Vec3>,
    /// Dead loads of statics [N], per particle; those of a step are in its targets.
    pub loads: Vec<Vec3>,
}

impl Pull {
    /// No inertia: statics.
    pub fn none(model: &Model) -> Pull {
        let n = model.elements.nodes();
        let [targets, loads] = [(); 2].map(|()| vec![Vec3::zeros(); n]);
        Pull { weights: vec![0.0; n], targets, loads }
    }

    /// Statics of a state, under its dead loads.
    pub fn still(model: &Model, state: &State) -> Pull {
        Pull { loads: state.all_loads(), ..Pull::none(model) }
    }

    /// Implicit Euler over `dt` [s] from the state: m/dt² towards x + dt v, drag c A/dt towards x, and dead loads.
    pub fn set_inertia(&mut self, model: &Model, state: &State, dt: f64) {
        for n in model.grid.active() {
            (self.weights[n], self.targets[n]) = Pull::of_inertia(model, state, dt, n);
            self.loads[n] = Vec3::zeros();
        }
    }

    /// Weight [N/m] and target [m] of an active particle for implicit Euler over `dt` [s] from the state.
    pub fn of_inertia(model: &Model, state: &State, dt: f64, n: usize) -> (f64, Vec3) {
        let inertia = model.mass(n) / (dt * dt);
        let drag = model.drag * model.elements.areas[n] / dt;
        let weight = inertia + drag;
        let drift = state.velocities[n] * (dt * inertia / weight);
        (weight, state.positions[n] + drift + state.load(n) / weight)
    }

    /// The way from `x` to where a particle is pulled [m]; none without a pull.
    pub fn way(&self, n: usize, x: Vec3) -> Vec3 {
        if self.weights[n] > 0.0 { self.targets[n] - x } else { Vec3::zeros() }
    }

    /// A pull of `shift` times the particle's mass [1/s²] towards the positions: pseudo-transient continuation.
    pub fn set_shift(&mut self, model: &Model, positions: &[Vec3], shift: f64) {
        for n in model.grid.active() {
            self.weights[n] = shift * model.mass(n);
        }
        model.elements.copy(positions, &mut self.targets);
    }
}

/// Which second derivatives the Hessian holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Curvature {
    /// All of them: the true Hessian, which may be indefinite.
    Exact,
    /// Positive semidefinite parts only: tension of stretched edges, no geometric part of bending, shear, contact.
    Clamped,
    /// The same, and where laws and friction slide that of parabolas nowhere below them: far from balance they may turn within a step.
    Bounding,
}

/// The potential of one step: a model, the state it starts from, and the pull of inertia.
#[derive(Clone, Copy)]
pub struct Potential<'a> {
    /// Constants.
    pub model: &'a Model,
    /// History, anchors, poses (its positions are not used).
    pub state: &'a State,
    /// What may touch obstacles.
    pub candidates: &'a Candidates,
    /// Inertia and drag.
    pub pull: &'a Pull,
}

/// Where contact is met in a step: a particle that is about to land presses on what it lands on, and is not first stopped when it has.
pub struct Ahead<'a> {
    /// Positions there [m].
    pub place: &'a [Vec3],
    /// The way there [m].
    pub way: &'a [Vec3],
    /// Memory for what it changes in the gradient [N].
    pub change: &'a mut [Vec3],
    /// Memory for what presses there, and for what does not but would come back.
    pub touches: &'a mut Touches,
    pub returning: &'a mut Touches,
}

impl History {
    /// Moves the history on over a step after which the elements measure `measures`; gives the energy that was dissipated [J].
    pub fn advance(&mut self, model: &Model, measures: &Measures) -> f64 {
        let (batches, fabric) = (&model.batches, &model.fabric);
        let mut lost = dispatch(Commit {
            lots: laws::edges(batches, fabric),
            measures: &measures.edges,
            history: &mut self.edges,
        });
        lost += dispatch(Commit {
            lots: laws::triples(batches, fabric),
            measures: &measures.triples,
            history: &mut self.triples,
        });
        lost += dispatch(Commit {
            lots: laws::shears(batches, fabric),
            measures: &measures.shears,
            history: &mut self.shears,
        });
        lost
    }
}

impl Potential<'_> {
    fn at(x: &[Vec3], node: u32) -> Vec3 {
        x[node as usize]
    }

    /// The part of the way to where inertia pulls a particle that its dead load makes [m].
    pub fn led_by_load(&self, n: usize) -> Vec3 {
        let weight = self.pull.weights[n];
        if weight > 0.0 { self.state.load(n) / weight } else { Vec3::zeros() }
    }

    /// Strain of an edge, from its rest.
    pub fn strain(&self, e: &Edge, x: &[Vec3]) -> edge::Strain {
        let mut strain = edge::strain(Self::at(x, e.nodes[1]) - Self::at(x, e.nodes[0]), e.length);
        strain.value -= self.state.rests * e.rest;
        strain
    }

    /// Curvature of a triple, from its rest.
    pub fn bend(&self, t: &Triple, weights: &triple::Weights, x: &[Vec3]) -> triple::Curvature {
        let mut kappa = weights.curvature(weights.vectors(t.nodes.map(|n| Self::at(x, n))));
        kappa.value -= self.state.rests * t.rest;
        kappa
    }

    /// Shear angle of a cell, from its rest.
    pub fn angle(&self, s: &Shear, weights: &shear::Weights, x: &[Vec3]) -> shear::Angle {
        let mut angle = shear::angle(weights.vectors(s.nodes.map(|n| Self::at(x, n))));
        angle.value -= self.state.rests * s.rest;
        angle
    }

    /// Twist of a cell.
    pub fn turn(&self, s: &Shear, weights: &twist::Weights, x: &[Vec3]) -> twist::Twist {
        twist::twist(weights.vectors(s.bent.map(|n| Self::at(x, n))))
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
            let tau = self.turn(s, &twist::Weights::new(s), x).value;
            energy += 0.5 * s.area * fabric.twist * tau * tau;
        }
        energy + self.weighed(x)
    }

    /// Energy in gravity [J].
    pub fn weighed(&self, x: &[Vec3]) -> f64 {
        let heights: f64 = self.model.grid.active().map(|n| self.model.mass(n) * x[n].z).sum();
        self.model.gravity * heights
    }

    /// The whole potential [J]: stored energy, contact, friction, pull of inertia.
    pub fn energy(&self, x: &[Vec3]) -> f64 {
        self.stored(x) + self.outer(x)
    }

    /// The same by kernels, with memory for the shape.
    pub fn energy_by_kernels(&self, x: &[Vec3], shape: &mut Planes, team: &Team) -> f64 {
        shape.set(x, &self.model.elements.named);
        let given = self.given(shape);
        let (mut own, mut other) = (0.0, 0.0);
        team.both(
            || own = dispatch(Energy { given, half: 0 }) + self.weighed(x) + self.outer(x),
            || other = dispatch(Energy { given, half: 1 }),
        );
        own + other
    }

    /// Energy of contact and friction, and of the pull of inertia [J].
    fn outer(&self, x: &[Vec3]) -> f64 {
        let pull = |n: usize| {
            let way = x[n] - self.pull.targets[n];
            0.5 * self.pull.weights[n] * way.norm_squared() - self.pull.loads[n].dot(&x[n])
        };
        self.model.grid.active().map(pull).sum::<f64>() + self.contact().energy(x)
    }

    /// Contact and friction.
    pub fn contact(&self) -> Contact<'_> {
        Contact { model: self.model, state: self.state, candidates: self.candidates }
    }

    /// Turns the step of each particle aside, or shortens it, so that nothing passes an obstacle.
    pub fn limit(&self, x: &[Vec3], step: &mut [Vec3], room: &mut Room) {
        self.candidates.limit(self.model, x, step, room);
    }

    /// The part of a step that can be gone as it is without passing an obstacle.
    pub fn free_share(&self, x: &[Vec3], step: &[Vec3], room: &mut Room) -> f64 {
        self.candidates.free_share(self.model, x, step, room)
    }

    fn given<'a>(&'a self, x: &'a Planes) -> Given<'a> {
        let (Model { batches, fabric, .. }, State { history, rests, .. }) = (self.model, self.state);
        Given { batches, fabric, history, rests: *rests, x }
    }

    /// Gradient of the potential in every active particle [N], fixed ones included, into `out`, zero in ghosts; what the elements measure
    /// at `x` into `measures`.
    pub fn gradient(&self, x: &[Vec3], out: &mut [Vec3], measures: &mut Measures) {
        self.begin_gradient(x, out, &mut Touches::default());
        self.finish_gradient(x, out, measures, Team::nobody());
    }

    /// The part of the gradient that pull, weight and contact bring about; and what presses at `x`.
    pub fn begin_gradient(&self, x: &[Vec3], out: &mut [Vec3], touches: &mut Touches) {
        let model = self.model;
        model.elements.ghosts.iter().for_each(|ghost| out[ghost.node as usize] = Vec3::zeros());
        for n in model.grid.active() {
            out[n] = (x[n] - self.pull.targets[n]) * self.pull.weights[n] - self.pull.loads[n];
            out[n].z += model.mass(n) * model.gravity;
        }
        self.contact().find(x, touches);
        self.contact().add_gradient_of(touches, x, out);
    }

    /// Adds the elements' part to the gradient and keeps what they measure.
    pub fn finish_gradient(&self, x: &[Vec3], out: &mut [Vec3], measures: &mut Measures, team: &Team) {
        let Measures { edges, triples, shears, twists, shape, forces } = measures;
        let model = self.model;
        let named = &model.elements.named;
        shape.set(x, named);
        let given = self.given(shape);
        let [of_triples, of_others] = forces;
        // The helper's part is the shorter one: who waits for long lets it go.
        team.both(
            || {
                let out = of_others;
                out.clear();
                dispatch(edges::Gradient { given, out, measures: edges });
                dispatch(shears::Gradient { given, out, measures: shears });
                if model.fabric.twist > 0.0 {
                    dispatch(twists::Gradient { given, out, measures: twists });
                }
            },
            || {
                of_triples.clear();
                dispatch(triples::Gradient { given, out: of_triples, measures: triples });
            },
        );
        forces.iter().for_each(|forces| forces.add_to(out, named));
        model.elements.gather(out);
    }

    /// History after a step where the elements measure `measures`, and the energy it dissipated [J]; friction apart.
    pub fn commit(&self, measures: &Measures) -> (History, f64) {
        let mut history = self.state.history.clone();
        let lost = history.advance(self.model, measures);
        (history, lost)
    }

    /// Assembles the Hessian at `x` into `system`, whose right-hand side already holds the gradient, and its lower triangle too.
    ///
    /// `strains` are the independent tension unknowns of the mixed Newton step, one strain per edge: the geometric stiffness
    /// takes its tension from them and the right-hand side gets the linearized tension. The edges' own strains give plain Newton.
    pub fn hessian(&self, x: &[Vec3], strains: &[f64], kind: Curvature, system: &mut System) {
        self.begin_hessian(x, strains, kind, system, Team::nobody());
        self.finish_hessian(x, &self.contact().touches(x), kind, None, system);
        system.compress();
    }

    /// The part of the Hessian that the elements and the pull bring about.
    pub fn begin_hessian(
        &self,
        x: &[Vec3],
        strains: &[f64],
        kind: Curvature,
        system: &mut System,
        team: &Team,
    ) {
        system.set_shape(x, &self.model.elements.named);
        self.begin_soft(kind, system, team);
        self.add_stiff(strains, kind, system);
    }

    /// The part of the Hessian that bending, shear and twist bring about, at the system's shape.
    pub fn begin_soft(&self, kind: Curvature, system: &mut System, team: &Team) {
        system.clear();
        let (mut values, shape, _) = system.parts();
        add_soft(self.given(shape), kind, &mut values, team);
    }

    /// Adds what edges and the pull bring about, at the system's shape.
    pub fn add_stiff(&self, strains: &[f64], kind: Curvature, system: &mut System) {
        let (elements, is_middle) = (&self.model.elements, system.is_middle);
        let (mut values, shape, rhs) = system.parts();
        let Pattern { edges: slots, ghosted, .. } = values.pattern;
        let (given, stencils) = (self.given(shape), &ghosted.edges);
        let exceeds = dispatch(edges::Hessian {
            given,
            strains,
            is_middle,
            kind,
            slots,
            stencils,
            values: &mut values,
            rhs,
        });
        values.add_sums();
        values.add_to_diagonals(&self.pull.weights);
        if exceeds {
            system.excess.add_to(&mut system.rhs, &elements.named);
            system.excess.clear();
            elements.gather(&mut system.rhs);
        }
    }

    /// Adds contact to the Hessian, `touches` being what presses at `x`, and takes the fixed particles out. With `ahead`, contact's quadratic
    /// model around that place stands for the one around `x`, whose gradient is the right-hand side's; but what presses at `x` and would only
    /// leave to come back stays as it is there, else it would be left alone in one step and thrown out in the next.
    pub fn finish_hessian(
        &self,
        x: &[Vec3],
        touches: &Touches,
        kind: Curvature,
        ahead: Option<Ahead>,
        system: &mut System,
    ) {
        match ahead {
            None => self.add_contact(touches, x, kind, system, &mut |_, _, _| ()),
            Some(Ahead { place, way, change, touches: there, returning }) => {
                let elements = &self.model.elements;
                elements.present().for_each(|n| change[n] = Vec3::zeros());
                self.contact().add_gradient_of(touches, x, change);
                elements.present().for_each(|n| change[n] = -change[n]);
                self.contact().find(place, there);
                let yields = |n: u32| {
                    let weight = self.pull.weights[n as usize].max(f64::MIN_POSITIVE);
                    if system.fixed[n as usize] { 0.0 } else { 1.0 / weight }
                };
                self.contact().find_returning(touches, (there, way), &yields, returning);
                self.contact().add_press(returning, change);
                self.contact().add_gradient_of(there, place, change);
                self.add_contact(there, place, kind, system, &mut |row, column, block| {
                    let [row, column] = [row, column].map(|n| n as usize);
                    change[row] -= block * way[column];
                    if row != column {
                        change[column] -= block.transpose() * way[row];
                    }
                });
                self.contact().press_hessian(returning, x, kind, &mut |row, column, block| {
                    self.add_block(row, column, block, &mut system.parts().0);
                });
                elements.gather(change);
                elements.present().for_each(|n| system.rhs[n] += change[n]);
            }
        }
        system.close();
    }

    fn add_contact(
        &self,
        touches: &Touches,
        x: &[Vec3],
        kind: Curvature,
        system: &mut System,
        also: &mut dyn FnMut(u32, u32, &Mat3),
    ) {
        let (mut values, ..) = system.parts();
        self.contact().hessian(touches, x, kind, &mut |row, column, block| {
            also(row, column, block);
            self.add_block(row, column, block, &mut values);
        });
    }

    /// Adds a block of two particles, which stands for both orders; with ghosts, both of their masters' orders may be the same.
    fn add_block(&self, row: u32, column: u32, block: &Mat3, values: &mut Values) {
        let elements = &self.model.elements;
        elements.each_master(row, |m, share| {
            elements.each_master(column, |n, other| {
                let block = block * (share * other);
                if row == column && m != n {
                    values.add_block(m, n, &(block * 0.5));
                } else if row != column && m == n {
                    values.add_block(m, n, &(block + block.transpose()));
                } else {
                    values.add_block(m, n, &block);
                }
            });
        });
    }

    /// Strains of the edges extrapolated linearly along `step` [m]: from those at the system's shape or, where that is the middle of the step,
    /// from those in `out`.
    pub fn linearized_strains(&self, system: &System, step: &Planes, out: &mut [f64]) {
        let (given, is_middle) = (self.given(&system.shape), system.is_middle);
        dispatch(edges::Linearized { given, step, is_middle, out });
    }
}

/// Adds what bending, shear and twist bring to the Hessian at the given shape, in halves; the sums are the same whoever does which.
fn add_soft(given: Given, kind: Curvature, values: &mut Values, team: &Team) {
    add_parts(values, team, [(); 3], |part, (), values| {
        let Pattern { triples: slots, shears, ghosted, .. } = values.pattern;
        let stencils = &ghosted.triples;
        dispatch(triples::Hessian { given, kind, part, slots, stencils, values });
        let (slots, stencils) = (shears, &ghosted.shears);
        dispatch(shears::Hessian { given, kind, part, slots, stencils, values });
        if given.fabric.twist > 0.0 {
            let stencils = &ghosted.twists;
            dispatch(twists::Hessian { given, kind, part, slots, stencils, values });
        }
    });
}
