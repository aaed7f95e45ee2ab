//! Distances of all kinds of pairs, and the contact made of them: derivatives near parallel and degenerate pieces, continuity at kinks.

use crate::{
    cloth,
    derivatives::{assert_order, flat, random, taylor_order},
};
use kesi::{
    math::Vec3,
    model::Model,
    obstacle::{Obstacle, Polyhedron, Shape},
    potential::{
        Curvature,
        contact::{Contact, candidates::Candidates, distance::Near},
    },
    scene::Scene,
    state::State,
    world::World,
};
use nalgebra::{Isometry3, Rotation3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::sync::Arc;

/// A piece of cloth, and how far it is from a piece of an obstacle.
type Distance<'a> = (&'a str, Vec<Vec3>, Measure, f64);
type Measure = Box<dyn Fn(&[Vec3]) -> Near>;

/// Distances of every kind, near parallel and degenerate ones too, with the step that their curvature bears.
fn distances() -> Vec<Distance<'static>> {
    let v = Vec3::from;
    let (o, x, y, z) = (Vec3::zeros(), Vec3::x(), Vec3::y(), Vec3::z());
    let face = [o, x, y];
    let needle = [o, x, 0.5 * x + 1e-7 * y];
    let edge = |segment: [Vec3; 2]| Box::new(move |c: &[Vec3]| Near::edge_segment([c[0], c[1]], segment));
    let point = |p: Vec3| Box::new(move |c: &[Vec3]| Near::triangle_point([c[0], c[1], c[2]], p));
    let particle = |f: [Vec3; 3]| Box::new(move |c: &[Vec3]| Near::particle_face(c[0], f));
    let h = 1e-3;
    vec![
        ("particle, face", vec![v([0.2, 0.3, 0.4])], particle(face), h),
        ("particle, side of a face", vec![v([0.7, 0.8, 0.3])], particle(face), h),
        ("particle, corner of a face", vec![v([1.4, -0.3, 0.3])], particle(face), h),
        ("particle, needle", vec![v([0.3, 0.2, 0.3])], particle(needle), h),
        ("particle, needle, tiny gap", vec![v([0.5, 0.0, 1e-6])], particle(face), 1e-8),
        ("edge across a ridge", vec![v([-1.0, 0.1, 0.3]), v([1.2, -0.2, 0.4])], edge([-y, y]), h),
        ("edge beside a ridge", vec![v([0.3, 0.1, 0.3]), v([1.2, -0.2, 0.4])], edge([-y, y]), h),
        ("edge beyond a ridge's end", vec![v([-1.0, 1.5, 0.3]), v([1.2, 1.6, 0.4])], edge([-y, y]), h),
        ("edge nearly parallel", vec![v([0.1, -0.7, 0.3]), v([0.1 + 1e-4, 0.8, 0.3])], edge([-y, y]), 1e-7),
        (
            "edge nearly parallel, crossing",
            vec![v([-1e-3, -0.7, 0.3]), v([1e-3, 0.8, 0.3])],
            edge([-y, y]),
            1e-6,
        ),
        ("edge that is a point", vec![v([0.3, 0.1, 0.3]), v([0.3, 0.1, 0.3])], edge([-y, y]), 1e-3),
        ("edge, small gap", vec![v([-1.0, 0.1, 1e-4]), v([1.2, -0.2, 1e-4])], edge([-y, y]), 3e-5),
        (
            "triangle over a corner",
            vec![v([-1.0, -1.0, 0.3]), v([1.0, -0.8, 0.2]), v([0.1, 1.2, 0.4])],
            point(o),
            h,
        ),
        (
            "triangle beside a corner",
            vec![v([0.2, -1.0, 0.3]), v([1.0, -0.8, 0.2]), v([0.4, 1.2, 0.4])],
            point(o),
            h,
        ),
        (
            "sliver over a corner",
            vec![v([-1.0, -1e-3, 0.3]), v([1.0, -1e-3, 0.3]), v([0.1, 2e-3, 0.3])],
            point(0.1 * z),
            1e-6,
        ),
        (
            "edge nearly parallel, tiny gap",
            vec![v([-5e-4, -0.5, 1e-3]), v([5e-4, 0.5, 1e-3])],
            edge([-y, y]),
            1e-7,
        ),
        ("edge parallel to its end", vec![v([2e-4, 0.5, 0.3]), v([0.0, 1.5, 0.3])], edge([-y, y]), 1e-6),
        ("edge of two near ends", vec![v([1e-5, 0.1, 1e-3]), v([-1e-5, 0.1, 1e-3])], edge([-y, y]), 1e-7),
        (
            "ridge of two near ends",
            vec![v([-0.4, 0.1, 1e-3]), v([0.5, -0.1, 1e-3])],
            edge([-1e-5 * y, 1e-5 * y]),
            1e-7,
        ),
        (
            "triangle of three near corners",
            vec![v([-1e-4, -1e-4, 1e-3]), v([1e-4, -8e-5, 1e-3]), v([1e-5, 1.2e-4, 1e-3])],
            point(o),
            1e-7,
        ),
        (
            "triangle of two near corners",
            vec![v([-0.01, 0.0, 1e-3]), v([0.01, -5e-5, 1e-3]), v([0.01, 5e-5, 1e-3])],
            point(o),
            1e-8,
        ),
        (
            "triangle of two near corners, beside one",
            vec![v([-0.01, 0.0, 1e-3]), v([0.01, -5e-5, 1e-3]), v([0.01, 5e-5, 1e-3])],
            point(0.0101 * x),
            1e-8,
        ),
        (
            "sliver, tiny gap",
            vec![v([-0.01, -1e-4, 1e-3]), v([0.01, -1e-4, 1e-3]), v([1e-3, 2e-4, 1e-3])],
            point(o),
            1e-8,
        ),
        (
            "particle, face of near corners",
            vec![v([1e-5, 1e-5, 1e-3])],
            particle([o, 1e-4 * x, 1e-4 * y]),
            1e-6,
        ),
        ("particle, sliver", vec![v([0.5, 1e-4, 1e-3])], particle([o, x, 0.5 * x + 3e-4 * y]), 1e-6),
        ("particle, end of a sliver", vec![v([1.001, 1e-4, 1e-3])], particle([o, x, x + 1e-5 * y]), 1e-6),
        ("particle, face without area", vec![v([0.3, 2e-4, 1e-3])], particle([o, x, 0.5 * x]), 1e-6),
        ("triangle that is a line", vec![-x + z, x + z, 0.3 * x + z], point(1.5 * x), 1e-3),
    ]
}

