//! Absolute deadlines: ticks lie on a grid in time, and those whose time has passed are counted, never run.

use std::time::{Duration, Instant};

/// The grid of ticks of a session.
#[derive(Clone, Copy, Debug)]
pub struct Schedule {
    period: Duration,
    last: Instant,
}

impl Schedule {
    /// A grid whose next tick is due at once.
    pub fn due_at(now: Instant, period: Duration) -> Schedule {
        Schedule { period, last: now.checked_sub(period).unwrap_or(now) }
    }
    /// Goes on from the last grid point with another period.
    pub fn set_period(&mut self, period: Duration) {
        self.period = period;
    }
    /// When the present tick was due.
    pub fn now(&self) -> Instant {
        self.last
    }
    /// When the next tick is due; also the end of the present tick's time.
    pub fn deadline(&self) -> Instant {
        self.last + self.period
    }
    /// Begins the tick of the newest grid point at or before `now`; returns how many grid points that passes, at least 1.
    pub fn begin(&mut self, now: Instant) -> u32 {
        let gone = now.saturating_duration_since(self.last).as_nanos() / self.period.as_nanos().max(1);
        let slots = u32::try_from(gone).unwrap_or(u32::MAX).max(1);
        self.last += self.period * slots;
        slots
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_late_tick_stays_on_the_grid_and_passes_the_missed_ones() {
        let (start, ms) = (Instant::now() + Duration::from_secs(1), Duration::from_millis(1));
        let mut schedule = Schedule::due_at(start, 4 * ms);
        assert_eq!(schedule.begin(start), 1);
        assert_eq!(schedule.begin(start + 5 * ms), 1);
        assert_eq!(schedule.deadline(), start + 8 * ms);
        assert_eq!(schedule.begin(start + 23 * ms), 4);
        assert_eq!(schedule.deadline(), start + 24 * ms);
    }

    #[test]
    fn another_period_goes_on_from_the_last_tick() {
        let (start, ms) = (Instant::now() + Duration::from_secs(1), Duration::from_millis(1));
        let mut schedule = Schedule::due_at(start, 4 * ms);
        schedule.begin(start);
        schedule.set_period(10 * ms);
        assert_eq!(schedule.deadline(), start + 10 * ms);
        schedule.set_period(ms);
        assert_eq!(schedule.begin(start + 3 * ms), 3);
        assert_eq!(schedule.deadline(), start + 4 * ms);
    }
}
