//! Every derivative against differences: the remainder of the first-order expansion must fall with the square of the step.

use crate::cloth;
use kesi::{
    batch::{Measures, Planes},
    cores::Team,
    cost::{self, Coefficients, Forces},
    fabric::law::Law,
    grid::{Grid, Triple},
    math::Vec3,
    model::Model,
    potential::{
        Curvature, Potential, Pull,
        contact::{Contact, Touches, candidates::Candidates},
        edge,
        halves::FEWEST_IN_HALVES,
        pattern::Pattern,
        shear,
        system::System,
        triple, twist,
    },
    state::{Meeting, State},
};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::sync::Arc;

pub fn random(rng: &mut Pcg64Mcg) -> Vec3 {
    Vec3::from_fn(|_, _| rng.random_range(-1.0..1.0))
}

/// Order of the remainder |f(h) − f(0) − h f'(0)| from a series of halved steps: the best of the series, as large steps see
/// higher orders and small ones rounding. `f` returns any vector.
pub fn taylor_order(h: f64, f: impl Fn(f64) -> Vec<f64>, slope: &[f64]) -> f64 {
    let start = f(0.0);
    let remainder = |h: f64| {
        let terms = f(h).into_iter().zip(&start).zip(slope).map(|((a, b), s)| (a - b - h * s).powi(2));
        terms.sum::<f64>().sqrt()
    };
    let scale = start.iter().chain(slope).map(|v| v * v).sum::<f64>().sqrt();
    let errors: Vec<f64> = (0..6).map(|k| remainder(h / f64::from(1 << k))).collect();
    if errors[0] <= 1e-13 * scale {
        return 2.0;
    }
    errors.windows(2).map(|e| (e[0] / e[1]).log2()).fold(f64::NEG_INFINITY, f64::max)
}

pub fn assert_order(name: &str, order: f64) {
    assert!(order >= 1.9, "{name}: order {order:.3}");
}

/// Edge vectors, ordinary and degenerate.
#[test]
fn edge_strain_passes_the_taylor_test() {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    for e in [
        Vec3::new(1.0, 0.2, 0.1),
        Vec3::new(1e-4, 0.0, 0.0),
        Vec3::new(-3.0, 2.0, 1.0),
        Vec3::new(1e-3, 1e-3, 0.0),
    ] {
        let d = random(&mut rng);
        let h = 0.01 * e.norm();
        let s = edge::strain(e, 1.0);
        assert_order(
            "gradient",
            taylor_order(h, |h| vec![edge::strain(e + d * h, 1.0).value], &[s.gradient.dot(&d)]),
        );
        let hd = s.hessian() * d;
        let gradient = |h: f64| edge::strain(e + d * h, 1.0).gradient.iter().copied().collect();
        assert_order("hessian", taylor_order(h, gradient, hd.as_slice()));
    }
}

/// Flat, curved, folded, sheared nearly shut, collapsed to a line, and with vanishing sides.
#[test]
fn curvature_passes_the_taylor_test_on_degenerate_stencils_too() {
    let mut rng = Pcg64Mcg::seed_from_u64(2);
    let (x, y, z) = (Vec3::x(), Vec3::y(), Vec3::z());
    let triple = Triple {
        nodes: [0, 1, 2, 3, 4],
        site: 1,
        direction: 0,
        lengths: [0.004, 0.006],
        span: 0.009,
        reach: 0.005,
        area: 1.0,
        rest: 0.0,
    };
    let weights = triple::Weights::new(&triple);
    for (vectors, h) in [
        ([x, x, y], 1e-2),
        ([x, x + 0.5 * z, y - 0.2 * x], 1e-2),
        ([x, 0.1 * x + z, y], 1e-2),
        ([x + 0.1 * z, x - 0.1 * z, x + 0.02 * y], 1e-4),
        ([x, x + 0.3 * z, x], 1e-5),
        ([x, -x + 0.01 * z, y], 1e-4),
        ([x, 1e-3 * z, 1e-3 * y], 1e-5),
        ([Vec3::zeros(), x + z, y], 1e-5),
        ([x, x + 0.3 * z, 0.9 * x + 0.35 * y], 1e-3),
        ([x, 0.2 * x + z, 0.1 * x + 0.3 * y + 0.1 * z], 1e-3),
        ([z + 0.1 * x, 0.1 * x - 0.9 * z, 0.2 * x + 0.4 * y], 1e-4),
    ] {
        let d = [random(&mut rng), random(&mut rng), random(&mut rng)];
        let at = |h: f64| weights.curvature(std::array::from_fn(|k| vectors[k] + d[k] * h));
        let c = at(0.0);
        let slope: f64 = (0..3).map(|k| c.gradient[k].dot(&d[k])).sum();
        assert_order("gradient", taylor_order(h, |h| vec![at(h).value], &[slope]));
        let gradient = |h: f64| flat(&at(h).gradient);
        assert_order("hessian", taylor_order(h, gradient, &flat(&c.hessian_times(d))));
    }
}

