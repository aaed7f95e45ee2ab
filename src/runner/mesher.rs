//! Keeps the mesh of a session adapted: a thread beside the ticks looks at copies of the state and prepares new meshes, so a tick
//! only copies a state out or adopts a mesh that is ready.

use crate::{
    adapt::{Prepared, Settings},
    metrics::SessionMetrics,
    world::World,
};
use std::{
    sync::mpsc::{self, Receiver, TryRecvError},
    thread,
    time::Instant,
};

/// Ticks from one look at the mesh to the next.
const EVERY: u32 = 8;

/// What a look found, and how long it took [s].
type Look = (Option<Prepared>, f64);

/// The mesh's keeper.
pub(super) struct Mesher {
    look: Option<Receiver<Look>>,
    /// Ticks until the next look.
    wait: u32,
}

impl Mesher {
    /// Lets a world's mesh adapt, or keeps it as it is.
    pub fn new(world: &mut World, adaptive: bool) -> Mesher {
        world.set_adaptive(adaptive.then(Settings::default));
        Mesher { look: None, wait: EVERY }
    }

    /// After a tick: adopts what is ready, or begins a look that is due.
    pub fn tick(&mut self, world: &mut World, metrics: &SessionMetrics) {
        let Some(look) = &self.look else {
            self.wait = self.wait.saturating_sub(1);
            if self.wait == 0 {
                self.begin(world);
            }
            return;
        };
        match look.try_recv() {
            Ok((found, seconds)) => {
                metrics.remesh_seconds.observe(seconds);
                self.stop();
                let Some(prepared) = found else { return world.keep_mesh() };
                let start = Instant::now();
                if world.adopt(prepared) {
                    metrics.mesh_changes.inc();
                }
                metrics.adopt_seconds.observe(start.elapsed().as_secs_f64());
            }
            Err(TryRecvError::Empty) => {}
            // The thread failed; the mesh stays as it is until the next look.
            Err(TryRecvError::Disconnected) => self.stop(),
        }
    }

    fn stop(&mut self) {
        (self.look, self.wait) = (None, EVERY);
    }

    fn begin(&mut self, world: &World) {
        self.wait = EVERY;
        let Some(probe) = world.probe() else { return };
        let (found, look) = mpsc::channel();
        let work = move || {
            let start = Instant::now();
            let prepared = probe.prepare();
            // Nobody waits for it when the session has ended.
            let _ended = found.send((prepared, start.elapsed().as_secs_f64()));
        };
        // Without a thread the mesh stays as it is.
        self.look = thread::Builder::new().name("kesi-mesh".into()).spawn(work).ok().map(|_| look);
    }
}
