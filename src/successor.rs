//! A world on a new mesh that catches up beside the one it is to replace, so that no tick waits for the change.
//!
//! ```text
//! World ──fork──▶ Successor: Fork::on(new mesh), then the steps that the world makes meanwhile ──▶ World::succeed, between two steps
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
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc::{self, Receiver, Sender},
    },
    thread,
};

/// Part of a period that a step on the new mesh may take: beside the world it would else hardly catch up.
const SHARE: f64 = 0.75;
/// Steps within which it must.
const PATIENCE: u64 = 32;

/// Changes of a world's mesh, one at a time.
#[derive(Default)]
pub struct Changes {
    successor: Option<Successor>,
    /// Whether the last one failed: the next is made at once, so that not all do.
    failed: bool,
}

/// The world that comes, on a thread of its own.
struct Successor {
    shared: Arc<Shared>,
    steps: Sender<Step>,
    /// Steps told, the change itself among them.
    told: u64,
}

#[derive(Default)]
struct Shared {
    /// Steps made.
    made: AtomicU64,
    /// Whether nobody waits for it any more.
    over: AtomicBool,
    /// What came of the change; `None` before, and when it is taken.
    fate: Mutex<Option<Result<World, Declined>>>,
}

/// A step of the world.
struct Step {
    commands: Vec<Command>,
    dt: f64,
    solves: u32,
}

impl Changes {
    /// Whether one is under way.
    pub fn is_under_way(&self) -> bool {
        self.successor.is_some()
    }

    /// Begins a change between two steps of `dt` [s] that come no faster than that and take `cost` [s]: beside them, if there is a core for it
    /// and what comes can catch up, else at once. Gives the world that is left behind to whoever has time to free it.
    pub fn begin(&mut self, world: &mut World, prepared: Prepared, cost: f64, dt: f64) -> Option<World> {
        let catches_up = prepared.price * cost <= SHARE * dt && cores::has_room();
        if world.report().resting || self.failed || !catches_up {
            self.failed = false;
            return world.exchange(prepared);
        }
        // Without a thread the mesh stays as it is until the next time.
        self.successor = Successor::start(world.fork(), prepared).ok();
        self.failed = self.successor.is_none();
        None
    }

    /// Before a step: goes on as the world on the new mesh if it has caught up, or tells it the step. Gives the world that is left behind
    /// to whoever has time to free it.
    pub fn before_step(
        &mut self,
        world: &mut World,
        commands: &[Command],
        dt: f64,
        solves: u32,
    ) -> Option<World> {
        let successor = self.successor.as_mut()?;
        let Some(fate) = successor.fate() else {
            successor.tell(Step { commands: commands.to_vec(), dt, solves });
            return None;
        };
        self.successor = None;
        match fate {
            Ok(mut heir) => {
                self.failed = !world.succeed(&mut heir);
                Some(heir)
            }
            Err(declined) => {
                world.decline(declined);
                self.failed = true;
                None
            }
        }
    }

    /// Gives up what is under way.
    pub fn give_up(&mut self) {
        self.successor = None;
    }
}

impl Successor {
    fn start(fork: Fork, prepared: Prepared) -> io::Result<Successor> {
        let shared = Arc::new(Shared::default());
        let (steps, told) = mpsc::channel();
        let own = shared.clone();
        let thread = thread::Builder::new().name("kesi-successor".into());
        thread.spawn(move || own.live(fork, prepared, &told))?;
        Ok(Successor { shared, steps, told: 1 })
    }

    fn tell(&mut self, step: Step) {
        // One whose mesh was declined listens no more.
        let _declined = self.steps.send(step);
        self.told += 1;
    }

    /// What came of the change, once it has made all steps that it was told, or too many to wait for more.
    fn fate(&self) -> Option<Result<World, Declined>> {
        if self.shared.made.load(Ordering::Acquire) >= self.told {
            // A thread that panicked leaves nothing.
            Some(self.shared.hold().take().unwrap_or(Err(Declined::Late)))
        } else {
            (self.told > PATIENCE).then_some(Err(Declined::Late))
        }
    }
}

impl Drop for Successor {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::Relaxed);
    }
}

impl Shared {
    fn hold(&self) -> MutexGuard<'_, Option<Result<World, Declined>>> {
        self.fate.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn live(&self, fork: Fork, prepared: Prepared, steps: &Receiver<Step>) {
        let changed = fork.on(prepared);
        let is_declined = changed.is_err();
        *self.hold() = Some(changed);
        self.made.store(if is_declined { u64::MAX } else { 1 }, Ordering::Release);
        while let Ok(Step { commands, dt, solves }) = steps.recv() {
            // It may have been taken.
            let Some(Ok(world)) = &mut *self.hold() else { return };
            if self.over.load(Ordering::Relaxed) {
                return;
            }
            world.step(&commands, dt, Budget::solves(solves));
            self.made.fetch_add(1, Ordering::Release);
        }
    }
}
