//! Minimization of the incremental potential: mixed Newton for live steps, exact Newton with line search for rest.
//!
//! Mixed Newton keeps the tensions as independent unknowns within a step (condensed out), because a straight step along a nearly
//! inextensible sheet would otherwise be ruined by the stretch it causes to second order; and it moves the hand inside the
//! linear solve. Trouble is a value here: outcomes say how a minimization ended.

use crate::{
    batch::{Measures, Planes},
    grid::Interpolation,
    math::{Mat3, Vec3},
    model::Model,
    phase::{Phase, Watch},
    potential::{
        Ahead, Curvature, Potential, Pull,
        contact::guard::Room,
        system::{Pattern, System},
    },
};
use factor::{COLUMNS, Cholesky, Indefinite};
use iterative::Iterative;
use multigrid::{End, Multigrid};
use soft::Soft;
use std::sync::Arc;

pub mod cores;
pub mod soft;
pub mod factor;
pub mod multigrid;
pub mod iterative;

/// How the linear systems of live steps are solved. Rest, and the stiffness there, always come from a factor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Method {
    /// Cholesky by dense fronts on the dissection tree: ours.
    #[default]
    Fronts,
    /// Cholesky by faer, the reference.
    Faer,
    /// Conjugate gradients with a multigrid preconditioner, to the accuracy that the hand feels.
    Multigrid,
}

/// How much a minimization may cost.
#[derive(Clone, Copy)]
pub struct Budget<'a> {
    /// Linear solves at the most.
    pub solves: u32,
    /// Linear solves after which `stop` is asked.
    pub least: u32,
    /// Asked between solves; `true` ends the minimization. The caller owns the clock.
    pub stop: Option<&'a dyn Fn() -> bool>,
    /// Who is told when a phase ends.
    pub watch: Watch<'a>,
}

impl Budget<'_> {
    /// So many solves, however long they take.
    pub const fn solves(solves: u32) -> Budget<'static> {
        Budget { solves, least: solves, stop: None, watch: Watch(None) }
    }

    fn is_spent(&self, solves: u32) -> bool {
        solves >= self.solves || solves >= self.least && self.is_late()
    }

    fn is_late(&self) -> bool {
        self.stop.is_some_and(|stop| stop())
    }
}

/// How a minimization ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The residual is below the tolerance.
    Converged,
    /// Out of budget; the residual goes into the next step.
    Budget,
    /// No step lowers the energy or the residual any more.
    Stalled,
    /// A number was not finite.
    NotFinite,
}

/// Solver memory for one mesh. The state it leaves behind (last gradient, last response to the hand) is read by `hand`.
pub struct Minimizer {
    /// Matrix, fixed particles, prescribed displacements.
    pub system: System,
    /// Gradient at the newest positions [N].
    pub gradient: Vec<Vec3>,
    /// What the elements measure there.
    pub measures: Measures,
    /// H⁻¹ H_ih of the last factor, per free particle: how the cloth follows the hand [1].
    pub response: Vec<Mat3>,
    /// Linear solves since the counter was last cleared.
    pub solves: u32,
    factor: Cholesky,
    iterative: Option<Iterative>,
    rhs: Vec<f64>,
    step: Vec<Vec3>,
    strains: Vec<f64>,
    trial: Vec<Vec3>,
    base: Vec<Vec3>,
    /// Where a minimization with prescribed displacements began, and the gradient where one without did.
    origin: Vec<Vec3>,
    before: Vec<Vec3>,
    /// Where inertia takes each particle, and how contact there changes the gradient.
    way: Vec<Vec3>,
    change: Vec<Vec3>,
    /// The step, or a shape, as kernels read it.
    planes: Planes,
    /// Memory for what contact leaves of a step.
    room: Room,
    /// Solves for which the exact Hessian is not tried again after it was indefinite, and the next such pause.
    pause: u32,
    next_pause: u32,
    /// Whether the last step came from the exact Hessian.
    was_exact: bool,
    /// Whether the last matrix was in part that of a moment ago.
    lagged: bool,
    /// The last budget ended far out of balance: the next one searches from the start.
    troubled: bool,
    /// Its mixed steps led nowhere: the next one begins with searches.
    futile: bool,
}

