//! Small worlds that several tests share.

use kesi::{
    batch::Measures,
    fabric,
    math::Vec3,
    model::{Model, Setup},
    obstacle::{Obstacle, Shape},
    potential::{Potential, Pull, contact::candidates::Candidates},
    state::State,
    world::{Budget, World},
};
use nalgebra::Isometry3;
use std::sync::Arc;

/// A flat horizontal sheet of a fabric, free, under gravity.
pub fn sheet(fabric: &str, particles: [usize; 2], size: [f64; 2]) -> Setup {
    let spacing = [0, 1].map(|k| size[k] / (particles[k] - 1) as f64);
    let site = |n: usize| [n / particles[1], n % particles[1]];
    let positions = (0..particles[0] * particles[1])
        .map(|n| Vec3::new(site(n)[0] as f64 * spacing[0], site(n)[1] as f64 * spacing[1], 0.0))
        .collect();
    Setup {
        fabric: Arc::new(fabric::load(fabric).expect("a built-in fabric")),
        particles,
        size,
        positions,
        pins: vec![],
        hand: None,
        obstacles: vec![],
        gravity: 9.81,
        drag: 0.5,
        cut: None,
        particles_only: false,
    }
}

/// A sheet that hangs from its two upper corners, brought 10 % nearer than the edge is long: every weft line starts as an arc.
pub fn hang(fabric: &str, n: usize) -> Setup {
    let size = 0.3;
    let mut angle: f64 = 0.5;
    for _ in 0..60 {
        angle -= (angle.sin() - 0.9 * angle) / (angle.cos() - 0.9);
    }
    let radius = size / (2.0 * angle);
    let spacing = size / (n - 1) as f64;
    let mut setup = sheet(fabric, [n, n], [size, size]);
    for (k, p) in setup.positions.iter_mut().enumerate() {
        let turn = (k % n) as f64 * spacing / radius - angle;
        let depth = (k / n) as f64 * spacing;
        *p = Vec3::new(radius * turn.sin(), radius * (turn.cos() - angle.cos()), -depth);
    }
    setup.hand = Some([0, 0]);
    setup.pins = vec![[0, n - 1]];
    setup
}

/// A box with these half lengths [m], centred at `at`.
pub fn cuboid(half: [f64; 3], at: Vec3) -> Obstacle {
    Obstacle {
        name: "box".into(),
        shape: Shape::Cuboid { half },
        pose: Isometry3::translation(at.x, at.y, at.z),
        friction: None,
    }
}

/// Steps without commands until the cloth rests; fails after `most` steps.
pub fn settle(world: &mut World, dt: f64, most: usize) {
    for _ in 0..most {
        if world.step(&[], dt, Budget::solves(20)).resting {
            return;
        }
    }
    panic!("not at rest after {most} steps: {:?}", world.report());
}

/// Advances the history of a state where it is.
pub fn commit(model: &Model, state: &mut State) {
    let pull = Pull::none(model);
    let potential = Potential { model, state, candidates: &Candidates::of(model, state), pull: &pull };
    let (mut gradient, mut measures) =
        (vec![Vec3::zeros(); state.positions.len()], Measures::new(&model.elements));
    potential.gradient(&state.positions, &mut gradient, &mut measures);
    let (history, _) = potential.commit(&measures);
    let mut anchors = Vec::new();
    let (contact, x) = (potential.contact(), &state.positions);
    contact.commit(&contact.touches(x), x, &mut anchors);
    (state.history, state.anchors) = (history, anchors);
}
