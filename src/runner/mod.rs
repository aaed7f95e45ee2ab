//! A session's thread: the only clock. It takes requests, steps the world, and publishes; it never waits for a socket,
//! a disk or a log.
//!
//! ```text
//! sockets ──post──▶ Mailbox ──take──▶ Runner::tick ── World::step ──▶ watch<Tick>      newest wins
//!                                                                └──▶ watch<Picture>   encoded once, only if wanted
//! ```
//!
//! At rest, with nothing to do, it sleeps without a time-out.

mod hand;
mod ladder;
mod mailbox;
mod mesher;
mod path;
mod picture;
mod schedule;

pub use hand::Made;
pub use ladder::{Ladder, Rung};
pub use mailbox::{ClientId, Full, Granted, Mailbox, Pose, Refusal, Request};
pub use picture::{Painter, Picture};

use crate::{
    config::Pace,
    metrics::SessionMetrics,
    phase::{Phase, Stopwatch, Watch},
    protocol::haptic::{Level, Status},
    recording::Recorder,
    world::{Budget, Command, OBSERVATION, Outcome, Report, World},
};
use hand::Hand;
use mailbox::Woke;
use mesher::Mesher;
use schedule::Schedule;
use std::{
    cell::Cell,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
    thread,
    time::{Duration, Instant},
};
use tokio::sync::{broadcast, watch};

/// The newest state, for sockets and snapshots.
#[derive(Clone, Debug)]
pub struct Tick {
    /// Ticks run so far.
    pub number: u64,
    /// What the step did.
    pub report: Report,
    /// Server time of the state, since the session began [µs].
    pub server_us: u64,
    /// Time the step took [ms].
    pub solve_ms: f64,
    /// The client whose hand holds a particle.
    pub holder: Option<ClientId>,
    /// Its newest move that the state includes.
    pub newest_move: Option<Made>,
    /// Number of the mesh.
    pub epoch: u32,
    /// Ticks so far in which the contact set changed.
    pub contact_changes: u64,
    /// The tick rate now, and who solves.
    pub rung: Rung,
    /// Ticks per second, measured over the last tenths of a second [Hz].
    pub measured_hz: f64,
}

impl Tick {
    /// Of a world that has not been stepped yet.
    pub fn first(world: &World, rung: Rung) -> Tick {
        Tick {
            number: 0,
            report: world.report().clone(),
            server_us: 0,
            solve_ms: 0.0,
            holder: None,
            newest_move: None,
            epoch: world.grid().epoch,
            contact_changes: 0,
            rung,
            measured_hz: rung.tick_hz,
        }
    }
}

/// Why a session ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// Somebody ended it.
    Deleted,
    /// The server is shutting down.
    Shutdown,
    /// Its thread failed, with these words.
    Failed(String),
}

/// What a session's thread shares with the rest of the server.
#[derive(Debug)]
pub struct Shared {
    /// The way in.
    pub mailbox: Mailbox,
    /// The newest state.
    pub ticks: watch::Sender<Arc<Tick>>,
    /// The newest encoded frame.
    pub pictures: watch::Sender<Option<Arc<Picture>>>,
    /// What all clients are told.
    pub status: broadcast::Sender<Status>,
    /// Set once, when the session ends.
    pub end: watch::Sender<Option<End>>,
    /// True when the thread is gone and its recording is finished.
    pub stopped: watch::Sender<bool>,
    /// What is counted.
    pub metrics: SessionMetrics,
}

impl Shared {
    /// Channels around a world that has not been stepped yet.
    pub fn new(world: &World, rung: Rung, metrics: SessionMetrics) -> Shared {
        metrics.tick_rate.set(rung.tick_hz);
        let tick = Tick::first(world, rung);
        Shared {
            mailbox: Mailbox::default(),
            ticks: watch::Sender::new(Arc::new(tick)),
            pictures: watch::Sender::new(None),
            status: broadcast::Sender::new(16),
            end: watch::Sender::new(None),
            stopped: watch::Sender::new(false),
            metrics,
        }
    }

    /// Ends the session; the first reason stays.
    pub fn finish(&self, end: End) {
        self.end.send_if_modified(|now| {
            let first = now.is_none();
            if first {
                *now = Some(end);
            }
            first
        });
        self.mailbox.stop();
    }

    fn tell(&self, level: Level, code: &str, message: String) {
        let _ = self.status.send(Status { level, code: code.into(), message });
    }
}