/// Factor by which a mixed step must lower the residual to be followed by another.
const FALLING: f64 = 0.5;
/// Residual, over the sheet's weight, at which the end of a budget looks whether the energy rose.
const SUSPECT: f64 = 0.1;
/// Solves beyond a budget that would end in trouble, where they were counted and where time is up: a late tick is felt less than a
/// force that is far off, but one of many long solves is felt as well.
const EXTRA: [u32; 2] = [8, 4];
/// Force on the hand, over the sheet's weight, below which errors are not felt as relative ones.
const FELT: f64 = 0.01;
/// Parts by which the diagonal grows, one after the other, until rounding no longer makes the factor fail.
const STIFFER: [f64; 5] = [0.0, 1e-12, 1e-10, 1e-8, 1e-6];
/// Rounding of a force over the unit in the last place of positions and the stiffness of its particle.
const ROUNDING: f64 = 4.0;
/// Halvings of a step in a line search; and, where there is no better Hessian to turn to, leaps beyond: a cell that has all but
/// collapsed bends the energy within 1e-4 of a step.
const HALVINGS: u32 = 12;
const LEAPS: u32 = 8;
const LEAP: f64 = 1.0 / 16.0;
/// Longest pause before the exact Hessian is tried again, in solves.
const LONGEST_PAUSE: u32 = 64;

fn iterative(model: &Model, pattern: &Arc<Pattern>) -> Iterative {
    Iterative::new(Multigrid::new(&model.grid, pattern), Soft::new(model, pattern), pattern)
}

impl Minimizer {
    /// Memory for the model's mesh.
    pub fn new(model: &Model, method: Method) -> Minimizer {
        let pattern = Arc::new(Pattern::new(&model.grid, &model.elements));
        let n = model.elements.nodes();
        Minimizer {
            factor: Cholesky::new(&pattern, method),
            iterative: (method == Method::Multigrid).then(|| iterative(model, &pattern)),
            gradient: vec![Vec3::zeros(); n],
            measures: Measures::new(&model.elements),
            response: vec![Mat3::zeros(); n],
            solves: 0,
            rhs: vec![0.0; 3 * pattern.particles.len() * COLUMNS],
            system: System::new(pattern),
            step: vec![Vec3::zeros(); n],
            strains: vec![0.0; model.elements.edges.len()],
            trial: vec![Vec3::zeros(); n],
            base: vec![Vec3::zeros(); n],
            origin: vec![Vec3::zeros(); n],
            before: vec![Vec3::zeros(); n],
            way: vec![Vec3::zeros(); n],
            change: vec![Vec3::zeros(); n],
            planes: Planes::new(model.elements.named.len()),
            room: Room::default(),
            pause: 0,
            next_pause: 1,
            was_exact: false,
            lagged: false,
            troubled: false,
            futile: false,
        }
    }

    /// Forgets what earlier solves taught about the Hessian.
    pub fn forget(&mut self) {
        self.response.fill(Mat3::zeros());
        self.iterative.iter_mut().for_each(Iterative::forget);
        (self.troubled, self.futile) = (false, false);
        (self.pause, self.next_pause) = (0, 1);
    }

    /// Solves live steps by conjugate gradients from now on, or by the factor alone.
    pub fn iterate(&mut self, model: &Model, iterates: bool) {
        if iterates == self.iterative.is_some() {
            return;
        }
        self.iterative = iterates.then(|| iterative(model, &self.system.pattern));
        self.iterative.iter_mut().for_each(|iterative| iterative.set_response(&self.system, &self.response));
    }

    /// Whether the iterative solver makes everything anew at every solve, until the mesh changes.
    pub fn solve_afresh(&mut self, afresh: bool) {
        self.iterative.iter_mut().for_each(|iterative| iterative.afresh = afresh);
    }

    /// Goes on where the solver of another mesh was: what is fixed, what the hand's response was, what is out of balance.
    pub fn take_over(&mut self, other: &Minimizer, old: &Model, new: &Model) {
        let particles = old.grid.particles();
        self.system.fixed[..particles].copy_from_slice(&other.system.fixed[..particles]);
        self.system.hand = other.system.hand;
        (self.pause, self.next_pause) = (other.pause, other.next_pause);
        (self.was_exact, self.troubled, self.solves) = (other.was_exact, other.troubled, other.solves);
        for n in new.grid.active() {
            if old.grid.is_active(n) {
                (self.gradient[n], self.response[n]) = (other.gradient[n], other.response[n]);
                continue;
            }
            let masters = old.grid.masters(n, Interpolation::Linear);
            self.gradient[n] = Vec3::zeros();
            self.response[n] = masters.iter().map(|&(m, w)| other.response[m as usize] * w).sum();
        }
        if let Some(iterative) = &mut self.iterative {
            iterative.set_response(&self.system, &self.response);
        }
    }

