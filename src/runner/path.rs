//! The path of a hand in time. Between poses the hand goes straight and evenly, and about an interval of its device late; else ticks
//! would find now one pose and now three, and the cloth would feel the hand stop and jump.

use super::mailbox::Pose;
use crate::math::Vec3;
use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

/// Longest time between poses of a hand that moves.
const PAUSE: Duration = Duration::from_millis(50);
/// Part by which a pose that comes late puts off those after it, and one that comes early brings them forward.
const LATE: u32 = 16;
const EARLY: u32 = 256;
/// Longest interval that the hand waits for, and intervals after it came by which it is at a pose at the latest, or a pause.
const LONGEST: Duration = Duration::from_millis(20);
const LATEST: u32 = 4;

/// How much faster than its poses the hand may go where the cloth could not follow in time, and the time [s] in which it makes good what
/// it is behind: a cloth that runs slow would else feel a hand as much faster, and run slower still.
const HASTE: f64 = 1.25;
const CATCH_UP: f64 = 0.2;
/// Time in which the speed of a hand that slows down is forgotten [s].
const MEMORY: f64 = 0.1;

/// A pose, and the time in which the hand goes there from the one before.
#[derive(Clone, Copy, Debug)]
struct Stop {
    pose: Pose,
    begin: Instant,
    end: Instant,
}

/// Poses of one hand, reached and to come.
#[derive(Clone, Debug, Default)]
pub(super) struct Path {
    /// When the newest pose came, unless what comes next begins anew.
    last: Option<Instant>,
    /// Where the hand was last.
    reached: Option<Stop>,
    /// Where it is to go next; the earliest first.
    coming: VecDeque<Stop>,
    /// Until when it was followed.
    followed: Option<Instant>,
    /// Where the hand was led.
    at: Vec3,
    /// How far it is behind its path [m].
    behind: f64,
    /// Its speed on the client's clock, the highest of late [m/s].
    speed: f64,
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
    /// Whether there is more of it to follow.
    pub(super) fn goes_on(&self) -> bool {
        !self.coming.is_empty() || self.behind > 0.0
    }

    /// Takes the newest pose, and returns the time between its coming and that of the one before. After a pause there is none, and the
    /// pose is reached at once: `go` is called with it.
    pub(super) fn take(&mut self, pose: Pose, go: impl FnMut([f64; 3])) -> Option<Duration> {
        let gap = self.last.replace(pose.received).map(|last| pose.received - last);
        let before = self.coming.back().copied().or(self.reached);
        let (Some(before), Some(gap)) = (before, gap.filter(|gap| *gap < PAUSE)) else {
            self.coming.push_back(Stop { pose, begin: pose.received, end: pose.received });
            self.speed = 0.0;
            self.finish(go);
            return None;
        };
        let begin = self.followed.map_or(before.end, |followed| followed.max(before.end));
        let step = step(&before.pose, &pose, gap);
        let seconds = if step.is_zero() { gap } else { step }.as_secs_f64();
        let speed = (Vec3::from(pose.position) - Vec3::from(before.pose.position)).norm() / seconds;
        let remembered = self.speed * (-seconds / MEMORY).exp();
        self.speed = if seconds > 0.0 { speed.max(remembered) } else { remembered };
        self.coming.push_back(Stop { pose, begin, end: end(begin, step, &pose) });
        Some(gap)
    }

    /// Follows the path to its end, and begins a new one with the next pose.
    pub(super) fn restart(&mut self, go: impl FnMut([f64; 3])) {
        self.finish(go);
        self.last = None;
    }

    /// Follows the path for a step of `dt` [s] to where it is at `now`: calls `go` with each pose on it, and with the point between two.
    pub(super) fn follow(&mut self, now: Instant, dt: f64, mut go: impl FnMut([f64; 3])) {
        // Never back, though another tick rate has other grid points.
        let now = self.followed.map_or(now, |followed| now.max(followed));
        self.followed = Some(now);
        let mut left = (HASTE * self.speed + self.behind / CATCH_UP) * dt;
        let was_behind = self.behind > 0.0;
        while let Some(stop) = self.coming.pop_front_if(|stop| stop.end <= now) {
            self.reached = Some(stop);
            if !was_behind {
                self.lead(stop.pose.position.into(), &mut left, &mut go);
            }
        }
        let Some(last) = self.reached else { return };
        let mut end = Vec3::from(last.pose.position);
        if let Some(next) = self.coming.front()
            && next.begin < now
        {
            let part = (now - next.begin).div_duration_f64(next.end - next.begin);
            end += (Vec3::from(next.pose.position) - end) * part;
        }
        if end != self.at {
            self.lead(end, &mut left, &mut go);
        }
    }

