//! One Newton step: assembly, and the linear solve with what is done where it fails.

use super::{
    Minimizer,
    factor::{COLUMNS, Indefinite},
    iterative::{Aim, Iterative},
    multigrid::End,
};
use crate::{
    math::{Mat3, Vec3},
    phase::{Phase, Watch},
    potential::{Ahead, Curvature, Potential},
};

/// Parts by which the diagonal grows, one after the other, until rounding no longer makes the factor fail.
const STIFFER: [f64; 5] = [0.0, 1e-12, 1e-10, 1e-8, 1e-6];
/// How far ahead contact is met, over its activation distance.
const FORESEEN: f64 = 0.25;
/// Longest pause before the exact Hessian is tried again, in solves.
const LONGEST_PAUSE: u32 = 64;

/// How a Newton step begins.
#[derive(Clone, Copy, Default)]
struct Start {
    /// It is the first of its minimization, and guessed to follow inertia.
    is_first: bool,
    /// It goes by what was known before: soft elements' blocks may be of a moment ago, and in a step that is told what the last ones left
    /// that is made up for, and the matrix is that of half the way.
    leads: bool,
    /// Contact is met where inertia takes the cloth.
    foresees: bool,
}

impl Minimizer {
    /// One Newton step into `step`: exact Hessian unless it was indefinite lately or balance is far, else the clamped one. The first step,
    /// if it is mixed, meets contact where inertia takes the cloth and, if it is told what the last ones left, all else half way there.
    pub(super) fn newton(
        &mut self,
        potential: &Potential,
        x: &[Vec3],
        is_mixed: bool,
        is_first: bool,
        is_far: bool,
        watch: Watch,
    ) {
        if is_first {
            self.follow_inertia(potential, x);
        }
        let foresees = is_mixed && is_first && potential.contact().is_near();
        if foresees {
            self.foresee(potential, x);
            watch.ended(Phase::Contact);
        }
        let start = Start { is_first, leads: is_first && !self.troubled, foresees };
        if self.tries_exact(is_far) {
            let exact = Curvature::Exact;
            let mut solved = self.assemble_and_solve(potential, x, exact, start, watch).is_ok();
            if !solved && std::mem::take(&mut self.lagged) {
                self.iterative.iter_mut().for_each(Iterative::forget_soft);
                solved = self.assemble_and_solve(potential, x, exact, start, watch).is_ok();
            }
            if solved {
                self.next_pause = 1;
                self.was_exact = true;
                return;
            }
            self.pause = self.next_pause;
            self.next_pause = (2 * self.next_pause).min(LONGEST_PAUSE);
        } else {
            self.pause = self.pause.saturating_sub(1);
        }
        self.was_exact = false;
        let bounds = is_mixed && is_far && self.circles;
        let kind = if bounds { Curvature::Bounding } else { Curvature::Clamped };
        let solved = self.assemble_and_solve(potential, x, kind, start, watch).is_ok();
        if !solved && !self.solve_stiffened(potential) {
            potential.model.elements.present().for_each(|n| self.step[n] = Vec3::repeat(f64::NAN));
        }
    }

    /// Whether the next solve begins with the exact Hessian.
    fn tries_exact(&self, is_far: bool) -> bool {
        self.pause == 0 && !is_far
    }

    /// Which way inertia takes each particle from `x`, and what is prescribed the fixed ones. Dead loads are in balance with what the cloth
    /// does: alone they would lead it away.
    fn follow_inertia(&mut self, potential: &Potential, x: &[Vec3]) {
        for n in self.system.pattern.order.iter().map(|&n| n as usize) {
            self.inertial[n] = match self.system.fixed[n] {
                true => self.system.shift(n),
                false => potential.pull.way(n, x[n]) - potential.led_by_load(n),
            };
        }
        potential.model.elements.fill(&mut self.inertial);
    }

    /// Where inertia takes the cloth from `x`, no farther than contact reaches and short of passing an obstacle, into `trial`; the way
    /// there into `way`. Farther off it knows nothing of contact here: on a long step it led cloth into obstacles by half a millimetre.
    fn foresee(&mut self, potential: &Potential, x: &[Vec3]) {
        for n in self.system.pattern.order.iter().map(|&n| n as usize) {
            self.way[n] =
                if self.system.fixed[n] { self.system.shift(n) } else { potential.pull.way(n, x[n]) };
        }
        let reach = FORESEEN * potential.model.contact.barrier.activation;
        let elements = &potential.model.elements;
        elements.present().for_each(|n| self.way[n] = self.way[n].cap_magnitude(reach));
        elements.fill(&mut self.way);
        potential.limit(x, &mut self.way, &mut self.room);
        elements.present().for_each(|n| self.trial[n] = x[n] + self.way[n]);
    }

    /// Solves with the assembled clamped Hessian where rounding made its factor fail: it is positive semidefinite by construction, but
    /// a cell that collapsed is stiffer than others by more than double precision holds. False where numbers are not finite.
    fn solve_stiffened(&mut self, potential: &Potential) -> bool {
        for part in STIFFER {
            self.system.stiffen(part);
            self.system.compress();
            if self.factor.factorize(&self.system.pattern, &self.system.values).is_ok() {
                self.solve(potential);
                return true;
            }
        }
        false
    }

