//! Minimization of the incremental potential: mixed Newton for live steps, exact Newton with line search for rest.
//!
//! Mixed Newton keeps the tensions as independent unknowns within a step (condensed out), because a straight step along a nearly
//! inextensible sheet would otherwise be ruined by the stretch it causes to second order; and it moves the hand inside the
//! linear solve. Trouble is a value here: outcomes say how a minimization ended.

use crate::{
    batch::{Measures, Planes},
    cores::Team,
    math::{Mat3, Vec3},
    model::Model,
    phase::{Phase, Watch},
    potential::{
        Potential,
        contact::{Touches, room::Room},
        halves::call_for_assembly,
        pattern::Pattern,
        system::System,
    },
};
use factor::{COLUMNS, Cholesky};
use iterative::Iterative;
use lower::Known;
use remainder::Remainder;
use std::sync::Arc;

pub use budget::Budget;
pub use legacy::Legacy;
pub use method::Method;

mod budget;
pub mod method;
pub mod soft;
pub mod factor;
pub mod multigrid;
mod iterative;
mod legacy;
mod lower;
mod newton;
mod remainder;
mod search;
mod turns;

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
    /// What presses there, and memory for what does elsewhere.
    pub touches: Touches,
    touches_elsewhere: Touches,
    touches_returning: Touches,
    /// H⁻¹ H_ih of the last factor, per free particle: how the cloth follows the hand [1].
    pub response: Vec<Mat3>,
    /// The hand that it is to; none before the first solve with one.
    responds_to: Option<u32>,
    /// H_hh − H_hi H⁻¹ H_ih: what the hand feels of the cloth when it moves [N/m].
    pub stiffness: Mat3,
    /// Linear solves since the counter was last cleared.
    pub solves: u32,
    factor: Cholesky,
    iterative: Option<Iterative>,
    /// Who does halves of what takes long, from the first long solve of a step to its end.
    team: Team,
    rhs: Vec<f64>,
    step: Vec<Vec3>,
    strains: Vec<f64>,
    trial: Vec<Vec3>,
    /// Where a minimization began, its prescribed displacements that are not zero, and the gradient there where it has none.
    origin: Vec<Vec3>,
    pushed: Vec<(u32, Vec3)>,
    before: Vec<Vec3>,
    /// Where the cloth would be had it followed the fixed particles from there as it did last time, and whether it is made.
    base: Vec<Vec3>,
    has_base: bool,
    /// Which way inertia takes each particle; how far of it contact is met, and how that changes the gradient.
    inertial: Vec<Vec3>,
    way: Vec<Vec3>,
    change: Vec<Vec3>,
    /// What the first solve of the next step will leave out of balance.
    remainder: Remainder,
    /// Whether the step is told that, as far as the caller says; then whether it was.
    pub is_told: bool,
    /// The step, or a shape, as kernels read it.
    planes: Planes,
    /// Memory for what contact leaves of a step.
    pub room: Room,
    /// Solves for which the exact Hessian is not tried again after it was indefinite, and the next such pause.
    pause: u32,
    next_pause: u32,
    /// Whether the last step came from the exact Hessian.
    was_exact: bool,
    /// Whether the last matrix was in part that of a moment ago, and whether it left out what lean ones do.
    lagged: bool,
    was_lean: bool,
    /// Steps whose first matrix is whole and of now.
    lean_pause: u32,
    /// Far out of balance after the last solve: a budget that ends so lets the next one search from the start.
    troubled: bool,
    /// Whether it was so after any solve of the present budget.
    strayed: bool,
    /// Its mixed steps led nowhere: the next one begins with searches.
    futile: bool,
    /// Whether mixed steps led nowhere since the last step that stayed near balance.
    circles: bool,
}

/// Factor by which a mixed step must lower the residual to be followed by another.
const FALLING: f64 = 0.5;
/// Residual, over the sheet's weight, at which the end of a budget looks whether the energy rose.
const SUSPECT: f64 = 0.1;
/// Steps that begin with whole matrices after a lean one led astray.
const LEAN_PAUSE: u32 = 16;
/// Solves beyond a budget that would end in trouble, where they were counted and where time is up: a late tick is felt less than a
/// force that is far off, but one of many long solves is felt as well.
const EXTRA: [u32; 2] = [8, 4];

