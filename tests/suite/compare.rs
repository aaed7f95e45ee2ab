//! The paper's minimizers, and carrying solutions between meshes.

use crate::cloth;
use kesi::{
    compare::{Descent, Rule, carry, shape_error, without_hysteresis},
    cost::{self, Coefficients},
    fabric,
    math::Vec3,
    model::Model,
    potential::{Potential, Pull, contact::candidates::Candidates},
    state::State,
    world::World,
};

/// A sheet with two clamped edges, taut between them: its equilibrium is near its start.
fn hammock(n: usize) -> (Model, State, Vec<bool>) {
    let setup = cloth::sheet("denim-a", [n, n], [0.1, 0.1]);
    let model = Model::new(&setup).unwrap();
    let state = State::new(&model, setup.positions);
    let fixed = (0..n * n).map(|k| k % n == 0 || k % n == n - 1).collect();
    (model, state, fixed)
}

#[test]
fn descents_lower_the_cost_at_every_iteration_and_conjugate_gradients_go_farther() {
    let (model, state, fixed) = hammock(5);
    let [steepest, conjugate] = [Rule::SteepestDescent, Rule::ConjugateGradients].map(|rule| {
        let mut descent = Descent::new(&model, state.clone(), &fixed, rule, Coefficients::default());
        let mut last = descent.cost().total();
        assert!((last - 0.75).abs() < 1e-9, "the free part of an unloaded sheet owes its weight: {last}");
        for _ in 0..400 {
            assert!(descent.step());
            let cost = descent.cost().total();
            assert!(cost < last, "{rule:?}: {cost} after {last}");
            last = cost;
        }
        last
    });
    assert!(conjugate < 0.1 * steepest && steepest < 0.5, "{conjugate} {steepest}");
}

#[test]
fn conjugate_gradients_arrive_where_forces_balance_the_weight() {
    let (model, state, fixed) = hammock(5);
    let mut descent = Descent::new(&model, state, &fixed, Rule::ConjugateGradients, Coefficients::default());
    while descent.cost().total() > 1e-10 && descent.iterations < 20_000 && descent.step() {}
    let held: Vec3 = descent.residuals().iter().zip(&fixed).filter(|(_, f)| **f).map(|(r, _)| r).sum();
    assert!(descent.residual() < 1e-4 * model.weight(), "{:?}", descent.cost());
    assert!((held.z - model.weight()).abs() < 1e-4 * model.weight(), "{held}");
}

#[test]
fn a_solution_carried_to_its_own_mesh_keeps_its_cost_and_to_a_finer_one_nearly() {
    let mut world = World::new(cloth::hang("denim-a", 10)).unwrap();
    cloth::settle(&mut world, 0.02, 2000);
    let cost_on = |to: &Model| {
        let carried = carry(world.model(), world.state(), &cost_forces(&world), to).unwrap();
        let n = to.grid.counts[1];
        let fixed: Vec<bool> = (0..to.elements.nodes()).map(|k| k == 0 || k == n - 1).collect();
        carried.cost(to, &fixed).total()
    };
    let same = cost_on(world.model());
    assert!(same < 1e-9, "{same}");
    let finer = Model::new(&cloth::hang("denim-a", 19)).unwrap();
    let carried = cost_on(&finer);
    assert!(carried > 1e-3 && carried.is_finite(), "{carried}");
    assert!(carry(world.model(), world.state(), &cost_forces(&world), &hammock(12).0).is_none());
}

fn cost_forces(world: &World) -> cost::Forces {
    let still = Pull::none(world.model());
    let candidates = Candidates::default();
    let (model, state) = (world.model(), world.state());
    let potential = Potential { model, state, candidates: &candidates, pull: &still };
    cost::forces(&potential, &world.state().positions)
}

#[test]
fn a_fabric_without_hysteresis_loads_and_unloads_on_one_curve() {
    let with = fabric::load("denim-a").unwrap();
    let without = without_hysteresis(&with).unwrap();
    for kappa in [-150.0, -3.0, 0.5, 80.0, 240.0] {
        let [low, high] = with.bending[0].envelope(kappa);
        let [a, b] = without.bending[0].envelope(kappa);
        assert!((a - b).abs() < 1e-12 && high > low);
        assert!((a - 0.5 * (low + high)).abs() < 1e-9 * high.abs());
    }
}

#[test]
fn shape_error_is_the_distance_of_a_shifted_shape() {
    let a = vec![Vec3::zeros(); 9];
    let b = vec![Vec3::new(3e-3, 0.0, 4e-3); 9];
    let [rms, max] = shape_error(&a, &b);
    assert!((rms - 5e-3).abs() < 1e-15 && (max - 5e-3).abs() < 1e-15);
}
