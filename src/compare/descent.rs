//! Steepest descent and conjugate gradients on the paper's cost, over positions and element forces at once.
//!
//! Unknowns are divided by fixed natural units, the only preconditioning. History needs no variable of its own here: any force
//! within the envelope costs nothing. Friction anchors advance in `commit`, which begins a new step as the paper's frames do.

use crate::{
    cost::{self, Coefficients, CostReport, Forces},
    math::Vec3,
    model::Model,
    potential::{
        Potential, Pull,
        contact::{candidates::Candidates, room::Room},
    },
    state::State,
};

/// How the next direction follows from the gradient.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rule {
    /// Down the gradient.
    SteepestDescent,
    /// Polak and Ribière, restarted where the factor is negative or the direction does not descend.
    ConjugateGradients,
}

/// A minimization of the cost on its way.
pub struct Descent<'a> {
    model: &'a Model,
    state: State,
    /// What may touch within `REACH` of the positions.
    candidates: Candidates,
    still: Pull,
    fixed: Vec<bool>,
    coefficients: Coefficients,
    rule: Rule,
    scales: Scales,
    forces: Forces,
    cost: CostReport,
    gradient: Vec<f64>,
    direction: Vec<f64>,
    /// Length of the last accepted step along its direction.
    length: f64,
    /// Iterations so far.
    pub iterations: u64,
    /// Evaluations of the cost so far.
    pub evaluations: u64,
}

/// A point along a direction.
struct Trial {
    x: Vec<Vec3>,
    forces: Forces,
    cost: CostReport,
    length: f64,
}

/// Natural units of the unknowns.
struct Scales {
    /// [m].
    position: f64,
    /// Of tensions and shear forces [N/m].
    force: f64,
    /// [N].
    moment: f64,
}

/// Part of the slope that a step must gain.
const GAIN: f64 = 1e-4;
/// Farthest a particle goes in one iteration where there are obstacles [m].
const REACH: f64 = 5e-3;
/// Halvings of a step at the most.
const HALVINGS: u32 = 40;

impl<'a> Descent<'a> {
    /// From a state, with the forces that the laws give there.
    pub fn new(
        model: &'a Model,
        state: State,
        fixed: &[bool],
        rule: Rule,
        coefficients: Coefficients,
    ) -> Self {
        let still = Pull::none(model);
        let mut candidates = Candidates::new(model);
        candidates.update(model, &state.poses, &state.positions, REACH);
        let potential = Potential { model, state: &state, candidates: &candidates, pull: &still };
        let forces = cost::forces(&potential, &state.positions);
        let spacing = model.grid.spacing(0).min(model.grid.spacing(1));
        let weight = model.weight_on_earth() / model.area;
        // A step of 1 strains an edge by 1 %, or loads a particle with about its weight.
        let scales =
            Scales { position: 0.01 * spacing, force: weight * spacing, moment: weight * spacing * spacing };
        let mut descent = Descent {
            model,
            state,
            candidates,
            still,
            fixed: fixed.to_vec(),
            coefficients,
            rule,
            scales,
            forces,
            cost: CostReport::default(),
            gradient: Vec::new(),
            direction: Vec::new(),
            length: 1e-3,
            iterations: 0,
            evaluations: 0,
        };
        descent.restart();
        descent
    }

    /// The cost where it is now.
    pub fn cost(&self) -> CostReport {
        self.cost
    }

    /// The state: positions, anchors.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// The element forces.
    pub fn forces(&self) -> &Forces {
        &self.forces
    }

    /// Force out of balance on every particle [N]; minus that of a fixed one is the reaction to it.
    pub fn residuals(&self) -> Vec<Vec3> {
        cost::residuals(&self.potential(), &self.state.positions, &self.forces)
    }

    /// Largest force out of balance on a free particle [N].
    pub fn residual(&self) -> f64 {
        let residuals = self.residuals();
        let free = self.model.grid.active().filter(|&n| !self.fixed[n]);
        free.map(|n| residuals[n].norm()).fold(0.0, f64::max)
    }

    /// Goes on with other weights of the terms.
    pub fn weigh(&mut self, coefficients: Coefficients) {
        self.coefficients = coefficients;
        self.restart();
    }

    /// Begins a new step: friction anchors go where the particles are.
    pub fn commit(&mut self) {
        let mut anchors = Vec::new();
        let (potential, x) = (self.potential(), &self.state.positions);
        let contact = potential.contact();
        contact.commit(&contact.touches(x), x, &mut anchors);
        self.state.anchors = anchors;
        self.restart();
    }