#[test]
fn distances_of_all_pairs_pass_the_taylor_test_near_parallel_and_degenerate_ones_too() {
    let mut rng = Pcg64Mcg::seed_from_u64(9);
    for (name, cloth, near, h) in distances() {
        let d: Vec<Vec3> = cloth.iter().map(|_| random(&mut rng)).collect();
        let at = |h: f64| -> Vec<Vec3> { cloth.iter().zip(&d).map(|(c, d)| c + d * h).collect() };
        let gradient = |h: f64| {
            let near = near(&at(h));
            flat(&(0..cloth.len()).map(|k| near.normal * near.weights[k]).collect::<Vec<_>>())
        };
        let slope: f64 = gradient(0.0).iter().zip(flat(&d)).map(|(g, d)| g * d).sum();
        assert_order(name, taylor_order(h, |h| vec![near(&at(h)).distance], &[slope]));
        let blocks = near(&cloth).hessian(&cloth);
        let turn: Vec<Vec3> =
            (0..cloth.len()).map(|a| (0..cloth.len()).map(|b| blocks[a][b] * d[b]).sum()).collect();
        assert_order(&format!("{name}, hessian"), taylor_order(h, gradient, &flat(&turn)));
    }
}

/// The largest change of a function over an interval of 1e-12, found by halving each of many pieces of the way from 0 to 1 towards
/// where it changes most; relative to its largest value.
fn jump(f: impl Fn(f64) -> Vec<f64>) -> f64 {
    const PIECES: u32 = 200;
    let change = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    let scale = (0..=PIECES).map(|k| f(f64::from(k) / f64::from(PIECES)).iter().map(|v| v * v).sum::<f64>());
    let scale = scale.fold(0.0, f64::max).sqrt();
    let mut worst = 0.0_f64;
    for k in 0..PIECES {
        let [mut from, mut to] = [k, k + 1].map(|k| f64::from(k) / f64::from(PIECES));
        let [mut a, mut b] = [f(from), f(to)];
        while to - from > 1e-12 {
            let middle = 0.5 * (from + to);
            let m = f(middle);
            if change(&a, &m) > change(&m, &b) {
                (to, b) = (middle, m);
            } else {
                (from, a) = (middle, m);
            }
        }
        worst = worst.max(change(&a, &b));
    }
    worst / scale
}