#[test]
fn shear_angle_passes_the_taylor_test_on_degenerate_cells_too() {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let (x, y) = (Vec3::x(), Vec3::y());
    for (vectors, h) in [
        ([x, y], 1e-2),
        ([x + 0.4 * y, y - 0.3 * x + 0.2 * Vec3::z()], 1e-2),
        ([x, x + 0.01 * y], 1e-5),
        ([x, x], 1e-6),
        ([1e-5 * x, y], 1e-7),
        ([Vec3::zeros(), y], 1e-7),
    ] {
        let d = [random(&mut rng), random(&mut rng)];
        let at = |h: f64| shear::angle(std::array::from_fn(|k| vectors[k] + d[k] * h));
        let c = at(0.0);
        let slope: f64 = (0..2).map(|k| c.gradient[k].dot(&d[k])).sum();
        assert_order("gradient", taylor_order(h, |h| vec![at(h).value], &[slope]));
        let [aa, ab, bb] = c.hessian();
        let rows = [aa * d[0] + ab * d[1], ab.tr_mul(&d[0]) + bb * d[1]];
        let flat: Vec<f64> = rows.iter().flat_map(|v| v.iter().copied()).collect();
        let gradient =
            |h: f64| at(h).gradient.iter().flat_map(|v| v.iter().copied().collect::<Vec<_>>()).collect();
        assert_order("hessian", taylor_order(h, gradient, &flat));
    }
}

#[test]
fn twist_passes_the_taylor_test_on_degenerate_cells_too() {
    let mut rng = Pcg64Mcg::seed_from_u64(8);
    let (x, y, z) = (Vec3::x(), Vec3::y(), Vec3::z());
    for (vectors, h) in [
        ([x, y, Vec3::zeros()], 1e-2),
        ([x + 0.3 * z, y - 0.2 * x, 40.0 * z + 10.0 * x], 1e-2),
        ([x, x + 0.01 * y, 5.0 * z - 3.0 * y], 1e-4),
        ([x, x, 5.0 * z], 1e-5),
        ([Vec3::zeros(), y, 5.0 * z + x], 1e-5),
    ] {
        let d = [random(&mut rng), random(&mut rng), random(&mut rng)];
        let at = |h: f64| twist::twist(std::array::from_fn(|k| vectors[k] + d[k] * h));
        let c = at(0.0);
        let slope: f64 = (0..3).map(|k| c.gradient[k].dot(&d[k])).sum();
        assert_order("gradient", taylor_order(h, |h| vec![at(h).value], &[slope]));
        assert_order("hessian", taylor_order(h, |h| flat(&at(h).gradient), &flat(&c.hessian_times(d))));
    }
}

/// A crumpled 7 × 6 sheet on a box, with history, inertia, contact of all kinds and friction all at work.
fn crumpled() -> (Model, State, Candidates, Pull, Vec<Vec3>) {
    crumple([7, 6])
}

