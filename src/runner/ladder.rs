//! The tick rate of a session: a ladder of rates, and the rung whose ticks fit. Costs go in, a rung comes out; it reads no clock.

use crate::world::Method;

/// One rate, and who solves its ticks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rung {
    /// Ticks per second [Hz].
    pub tick_hz: f64,
    /// Who solves the linear systems.
    pub method: Method,
    /// Linear solves per tick that time does not end.
    pub least: u32,
    /// What its ticks were measured to cost at the start [s].
    pub expense: f64,
}

/// Where a session stands on its ladder.
#[derive(Clone, Debug)]
pub struct Ladder {
    /// The slowest first.
    rungs: Vec<Rung>,
    at: usize,
    /// Cost of the tick before [s].
    last: f64,
    window: Window,
    /// Awake time [s] with room until a faster rung is tried.
    patience: f64,
    /// Awake time on this rung [s].
    held: f64,
}

/// Ticks that are judged together.
#[derive(Clone, Copy, Debug)]
struct Window {
    /// Awake time that they took [s].
    time: f64,
    ticks: u32,
    /// Those that did not end in time, and the cheapest of them [s].
    late: u32,
    least: f64,
    /// Those that would leave the faster rung that needs the least of its time no room.
    tight: u32,
}

const FRESH: Window = Window { time: 0.0, ticks: 0, late: 0, least: f64::INFINITY, tight: 0 };
/// Share of ticks that may be late: p99 is in time.
const LATE: f64 = 0.01;
/// Share of a faster rung's period that ticks may be expected to take when it is tried.
const ROOM: f64 = 0.8;
/// Ticks after which their mean tells whether they overrun, and how many periods it is then.
const TOLD: u32 = 8;
const OVERRUN: f64 = 1.5;
/// Ticks per pose of the hand at the most: a tick without one feels the hand stop, and the next one that it jumps. Below 2, so that
/// ticks do not come twice as often as poses; 60 poses per second bear 100 ticks.
const PER_POSE: f64 = 1.8;
/// Patience at first [s], and at most: it doubles each time a rung does not hold for as long as that.
const PATIENCE: f64 = 1.0;
const LONGEST_PATIENCE: f64 = 64.0;

impl Ladder {
    /// A ladder of at least one rung, the slowest first; begins on the fastest that is expected to fit.
    pub fn new(rungs: Vec<Rung>) -> Ladder {
        let at = rungs.iter().rposition(|rung| rung.expense * rung.tick_hz <= ROOM).unwrap_or(0);
        Ladder { rungs, at, last: 0.0, window: FRESH, patience: PATIENCE, held: 0.0 }
    }

    /// The present rung.
    pub fn rung(&self) -> Rung {
        self.rungs[self.at]
    }

    /// Takes the cost of a tick [s], and how often poses of the hand come [Hz], where that is known; true when the rung changed. What hits
    /// one tick alone (another process, a new mesh) does not count: of two ticks in a row the cheaper one does.
    pub fn tick(&mut self, cost: f64, poses_hz: Option<f64>) -> bool {
        let cost = cost.min(std::mem::replace(&mut self.last, cost));
        let rung = self.rungs[self.at];
        let follows = |rung: &Rung| poses_hz.is_none_or(|hz| rung.tick_hz <= PER_POSE * hz);
        // Not always the next: a faster rung may have the quicker solver.
        let load = |k: &usize| self.rungs[*k].expense * self.rungs[*k].tick_hz;
        let faster = (self.at + 1..self.rungs.len()).filter(|k| follows(&self.rungs[*k]));
        let faster = faster.min_by(|a, b| load(a).total_cmp(&load(b)));
        let time = cost.max(1.0 / rung.tick_hz);
        self.held += time;
        let window = &mut self.window;
        window.time += time;
        window.ticks += 1;
        if cost * rung.tick_hz > 1.0 {
            window.late += 1;
            window.least = window.least.min(cost);
        }
        if faster.is_some_and(|k| cost / rung.expense * load(&k) > ROOM) {
            window.tight += 1;
        }
        // So many are late by chance in a window of this length where p99 is in time.
        let mean = LATE * f64::from(window.ticks);
        let allowed = mean + 2.0 * mean.sqrt() + 1.0;
        if f64::from(window.late) > allowed && self.at > 0 {
            let fits = |rung: &Rung| window.least * rung.tick_hz <= 1.0;
            let fitting = self.rungs[..self.at].iter().rposition(fits).unwrap_or(0);
            let before = if self.held < LONGEST_PATIENCE { self.patience } else { PATIENCE };
            self.patience = (2.0 * before).min(LONGEST_PATIENCE);
            return self.change(fitting);
        }
        if self.at > 0 && !follows(&rung) {
            return self.change(self.rungs[..self.at].iter().rposition(follows).unwrap_or(0));
        }
        if window.time < self.patience {
            return false;
        }
        if let Some(faster) = faster
            && f64::from(window.tight) <= allowed
        {
            return self.change(faster);
        }
        self.window = FRESH;
        false
    }

    /// Whether ticks take so much longer than their period that to make missed ones as well would put off all that come.
    pub fn overruns(&self) -> bool {
        let periods = self.window.time * self.rung().tick_hz;
        self.window.ticks >= TOLD && periods > OVERRUN * f64::from(self.window.ticks)
    }

