//! The linear solves of live steps by conjugate gradients: to the accuracy that the hand feels, from a good guess, and with the
//! response to the hand renewed a column at a time.

use super::{
    method::Accuracy,
    multigrid::{Coarser, End, Multigrid, Residual},
    soft::{Blocks, Brought, Soft},
    turns::{Turns, WORN},
};
use crate::{
    cores::{Beside, Team, Work},
    math::{
        Mat3, Vec3,
        pack::{Arch, instructions, with_instructions},
    },
    model::Model,
    phase::{Phase, Watch},
    potential::{Curvature, Potential, pattern::Pattern, system::System},
};
use std::sync::Arc;

/// Share of the error of the hand's force that they begin with at which a step's solves with the clamped Hessian end, but for its first:
/// that Hessian is not the energy's, and what they leave is the next one's.
const ROUGH: f64 = 0.01;
/// Share of what a solve may leave, out of balance or of the hand's force, up to which rounding of a residual is no matter. The hand feels no
/// more of it than its size: no particle follows farther than the hand goes, and signs are random.
const FAINT: f64 = 0.25;
/// Iterations at the most: of a solve, and of one with the clamped Hessian, which leads down wherever it ends.
const MOST: u32 = 60;
const ROUGH_MOST: u32 = 30;
/// Solves between two renewals of columns that were good enough, the most of them where solves take long, and iterations of one: a tick
/// should not take longer for it than the others.
const RENEWAL: u32 = 6;
const LATEST: u32 = 9;
const COLUMN_MOST: u32 = 1;

/// Solver memory. Vectors are in planes in the order of the lattice, zero for fixed particles.
pub struct Iterative {
    /// Where solves end, and what may lag.
    pub accuracy: Accuracy,
    /// What is made for later solves, while this one goes on;
    later: Beside<Box<Later>>,
    /// that, if it is to be started when the solve is over.
    waiting: Option<Box<Later>>,
    /// What makes coarser levels, unless that is with what is made for later.
    coarser: Option<Coarser>,
    soft: Soft,
    multigrid: Multigrid,
    rhs: Vec<f64>,
    column_rhs: Vec<f64>,
    x: Vec<f64>,
    /// H⁻¹ H_ih, column by column, and how many are known for this hand.
    columns: [Vec<f64>; 3],
    /// The same in single precision: what the hand feels of a residual needs no more.
    felt: [Vec<f32>; 3],
    known: usize,
    /// H_hh − H_hi H⁻¹ H_ih, each column of when it was renewed [N/m].
    pub stiffness: Mat3,
    hand: Option<u32>,
    next: usize,
    age: u32,
    /// Whether the column that was renewed last was good enough.
    is_good: bool,
    /// Whether the response is that of a cloth at rest, which follows the hand much farther: it is then solved for anew.
    pub is_static: bool,
    /// When coarser levels are made, and whether the next solve's turn at them was given away.
    turns: Turns,
    is_turned: bool,
    /// Builds coarser levels, looks at soft elements and renews the response at every solve: to measure what it saves not to.
    pub afresh: bool,
}

/// What a solve begins and ends with.
pub struct Aim<'a> {
    /// The system's Hessian.
    pub kind: Curvature,
    /// Where each particle is guessed to go [m], in a step's first solve.
    pub guess: Option<&'a [Vec3]>,
    /// The hand's force [N], against which its error is to be small.
    pub force: f64,
    /// Whether the step is told what the last ones left, as this one's remainder will be.
    pub is_told: bool,
}

/// What may be made on another core.
struct Later {
    soft: Blocks,
    /// Whether soft elements' blocks are to be made.
    is_due: bool,
    /// Coarser levels, of which a turn is to be made.
    coarser: Option<Coarser>,
    instructions: Arch,
}

impl Later {
    /// Says what is to be made, by this thread's instructions: soft elements' blocks too if they are due.
    fn is_to_make(&mut self, is_due: bool) {
        (self.is_due, self.instructions) = (is_due, instructions());
    }
}

impl Work for Box<Later> {
    fn work(&mut self) {
        let Later { soft, is_due, coarser, instructions } = &mut **self;
        with_instructions(*instructions, || {
            if *is_due {
                soft.work();
            }
            if let Some(coarser) = coarser {
                coarser.work();
            }
        });
    }
}

