//! When the coarser levels of multigrid are made. They may lag behind where solves are easy, as they change little in a tick then and it is
//! the iteration that decides what is exact: they are made in turns, as no tick should take longer than the others, and only once they are
//! worn. Where solves are hard they are made at once, of the same matrix.

use super::multigrid::TURNS;

/// Iterations that solves may lose to levels that lag behind before these are made at once: about what that takes.
const AT_ONCE: u32 = 6;
/// Solves after which levels are worn though none took more iterations than the first.
pub const WORN: u32 = 8;

/// How levels wear, and how far the next ones are.
#[derive(Clone, Copy)]
pub struct Turns {
    /// Solves after which levels are worn in any case.
    worn: u32,
    /// Turns that were begun since levels were taken over.
    begun: u32,
    /// Solves since then, the iterations of the first of them, and whether the last one took more.
    solves: u32,
    first: u32,
    grows: bool,
    /// Whether they must be made at once: they are of something else, or a solve did not end with them.
    pub stale: bool,
    /// Iterations of the first solve after they were made at once, and what later ones took beyond one more than that.
    pub usual: u32,
    lost: u32,
}

impl Turns {
    /// Before any were made; they are worn after so many solves.
    pub fn new(worn: u32) -> Turns {
        Turns { worn, begun: 0, solves: 0, first: 0, grows: false, stale: true, usual: 0, lost: 0 }
    }

    /// Whether levels must be made at once.
    pub fn are_due_at_once(&self) -> bool {
        self.stale || self.lost >= AT_ONCE
    }

    /// Whether new levels are finished.
    pub fn are_finished(&self) -> bool {
        self.begun == TURNS
    }

    /// Whether a turn is to be made: some are, or levels are worn.
    pub fn are_due(&self) -> bool {
        self.begun > 0 || self.grows || self.solves >= self.worn
    }

    /// A turn is begun; whether it is the first one.
    pub fn begin(&mut self) -> bool {
        self.begun += 1;
        self.begun == 1
    }

    /// New levels are taken over.
    pub fn taken_over(&mut self) {
        (self.begun, self.solves, self.grows, self.stale) = (0, 0, false, false);
    }

    /// A solve ended, with levels made at once or not.
    pub fn solved(&mut self, iterations: u32, at_once: bool) {
        if self.solves == 0 {
            self.first = iterations;
        }
        self.solves += 1;
        self.grows = iterations > self.first;
        if at_once {
            (self.usual, self.lost) = (iterations, 0);
        } else {
            self.lost += iterations.saturating_sub(self.usual + 1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Solves until a turn is due, after levels were taken over, if they take so many iterations, the last one for good.
    fn until_due(iterations: &[u32]) -> usize {
        let mut turns = Turns::new(WORN);
        turns.taken_over();
        let last = iterations.last().expect("one at least");
        let solves = iterations.iter().chain(std::iter::repeat(last)).take(100);
        solves.take_while(|&&n| !(turns.are_due(), turns.solved(n, false)).0).count()
    }

    #[test]
    fn levels_stay_until_iterations_grow_or_they_are_old() {
        assert_eq!(until_due(&[3]), WORN as usize);
        assert_eq!(until_due(&[3, 2, 3, 1]), WORN as usize);
        assert_eq!(until_due(&[2, 2, 3]), 3);
    }

    #[test]
    fn turns_that_are_begun_go_on_until_they_are_finished() {
        let mut turns = Turns::new(WORN);
        turns.taken_over();
        turns.solved(2, true);
        turns.solved(3, false);
        assert!(turns.are_due() && turns.begin());
        turns.solved(1, false);
        for _ in 1..TURNS {
            assert!(turns.are_due() && !turns.are_finished() && !turns.begin());
        }
        assert!(turns.are_finished());
        turns.taken_over();
        assert!(!turns.are_due());
    }

    #[test]
    fn what_solves_lose_has_levels_made_at_once() {
        let mut turns = Turns::new(WORN);
        assert!(turns.are_due_at_once());
        turns.taken_over();
        turns.solved(4, true);
        for _ in 0..AT_ONCE {
            assert!(!turns.are_due_at_once());
            turns.solved(6, false);
        }
        assert!(turns.are_due_at_once());
    }
}
