//! Graded meshes: patch tests across level jumps, derivatives over ghosts, factors.

use crate::cloth;
use kesi::{
    batch::{Measures, Planes},
    cores::Team,
    fabric::{Fabric, isotropic_twist, law::Law},
    grid::{Cell, Edit, Site},
    math::Vec3,
    minimize::{Budget, Method, Minimizer, factor::Cholesky},
    model::{Model, Setup},
    phase::Watch,
    potential::{
        Curvature, Potential, Pull,
        contact::{Contact, candidates::Candidates},
        pattern::Pattern,
        system::System,
        triple,
    },
    state::State,
};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::sync::Arc;

/// Sides of cells in the order in which squares merge, and cells of all shapes.
const SQUARES: [[usize; 2]; 3] = [[2, 2], [4, 4], [8, 8]];
const SHAPES: [[usize; 2]; 8] = [[1, 2], [2, 1], [2, 2], [1, 4], [4, 1], [2, 4], [4, 2], [4, 4]];

/// Merges leaves to cells of these sizes, in this order, where `size_at` asks for no less.
fn shape(model: &mut Model, sizes: &[[usize; 2]], size_at: impl Fn(Site) -> [usize; 2]) {
    let intervals = model.grid.counts.map(|n| n - 1);
    let mut grid = model.grid.clone();
    let mut edits = Vec::new();
    for &size in sizes {
        for i in (0..intervals[0]).step_by(size[0]) {
            for j in (0..intervals[1]).step_by(size[1]) {
                let within = |n: usize| {
                    let wanted = size_at([i + n / size[1], j + n % size[1]]);
                    (0..2).all(|k| wanted[k] >= size[k])
                };
                // What does not fit yet (balance, border) stays finer.
                let edit = Edit::Coarsen(Cell { corner: [i, j], size });
                if (0..size[0] * size[1]).all(within) && grid.edit(&[edit]).is_ok() {
                    edits.push(edit);
                }
            }
        }
    }
    model.remesh(&edits).unwrap();
    model.grid.validate(&model.elements).unwrap();
}

/// Merges leaves to squares as large as `size_at` asks for.
fn grade(model: &mut Model, size_at: impl Fn(Site) -> usize) {
    shape(model, &SQUARES, |site| [size_at(site); 2]);
}

/// A straight jump and bands of sizes 1, 2, 4 across each direction, random sizes, and nearly one size; `fine` sites stay of size 1.
pub fn meshes(setup: &Setup, fine: impl Fn(Site) -> bool) -> Vec<(String, Model)> {
    let mut meshes = Vec::new();
    let mut add = |name: String, size_at: &dyn Fn(Site) -> usize| {
        let mut model = Model::new(setup).unwrap();
        grade(&mut model, |site| if fine(site) { 1 } else { size_at(site) });
        meshes.push((name, model));
    };
    for across in 0..2 {
        let half = setup.particles[across] / 8 * 4;
        add(format!("straight {across}"), &|site| if site[across] >= half { 2 } else { 1 });
        let third = setup.particles[across] / 12 * 4;
        add(format!("banded {across}"), &|site| 1 << (site[across] / third).min(2));
    }
    for seed in 0..4 {
        let wish = wishes(seed, 4);
        add(format!("random {seed}"), &|site| wish[site[0] / 4 * 64 + site[1] / 4]);
    }
    add("of two but for a few".into(), &of_two);
    meshes.extend((0..3).map(|seed| (format!("slender {seed}"), slender(setup, &fine, seed))));
    meshes
}

/// Sides along warp and weft, each drawn apart for blocks of four intervals.
fn slender(setup: &Setup, fine: impl Fn(Site) -> bool, seed: u64) -> Model {
    let mut model = Model::new(setup).unwrap();
    let wish = [seed, seed + 100].map(|seed| wishes(seed, 4));
    let wanted = |[i, j]: Site| [0, 1].map(|k| wish[k][i / 4 * 64 + j / 4]);
    shape(&mut model, &SHAPES, |site| if fine(site) { [1; 2] } else { wanted(site) });
    let has = |shape: &dyn Fn([usize; 2]) -> bool| model.grid.cells().iter().any(|c| shape(c.size));
    assert!(has(&|[i, j]| i < j) && has(&|[i, j]| i > j));
    model
}

/// Sizes of a lattice of cells of two intervals, but for a corner and a band.
fn of_two(site: Site) -> usize {
    let in_corner = site.iter().all(|&k| k < 5);
    let in_band = site[0].abs_diff(16) < 2 && site[1] < 9;
    if in_corner || in_band { 1 } else { 2 }
}

/// The mesh of a setup with such sizes.
pub fn nearly_of_two(setup: &Setup) -> Model {
    let mut model = Model::new(setup).unwrap();
    grade(&mut model, of_two);
    model
}

