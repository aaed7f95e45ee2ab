//! The phases of a step. Physics says when one ends and reads no clock; a caller that wants to know how long they take brings a
//! `Stopwatch`.

use std::{cell::Cell, time::Instant};

/// A part of a step's work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phase {
    /// Commands, the hand's way, inertia, and what else no other phase names.
    Setup,
    /// Contact: candidates, gradient and Hessian of pairs, steps cut short, anchors.
    Contact,
    /// Gradient and measures of the fabric's elements.
    Gradient,
    /// The fabric's Hessian.
    Assembly,
    /// A direct factorization and its solves.
    Factor,
    /// The multigrid hierarchy is built.
    Hierarchy,
    /// One iteration of conjugate gradients.
    Iteration,
    /// The step is taken: new positions, tension unknowns.
    Advance,
    /// History moves on.
    Commit,
    /// Reaction, stiffness, force model.
    Feel,
    /// A try to come to rest.
    Rest,
    /// Cost, energy and gaps for the report.
    Observe,
}

impl Phase {
    /// Every phase, in the order of their declaration.
    pub const ALL: [Phase; 12] = [
        Phase::Setup,
        Phase::Contact,
        Phase::Gradient,
        Phase::Assembly,
        Phase::Factor,
        Phase::Hierarchy,
        Phase::Iteration,
        Phase::Advance,
        Phase::Commit,
        Phase::Feel,
        Phase::Rest,
        Phase::Observe,
    ];

    /// Its name in metrics and reports.
    pub fn name(self) -> &'static str {
        match self {
            Phase::Setup => "setup",
            Phase::Contact => "contact",
            Phase::Gradient => "gradient",
            Phase::Assembly => "assembly",
            Phase::Factor => "factor",
            Phase::Hierarchy => "hierarchy",
            Phase::Iteration => "iteration",
            Phase::Advance => "advance",
            Phase::Commit => "commit",
            Phase::Feel => "feel",
            Phase::Rest => "rest",
            Phase::Observe => "observe",
        }
    }
}

/// Who is told when a phase ends, if anybody.
#[derive(Clone, Copy, Default)]
pub struct Watch<'a>(pub Option<&'a dyn Fn(Phase)>);

impl Watch<'_> {
    /// Says that a phase ends now.
    #[inline]
    pub fn ended(self, phase: Phase) {
        if let Some(tell) = self.0 {
            tell(phase);
        }
    }
}

/// How often a phase ended, and how long it took in all [s].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lap {
    /// Ends.
    pub count: u32,
    /// Time [s].
    pub seconds: f64,
}

/// Times phases: what passes between two ends belongs to the later one.
#[derive(Debug)]
pub struct Stopwatch {
    last: Cell<Instant>,
    laps: [Cell<Lap>; Phase::ALL.len()],
}

impl Default for Stopwatch {
    fn default() -> Stopwatch {
        Stopwatch { last: Cell::new(Instant::now()), laps: Default::default() }
    }
}

impl Stopwatch {
    /// Forgets all laps; the first phase begins now.
    pub fn start(&self) {
        self.laps.iter().for_each(|lap| lap.set(Lap::default()));
        self.last.set(Instant::now());
    }

    /// Ends a phase.
    pub fn ended(&self, phase: Phase) {
        let now = Instant::now();
        let lap = &self.laps[phase as usize];
        let Lap { count, seconds } = lap.get();
        let passed = (now - self.last.replace(now)).as_secs_f64();
        lap.set(Lap { count: count + 1, seconds: seconds + passed });
    }

    /// What was timed since the start.
    pub fn lap(&self, phase: Phase) -> Lap {
        self.laps[phase as usize].get()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phases_stand_in_the_order_of_their_declaration() {
        for (place, phase) in Phase::ALL.into_iter().enumerate() {
            assert_eq!(phase as usize, place, "{}", phase.name());
        }
    }

    #[test]
    fn laps_count_ends_and_add_up_to_the_time_that_passed() {
        let watch = Stopwatch::default();
        let began = Instant::now();
        watch.start();
        for phase in [Phase::Gradient, Phase::Iteration, Phase::Iteration] {
            watch.ended(phase);
        }
        let passed = began.elapsed().as_secs_f64();
        assert_eq!([Phase::Gradient, Phase::Iteration, Phase::Rest].map(|p| watch.lap(p).count), [1, 2, 0]);
        let sum: f64 = Phase::ALL.iter().map(|p| watch.lap(*p).seconds).sum();
        assert!(sum > 0.0 && sum <= passed);
    }
}