/// The same of any size; particles are 1 cm apart.
fn crumple(particles: [usize; 2]) -> (Model, State, Candidates, Pull, Vec<Vec3>) {
    let mut setup = cloth::sheet("denim-a", particles, particles.map(|n| 0.01 * (n - 1) as f64));
    setup.obstacles = vec![cloth::cuboid([0.0213, 0.0187, 0.02], Vec3::new(0.03, 0.025, -0.02105))];
    let model = Model::new(&setup).unwrap();
    let mut rng = Pcg64Mcg::seed_from_u64(4);
    let x: Vec<Vec3> = setup.positions.iter().map(|p| p + random(&mut rng) * 0.001).collect();
    let mut state = State::new(&model, x.clone());
    let mut wobble = |p: &mut f64, scale: f64| *p += rng.random_range(-0.5..0.5) * scale;
    state.history.edges.iter_mut().for_each(|p| wobble(p, model.fabric.tensile[0].stick()));
    state.history.triples.iter_mut().for_each(|p| wobble(p, model.fabric.bending[0].stick()));
    state.history.shears.iter_mut().for_each(|p| wobble(p, model.fabric.shear.stick()));
    let mut candidates = Candidates::new(&model);
    candidates.update(&model, &state.poses, &x, 1e-3);
    let before: Vec<Vec3> = x.iter().map(|p| p + random(&mut rng) * 1e-4).collect();
    let contact = Contact { model: &model, state: &state, candidates: &candidates };
    let mut anchors = Vec::new();
    contact.commit(&contact.touches(&before), &before, &mut anchors);
    state.anchors = anchors;
    let kinds = |kind| state.anchors.iter().filter(|a| a.pair.kind == kind).count();
    let kinds = [Meeting::ParticleFace, Meeting::EdgeRidge, Meeting::TriangleCorner].map(kinds);
    assert!(kinds.iter().all(|&count| count > 0), "all kinds of pairs touch: {kinds:?}");
    let mut pull = Pull::none(&model);
    pull.set_inertia(&model, &state, 0.01);
    (model, state, candidates, pull, x)
}

pub fn flat(v: &[Vec3]) -> Vec<f64> {
    v.iter().flat_map(|p| p.iter().copied().collect::<Vec<_>>()).collect()
}

/// Checks that kernels tell the potential's energy, and gradient and Hessian in a random direction, in steps of `h`. Gives the Hessian's system.
pub fn assert_taylor(potential: &Potential, x: &[Vec3], rng: &mut Pcg64Mcg, h: f64) -> System {
    let model = potential.model;
    let mut planes = Planes::new(model.elements.named.len());
    let [energy, by_kernels] =
        [potential.energy(x), potential.energy_by_kernels(x, &mut planes, &Team::default())];
    assert!((by_kernels / energy - 1.0).abs() < 1e-12, "{by_kernels} for {energy}");
    let d: Vec<Vec3> = x.iter().map(|_| random(rng)).collect();
    let along = |h: f64| -> Vec<Vec3> { x.iter().zip(&d).map(|(p, d)| p + d * h).collect() };
    let gradient = |h: f64| {
        let mut g = vec![Vec3::zeros(); x.len()];
        potential.gradient(&along(h), &mut g, &mut Measures::new(&model.elements));
        g
    };
    let slope: f64 = gradient(0.0).iter().zip(&d).map(|(g, d)| g.dot(d)).sum();
    assert_order("energy", taylor_order(h, |h| vec![potential.energy(&along(h))], &[slope]));
    let mut system = System::new(Arc::new(Pattern::new(&model.grid, &model.elements)));
    let strains: Vec<f64> = model.elements.edges.iter().map(|e| potential.strain(e, x).value).collect();
    potential.hessian(x, &strains, Curvature::Exact, &mut system);
    assert_order("gradient", taylor_order(h, |h| flat(&gradient(h)), &flat(&system.product(&d))));
    system
}

#[test]
fn potential_passes_the_taylor_test_as_a_whole() {
    let (model, state, candidates, pull, x) = crumpled();
    let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
    assert!(potential.contact().energy(&x).is_finite());
    let system = assert_taylor(&potential, &x, &mut Pcg64Mcg::seed_from_u64(5), 4e-7);
    assert!(system.rhs.iter().all(|r| r.norm() < 1e-9), "plain Newton has no tension excess");
}

/// A sheet large enough for its Hessian to be assembled in halves.
#[test]
fn hessians_in_halves_pass_the_taylor_test() {
    let (model, state, candidates, pull, x) = crumple([57, 54]);
    assert!(x.len() >= FEWEST_IN_HALVES);
    let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
    let mut rng = Pcg64Mcg::seed_from_u64(6);
    let d: Vec<Vec3> = x.iter().map(|_| random(&mut rng)).collect();
    let gradient = |h: f64| {
        let (mut g, to) = (vec![Vec3::zeros(); x.len()], x.iter().zip(&d).map(|(p, d)| p + d * h));
        potential.gradient(&to.collect::<Vec<_>>(), &mut g, &mut Measures::new(&model.elements));
        flat(&g)
    };
    let mut system = System::new(Arc::new(Pattern::new(&model.grid, &model.elements)));
    let strains: Vec<f64> = model.elements.edges.iter().map(|e| potential.strain(e, &x).value).collect();
    potential.hessian(&x, &strains, Curvature::Exact, &mut system);
    assert_order("gradient", taylor_order(4e-7, gradient, &flat(&system.product(&d))));
}