/// Sizes of 64 × 64 blocks, powers of two from so many.
fn wishes(seed: u64, levels: u32) -> Vec<usize> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    (0..64 * 64).map(|_| 1 << rng.random_range(0..levels)).collect()
}

fn weightless(particles: [usize; 2]) -> Setup {
    let mut setup = cloth::sheet("denim-a", particles, [0.3, 0.24]);
    setup.gravity = 0.0;
    setup
}

#[test]
fn constant_strain_and_shear_are_exact_across_level_jumps() {
    let setup = weightless([33, 41]);
    for (name, model) in meshes(&setup, |_| false) {
        // Stretched, sheared and turned; flat, so that nothing bends.
        let map =
            |p: &Vec3| Vec3::new(1.03 * p.x + 0.04 * p.y, 0.6 * (1.02 * p.y - 0.01 * p.x), 0.8 * 1.02 * p.y);
        let state = State::new(&model, setup.positions.iter().map(map).collect());
        let pull = Pull::none(&model);
        let potential =
            Potential { model: &model, state: &state, candidates: &Candidates::new(&model), pull: &pull };
        let mut gradient = vec![Vec3::zeros(); model.elements.nodes()];
        potential.gradient(&state.positions, &mut gradient, &mut Measures::new(&model.elements));
        let [i, j] = setup.particles;
        let inside = |n: usize| {
            let [a, b] = model.grid.site(n);
            a > 0 && b > 0 && a + 1 < i && b + 1 < j
        };
        let (inner, outer): (Vec<usize>, Vec<usize>) =
            (0..gradient.len()).partition(|&n| n >= i * j || inside(n));
        let worst = |of: &[usize]| of.iter().map(|&n| gradient[n].norm()).fold(0.0, f64::max);
        assert!(worst(&inner) < 1e-10 * worst(&outer), "{name}: {:e} of {}", worst(&inner), worst(&outer));
    }
}

/// The corners of a hundred random meshes; with cubic ghosts over the nearest particles the third already has 0.204 Bκ.
#[test]
fn corners_of_any_random_mesh_stay_below_a_fifth_of_the_moment() {
    let mut setup = cloth::sheet("denim-a", [49, 49], [0.3, 0.3]);
    setup.gravity = 0.0;
    for seed in 0..100 {
        let wish = wishes(seed, 3);
        let along = (seed % 2) as usize;
        let mut model = Model::new(&setup).unwrap();
        grade(&mut model, |site| {
            let fine = site[along] == 0 || site[along] == 47;
            if fine { 1 } else { wish[site[0] / 4 * 64 + site[1] / 4] }
        });
        let kappa = 0.3 / (4.0 * model.grid.spacing(along));
        let inside = |site: Site| (0..2).all(|k| site[k] >= 8 && site[k] + 8 < 49);
        let [spurious, residual, energy] = cylinder(&mut model, &setup, along, kappa, inside);
        assert!(residual < 0.2, "seed {seed}: {residual} Bκ");
        assert!(spurious < 0.06 && energy.abs() < 5e-3, "seed {seed}: {spurious} of κ, energy {energy}");
    }
}

/// What the bending of a cylinder looks like on a mesh: largest spurious cross curvature over κ, largest residual over Bκ of the
/// particles chosen, relative error of the energy.
fn cylinder(
    model: &mut Model,
    setup: &Setup,
    along: usize,
    kappa: f64,
    chosen: impl Fn(Site) -> bool,
) -> [f64; 3] {
    let b = 1e-5;
    let [bending, nothing] = [Law::linear(b), Law::linear(0.0)];
    model.fabric = Arc::new(Fabric {
        tensile: [nothing.clone(), nothing.clone()],
        bending: [bending.clone(), bending],
        shear: nothing,
        twist: isotropic_twist([b; 2]),
        ..(*model.fabric).clone()
    });
    let roll = |p: &Vec3| {
        let (turn, flat) = (p[along] * kappa, p[1 - along]);
        let [out, up] = [turn.sin() / kappa, (1.0 - turn.cos()) / kappa];
        if along == 0 { Vec3::new(out, flat, up) } else { Vec3::new(flat, out, up) }
    };
    let state = State::new(model, setup.positions.iter().map(roll).collect());
    let pull = Pull::none(model);
    let potential = Potential { model, state: &state, candidates: &Candidates::new(model), pull: &pull };
    let x = &state.positions;
    let bend = |t| potential.bend(t, &triple::Weights::new(t), x).value;
    let triples = &model.elements.triples;
    let crossing = triples.iter().filter(|t| t.direction != along);
    let spurious = crossing.map(|t| bend(t).abs() / kappa).fold(0.0, f64::max);
    let rolled = triples.iter().filter(|t| t.direction == along);
    let energy: f64 = rolled.map(|t| 0.5 * b * t.area * bend(t).powi(2)).sum();
    // A free end turns over whole cells only: half a cell at each end does not bend.
    let exact = 0.5 * b * kappa * kappa * (model.grid.size[along] - model.grid.spacing(along));
    let mut gradient = vec![Vec3::zeros(); x.len()];
    potential.gradient(x, &mut gradient, &mut Measures::new(&model.elements));
    let chosen = (0..model.grid.particles()).filter(|&n| chosen(model.grid.site(n)));
    let worst = chosen.map(|n| gradient[n].norm()).fold(0.0, f64::max);
    [spurious, worst / (b * kappa), energy / (exact * model.grid.size[1 - along]) - 1.0]
}