/// Ways past corners, sides and ends of either piece.
#[test]
fn distances_and_their_gradients_are_continuous_where_the_nearest_parts_change() {
    let mut rng = Pcg64Mcg::seed_from_u64(10);
    let face = [Vec3::zeros(), Vec3::x(), Vec3::y()];
    for _ in 0..20 {
        // Obstacles below, cloth above: it passes over them and never meets them.
        let mut place = |z: f64| Vec3::new(rng.random_range(-1.5..1.5), rng.random_range(-1.5..1.5), z);
        let [from, to] = [(); 2].map(|()| [place(0.3), place(0.4), place(0.5)]);
        let kinds: [(&str, usize, Measure); 4] = [
            ("particle, face", 1, Box::new(move |c| Near::particle_face(c[0], face))),
            ("particle, ridge", 1, Box::new(move |c| Near::particle_segment(c[0], [face[0], face[1]]))),
            ("edge, ridge", 2, Box::new(move |c| Near::edge_segment([c[0], c[1]], [face[0], face[1]]))),
            ("triangle, corner", 3, Box::new(move |c| Near::triangle_point([c[0], c[1], c[2]], face[0]))),
        ];
        for (name, count, near) in kinds {
            let at = |t: f64| {
                let cloth: Vec<Vec3> = (0..count).map(|k| from[k] + (to[k] - from[k]) * t).collect();
                near(&cloth)
            };
            let value = jump(|t| vec![at(t).distance]);
            let gradient = jump(|t| {
                let near = at(t);
                flat(&(0..count).map(|k| near.normal * near.weights[k]).collect::<Vec<_>>())
            });
            assert!(value < 1e-9 && gradient < 1e-6, "{name}: {value:e} {gradient:e}");
        }
    }
}

/// One cell of cloth, 2 cm wide, above an obstacle around the origin whose top is 1 cm up.
fn one_cell(shape: Shape) -> (Model, State) {
    let mut setup = cloth::sheet("denim-a", [2, 2], [0.02, 0.02]);
    setup.positions.iter_mut().for_each(|p| *p -= Vec3::new(0.01, 0.01, 0.0));
    setup.obstacles =
        vec![Obstacle { name: "it".into(), shape, pose: Isometry3::identity(), friction: None }];
    let model = Model::new(&setup).unwrap();
    let state = State::new(&model, setup.positions);
    (model, state)
}