impl Iterative {
    /// Memory for a model's mesh.
    pub fn new(model: &Model, pattern: &Arc<Pattern>, accuracy: Accuracy) -> Iterative {
        let zeros = || vec![0.0; 3 * pattern.lines.plane];
        let (multigrid, coarser) = Multigrid::new(&model.grid, pattern, accuracy.hard);
        let soft = Blocks::new(model, pattern);
        let later = Later { soft, is_due: false, coarser: None, instructions: instructions() };
        Iterative {
            accuracy,
            later: Beside::new(Box::new(later)),
            waiting: None,
            coarser: Some(coarser),
            soft: Soft::default(),
            multigrid,
            rhs: zeros(),
            column_rhs: zeros(),
            x: zeros(),
            columns: [zeros(), zeros(), zeros()],
            felt: std::array::from_fn(|_| vec![0.0; 3 * pattern.lines.plane]),
            known: 0,
            stiffness: Mat3::zeros(),
            hand: None,
            next: 0,
            age: 0,
            is_good: false,
            is_static: false,
            // Long solves are worth new levels.
            turns: Turns::new(if accuracy.may_lag { WORN } else { 0 }),
            is_turned: false,
            afresh: false,
        }
    }

    /// Forgets soft elements' blocks and the response to the hand, and with it the guesses that solves start from: they may not be finite.
    pub fn forget(&mut self) {
        self.forget_response();
        (self.next, self.age, self.turns.stale) = (0, 0, true);
        self.multigrid.forget();
        self.forget_soft();
    }

    fn forget_response(&mut self) {
        self.columns.iter_mut().for_each(|column| column.fill(0.0));
        self.felt.iter_mut().for_each(|felt| felt.fill(0.0));
        (self.known, self.is_good, self.is_static) = (0, false, false);
        self.stiffness = Mat3::zeros();
    }

    /// Forgets soft elements' blocks.
    pub fn forget_soft(&mut self) {
        let mut later = self.take_back();
        self.soft.forget(&mut later.soft);
        self.later.put(later);
    }

    /// Before a step's first solve: brings the soft elements' blocks into the system, true if they are those of a moment ago, and has
    /// made meanwhile what later steps need.
    pub fn bring(
        &mut self,
        potential: &Potential,
        kind: Curvature,
        system: &mut System,
        team: &Team,
    ) -> bool {
        let mut later = self.take_back();
        let brought = if self.accuracy.may_lag {
            self.soft.bring(&mut later.soft, potential, kind, system, team)
        } else {
            potential.begin_soft(kind, system, team);
            Brought { lag: false, due: false }
        };
        self.is_turned = self.takes_turn();
        if self.is_turned {
            later.coarser = self.coarser.take();
        }
        later.is_to_make(brought.due);
        if !(brought.due || self.is_turned) {
            self.later.put(later);
        } else if self.multigrid.is_for_two() && !later.soft.change_by_batches() {
            // It takes no longer than what follows the solve, which then has both cores for its iterations.
            team.call(system.pattern.order.len());
            self.waiting = Some(later);
        } else {
            team.dismiss();
            self.later.start(later);
        }
        brought.lag
    }

    /// Has soft elements' blocks made beside what comes until the first step on a new mesh, at the system's shape.
    pub fn make_ready(&mut self, potential: &Potential, kind: Curvature, system: &System) {
        if self.accuracy.may_lag {
            let mut later = self.take_back();
            self.soft.begin(&mut later.soft, potential, kind, &system.shape);
            later.is_to_make(true);
            self.later.start(later);
        }
    }

    /// After a solve: has made on another core, if one is free, what waited for its end.
    pub fn start_waiting(&mut self, team: &Team) {
        if let Some(later) = self.waiting.take() {
            team.dismiss();
            self.later.start(later);
        }
    }

    /// What was made for later, once it is; what makes coarser levels stays here.
    fn take_back(&mut self) -> Box<Later> {
        let mut later = taken_back(&mut self.waiting, &self.later);
        self.coarser = self.coarser.take().or_else(|| later.coarser.take());
        later
    }

    /// Takes over coarser levels that are finished. Whether a turn at the next ones is to be made: where levels may lag, not in a tick that
    /// renews a column.
    fn takes_turn(&mut self) -> bool {
        let renews = self.is_good && self.hand.is_some() && self.age + 1 >= RENEWAL;
        if self.must_renew() || renews && self.accuracy.may_lag || !self.turns.are_due() {
            return false;
        }
        let coarser = self.coarser.get_or_insert_with(|| coarser_of(&mut self.waiting, &self.later));
        if self.turns.are_finished() {
            self.multigrid.take(coarser);
            self.turns.taken_over();
            if !self.turns.are_due() {
                return false;
            }
        }
        if self.turns.begin() {
            self.multigrid.lend(coarser);
        }
        true
    }

