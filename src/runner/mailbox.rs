//! The way into a session's thread: requests in order, bounded; a bell that rings only when the thread sleeps.

use crate::protocol::haptic::{At, Denied};
use nalgebra::Isometry3;
use std::{
    collections::VecDeque,
    mem,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};
use tokio::sync::oneshot;

/// Control requests that may wait; a grab beyond them closes its client.
const CONTROLS: usize = 256;
/// Hand poses that may wait; beyond them the oldest goes. A device at 1 kHz sends four in a tick of 4 ms.
const POSES: usize = 512;

/// Number of a client, unique in its session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ClientId(pub u64);

/// A hand pose on its way to a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Whose.
    pub client: ClientId,
    /// Number of the move.
    pub seq: u32,
    /// The client's clock [µs].
    pub t_us: u64,
    /// Position [m].
    pub position: [f64; 3],
    /// When it came.
    pub received: Instant,
    /// Time between poses of its device.
    pub interval: Duration,
}

/// The answer to a grab that was taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Granted {
    /// The particle.
    pub particle: [usize; 2],
    /// Where it is [m].
    pub position: [f64; 3],
}

/// The answer to a grab that was not taken.
#[derive(Clone, Debug, PartialEq)]
pub struct Refusal {
    /// Why, for programs.
    pub code: Denied,
    /// Why, for people.
    pub message: String,
}

/// What sockets ask of a session's thread.
#[derive(Debug)]
pub enum Request {
    /// A client takes a particle.
    Grab {
        /// Whose hand.
        client: ClientId,
        /// Which particle.
        at: At,
        /// Where the answer goes.
        reply: oneshot::Sender<Result<Granted, Refusal>>,
    },
    /// A client moves its hand.
    Move(Pose),
    /// An obstacle is to go somewhere.
    Push {
        /// Its place in the setup.
        obstacle: usize,
        /// World from obstacle.
        pose: Isometry3<f64>,
        /// Time it takes [s].
        duration: f64,
        /// Where the answer goes.
        reply: oneshot::Sender<Result<(), String>>,
    },
    /// A client opens its hand, or lost it.
    Release {
        /// Whose hand.
        client: ClientId,
        /// True: the particle is free; false: it stays pinned.
        let_go: bool,
        /// Why, for the recording.
        why: &'static str,
    },
}

/// More control requests wait than the mailbox holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Full;

/// Why a sleeping thread woke.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Woke {
    /// The session is to end.
    Stop,
    /// Requests came.
    Requests,
    /// A viewer needs the present frame; nothing else happened.
    Frame,
}

/// The way into a session's thread.
#[derive(Debug, Default)]
pub struct Mailbox {
    inbox: Mutex<Inbox>,
    bell: Condvar,
}

#[derive(Debug, Default)]
struct Inbox {
    requests: VecDeque<Request>,
    poses: usize,
    poses_dropped: u64,
    frame_wanted: bool,
    asleep: bool,
    stopped: bool,
}

/// What a tick takes out of the mailbox.
#[derive(Debug, Default)]
pub struct Mail {
    /// Requests in the order they came.
    pub requests: VecDeque<Request>,
    /// Poses that were dropped for want of room.
    pub poses_dropped: u64,
}