    fn change(&mut self, to: usize) -> bool {
        (self.at, self.held, self.last, self.window) = (to, 0.0, 0.0, FRESH);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATES: [f64; 3] = [50.0, 100.0, 1000.0];

    fn ladder(parts: [f64; 3], cost: f64) -> Ladder {
        let rungs = RATES.into_iter().zip(parts);
        let rung = |(tick_hz, part)| Rung { tick_hz, method: Method::Fronts, least: 1, expense: cost * part };
        Ladder::new(rungs.map(rung).collect())
    }

    /// Rates and times [s] of the changes that ticks of this cost bring within a time [s].
    fn changes(ladder: &mut Ladder, seconds: f64, cost: impl Fn(f64) -> f64) -> Vec<(f64, f64)> {
        let (mut told, mut now) = (Vec::new(), 0.0);
        while now < seconds {
            let period = 1.0 / ladder.rung().tick_hz;
            let cost = cost(period);
            now += period.max(cost);
            if ladder.tick(cost, None) {
                told.push((ladder.rung().tick_hz, now));
            }
        }
        told
    }

    #[test]
    fn a_session_starts_at_the_fastest_rate_that_leaves_room() {
        let starts = |cost| ladder([2.0, 2.0, 1.0], cost).rung().tick_hz;
        assert_eq!([1e-4, 9e-4, 3e-3, 5e-3, 1.0].map(starts), [1000.0, 100.0, 100.0, 50.0, 50.0]);
    }

    #[test]
    fn ticks_that_do_not_fit_slow_down_at_once_to_a_rate_that_does() {
        let mut ladder = ladder([1.0; 3], 1e-4);
        let told = changes(&mut ladder, 1.0, |_| 0.015);
        assert_eq!(told.len(), 1, "{told:?}");
        assert!(told[0].0 == 50.0 && told[0].1 < 0.1, "{told:?}");
    }

    #[test]
    fn room_for_a_while_makes_ticks_faster_a_rung_at_a_time() {
        let mut ladder = ladder([1.0; 3], 1.0);
        let told = changes(&mut ladder, 5.0, |_| 5e-4);
        assert_eq!(told.iter().map(|t| t.0).collect::<Vec<_>>(), [100.0, 1000.0]);
        assert!(told[0].1 >= 1.0 && told[1].1 >= 2.0, "{told:?}");
    }

    #[test]
    fn a_rate_without_room_is_passed_over_for_a_faster_one_with_a_quicker_solver() {
        let mut ladder = ladder([2.0, 2.0, 0.1], 0.01);
        let cost = |period: f64| if period < 0.005 { 4e-4 } else { 9e-3 };
        let told = changes(&mut ladder, 5.0, cost);
        assert_eq!(told.iter().map(|t| t.0).collect::<Vec<_>>(), [1000.0]);
    }

    #[test]
    fn a_rate_that_does_not_hold_is_tried_ever_less_often() {
        // What short ticks are expected to cost is wrong here.
        let mut ladder = ladder([2.0, 2.0, 0.1], 1.0);
        let told = changes(&mut ladder, 120.0, |period| if period < 0.005 { 0.002 } else { 0.006 });
        let tries: Vec<f64> = told.iter().filter(|t| t.0 == 1000.0).map(|t| t.1).collect();
        assert!((4..=7).contains(&tries.len()), "{told:?}");
        assert!(tries.windows(3).all(|t| t[2] - t[1] > 1.5 * (t[1] - t[0])), "{tries:?}");
    }

    #[test]
    fn late_ticks_that_come_alone_change_nothing() {
        let mut ladder = ladder([1.0; 3], 1e-4);
        for k in 0..10_000 {
            assert!(!ladder.tick(if k % 20 == 0 { 0.01 } else { 5e-4 }, Some(1000.0)));
        }
        assert_eq!(ladder.rung().tick_hz, 1000.0);
    }

    #[test]
    fn ticks_do_not_outrun_the_hand() {
        let mut ladder = ladder([1.0; 3], 1e-4);
        assert!(ladder.tick(1e-4, Some(60.0)));
        assert_eq!(ladder.rung().tick_hz, 100.0);
        assert!((0..1000).all(|_| !ladder.tick(1e-4, Some(60.0))));
        assert!((0..1000).any(|_| ladder.tick(1e-4, None)));
        assert_eq!(ladder.rung().tick_hz, 1000.0);
    }

    #[test]
    fn ticks_overrun_where_most_are_too_long_but_not_by_chance() {
        let rung = Rung { tick_hz: 250.0, method: Method::Fronts, least: 1, expense: 1.0 };
        let overruns = |cost: fn(u32) -> f64| {
            let mut ladder = Ladder::new(vec![rung]);
            (0..2000).filter(|k| ladder.tick(cost(*k), None) || ladder.overruns()).count()
        };
        assert_eq!(overruns(|k| if k % 10 == 0 { 0.05 } else { 0.003 }), 0);
        assert_eq!(overruns(|_| 0.005), 0);
        // All but the first of each window, which lasts for a second.
        assert!(overruns(|_| 0.008) > 1850);
    }

    #[test]
    fn a_single_rate_stays() {
        let rung = Rung { tick_hz: 400.0, method: Method::Fronts, least: 1, expense: 1.0 };
        let mut ladder = Ladder::new(vec![rung]);
        assert!(changes(&mut ladder, 3.0, |_| 0.1).is_empty());
        assert!(changes(&mut ladder, 3.0, |_| 1e-5).is_empty());
    }
}