    /// Whether coarser levels must be made at once.
    fn must_renew(&self) -> bool {
        self.afresh || self.multigrid.is_hard || self.turns.are_due_at_once()
    }

    /// Takes over a response that was solved for directly.
    pub fn set_response(&mut self, system: &System, response: &[Mat3], stiffness: Mat3) {
        self.stiffness = stiffness;
        let plane = system.pattern.lines.plane;
        for c in 0..3 {
            self.recall(c, &system.pattern.order, plane, response);
            self.feel(c);
        }
        (self.known, self.hand, self.age) = (3, system.hand, 0);
        (self.is_good, self.is_static) = (false, false);
    }

    /// Solves H d = −rhs into `step`, for the first time in a step from a guess, later from zero, until the error of the hand's force is
    /// small against the force, or not even that with the clamped Hessian, and renews the response where it is due. `End::Spent` leaves
    /// the best that was found.
    pub fn solve(
        &mut self,
        system: &System,
        Aim { kind, guess, force, is_told }: Aim,
        (step, response): (&mut [Vec3], &mut [Mat3]),
        team: &Team,
        watch: Watch,
    ) -> End {
        let (order, plane) = (&system.pattern.order, system.pattern.lines.plane);
        if self.hand != system.hand {
            self.forget_response();
            self.turns.stale = true;
            self.hand = system.hand;
        }
        let whole = self.must_renew();
        if !self.is_turned && self.takes_turn() {
            self.coarser.as_mut().expect("just taken back").work();
        }
        self.multigrid.call(team);
        self.multigrid.set(system, team);
        if whole {
            let coarser = self.coarser.get_or_insert_with(|| coarser_of(&mut self.waiting, &self.later));
            self.multigrid.renew(coarser, team);
            self.turns.taken_over();
        }
        self.is_turned = false;
        watch.ended(Phase::Hierarchy);
        for (place, p) in order.iter().map(|&p| p as usize).enumerate() {
            let (b, x) = if system.fixed[p] {
                (Vec3::zeros(), Vec3::zeros())
            } else {
                (-system.rhs[p], guess.map_or(Vec3::zeros(), |guess| guess[p]))
            };
            for k in 0..3 {
                self.rhs[k * plane + place] = b[k];
                self.x[k * plane + place] = x[k];
            }
        }
        // What is not known at all must be, as the hand's force is what the solve goes by.
        let must_know = self.afresh || self.known < 3 || self.is_static;
        if must_know && self.renew_all(system, response, team, watch) == End::Indefinite {
            return End::Indefinite;
        }
        let (felt, known) = (self.felt.each_ref().map(|felt| &felt[..]), self.known);
        let is_clamped = kind != Curvature::Exact;
        let share = if is_clamped && guess.is_none() { ROUGH } else { 0.0 };
        let most = if is_clamped { ROUGH_MOST } else { MOST };
        let limits = self.accuracy.residual.map(|part| part.powi(2) * square(&self.rhs));
        let limit = limits[usize::from(guess.is_none())];
        let tolerance = self.accuracy.force[usize::from(!is_told)];
        let (mut allowed, mut left) = (None, f64::INFINITY);
        let is_met = |r: Residual| {
            let errors = if known == 3 { r.dots(felt) } else { [0.0; 3] };
            let error = errors.iter().map(|error| error * error).sum::<f64>().sqrt();
            left = r.square();
            let allowed = *allowed.get_or_insert((tolerance * force).max(share * error));
            (error <= allowed && left <= limit).then_some(FAINT * allowed.min(limit.sqrt()))
        };
        let (mut end, iterations) =
            self.multigrid.solve(system, (&self.rhs, &mut self.x), most, is_met, team, watch);
        self.turns.solved(iterations, whole);
        self.turns.stale = end != End::Met;
        if is_clamped && end == End::Spent && left <= limits[1] {
            end = End::Met;
        }
        self.age += 1;
        let (due, latest) = if self.is_good { (RENEWAL, LATEST) } else { (1, LATEST - RENEWAL) };
        let waits = iterations > self.turns.usual && self.age < latest;
        let renews = system.hand.is_some() && self.age >= due && !waits && end == End::Met;
        if renews && self.renew(system, response, COLUMN_MOST, team, watch) == End::Indefinite {
            return End::Indefinite;
        }
        for (place, p) in order.iter().map(|&p| p as usize).enumerate() {
            step[p] = if system.fixed[p] {
                system.shift(p)
            } else {
                Vec3::new(self.x[place], self.x[plane + place], self.x[2 * plane + place])
            };
        }
        end
    }

