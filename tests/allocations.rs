//! A tick allocates nothing: this binary's allocator counts what the test's own thread asks for while it is told to.

use kesi::{
    cores,
    math::Vec3,
    scene::Scene,
    world::{Budget, Command, Method, World},
};
use std::{
    alloc::{GlobalAlloc, Layout, System},
    backtrace::Backtrace,
    cell::{Cell, RefCell},
};

/// Counts allocations of threads that want it, and keeps where the first one came from.
struct Counting;

thread_local! {
    static COUNTING: Cell<bool> = const { Cell::new(false) };
    static COUNT: Cell<u64> = const { Cell::new(0) };
    static FIRST: RefCell<Option<String>> = const { RefCell::new(None) };
}

fn count() {
    // A thread that ends has no cells any more.
    if COUNTING.try_with(|c| c.replace(false)) != Ok(true) {
        return;
    }
    COUNT.set(COUNT.get() + 1);
    let place = Backtrace::force_capture().to_string();
    FIRST.with_borrow_mut(|first| _ = first.get_or_insert(place));
    COUNTING.set(true);
}

// SAFETY: everything is passed on to the system's allocator; counting does not touch the memory.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        unsafe { System.dealloc(memory, layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        unsafe { System.realloc(memory, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations of `work`, and where the first one came from.
fn allocations(work: impl FnOnce()) -> (u64, String) {
    COUNT.set(0);
    FIRST.set(None);
    COUNTING.set(true);
    work();
    COUNTING.set(false);
    (COUNT.get(), FIRST.take().unwrap_or_default())
}

/// A built-in scene at rest, its hand held.
fn at_rest(scene: &str, particles: usize, method: Method) -> World {
    let scene = Scene { particles: [particles; 2], ..Scene::named(scene).unwrap() };
    let mut world = World::with_method(scene.setup().unwrap(), method).unwrap();
    assert!((0..2000).any(|_| world.step(&[], 0.02, Budget::solves(2)).resting));
    let particle = world.setup().hand.unwrap();
    world.step(&[Command::Grab { particle }], 0.001, Budget::solves(1));
    world
}

/// Moves the hand around a circle of 1 cm radius at 0.1 m/s in ticks of 1 ms, `ticks` of them from `from` on, and counts.
fn drag(world: &mut World, start: Vec3, from: u32, ticks: u32) -> (u64, String) {
    let path = (from..from + ticks).map(|k| {
        let turned = 0.01 * f64::from(k);
        start + Vec3::new(0.008 * (1.0 - turned.cos()), 0.01 * turned.sin(), 0.006 * (1.0 - turned.cos()))
    });
    let path: Vec<Vec3> = path.collect();
    allocations(|| {
        for position in path {
            world.step(&[Command::Move { position }], 0.001, Budget::solves(1));
        }
    })
}

#[test]
fn the_counter_counts() {
    let (count, place) = allocations(|| drop(std::hint::black_box(vec![1_u8; 100])));
    assert_eq!(count, 1);
    assert!(place.contains("count"), "{place}");
}

#[test]
fn a_warm_tick_of_a_hanging_sheet_allocates_nothing() {
    for method in [Method::Multigrid, Method::Precise, Method::Fronts] {
        let mut world = at_rest("hang", 39, method);
        let start = world.report().hand.unwrap().position;
        drag(&mut world, start, 0, 20);
        let (count, place) = drag(&mut world, start, 20, 200);
        assert_eq!(count, 0, "{method:?}, first from {place}");
        assert!(world.report().dissipated > 0.0, "hysteresis is on");
    }
}

#[test]
fn a_core_that_becomes_free_makes_no_tick_allocate() {
    // In a process of its own nobody has had work done beside until then.
    let core = cores::claim();
    let mut world = at_rest("hang", 39, Method::Multigrid);
    let start = world.report().hand.unwrap().position;
    drag(&mut world, start, 0, 20);
    drop(core);
    let (count, place) = drag(&mut world, start, 20, 200);
    assert_eq!(count, 0, "first from {place}");
}

#[test]
fn a_warm_tick_in_contact_allocates_nothing() {
    let mut world = at_rest("drape", 39, Method::Multigrid);
    let start = world.report().hand.unwrap().position;
    // Twice the same way, which begins with a jump back, so that lists have been as long as they get.
    for round in [0, 1] {
        let (count, place) = drag(&mut world, start, 0, 200);
        assert!(world.report().contact.pairs > 0, "it touches the box");
        assert!(round == 0 || count == 0, "{count}, first from {place}");
    }
}