    /// Leads the hand to a point, or as far towards it as there is way left [m].
    fn lead(&mut self, to: Vec3, left: &mut f64, go: &mut impl FnMut([f64; 3])) {
        let way = to - self.at;
        let length = way.norm();
        self.behind = length - length.min(*left);
        self.at = if self.behind > 0.0 { self.at + way * (*left / length) } else { to };
        *left -= length - self.behind;
        go(self.at.into());
    }

    /// Follows the path to its end at once.
    pub(super) fn finish(&mut self, mut go: impl FnMut([f64; 3])) {
        let mut left = f64::INFINITY;
        while let Some(stop) = self.coming.pop_front() {
            self.lead(stop.pose.position.into(), &mut left, &mut go);
            self.reached = Some(stop);
        }
        if let Some(last) = self.reached.filter(|_| self.behind > 0.0) {
            self.lead(last.pose.position.into(), &mut left, &mut go);
        }
    }
}

/// Time between two poses on their client's clock; where that cannot be, the `gap` between their coming.
fn step(before: &Pose, pose: &Pose, gap: Duration) -> Duration {
    let step = Duration::from_micros(pose.t_us.saturating_sub(before.t_us));
    if step > gap * 2 + interval(pose) * LATEST { gap } else { step }
}

/// Time between poses of a device, as far as the hand waits for it.
fn interval(pose: &Pose) -> Duration {
    pose.interval.min(LONGEST)
}