/// The Hessian half way tells what a step changes to third order, where tensions are those half way too. Mixed Newton steps have those of the
/// step's beginning: where the cloth turns more than it stretches, that is as good.
#[test]
fn the_middle_of_a_step_tells_its_change_to_third_order() {
    let (model, mut state, _, pull, x) = crumpled();
    state.anchors.clear();
    let candidates = Candidates::new(&model);
    let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
    let mut system = System::new(Arc::new(Pattern::new(&model.grid, &model.elements)));
    // What a step of h d leaves, with the Hessian of so much of it and the tensions of so much.
    let mut left = |d: &[Vec3], h: f64, of_shape: f64, of_tensions: f64| {
        let to = |h: f64| -> Vec<Vec3> { x.iter().zip(d).map(|(p, d)| p + d * h).collect() };
        let gradient = |h: f64| {
            let mut g = vec![Vec3::zeros(); x.len()];
            potential.gradient(&to(h), &mut g, &mut Measures::new(&model.elements));
            g
        };
        let place = to(of_tensions * h);
        let strains: Vec<f64> =
            model.elements.edges.iter().map(|e| potential.strain(e, &place).value).collect();
        let way: Vec<Vec3> = d.iter().map(|d| d * (2.0 * of_shape * h)).collect();
        system.set_middle(&x, &way, &model.elements.named);
        potential.begin_soft(Curvature::Exact, &mut system, &Team::default());
        potential.add_stiff(&strains, Curvature::Exact, &mut system);
        potential.finish_hessian(&x, &Touches::default(), Curvature::Exact, None, &mut system);
        system.compress();
        let change = gradient(h).into_iter().zip(gradient(0.0)).map(|(to, from)| to - from);
        let told = system.product(d).into_iter().map(|change| change * h);
        change.zip(told).map(|(change, told)| (change - told).norm_squared()).sum::<f64>().sqrt()
    };
    let mut order = |d: &[Vec3], [of_shape, of_tensions]: [f64; 2], h: f64| {
        let steps = (0..4).map(|k| h / f64::from(1 << k));
        let orders = steps
            .map(|h| (left(d, h, of_shape, of_tensions) / left(d, 0.5 * h, of_shape, of_tensions)).log2());
        orders.fold(f64::NEG_INFINITY, f64::max)
    };
    let mut rng = Pcg64Mcg::seed_from_u64(8);
    let any: Vec<Vec3> = x.iter().map(|_| random(&mut rng)).collect();
    let turn: Vec<Vec3> = x.iter().map(|x| Vec3::new(0.5, 1.0, -0.7).cross(x) / 0.05).collect();
    for (name, d, parts, h, [from, to]) in [
        ("the beginning, any way", &any, [0.0, 0.0], 4e-7, [1.9, 2.1]),
        ("the middle, any way", &any, [0.5, 0.5], 4e-7, [2.9, 3.1]),
        ("the beginning, turning", &turn, [0.0, 0.0], 4e-5, [1.9, 2.1]),
        ("the middle with tensions of the beginning, turning", &turn, [0.5, 0.0], 4e-5, [2.9, 3.1]),
    ] {
        let order = order(d, parts, h);
        assert!(order >= from && order <= to, "{name}: {order}");
    }
}