    /// Whether the last budget ended far out of balance.
    pub fn is_troubled(&self) -> bool {
        self.troubled
    }

    /// Largest gradient on a free particle [N].
    pub fn residual(&self) -> f64 {
        let free = self.gradient.iter().zip(&self.system.fixed).filter(|(_, fixed)| !**fixed);
        // `max` would drop a NaN; comparing this way keeps it.
        free.map(|(g, _)| g.norm()).fold(0.0, |worst, g| if g > worst || g.is_nan() { g } else { worst })
    }

    /// Mixed Newton from `x`, with the prescribed displacements of `system.shift` in the first solve. Where its residual stops
    /// falling (edges that change between tension and compression can make it cycle), it goes on from the point of lowest energy
    /// met so far by Newton steps with a line search on the energy. Where the last budget ended in trouble, already the first step must lower it.
    ///
    /// `gradient` and `measures` must be those at `x`, before the prescribed displacements.
    pub fn descend(
        &mut self,
        potential: &Potential,
        x: &mut [Vec3],
        tolerance: f64,
        budget: Budget,
    ) -> Outcome {
        let watch = budget.watch;
        self.reset_strains();
        self.follow_fixed(potential, x);
        watch.ended(Phase::Setup);
        let from = self.solves;
        let mut last = f64::INFINITY;
        let is_pushed = self.system.shift.iter().any(|s| *s != Vec3::zeros());
        if is_pushed {
            self.origin.copy_from_slice(x);
        } else {
            self.before.copy_from_slice(&self.gradient);
        }
        let mut mixed = !std::mem::take(&mut self.futile) || is_pushed;
        if !mixed {
            last = self.residual();
        } else if self.troubled {
            // The whole step is on trial from the first solve on.
            self.trial.copy_from_slice(&self.gradient);
            potential.gradient(&self.base, &mut self.gradient, &mut self.measures);
            last = self.residual();
            self.gradient.copy_from_slice(&self.trial);
        }
        let suspect = SUSPECT * potential.model.weight_on_earth();
        let mut extra = 0;
        loop {
            let mut failed = false;
            self.newton(potential, x, mixed, self.solves == from, watch);
            if mixed {
                self.take_mixed_step(potential, x, watch);
            } else if !self.search(potential, x, last, watch) {
                self.measure(potential, x, watch);
                if self.is_rounding(x, tolerance) {
                    self.troubled = false;
                    return Outcome::Converged;
                }
                if self.was_exact {
                    // A direction of a hardly definite Hessian may lead too far; the clamped one is good for the rest of the
                    // budget and, should that be spent, for the first two solves of the next.
                    self.pause = 2;
                    failed = true;
                } else {
                    return Outcome::Stalled;
                }
            }
            let residual = self.residual();
            if !residual.is_finite() {
                return Outcome::NotFinite;
            }
            self.troubled = residual > suspect;
            if residual <= tolerance {
                return Outcome::Converged;
            }
            let spent = budget.is_spent(self.solves - from);
            if spent && self.troubled && extra < EXTRA[usize::from(budget.is_late())] {
                extra += 1;
            } else if spent {
                let is_held_back = is_pushed && !self.has_moved_fixed(x);
                if is_held_back {
                    // Obstacles kept what was prescribed from all of its way: it begins and ends at the same places.
                    std::mem::swap(&mut self.base, &mut self.origin);
                }
                let suspicious = is_held_back || !is_pushed && self.seems_higher(x);
                if mixed && self.troubled || suspicious {
                    self.futile = self.back_off(potential, x, watch);
                }
                return if failed { Outcome::Stalled } else { Outcome::Budget };
            }
            if mixed && residual > FALLING * last {
                mixed = false;
                self.choose_lower(potential, x, watch);
            }
            if !mixed {
                self.reset_strains();
            }
            last = self.residual();
        }
    }