/// When the hand is to be at a pose if it leaves for it at `begin`: `step` later, so that what the way here did to the spacing of poses is
/// not felt, and on the average an interval after it came. Where poses came too late for that the hand catches up, at twice its speed.
/// A client whose clock stands still is followed as its poses come.
fn end(begin: Instant, step: Duration, pose: &Pose) -> Instant {
    let interval = interval(pose);
    let (even, mean) = (begin + step, pose.received + interval);
    let end = if even > mean + interval {
        mean.max(begin + step / 2)
    } else if even > mean {
        even - (even - mean) / EARLY
    } else {
        even + (mean - even) / LATE
    };
    end.clamp(pose.received, pose.received + PAUSE.min(interval * LATEST)).max(begin)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runner::ClientId;

    const MS: Duration = Duration::from_millis(1);

    /// A hand along x, and what its path makes of it.
    struct Trial {
        start: Instant,
        path: Path,
        seq: u32,
    }

    impl Trial {
        fn new() -> Trial {
            Trial { start: Instant::now(), path: Path::default(), seq: 0 }
        }

        /// A pose at `x` [m], made and received at these times [s], of a device of 500 Hz; where the hand goes at once.
        fn pose(&mut self, x: f64, made: f64, received: f64) -> Option<f64> {
            self.seq += 1;
            let pose = Pose {
                client: ClientId(1),
                seq: self.seq,
                t_us: (made * 1e6).round() as u64,
                position: [x, 0.0, 0.0],
                received: self.start + Duration::from_secs_f64(received),
                interval: 2 * MS,
            };
            let mut at = None;
            self.path.take(pose, |p| at = Some(p[0]));
            at
        }

        /// Where the hand is at a time [s], after a step of 4 ms.
        fn at(&mut self, now: f64) -> f64 {
            let now = self.start + Duration::from_secs_f64(now);
            self.path.follow(now, 0.004, |_| {});
            self.path.at.x
        }
    }

    #[test]
    fn a_hand_goes_evenly_though_its_poses_do_not_come_so() {
        // Poses up to a millisecond late hardly show; one that is two more late now and then slows a step down.
        for (rare, most) in [(0.0, 0.02), (2e-3, 0.5)] {
            let mut trial = Trial::new();
            let (speed, mut sent, mut last) = (0.1, 0_u32, None);
            let late = |k: u32| {
                let rare = if k.is_multiple_of(97) { rare } else { 0.0 };
                [0.0, 5e-4, 9e-4, 2e-4, 1e-3][k as usize % 5] + rare
            };
            for tick in 1..500 {
                let now = 0.004 * f64::from(tick);
                while 0.002 * f64::from(sent) + late(sent) <= now {
                    let made = 0.002 * f64::from(sent);
                    trial.pose(speed * made, made, made + late(sent));
                    sent += 1;
                }
                let x = trial.at(now);
                let step = last.replace(x).map(|last| x - last);
                if tick > 50 {
                    let off = step.unwrap() / (0.004 * speed) - 1.0;
                    assert!(off.abs() < most, "a step of tick {tick} off by {off}");
                    let behind = now - x / speed;
                    assert!((0.002..0.006).contains(&behind), "{behind} s behind at tick {tick}");
                }
            }
            assert!(trial.path.goes_on());
            let end = 0.002 * f64::from(sent - 1);
            assert_eq!(trial.at(end + 0.02), end * speed, "it ends where it is led");
            assert!(!trial.path.goes_on() && trial.path.past().is_zero());
        }
    }

    #[test]
    fn a_pose_after_a_pause_is_reached_at_once() {
        let mut trial = Trial::new();
        assert_eq!(trial.pose(0.1, 0.0, 0.0), Some(0.1));
        assert_eq!(trial.pose(0.2, 1.0, 1.0), Some(0.2));
        assert_eq!(trial.pose(0.3, 1.002, 1.002), None);
        assert_eq!(trial.path.newest().unwrap().seq, 2);
        let on_the_way = trial.at(1.002);
        assert!(on_the_way > 0.2 && on_the_way < 0.3 && trial.at(1.001) == on_the_way, "never back");
        assert_eq!(trial.at(1.01), 0.3);
        assert_eq!(trial.path.newest().unwrap().seq, 3);
        trial.path.restart(|_| {});
        assert_eq!(trial.pose(0.9, 1.012, 1.012), Some(0.9), "another grab begins anew");
    }

    #[test]
    fn clocks_that_cannot_be_are_not_believed() {
        // It stands still, runs in nanoseconds, or backwards.
        for clock in [0.0, 1e3, -1.0] {
            let mut trial = Trial::new();
            for k in 0..200 {
                let t = 0.002 * f64::from(k);
                trial.pose(0.1 * t, 10.0 + clock * t, t);
                let behind = t - trial.at(t) / 0.1;
                assert!((-1e-9..0.01).contains(&behind), "{behind} s behind with a clock of {clock}");
            }
        }
    }

    #[test]
    fn a_cloth_that_runs_slow_feels_the_hand_hardly_faster() {
        let (mut trial, speed) = (Trial::new(), 0.1);
        let (mut sent, mut last) = (0, 0.0);
        // Steps of 4 ms take 20 ms each for half a second, which leaves the hand behind; then they keep up.
        for tick in 1..=600 {
            let now = if tick <= 25 { 0.02 * f64::from(tick) } else { 0.4 + 0.004 * f64::from(tick) };
            while 0.002 * f64::from(sent) <= now {
                let made = 0.002 * f64::from(sent);
                trial.pose(speed * made, made, made);
                sent += 1;
            }
            let x = trial.at(now);
            let most = (HASTE * speed + (speed * now - last) / CATCH_UP) * 0.004;
            assert!(x - last <= most + 1e-9, "{} m in tick {tick}", x - last);
            last = x;
            if tick == 25 {
                assert!(trial.path.behind > 0.01, "{} m behind", trial.path.behind);
                // What is grabbed next is not drawn to where the hand was to go.
                let mut path = trial.path.clone();
                path.restart(|_| {});
                assert!(!path.goes_on());
                path.follow(trial.start + 200 * MS * 5, 0.004, |p| panic!("led to {p:?}"));
            }
        }
        assert_eq!(trial.path.behind, 0.0, "and arrives");
    }

    #[test]
    fn a_path_that_ends_is_followed_to_its_end() {
        let mut trial = Trial::new();
        trial.pose(0.0, 0.0, 0.0);
        trial.pose(1e-3, 0.002, 0.002);
        let mut points = Vec::new();
        trial.path.finish(|p| points.push(p[0]));
        assert_eq!(points, [1e-3]);
        assert!(!trial.path.goes_on());
    }
}