/// Starts the thread of a session.
pub fn spawn(
    id: &str,
    world: World,
    recorder: Option<Recorder>,
    pace: Pace,
    ladder: Ladder,
    shared: Arc<Shared>,
) -> std::io::Result<()> {
    thread::Builder::new().name(format!("kesi-{id}")).spawn(move || {
        guarded(&shared, || Runner::new(world, recorder, pace, ladder, &shared).live());
    })?;
    Ok(())
}

/// Runs the life of a session; a panic ends the session, not the server, and its words go to the clients.
fn guarded(shared: &Shared, life: impl FnOnce()) {
    if let Err(panic) = catch_unwind(AssertUnwindSafe(life)) {
        let words = panic.downcast_ref::<String>().map(String::as_str);
        let words = words.or(panic.downcast_ref::<&str>().copied()).unwrap_or("no words");
        tracing::error!("a session failed: {words}");
        shared.finish(End::Failed(words.into()));
    }
    shared.stopped.send_replace(true);
}

struct Runner<'a> {
    world: World,
    recorder: Option<Recorder>,
    pace: Pace,
    ladder: Ladder,
    shared: &'a Shared,
    began: Instant,
    hand: Hand,
    mesher: Mesher,
    painter: Painter,
    tick: Tick,
    speed: Speed,
    stopwatch: Stopwatch,
    was_finite: bool,
    recording_failed: bool,
}

