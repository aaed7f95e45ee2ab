//! A helper that stays awake for halves of many short pieces of work.

use super::{
    Core,
    beside::{QUEUE, Run},
    claim, hold,
};
use crate::math::pack::{instructions, with_instructions};
use std::{
    hint, mem,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, LazyLock, Mutex,
        atomic::{AtomicBool, AtomicU8, AtomicUsize, Ordering},
    },
    thread,
};

/// A thread's helper for work that comes in two halves. From `call` to `dismiss` it stays awake on a core that is its own, where one is free:
/// handing it a half then takes less than a microsecond, waking a thread fifty or more. The core may be another program's all the same: a half
/// that the helper has not begun when the other is done is taken back, and a helper that is kept from one it has begun is let go for a while.
#[derive(Default)]
pub struct Team(Arc<Helper>);

#[derive(Default)]
struct Helper {
    /// One of the states below.
    at: AtomicU8,
    /// The half that it is lent.
    half: Mutex<Option<&'static mut (dyn FnMut() + Send)>>,
    /// Whether a half panicked.
    broke: AtomicBool,
    /// Its core while it is called.
    core: Mutex<Option<Core>>,
    /// Work for which it does not come yet when called, and for how much since it was kept from a half.
    deaf: AtomicUsize,
    rest: AtomicUsize,
    /// Held by the thread that helps.
    attended: Mutex<()>,
}

/// Nobody helps; somebody should; somebody waits for a half.
const AWAY: u8 = 0;
const CALLED: u8 = 1;
const HERE: u8 = 2;
/// Somebody is lending it a half, or is about to let it wait for the next; it may begin; it is at it; it has done it.
const KEPT: u8 = 3;
const LENT: u8 = 4;
const BUSY: u8 = 5;
const DONE: u8 = 6;

/// Looks at a state that does not change after which a waiting thread lets others on its core: about 20 µs. So many times that for one half
/// say that the helper is not running.
const LOOKS: u32 = 1000;
const LATE: u32 = 200;
/// Work for which it does not come then, the first time and at the most: some 20 and 160 ms of one thread, for large meshes as for small
/// ones.
const FIRST_REST: usize = 400_000;
const LONGEST_REST: usize = 3_200_000;

/// A half in the helper's hands; it comes back whatever happens.
struct Loan<'a>(&'a Helper);

impl Team {
    /// One whose helper nobody calls.
    pub fn nobody() -> &'static Team {
        static NOBODY: LazyLock<Team> = LazyLock::new(Team::default);
        &NOBODY
    }

    /// Has a helper come, if there is none, a core is free and the last one was not kept from its work a moment ago. `work` is what there is
    /// to do until the next call, in particles of an iteration.
    pub fn call(&self, work: usize) {
        if self.0.at.load(Ordering::Relaxed) != AWAY {
            return;
        }
        let less = |deaf: usize| (deaf > 0).then(|| deaf.saturating_sub(work));
        if self.0.deaf.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less).is_ok() {
            return;
        }
        if let Some(core) = claim() {
            *hold(&self.0.core) = Some(core);
            self.0.at.store(CALLED, Ordering::Release);
            QUEUE.add(self.0.clone());
        }
    }

    /// Lets the helper go.
    pub fn dismiss(&self) {
        if self.0.goes(CALLED, AWAY) {
            QUEUE.remove(&self.0);
        } else if self.0.goes(HERE, AWAY) {
            let rest = self.0.rest.load(Ordering::Relaxed);
            self.0.rest.store(rest - rest / 8, Ordering::Relaxed);
        } else {
            return;
        }
        hold(&self.0.core).take();
    }

    /// Does both, the other one on the helper's core if it has come; else one after the other. A panic of either is the caller's.
    pub fn both(&self, one: impl FnOnce(), other: impl FnOnce() + Send) {
        let helper = &*self.0;
        if !helper.goes(HERE, KEPT) {
            one();
            other();
            return;
        }
        let (mut other, instructions) = (Some(other), instructions());
        let mut half = || other.take().into_iter().for_each(|other| with_instructions(instructions, other));
        let half: &mut (dyn FnMut() + Send) = &mut half;
        // SAFETY: what is borrowed outlives the loan. It is used only by who takes it out of `half`: the caller here, or the helper between
        // `BUSY` and `DONE`, and `Loan` does not let this function end before it is out of the helper's hands, not by a panic either.
        let half =
            unsafe { mem::transmute::<&mut (dyn FnMut() + Send), &'static mut (dyn FnMut() + Send)>(half) };
        *hold(&helper.half) = Some(half);
        helper.at.store(LENT, Ordering::Release);
        let loan = Loan(helper);
        one();
        if let Some(half) = loan.take_back() {
            half();
        }
        let is_late = loan.wait();
        drop(loan);
        if is_late {
            helper.rest();
            self.dismiss();
        }
    }
}

impl Drop for Team {
    fn drop(&mut self) {
        self.dismiss();
    }
}

impl Loan<'_> {
    /// The half, if it was not begun.
    fn take_back(&self) -> Option<&'static mut (dyn FnMut() + Send)> {
        if self.0.goes(LENT, KEPT) { hold(&self.0.half).take() } else { None }
    }

    /// Waits until the half is done, if it was begun; whether that took so long that the helper cannot have been running.
    fn wait(&self) -> bool {
        let mut looks = 0;
        while self.0.at.load(Ordering::Acquire) == BUSY {
            pass(&mut looks);
        }
        looks >= LATE * LOOKS
    }
}

