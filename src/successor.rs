//! A world on a new mesh that catches up beside the one it is to replace, so that no tick waits for the change.
//!
//! ```text
//! World ──fork──▶ Successor ── Fork::on(new mesh), then the steps the world makes meanwhile ──▶ succeed, between two ticks
//!       ──tell──▶
//! ```

use crate::{
    adapt::Prepared,
    cores,
    world::{Budget, Command, Declined, Fork, World},
};
use std::{
    io,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
        mpsc::{self, Receiver, Sender},
    },
    thread::{self, JoinHandle},
};

/// Part of a period that a step on the new mesh may take: else, beside the world, it would hardly catch up.
const SHARE: f64 = 0.7;
/// Steps after which the world waits for it all the same.
const PATIENCE: u64 = 32;

/// The world that comes.
pub struct Successor {
    shared: Arc<Shared>,
    steps: Option<Sender<Step>>,
    thread: Option<JoinHandle<()>>,
    /// Steps told, the change itself among them.
    told: u64,
}

struct Shared {
    /// Steps made.
    made: AtomicU64,
    /// What came of the change; `None` before, and when it is taken.
    fate: Mutex<Option<Result<World, Declined>>>,
}

/// A step of the world.
struct Step {
    commands: Vec<Command>,
    dt: f64,
    solves: u32,
}

impl Successor {
    /// Whether one would catch up with a world that makes steps of `dt` [s], no faster than that, and takes `cost` [s] for one; and whether
    /// there is a core for it.
    pub fn would_catch_up(prepared: &Prepared, cost: f64, dt: f64) -> bool {
        cores::has_room() && prepared.price * cost <= SHARE * dt
    }

    /// Begins a change of the mesh, on a thread of its own.
    pub fn start(fork: Fork, prepared: Prepared) -> io::Result<Successor> {
        let shared = Arc::new(Shared { made: AtomicU64::new(0), fate: Mutex::new(None) });
        let (steps, told) = mpsc::channel();
        let own = shared.clone();
        let thread = thread::Builder::new()
            .name("kesi-successor".into())
            .spawn(move || own.live(fork, prepared, &told))?;
        Ok(Successor { shared, steps: Some(steps), thread: Some(thread), told: 1 })
    }

    /// Before a step of a world that may have a successor: lets it succeed if it has caught up, or tells it the step. Gives the world that is
    /// left behind to whoever has time to free it.
    pub fn before_step(
        own: &mut Option<Successor>,
        world: &mut World,
        commands: &[Command],
        dt: f64,
        solves: u32,
    ) -> Option<World> {
        let successor = own.as_mut()?;
        let Some(fate) = successor.arrived() else {
            successor.tell(commands, dt, solves);
            return None;
        };
        *own = None;
        match fate {
            Ok(mut heir) => {
                world.succeed(&mut heir);
                Some(heir)
            }
            Err(declined) => {
                world.decline(declined);
                None
            }
        }
    }

    /// Tells it a step that the world is about to make.
    fn tell(&mut self, commands: &[Command], dt: f64, solves: u32) {
        let step = Step { commands: commands.to_vec(), dt, solves };
        // One whose mesh was declined listens no more.
        let _over = self.steps.as_ref().map(|steps| steps.send(step));
        self.told += 1;
    }

    /// What came of the change, once it has made all steps; waits for it when that takes too long. Nothing is left to come then.
    fn arrived(&mut self) -> Option<Result<World, Declined>> {
        let is_level = self.shared.made.load(Ordering::Acquire) >= self.told;
        if !is_level && self.told <= PATIENCE {
            return None;
        }
        // Its thread ends when it has made what it was told.
        self.steps = None;
        if let Some(thread) = self.thread.take().filter(|_| !is_level) {
            // One that panicked leaves nothing.
            let _panic = thread.join();
        }
        let fate = self.shared.fate.lock().unwrap_or_else(PoisonError::into_inner).take();
        Some(fate.unwrap_or(Err(Declined::Late)))
    }
}

impl Shared {
    fn live(&self, fork: Fork, prepared: Prepared, steps: &Receiver<Step>) {
        let fate = || self.fate.lock().unwrap_or_else(PoisonError::into_inner);
        let changed = fork.on(prepared);
        let declined = changed.is_err();
        *fate() = Some(changed);
        self.made.store(if declined { u64::MAX } else { 1 }, Ordering::Release);
        while let Ok(Step { commands, dt, solves }) = steps.recv() {
            // It may have been taken.
            let Some(Ok(world)) = &mut *fate() else { return };
            world.step(&commands, dt, Budget::solves(solves));
            self.made.fetch_add(1, Ordering::Release);
        }
    }
}
