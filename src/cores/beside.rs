//! A piece of work that goes to another core and comes back done.

use super::{Core, SPARE, claim, hold};
use std::{
    collections::VecDeque,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Condvar, LazyLock, Mutex},
    thread,
};

/// Something that can be worked on by whichever thread has it.
pub trait Work: Send + 'static {
    /// Does the work.
    fn work(&mut self);
}

/// A piece of work and its owner's way back to it: it is handed over whole, so nothing is shared meanwhile.
pub struct Beside<W>(Arc<Task<W>>);

struct Task<W> {
    place: Mutex<Place<W>>,
    done: Condvar,
}

/// Where a piece of work is.
enum Place<W> {
    /// With its owner, or lost to a panic.
    Absent,
    /// It waits for a core that is its own.
    Waiting(W, Core),
    /// Somebody is at it.
    Begun,
    /// Nobody need be.
    There(W),
}

/// What the threads below do.
pub(super) trait Run: Send + Sync {
    fn run(&self);
}

/// Work that waits for the threads below.
pub(super) struct Queue {
    waiting: Mutex<VecDeque<Arc<dyn Run>>>,
    more: Condvar,
}

/// One thread per spare core, asleep while there is nothing to do.
pub(super) static QUEUE: LazyLock<&'static Queue> = LazyLock::new(|| {
    let queue: &'static Queue =
        Box::leak(Box::new(Queue { waiting: Mutex::new(VecDeque::with_capacity(64)), more: Condvar::new() }));
    for _ in 0..*SPARE {
        // One that cannot be started is not missed: owners take back what nobody began.
        let thread = thread::Builder::new().name("kesi-beside".into());
        drop(thread.spawn(|| {
            loop {
                let first = queue.more.wait_while(hold(&queue.waiting), |waiting| waiting.is_empty());
                let first = first.expect("nobody panics while holding it").pop_front();
                first.expect("not empty").run();
            }
        }));
    }
    queue
});

impl Queue {
    /// Something for the next thread that has nothing to do.
    pub fn add(&self, run: Arc<dyn Run>) {
        hold(&self.waiting).push_back(run);
        self.more.notify_one();
    }

    /// Takes something back that nobody has begun.
    pub fn remove<R: Run>(&self, own: &Arc<R>) {
        let own = Arc::as_ptr(own).cast::<()>();
        hold(&self.waiting).retain(|run| Arc::as_ptr(run).cast::<()>() != own);
    }
}

impl<W: Work> Beside<W> {
    /// With its owner's work. The threads that may do it start now, not when a tick first finds a free core.
    pub fn new(work: W) -> Beside<W> {
        LazyLock::force(&QUEUE);
        Beside(Arc::new(Task { place: Mutex::new(Place::There(work)), done: Condvar::new() }))
    }

    /// Has the work done on another core, if one is free; else here and now.
    pub fn start(&self, mut work: W) {
        match claim() {
            Some(core) => {
                *hold(&self.0.place) = Place::Waiting(work, core);
                QUEUE.add(self.0.clone());
            }
            None => {
                work.work();
                self.put(work);
            }
        }
    }

    /// Keeps work that nobody needs to do.
    pub fn put(&self, work: W) {
        *hold(&self.0.place) = Place::There(work);
    }

    /// The work, done: waits for it, or does it here if nobody has begun.
    pub fn take(&self) -> W {
        let task = &*self.0;
        let place = task.done.wait_while(hold(&task.place), |place| matches!(place, Place::Begun));
        let mut place = place.expect("nobody panics while holding it");
        match std::mem::replace(&mut *place, Place::Absent) {
            Place::There(work) => work,
            Place::Waiting(mut work, _core) => {
                drop(place);
                QUEUE.remove(&self.0);
                work.work();
                work
            }
            Place::Absent | Place::Begun => panic!("work beside panicked, or was taken twice"),
        }
    }
}

impl<W: Work> Run for Task<W> {
    fn run(&self) {
        let mut place = hold(&self.place);
        // It may have been taken back.
        let (mut work, core) = match std::mem::replace(&mut *place, Place::Begun) {
            Place::Waiting(work, core) => (work, core),
            other => {
                *place = other;
                return;
            }
        };
        drop(place);
        // Who waits must not wait for ever.
        let done = catch_unwind(AssertUnwindSafe(|| work.work()));
        drop(core);
        *hold(&self.place) = if done.is_ok() { Place::There(work) } else { Place::Absent };
        self.done.notify_one();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Work for u32 {
        fn work(&mut self) {
            *self += 1;
        }
    }

    #[test]
    fn work_comes_back_done_once_whoever_did_it() {
        let beside = Beside::new(0);
        for done in 0..1000 {
            let work = beside.take();
            assert_eq!(work, done);
            // Sometimes nobody else has time for it.
            let claimed: Vec<Core> =
                std::iter::from_fn(claim).take(if done % 3 == 0 { 1000 } else { 0 }).collect();
            beside.start(work);
            drop(claimed);
        }
        assert_eq!(beside.take(), 1000);
    }

    struct Broken;

    impl Work for Broken {
        fn work(&mut self) {
            panic!("broken");
        }
    }

    #[test]
    fn a_panic_beside_is_the_owners() {
        let beside = Beside::new(Broken);
        let work = beside.take();
        *hold(&beside.0.place) = Place::Waiting(work, Core::another());
        beside.0.run();
        assert!(catch_unwind(AssertUnwindSafe(|| beside.take())).is_err());
    }
}