impl Drop for Loan<'_> {
    fn drop(&mut self) {
        self.take_back();
        self.wait();
        self.0.at.store(HERE, Ordering::Release);
        if self.0.broke.swap(false, Ordering::Relaxed) && !thread::panicking() {
            panic!("the other half panicked");
        }
    }
}

/// Passes a moment.
fn pass(looks: &mut u32) {
    *looks = looks.wrapping_add(1);
    if looks.is_multiple_of(LOOKS) { thread::yield_now() } else { hint::spin_loop() }
}

impl Helper {
    /// Goes from one state to another, if that is where it is.
    fn goes(&self, from: u8, to: u8) -> bool {
        self.at.compare_exchange(from, to, Ordering::AcqRel, Ordering::Relaxed).is_ok()
    }

    /// Does not hear calls for a while, and for longer the more often that happens.
    fn rest(&self) {
        let rest = (2 * self.rest.load(Ordering::Relaxed)).clamp(FIRST_REST, LONGEST_REST);
        self.rest.store(rest, Ordering::Relaxed);
        self.deaf.store(rest, Ordering::Relaxed);
    }
}

impl Run for Helper {
    fn run(&self) {
        // One helps already: it has not noticed yet that it could have gone.
        let Ok(_attended) = self.attended.try_lock() else { return };
        let mut looks = 0;
        loop {
            match self.at.load(Ordering::Acquire) {
                AWAY => return,
                CALLED => {
                    self.goes(CALLED, HERE);
                }
                LENT if self.goes(LENT, BUSY) => {
                    let half = hold(&self.half).take().expect("lent before");
                    // Who waits must not wait for ever.
                    if catch_unwind(AssertUnwindSafe(half)).is_err() {
                        self.broke.store(true, Ordering::Relaxed);
                    }
                    self.at.store(DONE, Ordering::Release);
                    looks = 0;
                }
                _ => pass(&mut looks),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    /// A team whose helper has come.
    fn team() -> Team {
        let team = Team::default();
        *hold(&team.0.core) = Some(Core::another());
        team.0.at.store(CALLED, Ordering::Release);
        let helper = team.0.clone();
        thread::spawn(move || helper.run());
        while team.0.at.load(Ordering::Acquire) != HERE {
            hint::spin_loop();
        }
        team
    }

    #[test]
    fn halves_are_both_done_with_and_without_a_helper() {
        for team in [team(), Team::default()] {
            let (mut one, mut other) = (0, 0);
            for _ in 0..10_000 {
                team.both(|| one += 1, || other += 2);
            }
            assert_eq!([one, other], [10_000, 20_000]);
            team.dismiss();
            team.both(|| one += 1, || other += 2);
            assert_eq!([one, other], [10_001, 20_002]);
        }
    }

    /// Does one half once the helper has begun the other.
    fn there(team: &Team, one: impl FnOnce(), other: impl FnOnce() + Send) {
        let begun = || {
            while team.0.at.load(Ordering::Relaxed) == LENT {
                hint::spin_loop();
            }
        };
        team.both(|| (begun(), one()).1, other);
    }

    #[test]
    fn a_helper_has_a_thread_of_its_own_and_comes_again() {
        let team = team();
        let here = thread::current().id();
        let mut done = Vec::new();
        there(&team, || (), || done.push(thread::current().id()));
        team.dismiss();
        team.both(|| (), || done.push(thread::current().id()));
        assert!(done.len() == 2 && done[0] != here && done[1] == here, "{done:?}");
        // However often it is called, and whether or not it comes in time, it holds one core at the most.
        for _ in 0..1000 {
            team.call(1);
            team.call(1);
            team.both(|| (), || ());
            team.dismiss();
        }
        assert!(hold(&team.0.core).is_none());
    }

    #[test]
    fn a_half_that_is_not_begun_is_taken_back() {
        let team = Team::default();
        // As if it were here, and another program on its core.
        team.0.at.store(HERE, Ordering::Relaxed);
        let here = thread::current().id();
        let mut done = Vec::new();
        for _ in 0..3 {
            team.both(|| (), || done.push(thread::current().id()));
        }
        assert_eq!(done, [here; 3]);
        let broken = || team.both(|| panic!("broken"), || done.push(here));
        assert!(catch_unwind(AssertUnwindSafe(broken)).is_err());
        assert_eq!(done.len(), 3);
    }

    #[test]
    fn a_helper_that_is_kept_from_its_half_is_let_go_for_a_while() {
        let team = team();
        let is_away = || team.0.at.load(Ordering::Relaxed) == AWAY && hold(&team.0.core).is_none();
        // Where other programs take the cores a look lasts as long as their turn.
        for pause in [0.3, 3.0, 30.0] {
            if !is_away() {
                there(&team, || (), || thread::sleep(Duration::from_secs_f64(pause)));
            }
        }
        for _ in 0..4 {
            assert!(is_away());
            team.call(FIRST_REST / 4);
        }
        assert!(is_away() && team.0.deaf.load(Ordering::Relaxed) == 0);
    }

    #[test]
    fn a_panic_of_either_half_is_the_callers() {
        let (first, second, mut done) = (team(), team(), 0);
        let other = || there(&first, || (), || panic!("broken"));
        assert!(catch_unwind(AssertUnwindSafe(other)).is_err());
        let one = || there(&second, || panic!("broken"), || done += 1);
        assert!(catch_unwind(AssertUnwindSafe(one)).is_err());
        for team in [first, second] {
            team.both(|| (), || done += 1);
        }
        assert_eq!(done, 3);
    }
}
