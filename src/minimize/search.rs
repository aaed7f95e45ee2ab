//! Line searches on the energy, and the Newton iteration for rest that is made of them.

use super::{Budget, Minimizer, Outcome};
use crate::{
    math::Vec3,
    phase::{Phase, Watch},
    potential::{Curvature, Potential, Pull},
};

/// Rounding of a force over the unit in the last place of positions and the stiffness of its particle.
const ROUNDING: f64 = 4.0;
/// Halvings of a step in a line search; and, where there is no better Hessian to turn to, leaps beyond: a cell that has all but
/// collapsed bends the energy within 1e-4 of a step.
const HALVINGS: u32 = 12;
const LEAPS: u32 = 8;
const LEAP: f64 = 1.0 / 16.0;

impl Minimizer {
    /// Newton with the exact Hessian, a growing shift where it is indefinite, and a line search on the energy: for statics
    /// close to rest, where mixed Newton alone may cycle.
    pub fn polish(
        &mut self,
        potential: &Potential,
        x: &mut [Vec3],
        tolerance: f64,
        budget: Budget,
    ) -> Outcome {
        let watch = budget.watch;
        self.measure(potential, x, watch);
        let mut pull = Pull::none(potential.model);
        let mut shift = 0.0;
        let from = self.solves;
        loop {
            let residual = self.residual();
            if !residual.is_finite() {
                return Outcome::NotFinite;
            }
            if residual <= tolerance {
                return Outcome::Converged;
            }
            if budget.is_spent(self.solves - from) {
                let ended = shift == 0.0 && self.solves > from && self.is_rounding(x, tolerance);
                return if ended { Outcome::Converged } else { Outcome::Budget };
            }
            self.reset_strains();
            pull.set_shift(potential.model, x, shift);
            let shifted = Potential { pull: &pull, ..*potential };
            if self.assemble_and_factor(&shifted, x, Curvature::Exact).is_err() {
                if shift > 1e12 {
                    return Outcome::Stalled;
                }
                shift = (shift * 10.0).max(1.0);
                continue;
            }
            self.solve_statics(potential);
            if !self.search(potential, x, residual, &mut None, watch) {
                self.measure(potential, x, watch);
                if shift == 0.0 && self.is_rounding(x, tolerance) {
                    return Outcome::Converged;
                }
                if shift > 1e9 {
                    return Outcome::Stalled;
                }
                shift = (shift * 10.0).max(1.0);
                continue;
            }
            shift = if shift < 1.0 { 0.0 } else { shift * 0.1 };
        }
    }

    /// Backtracks along `step` until the energy falls enough, or, where energies cannot tell any more, the residual does.
    /// Leaves `x` and the gradient at the accepted point; false when there is none. `known` is the energy at `x` [J], before and after.
    pub(super) fn search(
        &mut self,
        potential: &Potential,
        x: &mut [Vec3],
        residual: f64,
        known: &mut Option<f64>,
        watch: Watch,
    ) -> bool {
        // `trial` is filled below; until then its memory serves the step.
        let mut step = std::mem::take(&mut self.trial);
        let elements = &potential.model.elements;
        elements.copy(&self.step, &mut step);
        potential.limit(x, &mut step, &mut self.room);
        let slope =
            |step: &[Vec3]| -> f64 { elements.present().map(|n| self.gradient[n].dot(&step[n])).sum() };
        if slope(&step) >= 0.0 && slope(&self.step) < 0.0 {
            // Limited particle by particle it leads uphill: shorten it as a whole.
            let share = potential.free_share(x, &self.step, &mut self.room);
            elements.present().for_each(|n| step[n] = self.step[n] * share);
        }
        let slope = slope(&step);
        self.trial = std::mem::replace(&mut self.step, step);
        let energy =
            *known.get_or_insert_with(|| potential.energy_by_kernels(x, &mut self.planes, &self.team));
        let noise = 1e-13 * energy.abs().max(1e-6);
        elements.copy(x, &mut self.trial);
        let mut length = 1.0;
        for attempt in 0..if self.was_exact { HALVINGS } else { HALVINGS + LEAPS } {
            elements.present().for_each(|n| x[n] = self.trial[n] + self.step[n] * length);
            let there = potential.energy_by_kernels(x, &mut self.planes, &self.team);
            let change = there - energy;
            watch.ended(Phase::Advance);
            let falls = change <= 1e-4 * length * slope && slope < 0.0;
            if falls || change.abs() <= noise {
                self.measure(potential, x, watch);
                if falls || self.residual() < residual {
                    *known = Some(there);
                    return true;
                }
            }
            length *= if attempt < HALVINGS { 0.5 } else { LEAP };
        }
        elements.copy(&self.trial, x);
        false
    }

    /// The block Jacobi step, into `step`, where a search finds nothing along Newton's: a triangle that lies on a corner, all of its particles
    /// as near to one plane as is allowed, bars every step that would turn it about the corner, but none that lifts it.
    pub(super) fn jacobi(&mut self, potential: &Potential) {
        let Minimizer { system, gradient, step, .. } = self;
        for (place, &n) in system.pattern.order.iter().enumerate() {
            let n = n as usize;
            let block = if system.fixed[n] { None } else { system.diagonal(place).cholesky() };
            step[n] = block.map_or(Vec3::zeros(), |block| -block.solve(&gradient[n]));
        }
        potential.model.elements.fill(step);
    }

    /// Whether no more is out of balance than rounding of positions makes of the last Hessian: then no step can lower it. Coordinates are off
    /// by half a unit in the last place, and so are the differences and lengths that elements make of them; a row of the Hessian sums to some
    /// three times its diagonal block in norm (6, 4, 4, 1, 1 of bending), which `ROUNDING` allows for.
    pub(super) fn is_rounding(&self, x: &[Vec3], tolerance: f64) -> bool {
        let extent = x.iter().map(|p| p.amax()).fold(0.0, f64::max);
        self.system.pattern.order.iter().enumerate().all(|(place, &n)| {
            let n = n as usize;
            let floor = ROUNDING * f64::EPSILON * extent * self.system.diagonal(place).norm();
            self.system.fixed[n] || self.gradient[n].norm() <= tolerance.max(floor)
        })
    }
}
