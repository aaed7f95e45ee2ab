//! Contact and friction against closed forms and against an independent check.

use crate::cloth;
use kesi::{
    cli::bench::contact as bench,
    fabric::{Fabric, law::Law},
    math::Vec3,
    model::Setup,
    obstacle::{Obstacle, Polyhedron, Shape, witness::Witness},
    potential::contact::{candidates::Candidates, room::Room},
    scene::Scene,
    world::{Budget, Command, Method, World},
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::sync::Arc;

const FRICTION: f64 = 0.3;

/// A small sheet in contact with a plane inclined by an angle [rad].
fn on_a_slope(angle: f64) -> Setup {
    let mut setup = cloth::sheet("denim-a", [4, 4], [0.03, 0.03]);
    let turn = UnitQuaternion::from_axis_angle(&Vec3::y_axis(), angle);
    let gap = 0.9999 * setup.fabric.thickness;
    setup.positions.iter_mut().for_each(|p| *p = turn * (*p + Vec3::z() * gap));
    let pose = Isometry3::from_parts(Translation3::identity(), turn);
    setup.obstacles =
        vec![Obstacle { name: "slope".into(), shape: Shape::Plane, pose, friction: Some(FRICTION) }];
    setup.drag = 0.0;
    setup
}

fn middle(world: &World) -> Vec3 {
    world.positions().iter().sum::<Vec3>() / world.positions().len() as f64
}

#[test]
fn cloth_below_the_friction_angle_stays_for_an_hour() {
    let mut world = World::new(on_a_slope((0.9 * FRICTION).atan())).unwrap();
    for _ in 0..200 {
        world.step(&[], 0.02, Budget::solves(4));
    }
    let start = middle(&world);
    // Kept awake by pushes to where the slope is: every step of the hour is solved, not slept through.
    let pose = world.state().poses[0];
    for _ in 0..36_100 {
        let nudge = Command::Push { obstacle: 0, pose, duration: 0.0 };
        world.step(&[nudge], 0.1, Budget::solves(4));
        assert!(!world.report().resting);
    }
    let creep = (middle(&world) - start).norm();
    assert!(world.report().time > 3600.0);
    assert!(creep < 1e-5, "creep {creep} m");
}

#[test]
fn cloth_above_the_friction_angle_slides_as_coulomb_says() {
    for excess in [1.2_f64, 2.0] {
        let angle = (excess * FRICTION).atan();
        let mut world = World::new(on_a_slope(angle)).unwrap();
        let dt = 2e-3;
        let speed = |world: &mut World, steps: u32| {
            for _ in 0..steps {
                world.step(&[], dt, Budget::solves(4));
            }
            world.state().velocities.iter().map(|v| v.norm()).sum::<f64>() / 16.0
        };
        let (early, late) = (speed(&mut world, 20), speed(&mut world, 100));
        let acceleration = (late - early) / (100.0 * dt);
        let exact = 9.81 * (angle.sin() - FRICTION * angle.cos());
        assert!((acceleration / exact - 1.0).abs() < 0.02, "{excess}: {acceleration} for {exact}");
        let contact = world.report().contact;
        assert!(contact.sliding == contact.pairs && contact.pairs >= 16, "{contact:?}");
        assert!((contact.friction / contact.friction_limit - 1.0).abs() < 1e-9, "at its limit");
    }
}

#[test]
fn the_critical_angle_is_the_friction_angle() {
    let goes = |factor: f64| {
        let mut world = World::new(on_a_slope((factor * FRICTION).atan())).unwrap();
        let mut run = |steps: u32| {
            for _ in 0..steps {
                world.step(&[], 0.01, Budget::solves(4));
            }
            middle(&world)
        };
        let start = run(100);
        (run(200) - start).norm() > 1e-5
    };
    assert!(!goes(0.99), "it slides 1 % below");
    assert!(goes(1.01), "it sticks 1 % above");
}

/// A slab whose top is the plane z = 0 in triangles of 2 mm, raised or lowered by up to `rough` [m]; a hollow below makes it concave.
fn slab(rough: f64) -> Polyhedron {
    const CELLS: u32 = 24;
    let place = |k: u32| (f64::from(k) - 4.5) * 2e-3;
    let noise = |n: u32| f64::from(n.wrapping_mul(2_654_435_761) >> 16 & 1023) / 511.5 - 1.0;
    let at = |i: u32, j: u32, z: f64| Vec3::new(place(i), place(j), z);
    let top = |i: u32, j: u32| i * (CELLS + 1) + j;
    let mut points: Vec<Vec3> = (0..(CELLS + 1) * (CELLS + 1))
        .map(|n| at(n / (CELLS + 1), n % (CELLS + 1), rough * noise(n)))
        .collect();
    let mut faces = Vec::new();
    for (i, j) in (0..CELLS).flat_map(|i| (0..CELLS).map(move |j| (i, j))) {
        let [a, b, c, d] = [top(i, j), top(i + 1, j), top(i + 1, j + 1), top(i, j + 1)];
        faces.extend([[a, b, c], [a, c, d]]);
    }
    // Around the border and over the hollow's deepest point, below the middle.
    let mut border: Vec<u32> = (0..CELLS).map(|i| top(i, 0)).collect();
    border.extend((0..CELLS).map(|j| top(CELLS, j)));
    border.extend((0..CELLS).map(|i| top(CELLS - i, CELLS)));
    border.extend((0..CELLS).map(|j| top(0, CELLS - j)));
    let low = points.len() as u32;
    points.extend(border.iter().map(|&n| points[n as usize] - Vec3::z() * 0.02).collect::<Vec<_>>());
    let deepest = points.len() as u32;
    points.push(at(CELLS / 2, CELLS / 2, -0.01));
    for k in 0..border.len() {
        let next = (k + 1) % border.len();
        let [a, b, c, d] = [border[k], border[next], low + k as u32, low + next as u32];
        faces.extend([[b, a, c], [b, c, d], [d, c, deepest]]);
    }
    Polyhedron::mesh(points, faces).unwrap()
}

/// The small sheet on a slope of triangles.
fn on_triangles(angle: f64, rough: f64) -> Setup {
    let mut setup = on_a_slope(angle);
    let obstacle = &mut setup.obstacles[0];
    obstacle.shape = Shape::Polyhedron(Arc::new(slab(rough)));
    assert!(!obstacle.shape.is_convex());
    let up = obstacle.pose.rotation * Vec3::z() * (2.0 * rough);
    setup.positions.iter_mut().for_each(|p| *p += up);
    setup
}

#[test]
fn cloth_rests_on_a_slope_of_fine_triangles() {
    for rough in [0.0, 1e-4] {
        let mut world = World::new(on_triangles((0.8 * FRICTION).atan(), rough)).unwrap();
        for _ in 0..300 {
            world.step(&[], 0.02, Budget::solves(4));
        }
        let start = middle(&world);
        let pose = world.state().poses[0];
        for _ in 0..600 {
            let nudge = Command::Push { obstacle: 0, pose, duration: 0.0 };
            world.step(&[nudge], 0.1, Budget::solves(4));
        }
        let creep = (middle(&world) - start).norm();
        assert!(creep < 1e-5, "rough {rough}: creep {creep} m");
    }
}

#[test]
fn cloth_slides_over_fine_triangles_as_over_a_plane() {
    let angle = (2.0 * FRICTION).atan();
    let mut world = World::new(on_triangles(angle, 0.0)).unwrap();
    let dt = 1e-3;
    let mut speed = |steps: u32| {
        let mut least = f64::INFINITY;
        for _ in 0..steps {
            let contact = world.step(&[], dt, Budget::solves(4)).contact;
            least = least.min(contact.friction / contact.friction_limit);
        }
        (world.state().velocities.iter().map(|v| v.norm()).sum::<f64>() / 16.0, least)
    };
    let (early, _) = speed(20);
    let (late, least) = speed(60);
    let acceleration = (late - early) / (60.0 * dt);
    let exact = 9.81 * (angle.sin() - FRICTION * angle.cos());
    assert!((acceleration / exact - 1.0).abs() < 0.02, "{acceleration} for {exact}");
    assert!(least > 0.9, "friction falls to {least} of its limit");
}

#[test]
fn no_violence_makes_cloth_pass_an_obstacle() {
    let violence = bench::Violence { tick_s: 0.01, solves: 2, seed: 7, adaptive: false };
    for (obstacle, n, adaptive) in
        [("box", 12, false), ("sphere", 12, false), ("mesh", 12, false), ("box", 17, true)]
    {
        let violence = bench::Violence { adaptive, ..violence };
        let row = bench::manipulate(obstacle, n, 25, violence).unwrap();
        assert!(row.states == 250 && row.min_gap_m > 0.0, "{row:?}");
        assert!(row.violations == 0 && row.not_finite == 0 && row.stalled < 10, "{row:?}");
    }
}

/// What the guard leaves of a step from where the cloth is.
fn limited(world: &World, step: Vec<Vec3>) -> Vec<Vec3> {
    limited_in(&mut Room::default(), world, step)
}

/// The same with a memory.
fn limited_in(room: &mut Room, world: &World, mut step: Vec<Vec3>) -> Vec<Vec3> {
    let (model, x) = (world.model(), world.positions());
    let travel = step.iter().map(|way| way.norm()).fold(0.0, f64::max);
    let mut candidates = Candidates::new(model);
    candidates.update(model, &world.state().poses, x, travel);
    candidates.limit(model, x, &mut step, room);
    step
}

#[test]
fn a_step_into_a_slope_goes_on_along_it() {
    let world = World::new(on_a_slope(0.3)).unwrap();
    let turn = world.state().poses[0].rotation;
    let (along, normal) = (turn * Vec3::new(3e-3, 4e-3, 0.0), turn * Vec3::z());
    for (way, x) in limited(&world, vec![along - normal * 2e-3; 16]).iter().zip(world.positions()) {
        let coming = -normal.dot(way);
        assert!(coming > 0.0 && coming < normal.dot(x), "{coming} of {}", normal.dot(x));
        assert!((way + normal * coming - along).norm() < 1e-9, "{way:?} along {along:?}");
    }
}

/// Each particle may go any part of what is left of its step, whatever the others do.
#[test]
fn no_mixture_of_limited_steps_passes_an_obstacle() {
    let mut world =
        World::new(Scene { particles: [13, 13], ..Scene::named("drape").unwrap() }.setup().unwrap()).unwrap();
    for _ in 0..60 {
        world.step(&[], 0.02, Budget::solves(4));
    }
    let (witness, pose) = (Witness::new(&world.setup().obstacles[0]), world.state().poses[0]);
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let mut unlimited = 0;
    for _ in 0..300 {
        let wild: Vec<Vec3> =
            world.positions().iter().map(|_| Vec3::from_fn(|_, _| rng.random_range(-0.02..0.02))).collect();
        let tame = limited(&world, wild.clone());
        let shares: Vec<f64> = wild.iter().map(|_| rng.random_range(0.0..=1.0)).collect();
        let distance = |step: &[Vec3]| {
            let ways = step.iter().zip(&shares);
            let x: Vec<Vec3> = world.positions().iter().zip(ways).map(|(x, (way, s))| x + way * *s).collect();
            witness.distance(&pose, &x, &world.model().surface.triangles, 1.0)
        };
        assert!(distance(&tame) > 0.0);
        unlimited += u32::from(distance(&wild) <= 0.0);
    }
    assert!(unlimited > 250, "{unlimited} steps would have passed");
}

/// Steps are tried one after the other from one place, then from others, while the box moves.
#[test]
fn what_the_guard_remembers_changes_nothing() {
    let mut world =
        World::new(Scene { particles: [13, 13], ..Scene::named("drape").unwrap() }.setup().unwrap()).unwrap();
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    let (mut room, mut shortened) = (Room::default(), 0);
    for k in 0..90 {
        let pose = Translation3::new(0.0, 0.0, 0.02) * world.state().poses[0];
        let lift = Command::Push { obstacle: 0, pose, duration: 0.2 };
        world.step(if k == 50 { std::slice::from_ref(&lift) } else { &[] }, 0.02, Budget::solves(2));
        for one in [None, Some(rng.random_range(0..169)), None] {
            let mut way = || Vec3::from_fn(|_, _| rng.random_range(-0.01..0.01));
            let goes = |n: usize| one.is_none_or(|one| one == n);
            let wild: Vec<Vec3> = (0..169).map(|n| if goes(n) { way() } else { Vec3::zeros() }).collect();
            let tame = limited_in(&mut room, &world, wild.clone());
            assert_eq!(tame, limited(&world, wild.clone()), "{k}, {one:?}");
            shortened += u32::from(tame != wild);
        }
    }
    assert!(shortened > 150, "{shortened} steps were turned aside");
}

#[test]
fn a_corner_pulled_down_beside_the_box_does_not_cut_it() {
    let (ours, particles) =
        (bench::pull_beside_the_box(false).unwrap(), bench::pull_beside_the_box(true).unwrap());
    assert!(ours.max_penetration_m == 0.0 && ours.min_gap_m > 0.0, "{ours:?}");
    assert!(particles.max_penetration_m > 2e-3, "{particles:?}");
}

/// A sheet held at two corners, and each shape pushed up through it: the cloth goes along.
#[test]
fn a_moving_obstacle_of_any_shape_takes_the_cloth_along() {
    let cube = Shape::Cuboid { half: [0.02; 3] };
    let hull = Polyhedron::hull(&cube.features().points).unwrap();
    for shape in [
        cube,
        Shape::Sphere { radius: 0.02 },
        Shape::Capsule { half: 0.02, radius: 0.01 },
        Shape::Polyhedron(Arc::new(hull)),
    ] {
        let mut setup = cloth::sheet("denim-a", [9, 9], [0.16, 0.16]);
        setup.pins = vec![[0, 0], [8, 8]];
        let below = Isometry3::translation(0.08, 0.08, -0.06);
        setup.obstacles =
            vec![Obstacle { name: "it".into(), shape: shape.clone(), pose: below, friction: None }];
        let mut world = World::new(setup).unwrap();
        let witness = Witness::new(&world.setup().obstacles[0]);
        let turn = UnitQuaternion::from_euler_angles(0.2, 0.3, 0.4);
        let pose = Isometry3::from_parts(Translation3::new(0.08, 0.08, 0.05), turn);
        let mut commands = vec![Command::Push { obstacle: 0, pose, duration: 0.3 }];
        for _ in 0..80 {
            world.step(&commands, 0.01, Budget::solves(2));
            commands.clear();
            let x = world.positions();
            let triangles = &world.model().surface.triangles;
            let gap = witness.distance(&world.state().poses[0], x, triangles, 1.0);
            assert!(gap > 0.0, "{shape:?} passes a triangle");
        }
        assert_eq!(world.state().poses[0], pose, "it arrives: {shape:?}");
        let top = world.positions().iter().map(|p| p.z).fold(f64::NEG_INFINITY, f64::max);
        assert!(top > 0.05, "the cloth lies on {shape:?}: {top}");
    }
}

#[test]
fn an_obstacle_is_not_scaled_by_a_push_whose_quaternion_is_a_little_long() {
    let mut setup = cloth::sheet("denim-a", [3, 3], [0.1, 0.1]);
    let below = Isometry3::translation(0.05, 0.05, -0.06);
    let shape = Shape::Sphere { radius: 0.03 };
    setup.obstacles = vec![Obstacle { name: "ball".into(), shape, pose: below, friction: None }];
    let mut world = World::new(setup).unwrap();
    let long = UnitQuaternion::from_euler_angles(0.2, 0.3, 0.4).into_inner() * (1.0 + 9e-7);
    let pose = Isometry3::from_parts(below.translation, UnitQuaternion::new_unchecked(long));
    let push = Command::Push { obstacle: 0, pose, duration: 0.0 };
    assert_eq!(world.check(&push), Ok(()));
    world.step(&[push], 0.01, Budget::solves(2));
    while world.state().motions[0].is_some() {
        world.step(&[], 0.01, Budget::solves(2));
    }
    let coords = world.state().poses[0].rotation.coords;
    assert!((coords - long.coords).norm() < 1e-6, "{coords}");
    assert!((coords.norm() - 1.0).abs() < 1e-15, "{coords}");
}

/// A fabric without hysteresis, so that rest does not depend on the way.
fn elastic() -> Fabric {
    let [tensile, bending] = [Law::linear(1000.0), Law::linear(1e-5)];
    Fabric {
        name: "elastic".into(),
        areal_density: 0.2,
        thickness: 0.001,
        tensile: [tensile.clone(), tensile],
        bending: [bending.clone(), bending],
        shear: Law::linear(40.0),
        twist: 2e-5,
        friction: 0.0,
    }
}

/// What the bound on steps cuts off is cut off from the tension unknowns as well: a sheet hit at once rests as one pushed gently.
#[test]
fn a_sheet_hit_hard_comes_to_rest_as_one_pushed_gently() {
    let rest = |duration: f64| {
        let mut setup = cloth::sheet("denim-a", [9, 9], [0.16, 0.16]);
        setup.fabric = Arc::new(elastic());
        setup.pins = vec![[0, 0], [0, 8], [8, 0], [8, 8]];
        let below = Isometry3::translation(0.08, 0.08, -0.06);
        let shape = Shape::Sphere { radius: 0.03 };
        setup.obstacles = vec![Obstacle { name: "ball".into(), shape, pose: below, friction: None }];
        let mut world = World::new(setup).unwrap();
        let pose = Isometry3::translation(0.08, 0.08, 0.01);
        world.step(&[Command::Push { obstacle: 0, pose, duration }], 0.02, Budget::solves(2));
        cloth::settle(&mut world, 0.02, 2000);
        assert_eq!(world.state().poses[0], pose);
        assert!(world.report().contact.pairs > 4 && world.report().min_gap > 0.0);
        assert!(world.report().cost.total() < 1e-12, "{:?}", world.report().cost);
        world.positions().to_vec()
    };
    let (gently, hard) = (rest(2.0), rest(0.0));
    let apart = gently.iter().zip(&hard).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
    assert!(apart < 1e-6, "{apart} m");
}

#[test]
fn a_sheet_that_falls_far_in_one_step_comes_to_rest_as_one_laid_down() {
    let rest = |height: f64| {
        let mut setup = cloth::sheet("denim-a", [6, 6], [0.1, 0.1]);
        setup.fabric = Arc::new(elastic());
        setup.drag = 0.0;
        setup.positions.iter_mut().for_each(|p| p.z = height);
        let pose = Isometry3::identity();
        setup.obstacles = vec![Obstacle { name: "floor".into(), shape: Shape::Plane, pose, friction: None }];
        let mut world = World::new(setup).unwrap();
        let mut fastest = 0.0_f64;
        for _ in 0..2000 {
            let way = world.state().velocities.iter().map(|v| v.norm() * 0.02).fold(0.0, f64::max);
            fastest = fastest.max(way);
            if world.step(&[], 0.02, Budget::solves(2)).resting {
                break;
            }
        }
        let report = world.report();
        assert!(report.resting && report.min_gap > 0.0 && report.cost.total() < 1e-12, "{report:?}");
        (world.positions().to_vec(), fastest)
    };
    let ((laid, _), (fallen, way)) = (rest(1e-3), rest(0.1));
    assert!(way > 0.02, "the last steps before the floor go far beyond it: {way} m");
    let apart = laid.iter().zip(&fallen).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
    assert!(apart < 1e-6, "{apart} m");
}

#[test]
fn a_hand_sent_into_a_box_stops_at_it_and_feels_it() {
    let mut setup = cloth::sheet("denim-a", [9, 9], [0.16, 0.16]);
    setup.obstacles = vec![cloth::cuboid([0.1; 3], Vec3::new(0.08, 0.08, -0.105))];
    setup.hand = Some([4, 4]);
    let mut world = World::new(setup).unwrap();
    cloth::settle(&mut world, 0.02, 500);
    let free = world.report().hand.unwrap();
    world.step(&[Command::Grab { particle: [4, 4] }], 0.02, Budget::solves(4));
    let position = free.position - Vec3::z() * 0.05;
    world.step(&[Command::Move { position }], 0.02, Budget::solves(4));
    for _ in 0..20 {
        world.step(&[], 0.02, Budget::solves(4));
    }
    let report = world.report();
    let hand = report.hand.unwrap();
    assert!(report.hand_blocked, "the client is told");
    assert!(hand.position.z > -0.005 && report.min_gap > 0.0, "{hand:?}");
    assert!(hand.force.z > 0.05, "the box presses back: {:?}", hand.force);
    assert!(hand.stiffness[(2, 2)] > 100.0, "and stiffly: {}", hand.stiffness);
}

/// Contact is met where inertia takes the cloth. Met where the last step left it, one solve erred by 5 % of the force in the median.
#[test]
fn one_solve_per_tick_follows_a_hand_that_lifts_the_corner_of_a_drape() {
    let scene = Scene { particles: [20, 20], ..Scene::named("drape").unwrap() };
    let mut world = World::new(scene.setup().unwrap()).unwrap();
    cloth::settle(&mut world, 0.02, 2000);
    let from = world.report().hand.unwrap().position;
    let start = world.snapshot();
    let mut forces = |solves: u32| -> Vec<Vec3> {
        world.restore(&start);
        world.step(&[Command::Grab { particle: [0, 0] }], 1e-3, Budget::solves(solves));
        let lift = |tick: u32| {
            let position = from + 1e-4 * f64::from(tick) * Vec3::new(0.6, 0.0, 0.8);
            world.step(&[Command::Move { position }], 1e-3, Budget::solves(solves)).hand.unwrap().force
        };
        (1..=100).map(lift).collect()
    };
    let [one, exact] = [forces(1), forces(30)];
    let mut errors: Vec<f64> = one.iter().zip(&exact).map(|(a, b)| (a - b).norm() / b.norm()).collect();
    errors.sort_by(f64::total_cmp);
    assert!(errors[50] < 0.01 && errors[95] < 0.03, "{} {} {}", errors[50], errors[95], errors[99]);
}

/// What pressed, and was led out of its reach by inertia alone, was left out of one step and thrown out by the next: a hundred times a
/// particle's weight stayed out of balance in every tick.
#[test]
fn what_presses_is_not_let_go_in_every_second_tick() {
    let scene = Scene { particles: [39, 39], ..Scene::named("drape").unwrap() };
    let mut world = World::new(scene.setup().unwrap()).unwrap();
    cloth::settle(&mut world, 0.02, 2000);
    let (from, start) = (world.report().hand.unwrap().position, world.snapshot());
    let mut world = World::with_method(world.setup().clone(), Method::Multigrid).unwrap();
    world.restore(&start);
    world.step(&[Command::Grab { particle: [0, 0] }], 1e-3, Budget::solves(1));
    let circle = |tick: u32| {
        let angle = 0.005 * f64::from(tick);
        let position =
            from + 0.02 * Vec3::new(0.8 * (1.0 - angle.cos()), angle.sin(), 0.6 * (1.0 - angle.cos()));
        world.step(&[Command::Move { position }], 1e-3, Budget::solves(1)).residual
    };
    let mut residuals: Vec<f64> = (1..=250).map(circle).skip(50).collect();
    residuals.sort_by(f64::total_cmp);
    let weight = world.model().weight_on_earth() / 1521.0;
    let [half, most] = [100, 190].map(|k| residuals[k] / weight);
    assert!(half < 10.0 && most < 30.0, "{half} and {most} times a particle's weight out of balance");
}

/// Folds about a corner of the box are too sharp for matrices that leave out bending's moment: with them a tick takes more than two solves.
#[test]
fn a_hand_that_presses_beside_a_corner_takes_few_solves() {
    let mut solves = 0;
    for n in [27, 30, 33] {
        let scene = Scene { particles: [n, n], ..Scene::named("drape").unwrap() };
        let mut world = World::with_method(scene.setup().unwrap(), Method::Multigrid).unwrap();
        cloth::settle(&mut world, 0.02, 2000);
        world.step(&[Command::Grab { particle: [0, 0] }], 0.02, Budget::solves(8));
        let mut from = world.report().hand.unwrap().position;
        // On the top of the box, half way between its corner and its middle, and 5 mm into it.
        for to in [Vec3::new(-0.03, -0.03, 0.21), Vec3::new(-0.03, -0.03, 0.195)] {
            let steps = ((to - from).norm() / 2e-3).ceil();
            for k in 1..=steps as u32 {
                let position = from + (to - from) * (f64::from(k) / steps);
                world.step(&[Command::Move { position }], 0.02, Budget::solves(8));
            }
            from = to;
        }
        cloth::settle(&mut world, 0.02, 2000);
        let from = world.report().hand.unwrap().position - Vec3::z() * 5e-3;
        for tick in 1..=80 {
            let angle = 0.005 * f64::from(tick);
            let position = from + 0.02 * Vec3::new(angle.sin(), 1.0 - angle.cos(), 0.0);
            solves += world.step(&[Command::Move { position }], 1e-3, Budget::solves(1)).solves;
        }
    }
    assert!(solves < 2 * 3 * 80, "{solves} solves");
}