    /// Where the cloth would be if it followed the fixed particles as it did last time, into `base`.
    fn follow_fixed(&mut self, potential: &Potential, x: &[Vec3]) {
        let travel = self.system.hand.map_or(Vec3::zeros(), |h| self.system.shift[h as usize]);
        let elements = &potential.model.elements;
        for n in self.system.pattern.order.iter().map(|&n| n as usize) {
            self.step[n] =
                if self.system.fixed[n] { self.system.shift[n] } else { -(self.response[n] * travel) };
        }
        elements.fill(&mut self.step);
        potential.limit(x, &mut self.step, &mut self.room);
        self.base.copy_from_slice(x);
        elements.named.iter().for_each(|&n| self.base[n as usize] += self.step[n as usize]);
    }

    /// Whether a fixed particle is elsewhere than where the minimization began.
    fn has_moved_fixed(&self, x: &[Vec3]) -> bool {
        let mut fixed =
            self.system.pattern.order.iter().map(|&n| n as usize).filter(|&n| self.system.fixed[n]);
        fixed.any(|n| x[n] != self.origin[n])
    }

    /// Whether the gradients where it began, which is `base` where nothing is prescribed, and at `x` say that the energy rose on the way.
    fn seems_higher(&self, x: &[Vec3]) -> bool {
        let ends = self.before.iter().zip(&self.gradient);
        let rise: f64 =
            ends.zip(x.iter().zip(&self.base)).map(|((a, b), (x, base))| (a + b).dot(&(x - base))).sum();
        rise > 0.0
    }

    /// Shortens what the mixed steps did, from `base` on, until the energy does not rise: a budget that ends in the middle of
    /// trouble must not hand blown-up positions, and the speed they imply, to the next step. True when nothing is left of them.
    fn back_off(&mut self, potential: &Potential, x: &mut [Vec3], watch: Watch) -> bool {
        let limit = potential.energy_by_kernels(&self.base, &mut self.planes);
        if potential.energy_by_kernels(x, &mut self.planes) <= limit {
            return false;
        }
        for _ in 0..4 {
            self.step
                .iter_mut()
                .zip(&*x)
                .zip(&self.base)
                .for_each(|((step, p), base)| *step = (base - p) * 0.5);
            potential.limit(x, &mut self.step, &mut self.room);
            x.iter_mut().zip(&self.step).for_each(|(p, step)| *p += step);
            if potential.energy_by_kernels(x, &mut self.planes) <= limit {
                break;
            }
        }
        let futile = potential.energy_by_kernels(x, &mut self.planes) > limit;
        if futile {
            x.copy_from_slice(&self.base);
        }
        self.measure(potential, x, watch);
        futile
    }

    /// The whole Newton step: positions, and tension unknowns by the linearized strain. Keeps where it came from in `trial`,
    /// with the prescribed displacements already made. No step passes an obstacle.
    fn take_mixed_step(&mut self, potential: &Potential, x: &mut [Vec3], watch: Watch) {
        potential.limit(x, &mut self.step, &mut self.room);
        watch.ended(Phase::Contact);
        self.planes.set(&self.step, &potential.model.elements.named);
        potential.linearized_strains(&self.system.shape, &self.planes, &mut self.strains);
        let elements = &potential.model.elements;
        self.trial.copy_from_slice(x);
        for n in elements.named.iter().map(|&n| n as usize) {
            x[n] += self.step[n];
            if self.system.fixed[n] {
                self.trial[n] = x[n];
            }
        }
        elements.fill(&mut self.trial);
        self.system.shift.fill(Vec3::zeros());
        watch.ended(Phase::Advance);
        self.measure(potential, x, watch);
    }