    fn assemble_and_solve(
        &mut self,
        potential: &Potential,
        x: &[Vec3],
        kind: Curvature,
        start: Start,
        watch: Watch,
    ) -> Result<(), Indefinite> {
        self.assemble(potential, x, kind, start, watch);
        if let Some(iterative) = &mut self.iterative {
            let hand = self.system.hand.map_or(0.0, |hand| self.gradient[hand as usize].norm());
            let force = potential.model.felt_scale(hand);
            let guess = start.is_first.then_some(&self.inertial[..]);
            let aim = Aim { kind, guess, force, is_told: self.is_told };
            let to = (&mut self.step[..], &mut self.response[..]);
            let end = iterative.solve(&self.system, aim, to, &self.team, watch);
            iterative.start_waiting(&self.team);
            watch.ended(Phase::Assembly);
            match end {
                End::Met => {
                    self.stiffness = iterative.stiffness;
                    self.responds_to = self.system.hand;
                    potential.model.elements.fill(&mut self.step);
                    return Ok(());
                }
                End::Indefinite => return Err(Indefinite),
                End::Spent => {}
            }
        }
        self.system.compress();
        self.factor.factorize(&self.system.pattern, &self.system.values)?;
        self.solve(potential);
        watch.ended(Phase::Factor);
        Ok(())
    }

    fn assemble(
        &mut self,
        potential: &Potential,
        x: &[Vec3],
        kind: Curvature,
        Start { leads, foresees, .. }: Start,
        watch: Watch,
    ) {
        self.solves += 1;
        let elements = &potential.model.elements;
        if leads {
            self.remainder.foretell(elements, &self.gradient, &mut self.system.rhs);
        } else {
            elements.copy(&self.gradient, &mut self.system.rhs);
        }
        if leads && self.is_told {
            self.system.set_middle(x, &self.inertial, &elements.named);
        } else {
            self.system.set_shape(x, &elements.named);
        }
        (self.lagged, self.was_lean) = (false, false);
        let may_lag = leads && self.lean_pause == 0;
        let (system, team) = (&mut self.system, &self.team);
        match self.iterative.as_mut().filter(|iterative| may_lag && !iterative.afresh) {
            Some(iterative) => {
                self.lagged = iterative.bring(potential, kind, system, team);
                self.was_lean = iterative.accuracy.may_lag;
            }
            None => potential.begin_soft(kind, system, team),
        }
        potential.add_stiff(&self.strains, kind, system);
        watch.ended(Phase::Assembly);
        let ahead = foresees.then_some(Ahead {
            place: &self.trial,
            way: &self.way,
            change: &mut self.change,
            touches: &mut self.touches_elsewhere,
            returning: &mut self.touches_returning,
        });
        potential.finish_hessian(x, &self.touches, kind, ahead, &mut self.system);
        watch.ended(Phase::Contact);
    }

    /// On a new mesh: has made beside what comes until the next step what that needs, where conjugate gradients solve.
    pub fn make_ready(&mut self, potential: &Potential) {
        let (is_exact, begins) = (self.tries_exact(self.strayed), !self.troubled && self.lean_pause == 0);
        if let Some(iterative) = self.iterative.as_mut().filter(|i| is_exact && begins && !i.afresh) {
            self.system.set_shape(&potential.state.positions, &potential.model.elements.named);
            iterative.make_ready(potential, Curvature::Exact, &self.system);
        }
    }

    /// Factors the exact Hessian at `x` and solves for the response to the hand; false where it is indefinite.
    pub fn linearize(&mut self, potential: &Potential, x: &[Vec3]) -> bool {
        self.measure(potential, x, Watch::default());
        self.reset_strains();
        let definite = self.assemble_and_factor(potential, x, Curvature::Exact).is_ok();
        if definite {
            self.solve_statics(potential);
        }
        definite
    }

    pub(super) fn assemble_and_factor(
        &mut self,
        potential: &Potential,
        x: &[Vec3],
        kind: Curvature,
    ) -> Result<(), Indefinite> {
        self.assemble(potential, x, kind, Start::default(), Watch::default());
        self.system.compress();
        self.factor.factorize(&self.system.pattern, &self.system.values)
    }

    /// Solves as below with a factor of a cloth at rest.
    pub(super) fn solve_statics(&mut self, potential: &Potential) {
        self.solve(potential);
        self.iterative.iter_mut().for_each(|iterative| iterative.is_static = true);
    }

    /// Solves for the step and, where there is a hand, for the response to it.
    pub(super) fn solve(&mut self, potential: &Potential) {
        let n = self.system.pattern.particles.len();
        let columns = if self.system.hand.is_some() { COLUMNS } else { 1 };
        for (place, &p) in self.system.pattern.particles.iter().enumerate() {
            let (at, p) = (3 * place, p as usize);
            let free = !self.system.fixed[p];
            for k in 0..3 {
                self.rhs[at + k] = if free { self.system.rhs[p][k] } else { 0.0 };
                for c in 1..columns {
                    self.rhs[3 * n * c + at + k] = self.system.coupling[p][(k, c - 1)];
                }
            }
        }
        self.factor.solve(&mut self.rhs[..3 * n * columns], columns);
        for (place, &p) in self.system.pattern.particles.iter().enumerate() {
            let (at, p) = (3 * place, p as usize);
            let value = |c: usize, k: usize| self.rhs[3 * n * c + at + k];
            self.step[p] = if self.system.fixed[p] {
                self.system.shift(p)
            } else {
                -Vec3::new(value(0, 0), value(0, 1), value(0, 2))
            };
            if columns > 1 {
                self.response[p] = Mat3::from_fn(|k, c| value(c + 1, k));
            }
        }
        potential.model.elements.fill(&mut self.step);
        if columns > 1 {
            self.stiffness = self.system.condensed(&self.response);
            self.responds_to = self.system.hand;
            self.share_response();
        }
    }
}