impl<'a> Runner<'a> {
    fn new(
        mut world: World,
        recorder: Option<Recorder>,
        pace: Pace,
        ladder: Ladder,
        shared: &'a Shared,
    ) -> Runner<'a> {
        let tick = Tick::clone(&shared.ticks.borrow());
        let began = Instant::now();
        let mesher = Mesher::new(&mut world, pace.adaptive);
        world.observe_every(OBSERVATION);
        Runner {
            world,
            recorder,
            pace,
            ladder,
            shared,
            began,
            hand: Hand::default(),
            mesher,
            painter: Painter::default(),
            tick,
            speed: Speed::new(began),
            stopwatch: Stopwatch::default(),
            was_finite: true,
            recording_failed: false,
        }
    }

    fn live(mut self) {
        let mut schedule = Schedule::due_at(Instant::now(), self.period());
        loop {
            if self.tick.report.resting && !self.hand.goes_on() {
                let (woke, slept) = self.sleep();
                if woke == Woke::Stop {
                    break;
                }
                if slept >= self.period() {
                    schedule = Schedule::due_at(Instant::now(), self.period());
                    self.speed = Speed::new(Instant::now());
                }
            }
            if self.shared.mailbox.wait_until(schedule.deadline()) {
                break;
            }
            let slots = schedule.begin(Instant::now());
            self.tick(slots, &schedule);
            schedule.set_period(self.period());
        }
        if let Some(recorder) = self.recorder.take() {
            recorder.finish();
        }
    }

    /// Time between ticks now.
    fn period(&self) -> Duration {
        Duration::from_secs_f64(1.0 / self.ladder.rung().tick_hz)
    }

    /// Sleeps until there is a request or the end; paints for viewers that come meanwhile. Returns the time slept.
    fn sleep(&mut self) -> (Woke, Duration) {
        let from = Instant::now();
        loop {
            match self.shared.mailbox.sleep() {
                Woke::Frame => self.paint_if_wanted(),
                woke => {
                    let slept = from.elapsed();
                    let ticks = slept.as_secs_f64() * self.ladder.rung().tick_hz;
                    self.shared.metrics.slept_ticks.inc_by(ticks as u64);
                    return (woke, slept);
                }
            }
        }
    }

    /// Runs the present tick of a schedule and those of the `slots` grid points whose time has passed: together they cover the time gone
    /// in steps of a period, as far as the longest step allows. One long step would cost more than they do, and the next be as late. Where
    /// ticks overrun, the missed ones are lost: the hand would be asked for once in several steps, and what it feels as old as they take.
    fn tick(&mut self, slots: u32, schedule: &Schedule) {
        let period = self.period();
        let most = (self.pace.longest_step_s / period.as_secs_f64()).floor().max(1.0);
        let steps = if self.ladder.overruns() { 1 } else { slots.min(most as u32) };
        self.shared.metrics.missed_ticks.inc_by(u64::from(slots - 1));
        let mail = self.shared.mailbox.take();
        self.shared.metrics.poses_dropped.inc_by(mail.poses_dropped);
        let mut commands = self.hand.commands(&self.world, mail.requests, self.recorder.as_mut());
        // Where time is lost the hand is led to where it is now, and else evenly from grid point to grid point.
        let begin = Instant::now();
        let end = if steps < slots { begin } else { schedule.now() };
        for left in (0..steps).rev() {
            let due = end - period * slots * left / steps;
            self.hand.follow(due, period.as_secs_f64(), &mut commands);
            self.step(&commands, period, due + period);
            commands.clear();
            if begin.elapsed() > period * slots {
                break;
            }
        }
        self.paint_if_wanted();
    }

    /// Runs one step over a period, of commands in order, that should end by `deadline`.
    fn step(&mut self, commands: &[Command], period: Duration, deadline: Instant) {
        let start = Instant::now();
        let metrics = &self.shared.metrics;
        // Solves beyond the least are made in spare time, which is no cost: from its begin to its end. None begins that would not
        // end in time, were it as long as the least ones were.
        let (solves, least) = (self.pace.solves, self.ladder.rung().least);
        let spare = Cell::new(None);
        let stop = || {
            let now = Instant::now();
            let (begin, end) = spare.get().unwrap_or((now, now));
            spare.set(Some((begin, if end < deadline { now } else { end })));
            now + (begin - start) / least > deadline
        };
        let dt = period.as_secs_f64();
        self.mesher.begin_step(&mut self.world, commands, dt, least, metrics);
        self.stopwatch.start();
        let ended = |phase| self.stopwatch.ended(phase);
        let watch = Watch(Some(&ended));
        let budget = Budget { least, stop: Some(&stop), watch, ..Budget::solves(solves) };
        let report = self.world.step(commands, dt, budget).clone();
        metrics.add_phases(&self.stopwatch);
        let solve_ms = start.elapsed().as_secs_f64() * 1e3;
        let spare = spare.get().map_or(0.0, |(begin, end): (Instant, Instant)| (end - begin).as_secs_f64());
        let cost = solve_ms * 1e-3 - spare - self.stopwatch.lap(Phase::Rest).seconds;
        if self.ladder.tick(cost, self.hand.poses_hz()) {
            self.world.set_method(self.ladder.rung().method);
        }
        self.publish(report, start, solve_ms);
        self.record(start);
        self.mesher.end_step(&mut self.world, cost, dt, &self.shared.metrics);
        self.watch_speed(start, dt);
        self.shared.metrics.tick_seconds.observe(start.elapsed().as_secs_f64());
    }

    fn publish(&mut self, report: Report, start: Instant, solve_ms: f64) {
        let metrics = &self.shared.metrics;
        metrics.steps.inc();
        metrics.solves.inc_by(u64::from(report.solves));
        metrics.resting.set(i64::from(report.resting));
        metrics.particles_active.set(report.particles_active as i64);
        let finite = report.outcome != Outcome::NotFinite;
        if !finite {
            metrics.not_finite.inc();
            if self.was_finite {
                let words = "a number was not finite; the step was taken back and the cloth stays as it was";
                self.shared.tell(Level::Error, "not_finite", words.into());
            }
        }
        self.was_finite = finite;
        let before = &self.tick.report;
        if report.hand_blocked && !before.hand_blocked {
            let words = "an obstacle is in the hand's way: it goes along the surface as near as it gets";
            self.shared.tell(Level::Warning, "hand_blocked", words.into());
        }
        if report.obstacle_blocked && !before.obstacle_blocked {
            let words = "cloth that is held fast is in an obstacle's way: it goes as far as the cloth allows";
            self.shared.tell(Level::Warning, "obstacle_blocked", words.into());
        }
        let before = self.tick.rung;
        self.tick = Tick {
            number: self.tick.number + 1,
            server_us: (start - self.began).as_micros() as u64,
            solve_ms,
            holder: self.hand.holder(),
            newest_move: self.hand.newest_move(),
            epoch: self.world.grid().epoch,
            contact_changes: self.tick.contact_changes + u64::from(report.contact_changed),
            rung: self.ladder.rung(),
            measured_hz: self.speed.measured_hz(start, self.tick.measured_hz),
            report,
        };
        let now = self.tick.rung;
        self.shared.ticks.send_replace(Arc::new(self.tick.clone()));
        // Told after it is published: who comes meanwhile hears it in the hello.
        if now != before {
            metrics.tick_rate.set(now.tick_hz);
            let words = format!("{} instead of {} ticks per second", now.tick_hz, before.tick_hz);
            self.shared.tell(Level::Info, "tick_rate", words);
        }
    }

    fn record(&mut self, start: Instant) {
        let Some(recorder) = &mut self.recorder else { return };
        recorder.record(&self.world, start.elapsed().as_secs_f64() * 1e3);
        let status = recorder.status();
        self.shared.metrics.recording_dropped.set(status.dropped() as i64);
        if let (Some(error), false) = (status.error(), self.recording_failed) {
            self.recording_failed = true;
            self.shared.tell(Level::Warning, "recording_failed", error);
        }
    }

    fn paint_if_wanted(&mut self) {
        if self.shared.mailbox.take_frame_wanted() {
            let picture = self.painter.paint(&self.world, &self.tick);
            self.shared.pictures.send_replace(Some(picture));
            self.shared.metrics.frames_encoded.inc();
        }
    }

    fn watch_speed(&mut self, now: Instant, dt: f64) {
        match self.speed.passed(now, dt) {
            Some(Change::Slow(part)) => self.shared.tell(
                Level::Warning,
                "slow",
                format!(
                    "steps take longer than their ticks: the cloth runs at {:.0} % of real time",
                    part * 100.0
                ),
            ),
            Some(Change::Keeps) => {
                self.shared.tell(Level::Info, "keeps_up", "the cloth runs in real time again".into());
            }
            None => {}
        }
    }
}

