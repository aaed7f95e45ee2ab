//! A second core for a piece of work, where one is free.

use std::{
    sync::{
        LazyLock, Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
};

/// Pieces of work that run beside others at present, in all sessions.
static BESIDE: AtomicUsize = AtomicUsize::new(0);
/// Pieces that may: one core stays for the thread that asks.
static SPARE: LazyLock<usize> =
    LazyLock::new(|| thread::available_parallelism().map_or(1, |cores| cores.get()) - 1);

/// A core that nobody else has claimed, until it is dropped.
pub struct Core(());

/// Claims a core, if one is free.
pub fn claim() -> Option<Core> {
    let more = |used: usize| (used < *SPARE).then_some(used + 1);
    BESIDE.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).is_ok().then_some(Core(()))
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

/// Does both at once, the second on the other core, which is free again after.
pub fn both<A, B: Send>(_core: Core, a: impl FnOnce() -> A, b: impl FnOnce() -> B + Send) -> (A, B) {
    // A thread that cannot be started leaves its work here.
    let waiting = Mutex::new(Some(b));
    let take = || waiting.lock().expect("nobody panics while holding it").take();
    thread::scope(|scope| {
        let beside = || take().map(|b| b());
        let started = thread::Builder::new().name("kesi-factor".into()).spawn_scoped(scope, beside);
        let a = a();
        let b = match started {
            Ok(thread) => thread.join().expect("factorizing never panics"),
            Err(_) => beside(),
        };
        (a, b.expect("done once"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_more_cores_are_claimed_than_there_are() {
        let claimed: Vec<Core> = std::iter::from_fn(claim).take(1000).collect();
        assert!(claimed.len() <= *SPARE, "{} of {}", claimed.len(), *SPARE);
        drop(claimed);
        assert_eq!(both(Core::another(), || 1, || 2), (1, 2));
    }
}