/// Force out of balance on a cylinder where cells of all shapes meet, over Bκ: narrow cells feel what ghosts of wide ones load on them.
const SLENDER: f64 = 1.0;

#[test]
fn a_cylinder_bends_evenly_across_level_jumps() {
    let mut setup = cloth::sheet("denim-a", [49, 49], [0.3, 0.3]);
    setup.gravity = 0.0;
    for along in 0..2 {
        for (name, mut model) in meshes(&setup, |site| site[along] == 0 || site[along] == 47) {
            // The largest cell turns by 0.3 rad, where it would be refined.
            let largest = model.grid.cells().iter().map(|c| c.size[along]).max().unwrap();
            let kappa = 0.3 / (largest as f64 * model.grid.spacing(along));
            // Inside: where no one-sided ghost at the border reaches; with straight jumps also away from the finer ends.
            let margin = match name.split(' ').next() {
                Some("random") => 8,
                Some("slender") => 9,
                _ => 12,
            };
            let inside = |site: Site| (0..2).all(|k| site[k] >= margin && site[k] + margin < 49);
            let [spurious, residual, energy] = cylinder(&mut model, &setup, along, kappa, inside);
            let most = match name.split(' ').next() {
                Some("random") => 0.2,
                Some("slender") => SLENDER,
                _ => 0.06,
            };
            assert!(spurious < 0.06 && residual < most, "{name}: {spurious} of κ, {residual} Bκ");
            assert!(energy.abs() < 5e-3, "{name}: energy {energy}");
        }
    }
}

/// A crumpled graded sheet on a box, with history, inertia, contact, friction and dead loads at work.
fn crumpled(seed: u64) -> (Model, State, Candidates, Pull) {
    let mut setup = cloth::sheet("denim-a", [17, 13], [0.12, 0.09]);
    setup.obstacles = vec![cloth::cuboid([0.04, 0.04, 0.02], Vec3::new(0.06, 0.045, -0.0212))];
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut random = || Vec3::from_fn(|_, _| rng.random_range(-1.0..1.0));
    setup.positions.iter_mut().for_each(|p| *p += random() * 0.001);
    let mut model = Model::new(&setup).unwrap();
    grade(&mut model, |[i, j]| if i >= 8 { 4 } else { 1 + usize::from(j >= 4) });
    let mut state = State::new(&model, setup.positions.clone());
    let mut wobble = |p: &mut f64, scale: f64| *p += 0.5 * random().x * scale;
    state.history.edges.iter_mut().for_each(|p| wobble(p, model.fabric.tensile[0].stick()));
    state.history.triples.iter_mut().for_each(|p| wobble(p, model.fabric.bending[0].stick()));
    state.history.shears.iter_mut().for_each(|p| wobble(p, model.fabric.shear.stick()));
    let mut candidates = Candidates::new(&model);
    candidates.update(&model, &state.poses, &state.positions, 1e-3);
    let mut before: Vec<Vec3> = state.positions.iter().map(|p| p + random() * 1e-4).collect();
    model.elements.fill(&mut before);
    let contact = Contact { model: &model, state: &state, candidates: &candidates };
    let mut anchors = Vec::new();
    contact.commit(&contact.touches(&before), &before, &mut anchors);
    state.anchors = anchors;
    let over_ghosts =
        state.anchors.iter().filter(|a| a.nodes.iter().any(|&n| model.elements.ghost(n).is_some())).count();
    assert!(over_ghosts > 0, "ghosts touch too");
    let mut pull = Pull::none(&model);
    pull.set_inertia(&model, &state, 0.01);
    (model, state, candidates, pull)
}

