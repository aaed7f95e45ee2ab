//! Keeps the mesh of a session adapted: a thread beside the ticks looks at copies of the state and prepares new meshes, so a tick
//! only copies a state out or adopts a mesh that is ready.

use crate::{
    adapt::{Prepared, Settings},
    metrics::SessionMetrics,
    world::{OldMesh, World},
};
use std::{
    sync::mpsc::{self, Receiver, TryRecvError},
    thread,
    time::Instant,
};

/// Simulated time from the end of one look at the mesh to the next [s].
const EVERY: f64 = 0.1;

/// What a look found, and how long it took [s].
type Look = (Option<Prepared>, f64);

/// The mesh's keeper.
pub(super) struct Mesher {
    look: Option<Receiver<Look>>,
    /// Simulated time of the next look [s].
    next: f64,
    /// What the last change of the mesh left behind, for the next look to free.
    old: Option<OldMesh>,
}

impl Mesher {
    /// Lets a world's mesh adapt, or keeps it as it is.
    pub fn new(world: &mut World, adaptive: bool) -> Mesher {
        world.set_adaptive(adaptive.then(|| Settings::of(world.method())));
        Mesher { look: None, next: EVERY, old: None }
    }

    /// After a tick: adopts what is ready, or begins a look that is due.
    pub fn tick(&mut self, world: &mut World, metrics: &SessionMetrics) {
        if world.report().resting {
            // No look comes while it sleeps.
            self.old = None;
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
                let Some(prepared) = found else { return world.keep_mesh() };
                let start = Instant::now();
                if let Some(old) = world.exchange(prepared) {
                    self.old = Some(old);
                    metrics.mesh_changes.inc();
                }
                metrics.adopt_seconds.observe(start.elapsed().as_secs_f64());
            }
            Err(TryRecvError::Empty) => {}
            // The thread failed; the mesh stays as it is until the next look.
            Err(TryRecvError::Disconnected) => self.stop(world),
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
