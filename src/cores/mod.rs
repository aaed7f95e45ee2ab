//! A second core for a piece of work, or for halves of many short ones, where one is free.

mod beside;
mod team;

pub use beside::{Beside, Work};
pub use team::Team;

use std::{
    sync::{
        LazyLock, Mutex, MutexGuard,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
};

/// Pieces of work that run beside others at present, and threads that are at work of their own, in all sessions.
static BESIDE: AtomicUsize = AtomicUsize::new(0);
static AT_WORK: AtomicUsize = AtomicUsize::new(0);
/// Pieces that may: one core stays for the thread that asks.
static SPARE: LazyLock<usize> =
    LazyLock::new(|| thread::available_parallelism().map_or(1, |cores| cores.get()) - 1);

/// A core that nobody else has claimed, until it is dropped.
pub struct Core(());

/// Claims a core, if one is free.
pub fn claim() -> Option<Core> {
    let others = AT_WORK.load(Ordering::Relaxed).saturating_sub(1);
    let more = |used: usize| (used + others < *SPARE).then_some(used + 1);
    BESIDE.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).is_ok().then(|| Core(()))
}

/// Whether a thread that is not at work now would find a core for another one beside it.
pub fn has_room() -> bool {
    AT_WORK.load(Ordering::Relaxed) < *SPARE
}

/// A thread at work of its own, until it is dropped.
pub struct AtWork(());

/// Says that this thread is at work: others leave a core to it.
pub fn at_work() -> AtWork {
    AT_WORK.fetch_add(1, Ordering::Relaxed);
    AtWork(())
}

impl Drop for AtWork {
    fn drop(&mut self) {
        AT_WORK.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
impl Core {
    /// One more, whoever has claimed the others.
    pub fn another() -> Core {
        BESIDE.fetch_add(1, Ordering::Relaxed);
        Core(())
    }
}

impl Drop for Core {
    fn drop(&mut self) {
        BESIDE.fetch_sub(1, Ordering::Relaxed);
    }
}

fn hold<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().expect("nobody panics while holding it")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_more_cores_are_claimed_than_there_are() {
        let claimed: Vec<Core> = std::iter::from_fn(claim).take(1000).collect();
        assert!(claimed.len() <= *SPARE, "{} of {}", claimed.len(), *SPARE);
        // A claim that is refused gives nothing back.
        let held = BESIDE.load(Ordering::Relaxed);
        assert!(held >= claimed.len(), "{held} of {}", claimed.len());
    }

    #[test]
    fn the_cores_of_threads_at_work_are_not_claimed() {
        let all: Vec<AtWork> = (0..=*SPARE).map(|_| at_work()).collect();
        assert!(claim().is_none());
        drop(all);
    }
}