    /// One iteration; false where no step lowers the cost any more.
    pub fn step(&mut self) -> bool {
        let slope = dot(&self.gradient, &self.direction);
        if slope < 0.0
            && let Some(trial) = self.search(slope)
        {
            self.take(trial);
            return true;
        }
        // A conjugate direction may fail where the gradient does not.
        self.direction = self.gradient.iter().map(|g| -g).collect();
        self.length = self.length.max(1e-6);
        let slope = -dot(&self.gradient, &self.gradient);
        let found = if slope < 0.0 { self.search(slope) } else { None };
        let moved = found.is_some();
        if let Some(trial) = found {
            self.take(trial);
        }
        moved
    }

    fn potential(&self) -> Potential<'_> {
        Potential { model: self.model, state: &self.state, candidates: &self.candidates, pull: &self.still }
    }

    fn restart(&mut self) {
        self.cost = self.evaluate(&self.state.positions, &self.forces);
        self.gradient = self.slope();
        self.direction = self.gradient.iter().map(|g| -g).collect();
    }

    fn evaluate(&self, x: &[Vec3], forces: &Forces) -> CostReport {
        cost::evaluate(&self.potential(), x, forces, &self.fixed, &self.coefficients)
    }

    /// The gradient in the scaled unknowns: positions, tensions, moments, shear forces.
    fn slope(&self) -> Vec<f64> {
        let (x, forces, c) = (&self.state.positions, &self.forces, &self.coefficients);
        let (by_x, by_force) = cost::gradient(&self.potential(), x, forces, &self.fixed, c);
        let mut gradient = Vec::with_capacity(3 * x.len() + forces.tensions.len() + 2 * forces.moments.len());
        for (n, g) in by_x.iter().enumerate() {
            // Ghosts follow; their gradient has gone to their masters.
            let free = n < self.model.grid.particles() && self.model.grid.is_active(n) && !self.fixed[n];
            gradient.extend(g.iter().map(|v| if free { v * self.scales.position } else { 0.0 }));
        }
        gradient.extend(by_force.tensions.iter().map(|g| g * self.scales.force));
        gradient.extend(by_force.moments.iter().map(|g| g * self.scales.moment));
        gradient.extend(by_force.shears.iter().map(|g| g * self.scales.force));
        gradient
    }

    /// Positions and forces a length along the direction.
    fn along(&self, length: f64) -> (Vec<Vec3>, Forces) {
        let (mut x, mut forces) = (self.state.positions.clone(), self.forces.clone());
        let mut d = self.direction.iter();
        let mut step = vec![Vec3::zeros(); x.len()];
        for p in &mut step {
            p.iter_mut().zip(&mut d).for_each(|(p, d)| *p = self.scales.position * length * d);
        }
        self.model.elements.fill(&mut step);
        // Nothing may pass an obstacle, whatever the cost beyond.
        self.potential().limit(&x, &mut step, &mut Room::default());
        x.iter_mut().zip(&step).for_each(|(p, d)| *p += d);
        let Scales { force, moment, .. } = self.scales;
        for (values, scale) in
            [(&mut forces.tensions, force), (&mut forces.moments, moment), (&mut forces.shears, force)]
        {
            values.iter_mut().zip(&mut d).for_each(|(v, d)| *v += scale * length * d);
        }
        self.model.elements.fill(&mut x);
        (x, forces)
    }

    /// A length that gains enough: the last one, the bottom of the parabola through it, or halves of the better one.
    fn search(&mut self, slope: f64) -> Option<Trial> {
        let start = self.cost.total();
        let mut best: Option<Trial> = None;
        let mut length = self.length;
        for tried in 0..HALVINGS {
            let (x, forces) = self.along(length);
            let cost = self.evaluate(&x, &forces);
            self.evaluations += 1;
            let change = cost.total() - start;
            let lower = best.as_ref().is_none_or(|b| cost.total() < b.cost.total());
            if change <= GAIN * length * slope && lower {
                best = Some(Trial { x, forces, cost, length });
            }
            // Anything after the first two trials only looks for some gain.
            if tried > 0 && best.is_some() {
                break;
            }
            let bend = 2.0 * (change - slope * length) / (length * length);
            let bottom = if bend > 0.0 { -slope / bend } else { 4.0 * length };
            length = if tried == 0 && bottom.is_finite() {
                bottom.clamp(0.02 * length, 8.0 * length)
            } else {
                0.5 * length
            };
        }
        best
    }

    fn take(&mut self, trial: Trial) {
        self.state.positions = trial.x;
        self.candidates.update(self.model, &self.state.poses, &self.state.positions, REACH);
        (self.forces, self.cost, self.length) = (trial.forces, trial.cost, trial.length);
        self.iterations += 1;
        let before = std::mem::take(&mut self.gradient);
        self.gradient = self.slope();
        let factor = match self.rule {
            Rule::SteepestDescent => 0.0,
            Rule::ConjugateGradients => {
                let change = dot(&self.gradient, &self.gradient) - dot(&self.gradient, &before);
                (change / dot(&before, &before)).max(0.0)
            }
        };
        for (d, g) in self.direction.iter_mut().zip(&self.gradient) {
            *d = factor * *d - g;
        }
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
