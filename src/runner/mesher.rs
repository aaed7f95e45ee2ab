//! Keeps the mesh of a session adapted: threads beside the ticks look at copies of the state, prepare new meshes and make the steps on them
//! that the session makes meanwhile, so a tick only copies a state out or goes on as a world that is ready.

use crate::{
    adapt::{Prepared, Settings},
    metrics::SessionMetrics,
    successor::Successor,
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
    /// The world on a new mesh that catches up, and the time that it has taken from the ticks [s].
    successor: Option<Successor>,
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
        Mesher { look: None, successor: None, taken: 0.0, usual: 0.0, next: EVERY, old: None }
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
        if self.successor.is_none() {
            return;
        }
        let (start, before) = (Instant::now(), world.report().remeshing.changes);
        let old = Successor::before_step(&mut self.successor, world, commands, dt, solves);
        self.taken += start.elapsed().as_secs_f64();
        if self.successor.is_none() {
            metrics.mesh_changes.inc_by(world.report().remeshing.changes - before);
            metrics.adopt_seconds.observe(self.taken);
            self.old = old;
            self.next = world.report().time + EVERY;
        }
    }

    /// After a step of `dt` that took `cost` [s]: begins a change of the mesh that is ready, or a look that is due.
    pub fn end_step(&mut self, world: &mut World, cost: f64, dt: f64, metrics: &SessionMetrics) {
        self.usual += (cost - self.usual) * if self.usual > 0.0 { SMOOTHING } else { 1.0 };
        if world.report().resting {
            // No look comes while it sleeps.
            (self.old, self.successor) = (None, None);
        }
        if self.successor.is_some() {
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
                    Some(prepared) => self.change(world, prepared, dt, metrics),
                    None => world.keep_mesh(),
                }
            }
            Err(TryRecvError::Empty) => {}
            // The thread failed; the mesh stays as it is until the next look.
            Err(TryRecvError::Disconnected) => self.stop(world),
        }
    }

    /// Has another world change its mesh and catch up, where it can; else changes this one's at once.
    fn change(&mut self, world: &mut World, prepared: Prepared, dt: f64, metrics: &SessionMetrics) {
        if world.report().resting {
            return;
        }
        let start = Instant::now();
        if Successor::would_catch_up(&prepared, self.usual, dt) {
            // Without a thread the mesh stays as it is.
            self.successor = Successor::start(world.fork(), prepared).ok();
            self.taken = start.elapsed().as_secs_f64();
            return;
        }
        if let Some(old) = world.exchange(prepared) {
            self.old = Some(old);
            metrics.mesh_changes.inc();
        }
        metrics.adopt_seconds.observe(start.elapsed().as_secs_f64());
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