impl Minimizer {
    /// Memory for the model's mesh.
    pub fn new(model: &Model, method: Method) -> Minimizer {
        let pattern = Arc::new(Pattern::new(&model.grid, &model.elements));
        let n = model.elements.nodes();
        Minimizer {
            factor: Cholesky::new(&pattern, method),
            iterative: method.accuracy().map(|accuracy| Iterative::new(model, &pattern, accuracy)),
            gradient: vec![Vec3::zeros(); n],
            measures: Measures::new(&model.elements),
            touches: Touches::default(),
            touches_elsewhere: Touches::default(),
            touches_returning: Touches::default(),
            response: vec![Mat3::zeros(); n],
            responds_to: None,
            stiffness: Mat3::zeros(),
            solves: 0,
            team: Team::default(),
            rhs: vec![0.0; 3 * pattern.particles.len() * COLUMNS],
            system: System::new(pattern),
            step: vec![Vec3::zeros(); n],
            strains: vec![0.0; model.elements.edges.len()],
            trial: vec![Vec3::zeros(); n],
            base: vec![Vec3::zeros(); n],
            has_base: false,
            origin: vec![Vec3::zeros(); n],
            pushed: Vec::new(),
            before: vec![Vec3::zeros(); n],
            inertial: vec![Vec3::zeros(); n],
            way: vec![Vec3::zeros(); n],
            change: vec![Vec3::zeros(); n],
            remainder: Remainder::new(n),
            is_told: false,
            planes: Planes::new(model.elements.named.len()),
            room: Room::default(),
            pause: 0,
            next_pause: 1,
            was_exact: false,
            lagged: false,
            was_lean: false,
            lean_pause: 0,
            troubled: false,
            strayed: false,
            futile: false,
            circles: false,
        }
    }

    /// Forgets what earlier solves taught about the Hessian.
    pub fn forget(&mut self) {
        self.response.fill(Mat3::zeros());
        self.responds_to = None;
        self.stiffness = Mat3::zeros();
        self.iterative.iter_mut().for_each(Iterative::forget);
        self.remainder.forget();
        (self.troubled, self.strayed, self.futile, self.circles) = (false, false, false, false);
        (self.pause, self.next_pause, self.lean_pause) = (0, 1, 0);
    }

    /// Solves live steps by conjugate gradients from now on, to a method's accuracy, or by the factor alone.
    pub fn iterate(&mut self, model: &Model, method: Method) {
        let accuracy = method.accuracy();
        if accuracy == self.iterative.as_ref().map(|iterative| iterative.accuracy) {
            return;
        }
        self.iterative = accuracy.map(|accuracy| Iterative::new(model, &self.system.pattern, accuracy));
        self.share_response();
    }

    /// Lets conjugate gradients go on from the response, if it is that to the present hand.
    fn share_response(&mut self) {
        let is_known = self.responds_to.is_some() && self.responds_to == self.system.hand;
        if let Some(iterative) = self.iterative.as_mut().filter(|_| is_known) {
            iterative.set_response(&self.system, &self.response, self.stiffness);
        }
    }

    /// Brings the response to the hand, and the stiffness, up to the last solve's Hessian, where conjugate gradients solve: they renew it
    /// a little at a time, a factor at once.
    pub fn renew_response(&mut self, watch: Watch) {
        if let Some(iterative) = &mut self.iterative {
            iterative.renew_all(&self.system, &mut self.response, &self.team, watch);
            self.stiffness = iterative.stiffness;
            self.team.dismiss();
        }
    }

    /// Whether the iterative solver makes everything anew at every solve, until the mesh changes.
    pub fn solve_afresh(&mut self, afresh: bool) {
        self.iterative.iter_mut().for_each(|iterative| iterative.afresh = afresh);
    }

    /// Whether the last budget ended far out of balance.
    pub fn is_troubled(&self) -> bool {
        self.troubled
    }

    /// Largest gradient on a free particle [N].
    pub fn residual(&self) -> f64 {
        self.largest(&self.gradient)
    }

    fn largest(&self, gradient: &[Vec3]) -> f64 {
        let particles = self.system.pattern.order.iter().map(|&n| n as usize);
        let free = particles.filter(|&n| !self.system.fixed[n]).map(|n| gradient[n].norm_squared());
        // `max` would drop a NaN; comparing this way keeps it.
        free.fold(0.0, |worst, g| if g > worst || g.is_nan() { g } else { worst }).sqrt()
    }