    /// Goes back to where the last mixed step came from, or to where the cloth would be had it followed the hand as before, if
    /// the energy is lower there.
    fn choose_lower(&mut self, potential: &Potential, x: &mut [Vec3], watch: Watch) {
        let [here, trial, base] =
            [&*x, &self.trial, &self.base].map(|p| potential.energy_by_kernels(p, &mut self.planes));
        if here > trial.min(base) {
            x.copy_from_slice(if trial < base { &self.trial } else { &self.base });
            self.measure(potential, x, watch);
        }
    }

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
            self.solve(potential);
            if !self.search(potential, x, residual, watch) {
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

    /// Factors the exact Hessian at `x` and solves for the response to the hand; false where it is indefinite.
    pub fn linearize(&mut self, potential: &Potential, x: &[Vec3]) -> bool {
        self.measure(potential, x, Watch::default());
        self.reset_strains();
        let definite = self.assemble_and_factor(potential, x, Curvature::Exact).is_ok();
        if definite {
            self.solve(potential);
        }
        definite
    }

    /// Farthest that the last Newton step goes [m].
    pub fn longest_step(&self) -> f64 {
        self.step.iter().map(|s| s.norm()).fold(0.0, f64::max)
    }

    /// Gradient and measures at `x`.
    pub fn measure(&mut self, potential: &Potential, x: &[Vec3], watch: Watch) {
        potential.begin_gradient(x, &mut self.gradient);
        watch.ended(Phase::Contact);
        potential.finish_gradient(x, &mut self.gradient, &mut self.measures);
        watch.ended(Phase::Gradient);
    }

    /// Lets the tension unknowns start from the measured strains.
    fn reset_strains(&mut self) {
        self.strains.iter_mut().zip(&self.measures.edges).for_each(|(strain, [now, _])| *strain = *now);
    }

    /// One Newton step into `step`: exact Hessian unless it was indefinite lately, else the clamped one. The first step meets contact where
    /// inertia takes the cloth, if `foresees`.
    fn newton(&mut self, potential: &Potential, x: &[Vec3], foresees: bool, is_first: bool, watch: Watch) {
        let foresees = foresees && is_first && potential.contact().is_near();
        if foresees {
            self.foresee(potential, x);
            watch.ended(Phase::Contact);
        }
        if self.pause == 0 {
            let exact = Curvature::Exact;
            let mut solved = self.assemble_and_solve(potential, x, exact, foresees, is_first, watch).is_ok();
            if !solved && std::mem::take(&mut self.lagged) {
                self.iterative.iter_mut().for_each(|iterative| iterative.soft.forget());
                solved = self.assemble_and_solve(potential, x, exact, foresees, is_first, watch).is_ok();
            }
            if solved {
                self.next_pause = 1;
                self.was_exact = true;
                return;
            }
            self.pause = self.next_pause;
            self.next_pause = (2 * self.next_pause).min(LONGEST_PAUSE);
        } else {
            self.pause -= 1;
        }
        self.was_exact = false;
        let solved =
            self.assemble_and_solve(potential, x, Curvature::Clamped, foresees, is_first, watch).is_ok();
        if !solved && !self.solve_stiffened(potential) {
            self.step.fill(Vec3::repeat(f64::NAN));
        }
    }

    /// Where inertia takes the cloth from `x`, short of passing an obstacle, into `trial`; the way there into `way`.
    fn foresee(&mut self, potential: &Potential, x: &[Vec3]) {
        for n in self.system.pattern.order.iter().map(|&n| n as usize) {
            self.way[n] =
                if self.system.fixed[n] { self.system.shift[n] } else { potential.pull.way(n, x[n]) };
        }
        potential.model.elements.fill(&mut self.way);
        potential.limit(x, &mut self.way, &mut self.room);
        self.trial.iter_mut().zip(x.iter().zip(&self.way)).for_each(|(to, (x, way))| *to = x + way);
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

    /// The first step of a minimization is guessed to follow inertia.
    fn assemble_and_solve(
        &mut self,
        potential: &Potential,
        x: &[Vec3],
        kind: Curvature,
        foresees: bool,
        is_first: bool,
        watch: Watch,
    ) -> Result<(), Indefinite> {
        self.assemble(potential, x, kind, foresees, is_first && !self.troubled, watch);
        if let Some(iterative) = &mut self.iterative {
            let hand = self.system.hand.map_or(0.0, |hand| self.gradient[hand as usize].norm());
            let force = hand.max(FELT * potential.model.weight_on_earth());
            let inertial = |p: usize| potential.pull.way(p, x[p]);
            let guess = is_first.then_some(&inertial as &dyn Fn(usize) -> Vec3);
            let end = iterative.solve(&self.system, guess, force, &mut self.step, &mut self.response, watch);
            match end {
                End::Met => {
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
        foresees: bool,
        may_lag: bool,
        watch: Watch,
    ) {
        self.solves += 1;
        self.system.rhs.copy_from_slice(&self.gradient);
        self.lagged = false;
        if let Some(Iterative { soft, .. }) = self.iterative.as_mut().filter(|i| may_lag && !i.afresh) {
            self.system.set_shape(x, &potential.model.elements.named);
            self.lagged = soft.bring(potential, kind, &mut self.system);
            potential.add_stiff(&self.strains, kind, &mut self.system);
        } else {
            potential.begin_hessian(x, &self.strains, kind, &mut self.system);
        }
        watch.ended(Phase::Assembly);
        let ahead =
            foresees.then_some(Ahead { place: &self.trial, way: &self.way, change: &mut self.change });
        potential.finish_hessian(x, kind, ahead, &mut self.system);
        watch.ended(Phase::Contact);
    }

    fn assemble_and_factor(
        &mut self,
        potential: &Potential,
        x: &[Vec3],
        kind: Curvature,
    ) -> Result<(), Indefinite> {
        self.assemble(potential, x, kind, false, false, Watch::default());
        self.system.compress();
        self.factor.factorize(&self.system.pattern, &self.system.values)
    }

    /// Solves for the step and, where there is a hand, for the response to it.
    fn solve(&mut self, potential: &Potential) {
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
                self.system.shift[p]
            } else {
                -Vec3::new(value(0, 0), value(0, 1), value(0, 2))
            };
            if columns > 1 {
                self.response[p] = Mat3::from_fn(|k, c| value(c + 1, k));
            }
        }
        potential.model.elements.fill(&mut self.step);
        if let Some(iterative) = self.iterative.as_mut().filter(|_| columns > 1) {
            iterative.set_response(&self.system, &self.response);
        }
    }

    /// Whether no more is out of balance than rounding of positions makes of the last Hessian: then no step can lower it. Coordinates are off
    /// by half a unit in the last place, and so are the differences and lengths that elements make of them; a row of the Hessian sums to some
    /// three times its diagonal block in norm (6, 4, 4, 1, 1 of bending), which `ROUNDING` allows for.
    fn is_rounding(&self, x: &[Vec3], tolerance: f64) -> bool {
        let extent = x.iter().map(|p| p.amax()).fold(0.0, f64::max);
        self.system.pattern.order.iter().enumerate().all(|(place, &n)| {
            let n = n as usize;
            let floor = ROUNDING * f64::EPSILON * extent * self.system.diagonal(place).norm();
            self.system.fixed[n] || self.gradient[n].norm() <= tolerance.max(floor)
        })
    }

    /// Backtracks along `step` until the energy falls enough, or, where energies cannot tell any more, the residual does.
    /// Leaves `x` and the gradient at the accepted point; false when there is none.
    fn search(&mut self, potential: &Potential, x: &mut [Vec3], residual: f64, watch: Watch) -> bool {
        // `trial` is filled below; until then its memory serves the step.
        let mut step = std::mem::take(&mut self.trial);
        step.copy_from_slice(&self.step);
        potential.limit(x, &mut step, &mut self.room);
        let slope = |step: &[Vec3]| -> f64 { self.gradient.iter().zip(step).map(|(g, d)| g.dot(d)).sum() };
        if slope(&step) >= 0.0 && slope(&self.step) < 0.0 {
            // Cut short particle by particle it leads uphill: shorten it as a whole.
            let part = |(whole, cut): (&Vec3, &Vec3)| {
                if whole.norm() > 0.0 { cut.norm() / whole.norm() } else { 1.0 }
            };
            let part = self.step.iter().zip(&step).map(part).fold(1.0, f64::min);
            step.iter_mut().zip(&self.step).for_each(|(cut, whole)| *cut = whole * part);
        }
        let slope = slope(&step);
        self.trial = std::mem::replace(&mut self.step, step);
        let energy = potential.energy_by_kernels(x, &mut self.planes);
        let noise = 1e-13 * energy.abs().max(1e-6);
        self.trial.copy_from_slice(x);
        let mut length = 1.0;
        for attempt in 0..if self.was_exact { HALVINGS } else { HALVINGS + LEAPS } {
            for (p, (from, d)) in x.iter_mut().zip(self.trial.iter().zip(&self.step)) {
                *p = from + d * length;
            }
            let change = potential.energy_by_kernels(x, &mut self.planes) - energy;
            watch.ended(Phase::Advance);
            if change <= 1e-4 * length * slope && slope < 0.0 {
                self.measure(potential, x, watch);
                return true;
            }
            if change.abs() <= noise {
                self.measure(potential, x, watch);
                if self.residual() < residual {
                    return true;
                }
            }
            length *= if attempt < HALVINGS { 0.5 } else { LEAP };
        }
        x.copy_from_slice(&self.trial);
        false
    }
}