/// A sheet of 9 × 9 particles, 4 cm wide, tilted and wavy, so near an obstacle around the origin that some particles press and some do not.
fn wavy(shape: Shape, rng: &mut Pcg64Mcg) -> (Model, State) {
    let mut setup = cloth::sheet("denim-a", [9, 9], [0.04, 0.04]);
    setup.obstacles =
        vec![Obstacle { name: "it".into(), shape, pose: Isometry3::identity(), friction: None }];
    let model = Model::new(&setup).unwrap();
    let turn = Rotation3::from_axis_angle(&Vec3::x_axis(), rng.random_range(-0.1..0.1));
    let mut positions = setup.positions;
    for p in &mut positions {
        *p = turn * (*p - Vec3::new(0.02, 0.02, 0.0)) + Vec3::z() * 0.0106;
        *p += Vec3::from_fn(|_, _| rng.random_range(-2e-4..2e-4));
    }
    let state = State::new(&model, positions);
    (model, state)
}

/// The shapes whose pairs are listed in different ways.
fn listed_shapes() -> [Shape; 4] {
    let half = [0.011, 0.012, 0.01];
    let corners = (0..8).map(|n| Vec3::from_fn(|k, _| if n >> k & 1 == 1 { half[k] } else { -half[k] }));
    [
        Shape::Cuboid { half },
        Shape::Sphere { radius: 0.01 },
        Shape::Capsule { half: 0.002, radius: 0.008 },
        Shape::Polyhedron(Arc::new(Polyhedron::hull(&corners.collect::<Vec<_>>()).unwrap())),
    ]
}

#[test]
fn lists_made_a_while_ago_find_what_new_ones_find() {
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    for (kind, shape) in listed_shapes().into_iter().enumerate() {
        let mut pressing = 0;
        for _ in 0..20 {
            let (model, state) = wavy(shape.clone(), &mut rng);
            let mut old = Candidates::new(&model);
            old.update(&model, &state.poses, &state.positions, 1e-3);
            let moved = |p: &Vec3| p + Vec3::from_fn(|_, _| rng.random_range(-5e-4..5e-4));
            let x: Vec<Vec3> = state.positions.iter().map(moved).collect();
            let listed = Contact { model: &model, state: &state, candidates: &old };
            let mut gradient = vec![Vec3::zeros(); x.len()];
            listed.add_gradient(&x, &mut gradient);
            let (energy, expected, _) = contact_at(&model, &state, &x, &x);
            assert_eq!((listed.energy(&x), gradient), (energy, expected), "shape {kind}");
            pressing += usize::from(energy > 0.0);
        }
        assert!(pressing > 10, "shape {kind}: {pressing}");
    }
}

#[test]
fn anchors_change_the_gradient_as_a_commit_does() {
    let mut rng = Pcg64Mcg::seed_from_u64(6);
    for shape in listed_shapes() {
        let (model, mut state) = wavy(shape, &mut rng);
        let mut candidates = Candidates::new(&model);
        candidates.update(&model, &state.poses, &state.positions, 1e-3);
        let mut x = state.positions.clone();
        for _ in 0..3 {
            let mut anchors = Vec::new();
            let contact = Contact { model: &model, state: &state, candidates: &candidates };
            let mut gradient = vec![Vec3::zeros(); x.len()];
            contact.add_gradient(&x, &mut gradient);
            contact.commit(&contact.touches(&x), &x, &mut anchors);
            std::mem::swap(&mut state.anchors, &mut anchors);
            let contact = Contact { model: &model, state: &state, candidates: &candidates };
            contact.change_anchors(&anchors, &x, &mut gradient);
            let mut expected = vec![Vec3::zeros(); x.len()];
            contact.add_gradient(&x, &mut expected);
            let largest = expected.iter().map(|g| g.norm()).fold(0.0, f64::max);
            assert!(largest > 0.0 && !state.anchors.is_empty());
            for (changed, anew) in gradient.iter().zip(&expected) {
                assert!((changed - anew).norm() < 1e-12 * largest);
            }
            x.iter_mut().for_each(|p| *p += Vec3::from_fn(|_, _| rng.random_range(-1e-4..1e-4)));
        }
    }
}