/// The formulas of the elements, one at a time, against the batched kernels.
#[test]
fn kernels_agree_with_the_elements_they_batch() {
    let (model, state, candidates, pull, x) = crumpled();
    let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
    let (elements, fabric, history) = (&model.elements, &model.fabric, &state.history);
    let mut measures = Measures::new(elements);
    let mut kernels = vec![Vec3::zeros(); x.len()];
    potential.gradient(&x, &mut kernels, &mut measures);
    let mut singly: Vec<Vec3> = (0..x.len())
        .map(|n| (x[n] - pull.targets[n]) * pull.weights[n] + Vec3::z() * (model.mass(n) * model.gravity))
        .collect();
    potential.contact().add_gradient(&x, &mut singly);
    let near = |name: &str, [a, b]: [f64; 2], scale: f64| {
        assert!((a - b).abs() <= 1e-12 * (b.abs() + scale), "{name}: {a} {b}");
    };
    let check = |name: &str, law: &Law, [measure, force]: [f64; 2], truth: f64, p: f64, unit: f64| {
        near(name, [measure, truth], unit);
        near(name, [force, law.evaluate(measure, p).force], law.loading(unit));
    };
    for (k, e) in elements.edges.iter().enumerate() {
        let (law, strain, p) = (&fabric.tensile[e.direction], potential.strain(e, &x), history.edges[k]);
        check("edge", law, measures.edges[k], strain.value, p, 0.01);
        let pull = strain.gradient * (law.evaluate(strain.value, p).force * e.width * e.length);
        singly[e.nodes[0] as usize] -= pull;
        singly[e.nodes[1] as usize] += pull;
    }
    for (k, t) in elements.triples.iter().enumerate() {
        let weights = triple::Weights::new(t);
        let (law, kappa, p) =
            (&fabric.bending[t.direction], potential.bend(t, &weights, &x), history.triples[k]);
        check("triple", law, measures.triples[k], kappa.value, p, 100.0);
        let moment = law.evaluate(kappa.value, p).force * t.area;
        let spread = weights.spread(&kappa.gradient);
        t.nodes.iter().zip(spread).for_each(|(n, g)| singly[*n as usize] += g * moment);
    }
    for (k, s) in elements.shears.iter().enumerate() {
        let weights = shear::Weights::new(s);
        let (phi, p) = (potential.angle(s, &weights, &x), history.shears[k]);
        check("shear", &fabric.shear, measures.shears[k], phi.value, p, 0.1);
        let force = fabric.shear.evaluate(phi.value, p).force * s.area;
        let spread = weights.spread(&phi.gradient);
        s.nodes.iter().zip(spread).for_each(|(n, g)| singly[*n as usize] += g * force);
        let weights = twist::Weights::new(s);
        let tau = potential.turn(s, &weights, &x);
        near("twist", [measures.twists[k], tau.value], 1.0);
        let moment = fabric.twist * tau.value * s.area;
        let spread = weights.spread(&tau.gradient);
        s.bent.iter().zip(spread).for_each(|(n, g)| singly[*n as usize] += g * moment);
    }
    let scale = singly.iter().map(|g| g.norm()).fold(0.0, f64::max);
    for (a, b) in kernels.iter().zip(&singly) {
        assert!((a - b).norm() <= 1e-12 * scale, "{a} {b}");
    }
    let (committed, lost) = potential.commit(&measures);
    let mut dissipated = 0.0;
    for (k, s) in elements.shears.iter().enumerate() {
        let p = fabric.shear.commit(measures.shears[k][0], history.shears[k]);
        near("history", [committed.shears[k], p], 1e-3);
        dissipated += s.area * fabric.shear.dissipated(history.shears[k], p);
    }
    assert!(dissipated > 0.0 && lost > dissipated);
}

#[test]
fn clamped_hessian_is_positive_semidefinite() {
    let (model, state, candidates, pull, x) = crumpled();
    let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
    let mut system = System::new(Arc::new(Pattern::new(&model.grid, &model.elements)));
    let strains: Vec<f64> = model.elements.edges.iter().map(|e| potential.strain(e, &x).value).collect();
    potential.hessian(&x, &strains, Curvature::Clamped, &mut system);
    let mut rng = Pcg64Mcg::seed_from_u64(6);
    for _ in 0..200 {
        let d: Vec<Vec3> = x.iter().map(|_| random(&mut rng)).collect();
        let energy: f64 = d.iter().zip(system.product(&d)).map(|(a, b)| a.dot(&b)).sum();
        assert!(energy > 0.0);
    }
}

