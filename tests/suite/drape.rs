//! The drape meter: what it reads off known shapes, and a coarse drape.

use kesi::{
    fabric,
    lab::drape::DrapeTest,
    math::Vec3,
    world::{Budget, World},
};
use std::{f64::consts::PI, sync::Arc};

fn test(name: &str, particles: usize) -> DrapeTest {
    DrapeTest::new(Arc::new(fabric::load(name).unwrap()), particles, 1)
}

/// What the meter reads of a specimen whose points are at so much of the radius at which they lie flat.
fn reading(test: &DrapeTest, shrink: impl Fn(f64, f64) -> f64) -> (f64, usize) {
    let mut setup = test.setup();
    for p in &mut setup.positions {
        let (radius, angle) = (p.x.hypot(p.y), p.y.atan2(p.x));
        *p = if radius > 0.0 { *p * shrink(radius, angle) } else { *p };
    }
    let reading = test.read(&World::new(setup).unwrap());
    (reading.coefficient, reading.nodes)
}

#[test]
fn the_shadow_of_known_shapes_is_theirs() {
    let test = test("denim-a", 61);
    let [radius, support] = test.radii;
    let (flat, nodes) = reading(&test, |_, _| 1.0);
    assert!((flat - 1.0).abs() < 1e-4 && nodes == 0, "{flat} {nodes}");
    // A cone whose rim stands at 12 cm.
    let outer = 0.12;
    let cone = |r: f64| {
        if r < support { 1.0 } else { (support + (r - support) * (outer - support) / (radius - support)) / r }
    };
    let expected = (outer.powi(2) - support.powi(2)) / (radius.powi(2) - support.powi(2));
    let (coefficient, nodes) = reading(&test, |r, _| cone(r));
    assert!((coefficient / expected - 1.0).abs() < 1e-3 && nodes == 0, "{coefficient} for {expected}");
    // Six folds around that cone; their squares add half of the depth squared to the area.
    let depth = 0.01;
    let out = |r: f64| ((r - support) / (radius - support)).max(0.0);
    let (folded, nodes) = reading(&test, |r, a| cone(r) + depth * out(r) * (6.0 * a).cos() / r);
    let expected = expected + 0.5 * depth * depth * PI / (PI * (radius.powi(2) - support.powi(2)));
    assert!((folded / expected - 1.0).abs() < 5e-3 && nodes == 6, "{folded} for {expected}, {nodes} nodes");
}

#[test]
fn softer_cloth_drapes_more_and_the_same_start_drapes_the_same() {
    let [stiff, soft, again] =
        ["cotton-broad", "polyester-faille", "polyester-faille"].map(|name| test(name, 25).run().unwrap());
    assert!(stiff.resting && soft.resting, "{} {} steps", stiff.steps, soft.steps);
    assert!(soft.coefficient < stiff.coefficient - 0.2, "{} {}", soft.coefficient, stiff.coefficient);
    assert_eq!(soft.shadow, again.shadow);
}

#[test]
fn shaking_brings_folds_over_the_friction_in_the_fabric() {
    let [still, shaken] =
        [0, 3].map(|shakes| DrapeTest { shakes, ..test("cotton-broad", 25) }.run().unwrap());
    assert!(shaken.resting && still.resting);
    assert!(shaken.coefficient < still.coefficient - 0.02, "{} {}", shaken.coefficient, still.coefficient);
}

#[test]
fn a_budget_too_small_for_trouble_never_freezes_the_cloth() {
    let mut world = World::new(DrapeTest { seed: 5, ..test("polyester-tropical", 61) }.setup()).unwrap();
    for step in 0..30 {
        world.step(&[], 0.02, Budget::solves(2));
        let fastest = world.state().velocities.iter().map(Vec3::norm).fold(0.0, f64::max);
        // After a step that was taken back the next one is shorter; what has come to rest may stand.
        let is_shorter = step > 0 && world.report().time < 0.02 * f64::from(step + 1);
        assert!(fastest > 0.0 || is_shorter || world.report().resting, "step {step}");
    }
    let fallen = world.positions().iter().map(|p| p.z).fold(0.0, f64::min);
    assert!(fallen < -0.03, "still at {fallen} m");
}