/// The energy of contact at `x`, its gradient, and its Hessian times `d`.
fn contact_at(model: &Model, state: &State, x: &[Vec3], d: &[Vec3]) -> (f64, Vec<Vec3>, Vec<Vec3>) {
    let mut candidates = Candidates::new(model);
    candidates.update(model, &state.poses, x, 0.0);
    let contact = Contact { model, state, candidates: &candidates };
    let (mut gradient, mut turned) = (vec![Vec3::zeros(); x.len()], vec![Vec3::zeros(); x.len()]);
    contact.add_gradient(x, &mut gradient);
    contact.hessian(&contact.touches(x), x, Curvature::Exact, &mut |row, column, block| {
        turned[row as usize] += block * d[column as usize];
        if row != column {
            turned[column as usize] += block.transpose() * d[row as usize];
        }
    });
    (contact.energy(x), gradient, turned)
}

/// A cell whose one side lies along a ridge of a box, turned by angles from none to beyond where edges and ridges are faded out.
#[test]
fn contact_of_nearly_parallel_edges_passes_the_taylor_test_and_is_continuous() {
    let (model, state) = one_cell(Shape::Cuboid { half: [0.05, 0.01, 0.01] });
    let thickness = model.contact.barrier.activation;
    let cell = |angle: f64| -> Vec<Vec3> {
        let turn = Rotation3::from_axis_angle(&Vec3::z_axis(), angle);
        let slope = Rotation3::from_axis_angle(&Vec3::x_axis(), 0.4);
        // The side from (0, 0) to (1, 0) runs along x above and beyond the ridge at y = 0.01.
        let raise = Vec3::new(0.0, 0.01 + 0.35 * thickness, 0.01 + 0.5 * thickness);
        let place = |p: &Vec3| slope * (turn * (p + Vec3::y() * 0.01)) + raise;
        state.positions.iter().map(place).collect()
    };
    let mut rng = Pcg64Mcg::seed_from_u64(11);
    // Faded wholly, in part, and not at all: the sine's bound is 0.0316.
    for angle in [0.0, 1e-4, 0.01, 0.02, 0.03, 0.033, 0.1] {
        let x = cell(angle);
        let d: Vec<Vec3> = x.iter().map(|_| random(&mut rng)).collect();
        let at = |h: f64| -> Vec<Vec3> { x.iter().zip(&d).map(|(p, d)| p + d * h).collect() };
        let evaluate = |h: f64| contact_at(&model, &state, &at(h), &d);
        let (energy, gradient, turned) = evaluate(0.0);
        assert!(energy > 0.0, "it presses");
        let slope: f64 = gradient.iter().zip(&d).map(|(g, d)| g.dot(d)).sum();
        assert_order(&format!("energy at {angle}"), taylor_order(4e-7, |h| vec![evaluate(h).0], &[slope]));
        let order = taylor_order(4e-7, |h| flat(&evaluate(h).1), &flat(&turned));
        assert_order(&format!("gradient at {angle}"), order);
    }
    let still = vec![Vec3::zeros(); 4];
    let turning = |t: f64| contact_at(&model, &state, &cell(0.1 * (t - 0.3)), &still);
    let [value, gradient] = [jump(|t| vec![turning(t).0]), jump(|t| flat(&turning(t).1))];
    assert!(value < 1e-6 && gradient < 1e-4, "{value:e} {gradient:e}");
}

