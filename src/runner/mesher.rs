//! Keeps the mesh of a session adapted: threads beside the ticks look at copies of the state, prepare new meshes and make the steps on them
//! that the session makes meanwhile, so a tick only copies a state out or goes on as a world that is ready.

use crate::{
    adapt::{Prepared, Settings},
    metrics::SessionMetrics,
    successor::Changes,
    world::{Command, World},
};
use std::{
    sync::mpsc::{self, Receiver, TryRecvError},
    thread,
    time::Instant,
};

/// Simulated time from the end of one look at the mesh to the next [s].
const EVERY: f64 = 0.1;

/// Weight of a step's time in the usual one.
const SMOOTHING: f64 = 0.1;

/// What a look found, and how long it took [s].
type Look = (Option<Prepared>, f64);

/// The mesh's keeper.
pub(super) struct Mesher {
    look: Option<Receiver<Look>>,
    /// What is prepared, and the time that it has taken from the ticks [s].
    changes: Changes,
    taken: f64,
    /// Time that steps usually take [s].
    usual: f64,
    /// Simulated time of the next look [s].
    next: f64,
    /// What the last change of the mesh left behind, for the next look to free.
    old: Option<World>,
}

impl Mesher {
    /// Lets a world's mesh adapt, or keeps it as it is.
    pub fn new(world: &mut World, adaptive: bool) -> Mesher {
        world.set_adaptive(adaptive.then(|| Settings::of(world.method())));
        Mesher { look: None, changes: Changes::default(), taken: 0.0, usual: 0.0, next: EVERY, old: None }
    }

    /// Before a step of `dt` [s] with so many solves at the least: goes on as the world on a new mesh that has caught up, or tells it the step.
    pub fn begin_step(
        &mut self,
        world: &mut World,
        commands: &[Command],
        dt: f64,
        solves: u32,
        metrics: &SessionMetrics,
    ) {
        if self.changes.is_under_way() {
            self.time(world, metrics, |changes, world| changes.before_step(world, commands, dt, solves));
        }
    }

    /// After a step of `dt` that took `cost` [s]: begins a change of the mesh that is ready, or a look that is due.
    pub fn end_step(&mut self, world: &mut World, cost: f64, dt: f64, metrics: &SessionMetrics) {
        self.usual += (cost - self.usual) * if self.usual > 0.0 { SMOOTHING } else { 1.0 };
        if world.report().resting {
            // No look comes while it sleeps.
            (self.old, self.taken) = (None, 0.0);
            self.changes.give_up();
        }
        if self.changes.is_under_way() {
            return;
        }
        let Some(look) = &self.look else {
            if world.report().time >= self.next {
                self.begin(world);
            }
            return;
        };
        match look.try_recv() {
            Ok((found, seconds)) => {
                metrics.remesh_seconds.observe(seconds);
                self.stop(world);
                match found {
                    Some(prepared) => {
                        let usual = self.usual;
                        self.time(world, metrics, |changes, world| changes.begin(world, prepared, usual, dt));
                    }
                    None => world.keep_mesh(),
                }
            }
            Err(TryRecvError::Empty) => {}
            // The thread failed; the mesh stays as it is until the next look.
            Err(TryRecvError::Disconnected) => self.stop(world),
        }
    }

    /// Does what a change asks for between two steps, and takes its time.
    fn time(
        &mut self,
        world: &mut World,
        metrics: &SessionMetrics,
        work: impl FnOnce(&mut Changes, &mut World) -> Option<World>,
    ) {
        let (start, before) = (Instant::now(), world.report().remeshing.changes);
        let left = work(&mut self.changes, world);
        self.old = left.or(self.old.take());
        self.taken += start.elapsed().as_secs_f64();
        if !self.changes.is_under_way() {
            metrics.mesh_changes.inc_by(world.report().remeshing.changes - before);
            metrics.adopt_seconds.observe(std::mem::take(&mut self.taken));
            self.next = world.report().time + EVERY;
        }
    }

    fn stop(&mut self, world: &World) {
        (self.look, self.next) = (None, world.report().time + EVERY);
    }

    fn begin(&mut self, world: &World) {
        self.next = world.report().time + EVERY;
        let old = self.old.take();
        let Some(mut probe) = world.probe() else { return };
        // Another rate may have brought another solver.
        probe.settings = Settings::of(probe.method);
        let (found, look) = mpsc::channel();
        let work = move || {
            drop(old);
            let start = Instant::now();
            let prepared = probe.prepare();
            // Nobody waits for it when the session has ended.
            let _ended = found.send((prepared, start.elapsed().as_secs_f64()));
        };
        // Without a thread the mesh stays as it is.
        self.look = thread::Builder::new().name("kesi-mesh".into()).spawn(work).ok().map(|_| look);
    }
}
