//! The iterative solver over stiffness ratios, fabrics and states: it reaches its tolerance or falls back, and nothing is ever not a
//! number. `cargo test --release ratios -- --nocapture` prints iterations and fall-backs.

use crate::cloth;
use kesi::{
    fabric::{self, Fabric, isotropic_twist, law::Law},
    math::Vec3,
    model::Setup,
    phase::{Phase, Stopwatch, Watch},
    world::{Budget, Command, Method, World},
};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::sync::Arc;

const PARTICLES: usize = 20;
/// Ticks of a run; of one that needs many direct factors, fewer.
const TICKS: [u32; 2] = [40, 5];

/// How the sheet starts and what the hand does.
#[derive(Clone, Copy, Debug)]
enum Start {
    /// Hangs in an arc from two corners; the hand goes at 0.1 m/s.
    Hanging,
    /// Flat between the corners, which the hand pulls apart by 4 mm, more than 1 % of its diagonal.
    Taut,
    /// Shaken by as much as its cells measure; the hand goes at 0.1 m/s.
    Crumpled,
    /// Everything at one place but for a micrometre; the hand pulls it out.
    Point,
}

impl Start {
    const ALL: [Start; 4] = [Start::Hanging, Start::Taut, Start::Crumpled, Start::Point];

    fn apply(self, setup: &mut Setup) {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        let mut shake = |size: f64| Vec3::from_fn(|_, _| rng.random_range(-size..=size));
        let spacing = setup.size[0] / (PARTICLES - 1) as f64;
        for (k, p) in setup.positions.iter_mut().enumerate() {
            let flat = Vec3::new((k % PARTICLES) as f64, 0.0, -((k / PARTICLES) as f64)) * spacing;
            match self {
                Start::Hanging => {}
                Start::Taut => *p = flat,
                Start::Crumpled => *p += shake(spacing),
                Start::Point => *p = shake(1e-6),
            }
        }
    }

    fn ticks(self) -> u32 {
        TICKS[usize::from(matches!(self, Start::Crumpled | Start::Point))]
    }

    /// The hand's position after `k` ticks, from where it took hold.
    fn hand(self, k: u32) -> Vec3 {
        let way = 1e-4 * f64::from(k);
        match self {
            Start::Taut => Vec3::new(-0.7, 0.0, 0.7) * way,
            _ => Vec3::new(0.4, 0.2, 0.9) * way,
        }
    }
}

/// What a run took: iterations of each solve, Hessians beyond one per step, direct factorizations.
#[derive(Debug, Default)]
struct Tally {
    iterations: Vec<u32>,
    retries: u32,
    factors: u32,
}

fn run(fabric: &Fabric, start: Start, place: &str) -> Tally {
    let mut setup = cloth::hang("denim-a", PARTICLES);
    setup.fabric = Arc::new(fabric.clone());
    start.apply(&mut setup);
    let mut world = World::with_method(setup, Method::Multigrid).unwrap();
    world.step(&[Command::Grab { particle: [0, 0] }], 0.001, Budget::solves(1));
    let from = world.report().hand.unwrap().position;
    let watch = Stopwatch::default();
    let mut tally = Tally::default();
    for k in 1..=start.ticks() {
        watch.start();
        let ended = |phase| watch.ended(phase);
        let budget = Budget { watch: Watch(Some(&ended)), ..Budget::solves(1) };
        let report = world.step(&[Command::Move { position: from + start.hand(k) }], 0.001, budget);
        let hand = report.hand.unwrap();
        assert!(report.residual.is_finite() && hand.force.norm().is_finite(), "{place}: tick {k}");
        assert!(hand.stiffness.norm().is_finite() && hand.rate.norm().is_finite(), "{place}: tick {k}");
        let builds = watch.lap(Phase::Hierarchy).count;
        tally.iterations.push(watch.lap(Phase::Iteration).count / builds.max(1));
        tally.retries += report.solves - 1;
        tally.factors += watch.lap(Phase::Factor).count;
    }
    assert!(world.state().is_finite(), "{place}");
    tally.iterations.sort_unstable();
    tally
}

#[test]
fn every_ratio_fabric_and_state_is_solved_or_falls_back() {
    let mut materials = Vec::new();
    for exponent in 2..=7 {
        // The ratio of tension to bending, by h².
        let spacing: f64 = 0.3 / (PARTICLES - 1) as f64;
        let bending = 1000.0 * spacing * spacing / 10_f64.powi(exponent);
        let mut fabric = fabric::load("denim-a").unwrap();
        fabric.tensile = [Law::linear(1000.0), Law::linear(1000.0)];
        fabric.bending = [Law::linear(bending), Law::linear(bending)];
        fabric.twist = isotropic_twist([bending; 2]);
        materials.push((format!("ratio 1e{exponent}"), fabric));
    }
    materials.extend(fabric::list().into_iter().map(|name| {
        let fabric = fabric::load(&name).unwrap();
        (name, fabric)
    }));
    println!("{:22} {:9} iterations p50  max  further Hessians  factors", "material", "start");
    for start in Start::ALL {
        for (name, fabric) in &materials {
            let tally = run(fabric, start, &format!("{name}, {start:?}"));
            let [median, most] = [tally.iterations.len() / 2, tally.iterations.len() - 1];
            println!(
                "{name:22} {:9} {:14} {:4} {:17} {:8}",
                format!("{start:?}"),
                tally.iterations[median],
                tally.iterations[most],
                tally.retries,
                tally.factors
            );
            if matches!(start, Start::Hanging | Start::Taut) {
                assert_eq!(tally.factors, 0, "{name}, {start:?}: no direct factor is needed");
            }
        }
    }
}
