//! The path of a hand in time. Between poses the hand goes straight and evenly, and about an interval of its device late; else ticks
//! would find now one pose and now three, and the cloth would feel the hand stop and jump.

use super::mailbox::Pose;
use crate::math::Vec3;
use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

/// Longest time between poses of a hand that moves.
pub(super) const PAUSE: Duration = Duration::from_millis(50);
/// Part by which a pose that comes late puts off those after it, and one that comes early brings them forward.
const LATE: u32 = 16;
const EARLY: u32 = 256;
/// Intervals after it came by which the hand is at a pose at the latest.
const LATEST: u32 = 4;

/// A pose, and the time in which the hand goes there from the one before.
#[derive(Clone, Copy, Debug)]
struct Stop {
    pose: Pose,
    begin: Instant,
    end: Instant,
}

/// Poses of one hand, reached and to come.
#[derive(Debug, Default)]
pub(super) struct Path {
    /// Where the hand was last.
    reached: Option<Stop>,
    /// Where it is to go next; the earliest first.
    coming: VecDeque<Stop>,
    /// Until when it was followed.
    followed: Option<Instant>,
}

impl Path {
    /// The newest pose reached.
    pub(super) fn newest(&self) -> Option<&Pose> {
        self.reached.as_ref().map(|stop| &stop.pose)
    }
    /// For how long the hand has been on its way from there to the next pose.
    pub(super) fn past(&self) -> Duration {
        let way = self.coming.front().zip(self.followed);
        way.map_or(Duration::ZERO, |(next, now)| now.saturating_duration_since(next.begin))
    }
    /// Whether poses are to come.
    pub(super) fn goes_on(&self) -> bool {
        !self.coming.is_empty()
    }

    /// Takes the newest pose. After a pause it is reached at once: `go` is called with it.
    pub(super) fn take(&mut self, pose: Pose, go: impl FnMut([f64; 3])) {
        let before = self.coming.back().copied().or(self.reached);
        match before.filter(|before| pose.received - before.pose.received < PAUSE) {
            Some(before) => {
                let begin = self.followed.map_or(before.end, |followed| followed.max(before.end));
                self.coming.push_back(Stop { pose, begin, end: end(&before.pose, begin, &pose) });
            }
            None => {
                self.coming.push_back(Stop { pose, begin: pose.received, end: pose.received });
                self.finish(go);
            }
        }
    }

    /// Follows the path to where it is at `now`: calls `go` with each pose on it, and with the point between two.
    pub(super) fn follow(&mut self, now: Instant, mut go: impl FnMut([f64; 3])) {
        self.followed = Some(now);
        while let Some(stop) = self.coming.pop_front_if(|stop| stop.end <= now) {
            go(stop.pose.position);
            self.reached = Some(stop);
        }
        if let (Some(last), Some(next)) = (self.reached, self.coming.front())
            && next.begin < now
        {
            let part = (now - next.begin).div_duration_f64(next.end - next.begin);
            let [a, b] = [last.pose.position, next.pose.position].map(Vec3::from);
            go((a + (b - a) * part).into());
        }
    }

    /// Follows the path to its end at once.
    pub(super) fn finish(&mut self, mut go: impl FnMut([f64; 3])) {
        while let Some(stop) = self.coming.pop_front() {
            go(stop.pose.position);
            self.reached = Some(stop);
        }
    }
}

/// When the hand is to be at a pose, if it leaves for it at `begin`: after the time that passed on its client's clock, so that what
/// the way here did to their spacing is not felt, and on the average an interval after it came. Where poses came too late for that
/// the hand catches up, at twice its speed. A client whose clock stands still is followed as its poses come.
fn end(before: &Pose, begin: Instant, pose: &Pose) -> Instant {
    let step = Duration::from_micros(pose.t_us.saturating_sub(before.t_us)).min(PAUSE);
    let even = begin + step;
    let mean = pose.received + pose.interval;
    let end = if even > mean + pose.interval {
        mean.max(begin + step / 2)
    } else if even > mean {
        even - (even - mean) / EARLY
    } else {
        even + (mean - even) / LATE
    };
    end.clamp(pose.received, pose.received + pose.interval * LATEST).max(begin)
}
