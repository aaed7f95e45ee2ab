//! A disc cut from the sheet: it weighs what it should, hangs in balance, and what is cut away is not there.

use crate::cloth;
use kesi::{
    cut::Cut,
    math::Vec3,
    model::Setup,
    world::{Budget, Command, World},
};
use std::f64::consts::PI;

/// A disc of 10 cm held at two particles near its upper rim.
fn disc(n: usize) -> Setup {
    let cut = Cut { center: [0.05, 0.05], radius: 0.05 };
    let sheet = cloth::sheet("denim-a", [n, n], [0.1, 0.1]);
    let positions = sheet.positions.iter().map(|p| Vec3::new(p.y, 0.0, p.x)).collect();
    Setup { cut: Some(cut), positions, pins: vec![[n - 5, n / 2 - 3], [n - 5, n / 2 + 3]], ..sheet }
}

#[test]
fn a_disc_weighs_its_area_on_any_mesh_and_hangs_in_balance() {
    for n in [17, 24] {
        let setup = disc(n);
        let pins = setup.pins.clone();
        let mut world = World::new(setup).unwrap();
        let weight = world.model().weight();
        let expected = world.model().fabric.areal_density * 9.81 * PI * 0.05 * 0.05;
        assert!((weight / expected - 1.0).abs() < 1e-12, "{weight} for {expected}");
        cloth::settle(&mut world, 0.02, 500);
        let held: Vec3 = pins.iter().map(|p| world.reaction(*p).unwrap()).sum();
        assert!((held + Vec3::z() * weight).norm() < 1e-6 * weight, "{held:?} of {weight}");
        assert!(world.report().cost.total() < 1e-6);
    }
}

#[test]
fn what_is_cut_away_has_no_elements_and_cannot_be_grabbed() {
    let setup = disc(17);
    let world = World::new(setup.clone()).unwrap();
    let model = world.model();
    assert!(model.grid.is_cut_away(0) && !model.grid.is_cut_away(model.grid.index([8, 8])));
    assert_eq!(model.present, world.report().particles_active);
    let nodes = model.elements.shears.iter().flat_map(|s| s.nodes);
    assert!(
        nodes.into_iter().chain(model.grid.triangles().concat()).all(|n| !model.grid.is_cut_away(n as usize))
    );
    let refused = world.check(&Command::Grab { particle: [0, 0] }).unwrap_err();
    assert!(refused.to_string().contains("[0, 0], which is cut away"), "{refused}");
    assert!(World::new(Setup { pins: vec![[0, 0]], ..setup.clone() }).is_err());
    let far = Some(Cut { center: [1.0, 1.0], radius: 0.1 });
    assert!(World::new(Setup { cut: far, ..setup }).is_err());
}

#[test]
fn a_cut_that_covers_the_whole_sheet_changes_nothing() {
    let whole = cloth::hang("denim-c", 11);
    let cut = Setup { cut: Some(Cut { center: [0.15, 0.15], radius: 1.0 }), ..whole.clone() };
    let run = |setup| {
        let mut world = World::new(setup).unwrap();
        for _ in 0..5 {
            world.step(&[], 0.01, Budget::solves(3));
        }
        world.positions().to_vec()
    };
    let far = run(whole).iter().zip(run(cut)).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
    assert!(far < 1e-12, "{far} m");
}