#[test]
fn potential_over_ghosts_passes_the_taylor_test() {
    let (model, state, candidates, pull) = crumpled(1);
    let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
    let x = &state.positions;
    let [energy, by_kernels] = [
        potential.energy(x),
        potential.energy_by_kernels(x, &mut Planes::new(model.elements.named.len()), &Team::default()),
    ];
    assert!((by_kernels / energy - 1.0).abs() < 1e-12, "{by_kernels} for {energy}");
    let mut rng = Pcg64Mcg::seed_from_u64(2);
    let mut d = vec![Vec3::zeros(); x.len()];
    model.grid.active().for_each(|n| d[n] = Vec3::from_fn(|_, _| rng.random_range(-1.0..1.0)));
    model.elements.fill(&mut d);
    let along = |h: f64| -> Vec<Vec3> { x.iter().zip(&d).map(|(p, d)| p + d * h).collect() };
    let gradient = |h: f64| {
        let mut g = vec![Vec3::zeros(); x.len()];
        potential.gradient(&along(h), &mut g, &mut Measures::new(&model.elements));
        g
    };
    let slope: f64 = model.grid.active().map(|n| gradient(0.0)[n].dot(&d[n])).sum();
    let h = 1e-7;
    let difference = (potential.energy(&along(h)) - potential.energy(&along(-h))) / (2.0 * h);
    assert!((difference / slope - 1.0).abs() < 1e-6, "{difference} for {slope}");
    let mut system = System::new(Arc::new(Pattern::new(&model.grid, &model.elements)));
    system.clear();
    let strains: Vec<f64> = model.elements.edges.iter().map(|e| potential.strain(e, x).value).collect();
    potential.hessian(x, &strains, Curvature::Exact, &mut system);
    let product = system.product(&d);
    let (plus, minus) = (gradient(h), gradient(-h));
    let scale = product.iter().map(|v| v.norm()).fold(0.0, f64::max);
    for n in model.grid.active() {
        let difference = (plus[n] - minus[n]) / (2.0 * h);
        assert!((difference - product[n]).norm() < 1e-6 * scale, "{n}: {difference:?} for {:?}", product[n]);
    }
}

#[test]
fn particles_inside_cells_are_neither_asked_nor_told_anything() {
    for method in [Method::Fronts, Method::Multigrid] {
        let (model, state, candidates, pull) = crumpled(1);
        let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
        let is_active = |n: usize| n < model.grid.particles() && model.grid.is_active(n);
        let is_absent = |n: &usize| !is_active(*n) && model.elements.ghost(*n as u32).is_none();
        let absent: Vec<usize> = (0..model.elements.nodes()).filter(is_absent).collect();
        assert_eq!(absent.len() + model.elements.named.len(), model.elements.nodes());
        assert!(absent.len() > 50, "{} are absent", absent.len());
        let after = |inside: Vec3| {
            let mut minimizer = Minimizer::new(&model, method);
            let mut x = state.positions.clone();
            for &n in &absent {
                (x[n], minimizer.gradient[n]) = (inside, inside);
            }
            minimizer.system.fixed[0] = true;
            minimizer.system.hand = Some(0);
            minimizer.measure(&potential, &x, Watch::default());
            minimizer.system.prescribe(0, Vec3::new(1e-4, -2e-4, 3e-4));
            let outcomes = [(); 2].map(|()| minimizer.descend(&potential, &mut x, 0.0, Budget::solves(3)));
            assert!(absent.iter().all(|&n| x[n].map(f64::to_bits) == inside.map(f64::to_bits)));
            let of_present = |v: &[Vec3]| model.elements.present().map(|n| v[n]).collect::<Vec<Vec3>>();
            (outcomes, of_present(&x), of_present(&minimizer.gradient), minimizer.residual())
        };
        assert_eq!(after(Vec3::zeros()), after(Vec3::repeat(f64::NAN)), "{method:?}");
    }
}

#[test]
fn factors_of_graded_meshes_solve_like_faers() {
    let (model, state, candidates, pull) = crumpled(3);
    let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
    let mut system = System::new(Arc::new(Pattern::new(&model.grid, &model.elements)));
    system.fixed[0] = true;
    system.clear();
    let strains: Vec<f64> =
        model.elements.edges.iter().map(|e| potential.strain(e, &state.positions).value).collect();
    potential.hessian(&state.positions, &strains, Curvature::Clamped, &mut system);
    let solve = |method| {
        let mut factor = Cholesky::new(&system.pattern, method);
        factor.factorize(&system.pattern, &system.values).unwrap();
        let mut x: Vec<f64> = (0..3 * system.pattern.particles.len()).map(|k| (k as f64).sin()).collect();
        factor.solve(&mut x, 1);
        x
    };
    let (ours, faers) = (solve(Method::Fronts), solve(Method::Faer));
    let scale = faers.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
    assert!(ours.iter().zip(&faers).all(|(a, b)| (a - b).abs() < 1e-9 * scale));
}