/// A cell dragged and turned over the ridges and corners of every shape, pressed to it by less than its thickness.
#[test]
fn contact_is_continuous_over_ridges_and_corners_of_every_shape() {
    let cube = Shape::Cuboid { half: [0.01; 3] };
    let mut hollow = cube.features().points;
    let hull = Polyhedron::hull(&hollow).unwrap();
    // A cube with a pit in its side: not convex, its top as before.
    let mut faces = hull.faces().to_vec();
    hollow = hull.points().to_vec();
    let is_side = |f: &[u32; 3]| f.iter().all(|&n| hollow[n as usize].y < 0.0);
    let side: Vec<[u32; 3]> = faces.iter().copied().filter(|f| is_side(f)).collect();
    faces.retain(|f| !is_side(f));
    let pit = hollow.len() as u32;
    let mut sides: Vec<[u32; 2]> = side.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]).collect();
    let inner: Vec<[u32; 2]> = sides.iter().copied().filter(|[a, b]| sides.contains(&[*b, *a])).collect();
    sides.retain(|s| !inner.contains(s));
    faces.extend(sides.iter().map(|&[a, b]| [a, b, pit]));
    hollow.push(Vec3::new(0.0, -0.005, 0.0));
    let mesh = Polyhedron::mesh(hollow, faces).unwrap();
    assert!(!mesh.is_convex());
    for shape in [
        cube,
        Shape::Sphere { radius: 0.01 },
        Shape::Capsule { half: 0.008, radius: 0.002 },
        Shape::Polyhedron(Arc::new(hull)),
        Shape::Polyhedron(Arc::new(mesh)),
    ] {
        let (model, state) = one_cell(shape.clone());
        let thickness = model.contact.barrier.activation;
        let still = vec![Vec3::zeros(); 4];
        let at = |t: f64| {
            let turn = Rotation3::from_euler_angles(0.0, 0.0, 0.3 + 1.1 * t);
            let raise = Vec3::new(0.015 * t - 0.004, 0.012 * t - 0.003, 0.01 + 0.7 * thickness);
            let x: Vec<Vec3> = state.positions.iter().map(|p| turn * p + raise).collect();
            contact_at(&model, &state, &x, &still)
        };
        let [value, gradient] = [jump(|t| vec![at(t).0]), jump(|t| flat(&at(t).1))];
        assert!(value < 1e-6 && gradient < 1e-4, "{shape:?}: {value:e} {gradient:e}");
    }
}

/// Lists made for cloth that was fast hold pairs far away. They are made anew when it is slow, last while it creeps over a corner for a
/// hundred steps of 0.1 mm, and find what ones made for each place find.
#[test]
fn lists_of_what_may_touch_follow_the_speed_of_the_cloth() {
    let setup = Scene { particles: [20, 20], ..Scene::built_in("drape").unwrap() }.setup().unwrap();
    let model = Model::new(&setup).unwrap();
    let state = World::new(setup).unwrap().state().clone();
    let top = model.obstacles.iter().zip(&state.poses).map(|(o, pose)| {
        let Shape::Cuboid { half } = o.shape else { return f64::NEG_INFINITY };
        pose.translation.z + half[2]
    });
    let thickness = model.contact.barrier.activation;
    let raised = top.fold(f64::NEG_INFINITY, f64::max) + 0.5 * thickness - state.positions[0].z;
    let start: Vec<Vec3> = state.positions.iter().map(|x| x + Vec3::z() * raised).collect();
    let at = |way: f64| -> Vec<Vec3> { start.iter().map(|x| x + Vec3::x() * way).collect() };
    let mut candidates = Candidates::new(&model);
    let listed =
        |candidates: &Candidates| candidates.listed().iter().map(|l| l.triangles.len()).sum::<usize>();
    candidates.update(&model, &state.poses, &start, 0.05);
    let (fast, made) = (listed(&candidates), candidates.builds);
    candidates.update(&model, &state.poses, &start, 2e-3);
    let slow = listed(&candidates);
    assert!(candidates.builds == made + 1 && slow < fast, "{} lists; {slow} of {fast}", candidates.builds);
    let mut pressed = 0.0;
    for step in 1..=100 {
        let x = at(1e-4 * f64::from(step));
        candidates.update(&model, &state.poses, &x, 2e-3);
        let listed = Contact { model: &model, state: &state, candidates: &candidates };
        let (expected, ..) = contact_at(&model, &state, &x, &x);
        assert_eq!(listed.energy(&x).to_bits(), expected.to_bits(), "step {step}");
        pressed += expected;
    }
    assert!(candidates.builds <= made + 2 && pressed > 0.0, "{} lists, {pressed:e} J", candidates.builds);
}