#[test]
fn cost_passes_the_taylor_test_in_positions_and_forces() {
    let (model, state, candidates, pull, x) = crumpled();
    let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
    let mut rng = Pcg64Mcg::seed_from_u64(7);
    let own = cost::forces(&potential, &x);
    let mut push = |v: &Vec<f64>| {
        v.iter().map(|f| f * rng.random_range(0.2..2.0) + rng.random_range(-0.1..0.1)).collect()
    };
    // Moments are about 1e-3 N: pushing them by 0.1 N would drown the other terms.
    let forces = Forces {
        tensions: push(&own.tensions),
        moments: own.moments.iter().map(|m| m * 1.7 + 1e-4).collect(),
        shears: push(&own.shears),
    };
    let fixed: Vec<bool> = (0..x.len()).map(|n| n == 0 || n == 17).collect();
    let coefficients = Coefficients { newton: 0.7, stretch: 1.3, bend: 0.4, shear: 2.0 };
    let report = cost::evaluate(&potential, &x, &forces, &fixed, &coefficients);
    assert!(
        report.newton > 0.0 && report.stretch > 0.0 && report.bend > 0.0 && report.shear > 0.0,
        "{report:?}"
    );
    let (by_x, by_force) = cost::gradient(&potential, &x, &forces, &fixed, &coefficients);
    let d: Vec<Vec3> = x.iter().map(|_| random(&mut rng)).collect();
    let slope: f64 = by_x.iter().zip(&d).map(|(g, d)| g.dot(d)).sum();
    let at = |h: f64| -> Vec<f64> {
        let moved: Vec<Vec3> = x.iter().zip(&d).map(|(p, d)| p + d * h).collect();
        vec![cost::evaluate(&potential, &moved, &forces, &fixed, &coefficients).total()]
    };
    assert_order("positions", taylor_order(4e-8, at, &[slope]));
    let step = |v: &Vec<f64>, h: f64| {
        v.iter().enumerate().map(|(k, f)| f + h * (1.0 + (k % 3) as f64)).collect::<Vec<_>>()
    };
    let along = |v: &Vec<f64>| v.iter().enumerate().map(|(k, g)| g * (1.0 + (k % 3) as f64)).sum::<f64>();
    for part in 0..3 {
        let at = |h: f64| {
            let mut f = forces.clone();
            match part {
                0 => f.tensions = step(&f.tensions, h),
                1 => f.moments = step(&f.moments, h * 1e-3),
                _ => f.shears = step(&f.shears, h),
            }
            vec![cost::evaluate(&potential, &x, &f, &fixed, &coefficients).total()]
        };
        let slope = match part {
            0 => along(&by_force.tensions),
            1 => along(&by_force.moments) * 1e-3,
            _ => along(&by_force.shears),
        };
        assert_order("forces", taylor_order(1e-3, at, &[slope]));
    }
}

#[test]
fn cost_is_zero_inside_the_envelope_and_for_balanced_forces() {
    let setup = cloth::sheet("denim-a", [5, 4], [0.1, 0.1]);
    let model = Model::new(&kesi::model::Setup { gravity: 0.0, ..setup.clone() }).unwrap();
    let state = State::new(&model, setup.positions.clone());
    let (pull, candidates) = (Pull::none(&model), Candidates::new(&model));
    let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
    let own = cost::forces(&potential, &setup.positions);
    let report = cost::evaluate(&potential, &setup.positions, &own, &[false; 20], &Coefficients::default());
    assert_eq!((report.stretch, report.bend, report.shear), (0.0, 0.0, 0.0));
    assert!(report.newton < 1e-9, "rounding of the spacing only: {report:?}");
    // Any force between the branches costs nothing but Newton's law.
    let inside =
        Forces { moments: own.moments.iter().map(|_| 0.9 * 0.5 * 0.139 * 9.80665e-3).collect(), ..own };
    let report =
        cost::evaluate(&potential, &setup.positions, &inside, &[false; 20], &Coefficients::default());
    assert_eq!(report.bend, 0.0);
    assert!(report.newton > 0.0);
}

/// The assembled pattern holds every pair that an element couples, in any lattice.
#[test]
fn pattern_serves_lattices_of_every_shape() {
    for counts in [[2, 2], [2, 9], [9, 2], [3, 40], [13, 11]] {
        let grid = Grid::uniform(counts, [0.1, 0.1]);
        let pattern = Pattern::new(&grid, &grid.elements(|_| false));
        let mut rank = pattern.rank.clone();
        rank.sort_unstable();
        assert!(rank.iter().enumerate().all(|(k, &r)| k as u32 == r), "{counts:?}: every particle once");
    }
}
