//! The linear solves of live steps by conjugate gradients: to the accuracy that the hand feels, from a good guess, and with the
//! response to the hand renewed a column at a time.

use super::{
    multigrid::{End, Multigrid, Part, TURNS, dot},
    soft::Soft,
};
use crate::{
    math::{Mat3, Vec3},
    phase::{Phase, Watch},
    potential::{pattern::Pattern, system::System},
};

/// Error of the hand's force at which a solve ends, relative to the force.
const FORCE_TOLERANCE: f64 = 2e-4;
/// Residual, relative to the right-hand side, above which no solve ends: of a step's first one, and of those that follow, whose right-hand
/// side is what the last one left.
const TOLERANCE: [f64; 2] = [1e-2, 1e-1];
/// Residual at which a renewed column of the response ends, relative to the hand's coupling.
const COLUMN_TOLERANCE: f64 = 1e-3;
/// Iterations at the most.
const MOST: u32 = 60;
/// Solves between two renewals of a column, and iterations of one at the most: a tick should not take longer for it than the others.
const RENEWAL: u32 = 6;
const COLUMN_MOST: u32 = 1;

/// Solver memory. Vectors are in planes in the order of the lattice, zero for fixed particles.
pub struct Iterative {
    /// What soft elements bring to the Hessian.
    pub soft: Soft,
    multigrid: Multigrid,
    rhs: Vec<f64>,
    column_rhs: Vec<f64>,
    x: Vec<f64>,
    /// H⁻¹ H_ih, column by column, and how many are known for this hand.
    columns: [Vec<f64>; 3],
    known: usize,
    hand: Option<u32>,
    next: usize,
    age: u32,
    /// Solves since the coarser levels were built at once, from 1 on, 0 where they must be; iterations of the first solve with them.
    lag: u32,
    usual: u32,
    /// Iterations of the last one.
    iterations: u32,
    /// Builds coarser levels, looks at soft elements and renews the response at every solve: to measure what it saves not to.
    pub afresh: bool,
}

impl Iterative {
    /// Memory around a hierarchy and soft elements' blocks.
    pub fn new(multigrid: Multigrid, soft: Soft, pattern: &Pattern) -> Iterative {
        let zeros = || vec![0.0; 3 * pattern.plane];
        Iterative {
            soft,
            multigrid,
            rhs: zeros(),
            column_rhs: zeros(),
            x: zeros(),
            columns: [zeros(), zeros(), zeros()],
            known: 0,
            hand: None,
            next: 0,
            age: 0,
            lag: 0,
            usual: 0,
            iterations: 0,
            afresh: false,
        }
    }

    /// Forgets soft elements' blocks and the response to the hand, and with it the guesses that solves start from: they may not be finite.
    pub fn forget(&mut self) {
        self.columns.iter_mut().for_each(|column| column.fill(0.0));
        (self.known, self.next, self.age, self.lag) = (0, 0, 0, 0);
        self.soft.forget();
    }

    /// Takes over a response that was solved for directly.
    pub fn set_response(&mut self, system: &System, response: &[Mat3]) {
        let plane = system.pattern.plane;
        for (place, &p) in system.pattern.order.iter().enumerate() {
            for (c, column) in self.columns.iter_mut().enumerate() {
                (0..3).for_each(|k| column[k * plane + place] = response[p as usize][(k, c)]);
            }
        }
        (self.known, self.hand, self.age) = (3, system.hand, 0);
    }

    /// Solves H d = −rhs into `step`, for the first time in a step from a guess [m], later from zero, until the error of the hand's force is
    /// small against `force` [N], and renews the response where it is due. `End::Spent` leaves the best that was found.
    pub fn solve(
        &mut self,
        system: &System,
        guess: Option<&dyn Fn(usize) -> Vec3>,
        force: f64,
        step: &mut [Vec3],
        response: &mut [Mat3],
        watch: Watch,
    ) -> End {
        let (order, plane) = (&system.pattern.order, system.pattern.plane);
        if self.hand != system.hand {
            self.known = 0;
            self.columns.iter_mut().for_each(|column| column.fill(0.0));
            self.lag = 0;
            self.hand = system.hand;
        }
        // The coarser levels may lag behind: they change little in a tick, and it is the iteration that decides what is exact. They are
        // built in turns, as no tick should take longer than the others.
        let whole = self.afresh || self.lag == 0 || self.iterations > self.usual + 1;
        let part = if whole { Part::All } else { Part::Turn((self.lag - 1) % TURNS) };
        self.multigrid.build(system, part);
        self.lag = if whole { 1 } else { self.lag + 1 };
        watch.ended(Phase::Hierarchy);
        for (place, p) in order.iter().map(|&p| p as usize).enumerate() {
            let (b, x) = if system.fixed[p] {
                (Vec3::zeros(), Vec3::zeros())
            } else {
                (-system.rhs[p], guess.map_or(Vec3::zeros(), |guess| guess(p)))
            };
            for k in 0..3 {
                self.rhs[k * plane + place] = b[k];
                self.x[k * plane + place] = x[k];
            }
        }
        if system.hand.is_some() {
            let end = self.renew(system, response, watch);
            if end == End::Indefinite {
                self.lag = 0;
                return end;
            }
        }
        let (columns, known) = (&self.columns, self.known);
        let limit = TOLERANCE[usize::from(guess.is_none())].powi(2) * square(&self.rhs);
        let is_met = |r: &[f64]| {
            let error: f64 = columns[..known].iter().map(|x| dot(x, r).powi(2)).sum();
            error.sqrt() <= FORCE_TOLERANCE * force && square(r) <= limit
        };
        let (end, iterations) = self.multigrid.solve(system, &self.rhs, &mut self.x, MOST, is_met, watch);
        self.iterations = iterations;
        if whole {
            self.usual = iterations;
        }
        if end != End::Met {
            self.lag = 0;
        }
        for (place, p) in order.iter().map(|&p| p as usize).enumerate() {
            step[p] = if system.fixed[p] {
                system.shift[p]
            } else {
                Vec3::new(self.x[place], self.x[plane + place], self.x[2 * plane + place])
            };
        }
        end
    }

    /// Renews one column of the response when it is due, all that are not known at once.
    fn renew(&mut self, system: &System, response: &mut [Mat3], watch: Watch) -> End {
        self.age += 1;
        let due = if self.afresh || self.known < 3 { 3 } else { usize::from(self.age >= RENEWAL) };
        let (order, plane) = (&system.pattern.order, system.pattern.plane);
        for _ in 0..due {
            let c = self.next;
            self.next = (c + 1) % 3;
            let b = &mut self.column_rhs;
            b.fill(0.0);
            for (place, p) in order.iter().map(|&p| p as usize).enumerate() {
                if !system.fixed[p] {
                    (0..3).for_each(|k| b[k * plane + place] = system.coupling[p][(k, c)]);
                }
            }
            let limit = COLUMN_TOLERANCE * COLUMN_TOLERANCE * square(b);
            let column = &mut self.columns[c];
            let most = if self.known < 3 || self.afresh { MOST } else { COLUMN_MOST };
            let (end, _) = self.multigrid.solve(system, b, column, most, |r| square(r) <= limit, watch);
            if end == End::Indefinite {
                return end;
            }
            for (place, &p) in order.iter().enumerate() {
                (0..3).for_each(|k| response[p as usize][(k, c)] = column[k * plane + place]);
            }
            self.age = 0;
        }
        self.known = 3;
        End::Met
    }
}

fn square(a: &[f64]) -> f64 {
    dot(a, a)
}
