//! Where the energy is lower: of the places that a minimization met, and on the way back from where it ended.

use super::Minimizer;
use crate::{
    math::Vec3,
    phase::{Phase, Watch},
    potential::Potential,
};

/// Energies of a step that are known already [J]: measuring one takes as long as a few iterations.
#[derive(Default)]
pub(super) struct Known {
    /// At `base`.
    pub(super) base: Option<f64>,
    /// At the positions.
    pub(super) here: Option<f64>,
}

/// Part of an energy by which two balances differ at the least: near a bifurcation they lie close, and either will do.
const APART: f64 = 1e-6;

impl Minimizer {
    /// Makes `base`. Few steps ask for it.
    pub(super) fn follow_fixed(&mut self, potential: &Potential) {
        if std::mem::replace(&mut self.has_base, true) {
            return;
        }
        potential.model.elements.copy(&self.origin, &mut self.base);
        let pushed = |n: u32| self.pushed.iter().find(|p| p.0 == n).map_or(Vec3::zeros(), |p| p.1);
        let travel = self.system.hand.map_or(Vec3::zeros(), pushed);
        for &n in &self.system.pattern.order {
            let fixed = self.system.fixed[n as usize];
            self.way[n as usize] = if fixed { pushed(n) } else { -(self.response[n as usize] * travel) };
        }
        let elements = &potential.model.elements;
        elements.fill(&mut self.way);
        potential.limit(&self.origin, &mut self.way, &mut self.room);
        elements.present().for_each(|n| self.base[n] += self.way[n]);
    }

    /// Whether a fixed particle is elsewhere than where the minimization began.
    pub(super) fn has_moved_fixed(&self, x: &[Vec3]) -> bool {
        let mut fixed =
            self.system.pattern.order.iter().map(|&n| n as usize).filter(|&n| self.system.fixed[n]);
        fixed.any(|n| x[n] != self.origin[n])
    }

    /// Whether more is out of balance than where the minimization began, nothing prescribed.
    pub(super) fn has_grown(&self) -> bool {
        self.residual() > self.largest(&self.before)
    }

    /// Whether the gradients where it began and at `x` say that the energy rose on the way, nothing prescribed.
    pub(super) fn seems_higher(&self, potential: &Potential, x: &[Vec3]) -> bool {
        let rise = |n: usize| (self.before[n] + self.gradient[n]).dot(&(x[n] - self.origin[n]));
        potential.model.elements.present().map(rise).sum::<f64>() > 0.0
    }

    /// Whether the energy at `x` is clearly higher than where the minimization began.
    pub(super) fn is_higher(&mut self, potential: &Potential, x: &[Vec3], known: &mut Known) -> bool {
        let [there, here] = self.energies(potential, x, known);
        here - there > APART * there.abs()
    }

    /// The energies at `base` and at `x` [J].
    pub(super) fn energies(&mut self, potential: &Potential, x: &[Vec3], known: &mut Known) -> [f64; 2] {
        self.follow_fixed(potential);
        let Minimizer { base, planes, team, .. } = self;
        let there = *known.base.get_or_insert_with(|| potential.energy_by_kernels(base, planes, team));
        [there, *known.here.get_or_insert_with(|| potential.energy_by_kernels(x, planes, team))]
    }

    /// Shortens what the mixed steps did, from `base` on, until the energy does not rise: a budget that ends in the middle of
    /// trouble must not hand blown-up positions, and the speed they imply, to the next step. True when nothing is left of them.
    pub(super) fn back_off(
        &mut self,
        potential: &Potential,
        x: &mut [Vec3],
        known: &mut Known,
        watch: Watch,
    ) -> bool {
        let [limit, here] = self.energies(potential, x, known);
        if here <= limit {
            watch.ended(Phase::Advance);
            return false;
        }
        let elements = &potential.model.elements;
        let mut futile = true;
        for _ in 0..4 {
            elements.present().for_each(|n| self.step[n] = (self.base[n] - x[n]) * 0.5);
            potential.limit(x, &mut self.step, &mut self.room);
            elements.present().for_each(|n| x[n] += self.step[n]);
            let energy = potential.energy_by_kernels(x, &mut self.planes, &self.team);
            futile = energy > limit || energy.is_nan();
            if !futile {
                break;
            }
        }
        if futile {
            elements.copy(&self.base, x);
        }
        watch.ended(Phase::Advance);
        self.measure(potential, x, watch);
        futile
    }

    /// Goes back to where the last mixed step came from, or to where the cloth would be had it followed the hand as before, if
    /// the energy is lower there.
    pub(super) fn choose_lower(
        &mut self,
        potential: &Potential,
        x: &mut [Vec3],
        known: &mut Known,
        watch: Watch,
    ) {
        let [base, here] = self.energies(potential, x, known);
        let trial = potential.energy_by_kernels(&self.trial, &mut self.planes, &self.team);
        watch.ended(Phase::Advance);
        if here > trial.min(base) {
            let (lower, place) = if trial < base { (trial, &self.trial) } else { (base, &self.base) };
            known.here = Some(lower);
            potential.model.elements.copy(place, x);
            self.measure(potential, x, watch);
        }
    }
}