/// Measures ticks per second, and simulated against real time over windows of a few seconds.
struct Speed {
    previous: Option<Instant>,
    window: Instant,
    simulated: f64,
    slow: bool,
}

enum Change {
    Slow(f64),
    Keeps,
}

impl Speed {
    /// Real time over which simulated time is compared [s].
    const WINDOW: f64 = 3.0;
    /// Real time over which the rate of ticks is smoothed [s].
    const SMOOTHING: f64 = 0.2;

    fn new(now: Instant) -> Speed {
        Speed { previous: None, window: now, simulated: 0.0, slow: false }
    }

    /// Smoothed rate [Hz], given the one before.
    fn measured_hz(&mut self, now: Instant, before: f64) -> f64 {
        let Some(gone) = self.previous.replace(now).map(|p| (now - p).as_secs_f64()) else { return before };
        let part = 1.0 - (-gone / Self::SMOOTHING).exp();
        1.0 / ((1.0 - part) / before + part * gone.max(1e-6))
    }

    /// Adds a step of `dt` [s]; says when the cloth falls behind or keeps up again.
    fn passed(&mut self, now: Instant, dt: f64) -> Option<Change> {
        self.simulated += dt;
        let real = (now - self.window).as_secs_f64();
        if real < Self::WINDOW {
            return None;
        }
        let part = self.simulated / real;
        (self.window, self.simulated) = (now, 0.0);
        let slow = part < 0.9;
        let changed = slow != self.slow;
        self.slow = slow;
        changed.then_some(if slow { Change::Slow(part) } else { Change::Keeps })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{metrics::Metrics, scene::Scene, world::Method};

    const RUNG: Rung = Rung { tick_hz: 100.0, method: Method::Fronts, least: 1, expense: 1.0 };

    #[test]
    fn a_panic_ends_the_session_with_its_words() {
        let scene = Scene { particles: [4, 4], ..Scene::default() };
        let world = World::new(scene.setup().unwrap()).unwrap();
        let shared = Shared::new(&world, RUNG, Metrics::default().session("test"));
        guarded(&shared, || panic!("particle {} is lost", 3));
        assert_eq!(*shared.end.borrow(), Some(End::Failed("particle 3 is lost".into())));
        assert!(*shared.stopped.borrow());
        shared.finish(End::Shutdown);
        assert_eq!(
            *shared.end.borrow(),
            Some(End::Failed("particle 3 is lost".into())),
            "the first reason stays"
        );
    }

    #[test]
    fn falling_behind_is_told_once_and_keeping_up_again_too() {
        let start = Instant::now();
        let mut speed = Speed::new(start);
        let mut told = Vec::new();
        let mut now = start;
        for (count, part) in [(500, 0.5), (500, 0.5), (500, 1.0), (500, 1.0)] {
            for _ in 0..count {
                now += Duration::from_millis(10);
                told.extend(speed.passed(now, 0.01 * part));
            }
        }
        assert!(matches!(told[..], [Change::Slow(part), Change::Keeps] if (part - 0.5).abs() < 0.01));
    }
}