    /// Mixed Newton from `x`, with the displacements that the system prescribes in the first solve. Where its residual stops
    /// falling (edges that change between tension and compression can make it cycle), it goes on from the point of lowest energy
    /// met so far by Newton steps with a line search on the energy. Where the last budget ended in trouble, already the first step must lower it.
    ///
    /// `gradient`, `measures` and `touches` must be those at `x`, before the prescribed displacements.
    pub fn descend(
        &mut self,
        potential: &Potential,
        x: &mut [Vec3],
        tolerance: f64,
        budget: Budget,
    ) -> Outcome {
        let outcome = self.go_down(potential, x, tolerance, budget);
        self.team.dismiss();
        outcome
    }

    fn go_down(&mut self, potential: &Potential, x: &mut [Vec3], tolerance: f64, budget: Budget) -> Outcome {
        let watch = budget.watch;
        if !self.lagged {
            self.call_helper();
        }
        self.reset_strains();
        watch.ended(Phase::Setup);
        let from = self.solves;
        let mut last = f64::INFINITY;
        self.begin(potential, x);
        let is_pushed = !self.pushed.is_empty();
        let mut mixed = !std::mem::take(&mut self.futile) || is_pushed;
        self.is_told &= is_pushed && !self.troubled;
        let (mut is_first, learns) = (true, self.is_told);
        if !learns {
            self.remainder.forget();
        }
        if !mixed {
            last = self.residual();
        } else if self.troubled {
            // The whole step is on trial from the first solve on.
            potential.model.elements.copy(&self.gradient, &mut self.trial);
            self.follow_fixed(potential);
            potential.begin_gradient(&self.base, &mut self.gradient, &mut self.touches_elsewhere);
            potential.finish_gradient(&self.base, &mut self.gradient, &mut self.measures, &self.team);
            last = self.residual();
            potential.model.elements.copy(&self.trial, &mut self.gradient);
        }
        let suspect = SUSPECT * potential.model.weight_on_earth();
        let mut extra = 0;
        let mut is_far = std::mem::take(&mut self.strayed);
        self.circles &= is_far;
        let mut known = Known::default();
        loop {
            let mut failed = false;
            self.newton(potential, x, mixed, self.solves == from, is_far, watch);
            if mixed {
                self.take_mixed_step(potential, x, watch);
                known.here = None;
            } else if !self.search(potential, x, last, &mut known.here, watch) {
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
                    self.jacobi(potential);
                    if !self.search(potential, x, last, &mut known.here, watch) {
                        self.measure(potential, x, watch);
                        return Outcome::Stalled;
                    }
                }
            }
            let residual = self.residual();
            if !residual.is_finite() {
                return Outcome::NotFinite;
            }
            self.troubled = residual > suspect;
            if std::mem::take(&mut is_first) {
                self.judge_lean(is_pushed);
                if learns {
                    self.learn(potential.model);
                }
            }
            self.strayed |= self.troubled;
            is_far = self.troubled;
            let is_balanced = residual <= tolerance;
            // Several solves may lead to another balance, and a higher one.
            let has_jumped = mixed && is_balanced && !is_pushed && self.solves - from > 1;
            let is_higher = has_jumped && self.is_higher(potential, x, &mut known);
            if is_balanced && !is_higher {
                return Outcome::Converged;
            }
            let spent = budget.is_spent(self.solves - from);
            if spent && self.troubled && extra < EXTRA[usize::from(budget.is_late())] {
                extra += 1;
            } else if spent {
                let is_held_back = is_pushed && !self.has_moved_fixed(x);
                if is_held_back {
                    // Obstacles kept what was prescribed from all of its way: it begins and ends at the same places.
                    potential.model.elements.copy(&self.origin, &mut self.base);
                    (self.has_base, known.base) = (true, None);
                }
                // What the gradients at both ends say of the way between them may be wrong where laws have knees.
                let rises = |of: &mut Minimizer, known: &mut Known| {
                    of.has_grown() || of.seems_higher(potential, x) || of.is_higher(potential, x, known)
                };
                let suspicious = is_held_back || is_higher || !is_pushed && rises(self, &mut known);
                if mixed && self.troubled || suspicious {
                    self.futile = self.back_off(potential, x, &mut known, watch);
                }
                return if failed { Outcome::Stalled } else { Outcome::Budget };
            }
            if mixed && (is_higher || residual > FALLING * last) {
                (mixed, self.circles) = (false, true);
                self.choose_lower(potential, x, &mut known, watch);
            }
            if mixed {
                self.linearize_strains(potential);
            } else {
                self.reset_strains();
            }
            last = self.residual();
            self.call_helper();
        }
    }

    /// Has the next steps begin with whole matrices where, under a hand that moves, a lean one led far out of balance, as where folds are
    /// sharp.
    fn judge_lean(&mut self, is_pushed: bool) {
        let has_failed = is_pushed && self.was_lean && self.troubled;
        self.lean_pause = if has_failed { LEAN_PAUSE } else { self.lean_pause.saturating_sub(1) };
    }

    /// Keeps what a step's first solve left under a hand that moves, unless that was far out of balance.
    fn learn(&mut self, model: &Model) {
        if self.troubled {
            self.remainder.forget();
        } else {
            self.remainder.learn(&model.elements, &self.gradient, &self.touches, &self.system.fixed);
        }
    }

    /// Has a helper come for half of an assembly of more than edges.
    fn call_helper(&self) {
        if self.iterative.is_some() {
            call_for_assembly(&self.team, self.system.pattern.order.len());
        }
    }

    /// Keeps where a minimization begins.
    fn begin(&mut self, potential: &Potential, x: &[Vec3]) {
        self.pushed.clear();
        self.pushed.extend(self.system.shifts());
        if !self.pushed.is_empty() {
            self.bar(potential, x);
        }
        let elements = &potential.model.elements;
        elements.copy(x, &mut self.origin);
        self.has_base = false;
        if self.pushed.is_empty() {
            elements.copy(&self.gradient, &mut self.before);
        }
    }

    /// Takes what obstacles bar out of what is prescribed. Else the first solve would drag the cloth after a hand that cannot go there.
    fn bar(&mut self, potential: &Potential, x: &[Vec3]) {
        let Minimizer { system, pushed, way, room, .. } = self;
        let elements = &potential.model.elements;
        elements.present().for_each(|n| way[n] = Vec3::zeros());
        pushed.iter().for_each(|&(n, shift)| way[n as usize] = shift);
        elements.fill(way);
        potential.limit(x, way, room);
        for (n, shift) in &mut *pushed {
            *shift = way[*n as usize];
            system.prescribe(*n as usize, *shift);
        }
        pushed.retain(|(_, shift)| *shift != Vec3::zeros());
    }

    /// The whole Newton step. Keeps where it came from in `trial`, with the prescribed displacements already made. No step passes an obstacle.
    fn take_mixed_step(&mut self, potential: &Potential, x: &mut [Vec3], watch: Watch) {
        potential.limit(x, &mut self.step, &mut self.room);
        watch.ended(Phase::Contact);
        let elements = &potential.model.elements;
        elements.copy(x, &mut self.trial);
        for n in elements.present() {
            x[n] += self.step[n];
            if self.system.fixed[n] {
                self.trial[n] = x[n];
            }
        }
        elements.fill(&mut self.trial);
        self.system.prescribe_nothing();
        watch.ended(Phase::Advance);
        self.measure(potential, x, watch);
    }

    /// Farthest that the last Newton step goes [m].
    pub fn longest_step(&self) -> f64 {
        self.step.iter().map(|s| s.norm()).fold(0.0, f64::max)
    }

    /// Gradient, measures and what presses at `x`.
    pub fn measure(&mut self, potential: &Potential, x: &[Vec3], watch: Watch) {
        potential.begin_gradient(x, &mut self.gradient, &mut self.touches);
        watch.ended(Phase::Contact);
        potential.finish_gradient(x, &mut self.gradient, &mut self.measures, &self.team);
        watch.ended(Phase::Gradient);
    }

    /// Lets the tension unknowns follow the last mixed step by the linearized strain.
    fn linearize_strains(&mut self, potential: &Potential) {
        self.planes.set(&self.step, &potential.model.elements.named);
        potential.linearized_strains(&self.system, &self.planes, &mut self.strains);
    }

    /// Lets the tension unknowns start from the measured strains.
    fn reset_strains(&mut self) {
        self.strains.iter_mut().zip(&self.measures.edges).for_each(|(strain, [now, _])| *strain = *now);
    }
}