    /// Renews every column of the response, where there is a hand, until one ends in `End::Indefinite`.
    pub fn renew_all(&mut self, system: &System, response: &mut [Mat3], team: &Team, watch: Watch) -> End {
        if system.hand.is_none() {
            return End::Met;
        }
        for _ in 0..3 {
            if self.renew(system, response, MOST, team, watch) == End::Indefinite {
                return End::Indefinite;
            }
        }
        (self.known, self.is_static) = (3, false);
        End::Met
    }

    /// Renews a column of the response; `End::Indefinite` leaves it as it was.
    fn renew(&mut self, system: &System, response: &mut [Mat3], most: u32, team: &Team, watch: Watch) -> End {
        let (order, plane) = (&system.pattern.order, system.pattern.lines.plane);
        let c = self.next;
        self.next = (c + 1) % 3;
        self.age = 0;
        let b = &mut self.column_rhs;
        b.fill(0.0);
        for &p in &system.coupled {
            let place = system.pattern.place[p as usize] as usize;
            (0..3).for_each(|k| b[k * plane + place] = system.coupling[p as usize][(k, c)]);
        }
        let column = &mut self.columns[c];
        let felt = self.felt.each_ref().map(|felt| &felt[..]);
        let least = self.accuracy.column[usize::from(self.known == 3)].powi(2) * square(b);
        // What the residual r tells the hand, Xᵀ r, is the error of H_hh − H_hi X to first order.
        let raw = raw_stiffness(system, column, c);
        let tolerance = self.accuracy.stiffness;
        let (mut error, mut limit) = (Vec3::zeros(), None);
        let is_met = |r: Residual| {
            error = Vec3::from(r.dots(felt));
            let limit = *limit.get_or_insert_with(|| tolerance * (raw - error).norm());
            (error.norm() <= limit && r.square() <= least).then_some(FAINT * limit.min(least.sqrt()))
        };
        let (end, _) = self.multigrid.solve(system, (b, column), most, is_met, team, watch);
        let stiffness = raw_stiffness(system, column, c) - error;
        if end == End::Indefinite || !stiffness.iter().all(|k| k.is_finite()) {
            self.turns.stale = true;
            // What was known before is better than what a direction of negative curvature leaves: that may not be finite.
            self.recall(c, order, plane, response);
            return End::Indefinite;
        }
        self.stiffness.set_column(c, &stiffness);
        self.is_good = end == End::Met;
        self.feel(c);
        for (place, &p) in order.iter().enumerate() {
            (0..3).for_each(|k| response[p as usize][(k, c)] = self.columns[c][k * plane + place]);
        }
        end
    }

    /// A column as the response has it.
    fn recall(&mut self, c: usize, order: &[u32], plane: usize, response: &[Mat3]) {
        let column = &mut self.columns[c];
        for (place, &p) in order.iter().enumerate() {
            (0..3).for_each(|k| column[k * plane + place] = response[p as usize][(k, c)]);
        }
    }

    fn feel(&mut self, column: usize) {
        self.felt[column].iter_mut().zip(&self.columns[column]).for_each(|(felt, x)| *felt = *x as f32);
    }
}

/// What is made for later, done: here and now if it waits for the end of the solve.
fn taken_back(waiting: &mut Option<Box<Later>>, later: &Beside<Box<Later>>) -> Box<Later> {
    let Some(mut own) = waiting.take() else { return later.take() };
    own.work();
    own
}

/// What makes coarser levels, taken out of it.
fn coarser_of(waiting: &mut Option<Box<Later>>, later: &Beside<Box<Later>>) -> Coarser {
    let mut done = taken_back(waiting, later);
    let coarser = done.coarser.take();
    later.put(done);
    coarser.expect("with what is made for later")
}

/// A column of H_hh − H_hi H⁻¹ H_ih [N/m], by an H⁻¹ H_ih.
fn raw_stiffness(system: &System, column: &[f64], c: usize) -> Vec3 {
    let plane = system.pattern.lines.plane;
    let mut stiffness = Vec3::from(system.handle.column(c));
    for &n in &system.coupled {
        let place = system.pattern.place[n as usize] as usize;
        stiffness -= system.coupling[n as usize].tr_mul(&Vec3::from_fn(|k, _| column[k * plane + place]));
    }
    stiffness
}

fn square(a: &[f64]) -> f64 {
    a.iter().map(|a| a * a).sum()
}