impl Mailbox {
    fn lock(&self) -> MutexGuard<'_, Inbox> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn ring(&self, inbox: MutexGuard<'_, Inbox>) {
        if inbox.asleep {
            self.bell.notify_all();
        }
    }

    /// Leaves a request. Poses push out the oldest pose when there are too many; a release always finds room, because
    /// each needs a grab before it.
    pub fn post(&self, request: Request) -> Result<(), Full> {
        let mut inbox = self.lock();
        if matches!(request, Request::Move(_)) {
            if inbox.poses == POSES {
                let oldest = inbox.requests.iter().position(|r| matches!(r, Request::Move(_)));
                oldest.and_then(|k| inbox.requests.remove(k));
                inbox.poses -= 1;
                inbox.poses_dropped += 1;
            }
            inbox.poses += 1;
        } else if matches!(request, Request::Grab { .. } | Request::Push { .. })
            && inbox.requests.len() - inbox.poses >= CONTROLS
        {
            return Err(Full);
        }
        inbox.requests.push_back(request);
        self.ring(inbox);
        Ok(())
    }

    /// Asks for a frame: of the next tick, or of the present state when the thread sleeps.
    pub fn want_frame(&self) {
        let mut inbox = self.lock();
        inbox.frame_wanted = true;
        self.ring(inbox);
    }

    /// Ends the thread.
    pub fn stop(&self) {
        self.lock().stopped = true;
        self.bell.notify_all();
    }

    /// Waits for a deadline; true when the session is to end.
    pub fn wait_until(&self, deadline: Instant) -> bool {
        let mut inbox = self.lock();
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            if inbox.stopped || left.is_zero() {
                return inbox.stopped;
            }
            inbox = self.bell.wait_timeout(inbox, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Sleeps, without a time-out, until there is something to do.
    pub fn sleep(&self) -> Woke {
        let mut inbox = self.lock();
        inbox.asleep = true;
        loop {
            let woke = if inbox.stopped {
                Some(Woke::Stop)
            } else if !inbox.requests.is_empty() {
                Some(Woke::Requests)
            } else {
                inbox.frame_wanted.then_some(Woke::Frame)
            };
            if let Some(woke) = woke {
                inbox.asleep = false;
                return woke;
            }
            inbox = self.bell.wait(inbox).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Takes all requests.
    pub fn take(&self) -> Mail {
        let mut inbox = self.lock();
        inbox.poses = 0;
        Mail { requests: mem::take(&mut inbox.requests), poses_dropped: mem::take(&mut inbox.poses_dropped) }
    }

    /// True once after a frame was asked for.
    pub fn take_frame_wanted(&self) -> bool {
        mem::take(&mut self.lock().frame_wanted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(seq: u32) -> Request {
        let (client, received, interval) = (ClientId(1), Instant::now(), Duration::ZERO);
        Request::Move(Pose { client, seq, t_us: 0, position: [0.0; 3], received, interval })
    }

    #[test]
    fn a_flood_of_poses_keeps_the_newest() {
        let mailbox = Mailbox::default();
        (0..POSES as u32 + 3).for_each(|seq| mailbox.post(pose(seq)).unwrap());
        let mail = mailbox.take();
        assert_eq!((mail.requests.len(), mail.poses_dropped), (POSES, 3));
        assert!(matches!(mail.requests[0], Request::Move(Pose { seq: 3, .. })));
    }

    #[test]
    fn controls_are_bounded_and_poses_do_not_count_as_controls() {
        let mailbox = Mailbox::default();
        let release = || Request::Release { client: ClientId(1), let_go: false, why: "test" };
        (0..10).for_each(|seq| mailbox.post(pose(seq)).unwrap());
        (0..CONTROLS).for_each(|_| mailbox.post(release()).unwrap());
        let grab =
            || Request::Grab { client: ClientId(1), at: At::Particle([0, 0]), reply: oneshot::channel().0 };
        assert_eq!(mailbox.post(grab()), Err(Full));
        assert_eq!(mailbox.post(release()), Ok(()));
        mailbox.take();
        assert_eq!(mailbox.post(grab()), Ok(()));
    }

    #[test]
    fn a_sleeping_thread_wakes_for_a_frame_a_request_and_the_end() {
        let mailbox = Mailbox::default();
        mailbox.want_frame();
        assert_eq!(mailbox.sleep(), Woke::Frame);
        assert!(mailbox.take_frame_wanted() && !mailbox.take_frame_wanted());
        mailbox.post(pose(1)).unwrap();
        assert_eq!(mailbox.sleep(), Woke::Requests);
        mailbox.stop();
        assert_eq!(mailbox.sleep(), Woke::Stop);
    }
}
