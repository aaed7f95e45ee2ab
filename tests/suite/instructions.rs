//! Instruction sets: each repeats its own bits, and all agree: to rounding, or to the tolerance of an iterative solve.

use crate::cloth;
use kesi::{
    math::{
        Vec3,
        pack::{Arch, all_instructions, with_instructions},
    },
    phase::{Phase, Stopwatch, Watch},
    world::{Budget, Command, Method, Snapshot, World},
};

fn world(method: Method) -> World {
    World::with_method(cloth::hang("denim-a", 17), method).unwrap()
}

/// A resting sheet pulled by its corner in ticks of 1 ms: its places, the hand's forces, each with the iterations so far, and the checksum
/// of its state.
fn pulled(rest: &Snapshot, method: Method) -> (Vec<Vec3>, Vec<(Vec3, u32)>, u64) {
    let mut world = world(method);
    world.restore(rest);
    let stopwatch = Stopwatch::default();
    let ended = |phase| stopwatch.ended(phase);
    let budget = Budget { watch: Watch(Some(&ended)), ..Budget::solves(1) };
    let start = world.report().hand.unwrap().position;
    let forces = (1_u32..=50).map(|k| {
        // Within 50 ms to 0.1 m/s: a sudden start buckles the sheet, and where it buckles, rounding decides the way.
        let position = start + Vec3::new(0.4, -0.2, 0.9) * (1e-6 * f64::from(k * k));
        let force = world.step(&[Command::Move { position }], 0.001, budget).hand.unwrap().force;
        (force, stopwatch.lap(Phase::Iteration).count)
    });
    let forces = forces.collect();
    (world.positions().to_vec(), forces, world.checksum())
}

#[test]
fn instruction_sets_repeat_their_bits_and_agree() {
    let mut sheet = world(Method::Fronts);
    assert!((0..1000).any(|_| sheet.step(&[], 0.02, Budget::solves(2)).resting));
    sheet.step(&[Command::Grab { particle: [0, 0] }], 0.001, Budget::solves(1));
    let rest = sheet.snapshot();
    let all = all_instructions();
    assert!(matches!(all[0], Arch::Scalar));
    // Rounding in single precision changes the preconditioner of stiff blocks by up to a percent, and with it what is left of the error. Without
    // it sets agree to rounding, until rounding decides whether a Hessian is definite: seen at the 19th tick, with 5e-9 m and 1e-5 from there on.
    // Where it decides whether an error is small enough (seen at the 13th), one set iterates once more, and forces differ by what solves may
    // leave in each tick.
    let left = Method::Multigrid.accuracy().unwrap().force[0];
    for (method, way, parts) in
        [(Method::Fronts, 1e-7, [1e-9, 1e-4]), (Method::Multigrid, 1e-5, [1e-4, 1e-4])]
    {
        let run = |arch: &Arch| with_instructions(*arch, || pulled(&rest, method));
        let runs: Vec<_> = all.iter().map(run).collect();
        for (arch, (positions, forces, bits)) in all.iter().zip(&runs) {
            assert_eq!(run(arch).2, *bits, "{arch:?} {method:?}");
            let apart = positions.iter().zip(&runs[0].0).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
            assert!(apart <= way, "{arch:?} {method:?}: {apart} m apart");
            let pairs = || forces.iter().zip(&runs[0].1);
            let differ: Vec<f64> = pairs().map(|((a, _), (b, _))| (a - b).norm() / b.norm()).collect();
            let alike = pairs().take_while(|((_, a), (_, b))| a == b).count();
            assert!(alike >= 8, "{arch:?} {method:?}: as many iterations in {alike} ticks only");
            for (ticks, part) in [(8, parts[0]), (alike, parts[1]), (differ.len(), 4.0 * left)] {
                let differ = differ[..ticks].iter().copied().fold(0.0, f64::max);
                assert!(differ <= part, "{arch:?} {method:?}: forces differ by {differ} in {ticks} ticks");
            }
        }
        assert_eq!(pulled(&rest, method).2, runs[runs.len() - 1].2, "the best are chosen");
    }
}
