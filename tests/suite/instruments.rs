//! Virtual KES instruments: specimens of particles in a world, held by clamps that move as the machines' do, read by reactions.
//!
//! Quasi-static: no gravity, and steps so long that inertia and drag vanish.

use crate::cloth;
use kesi::{
    fabric::{self, instrument},
    grid::Site,
    math::Vec3,
    model::Setup,
    world::{Budget, Command, World},
};

const BUDGET: Budget<'static> = Budget { solves: 60, stop: None };
/// Length of a step [s].
const DT: f64 = 1e4;

/// A specimen without gravity, its rows `i` of `clamped` pinned.
fn specimen(fabric: &str, particles: [usize; 2], size: [f64; 2], clamped: &[usize]) -> Setup {
    let pins = clamped.iter().flat_map(|&i| (0..particles[1]).map(move |j| [i, j])).collect();
    Setup { gravity: 0.0, drag: 0.0, pins, ..cloth::sheet(fabric, particles, size) }
}

/// Moves the pinned sites to where `place` puts them.
fn drive(world: &mut World, sites: &[Site], place: impl Fn(Site) -> Vec3) {
    let commands: Vec<Command> =
        sites.iter().map(|&particle| Command::Drive { particle, position: place(particle) }).collect();
    world.step(&commands, DT, BUDGET);
}

/// Force of the specimen on the sites.
fn reaction(world: &World, sites: &[Site]) -> Vec3 {
    sites.iter().map(|&s| world.reaction(s).expect("a clamped particle")).sum()
}

fn assert_close(fabric: &str, name: &str, got: f64, expected: f64) {
    assert!((got / expected - 1.0).abs() < 0.01, "{fabric} {name}: got {got}, expected {expected}");
}

fn given(fabric: &str, key: &str) -> f64 {
    let file = fabric::library::Library::default().read(fabric).unwrap();
    let quantity = file.quantities.iter().find(|q| q.key == key);
    quantity.unwrap_or_else(|| panic!("{fabric} has no {key}: {:?}", file.quantities)).value
}

/// FB1 tensile: 5 cm between the clamps, 20 cm wide (a strip of it), pulled to the largest load and back.
#[test]
fn tensile_instrument_gives_the_parameters_back() {
    for name in fabric::list() {
        let (length, width) = (0.05, 0.02);
        let setup = specimen(&name, [5, 3], [length, width], &[0, 4]);
        let start = setup.positions.clone();
        let mut world = World::new(setup).unwrap();
        let moving: Vec<Site> = (0..3).map(|j| [4, j]).collect();
        let emt = given(&name, "tensile.both.EMT") * 0.01;
        let samples: Vec<[f64; 2]> = instrument::path(&[emt, 0.0], 80)
            .into_iter()
            .map(|strain| {
                drive(&mut world, &moving, |s| start[s[0] * 3 + s[1]] + Vec3::x() * (strain * length));
                [strain, -reaction(&world, &moving).x / width]
            })
            .collect();
        let reading = instrument::read_tensile(&samples).unwrap();
        assert_close(&name, "EMT", reading.emt, emt);
        assert_close(&name, "LT", reading.lt, given(&name, "tensile.both.LT"));
        assert_close(&name, "RT", reading.rt * 100.0, given(&name, "tensile.both.RT"));
        assert_close(&name, "Fm", reading.max_load, given(&name, "tensile.both.max_load") * 0.980665);
        let wt = given(&name, "tensile.both.LT") * emt * given(&name, "tensile.both.max_load") / 2.0;
        assert_close(&name, "WT", reading.wt / 0.980665, wt);
    }
}

/// FB1 shear: 20 cm wide, 5 cm between the clamps, under a pretension of 10 gf/cm; one clamp moves sideways on the circle that
/// keeps that tension. Read over the middle half of the clamp, as the free sides of a specimen cannot bear shear.
#[test]
fn shear_instrument_gives_the_parameters_back() {
    for name in fabric::list() {
        let (length, width, across) = (0.05, 0.2, 17);
        let setup = specimen(&name, [4, across], [length, width], &[0, 3]);
        let pretension = setup.fabric.tensile[0].strains(9.80665)[0];
        let start = setup.positions.clone();
        let mut world = World::new(setup).unwrap();
        let moving: Vec<Site> = (0..across).map(|j| [3, j]).collect();
        let turn = instrument::SHEAR_RANGE;
        let samples: Vec<[f64; 2]> = instrument::path(&[turn, -turn, 0.0], 160)
            .into_iter()
            .map(|angle| {
                let stretched = length * (1.0 + pretension);
                let shift = Vec3::new(stretched * angle.cos() - length, stretched * angle.sin(), 0.0);
                drive(&mut world, &moving, |s| start[s[0] * across + s[1]] + shift);
                // Across the warp lines, so that the tension along them has no part in it.
                let sideways = Vec3::new(-angle.sin(), angle.cos(), 0.0);
                let middle = &moving[across / 4..=across - 1 - across / 4];
                let ends = [middle[0], middle[middle.len() - 1]];
                let force = reaction(&world, middle) - reaction(&world, &ends) * 0.5;
                [angle, -force.dot(&sideways) * (1.0 + pretension) / (0.5 * width)]
            })
            .collect();
        let reading = instrument::read_shear(&samples).unwrap();
        let (line, slope) = (0.980665, 56.188);
        assert_close(&name, "G", reading.g / slope, given(&name, "shear.G"));
        assert_close(&name, "2HG", reading.width / line, given(&name, "shear.2HG"));
        assert_close(&name, "2HG5", reading.width5 / line, given(&name, "shear.2HG5"));
    }
}

/// FB2 bending: 1 cm between the clamps, which move so that the specimen is an arc of the curvature; the moment is read at one.
#[test]
fn bending_instrument_gives_the_parameters_back() {
    for name in fabric::list() {
        let intervals = 10;
        let (gauge, width) = (0.01, 0.01);
        let spacing = gauge / intervals as f64;
        // A clamp is two rows: the edge between them cannot bend.
        let rows = intervals + 3;
        let clamped = [0, 1, rows - 2, rows - 1];
        let setup = specimen(&name, [rows, 2], [spacing * (rows - 1) as f64, width], &clamped);
        let start = setup.positions.clone();
        let mut world = World::new(setup).unwrap();
        let moving: Vec<Site> = [rows - 2, rows - 1].iter().flat_map(|&i| [[i, 0], [i, 1]]).collect();
        let turn = instrument::BENDING_RANGE;
        let samples: Vec<[f64; 2]> = instrument::path(&[turn, -turn, 0.0], 100)
            .into_iter()
            .map(|kappa| {
                let heading = kappa * gauge;
                let end = polygon(heading, gauge, intervals);
                let place = |s: Site| {
                    let out = if s[0] == rows - 1 { spacing } else { 0.0 };
                    let along = Vec3::new(heading.cos(), 0.0, heading.sin()) * out;
                    Vec3::new(spacing, start[s[0] * 2 + s[1]].y, 0.0) + end + along
                };
                drive(&mut world, &moving, place);
                let pivot = place([rows - 2, 0]);
                let moment: Vec3 = moving
                    .iter()
                    .map(|&s| (world.positions()[s[0] * 2 + s[1]] - pivot).cross(&world.reaction(s).unwrap()))
                    .sum();
                [kappa, moment.y / width]
            })
            .collect();
        let station = given(&name, "bending.both.read_at") * 100.0;
        let reading = instrument::read_bending(&samples, station).unwrap();
        assert_close(&name, "B", reading.b / 9.80665e-5, given(&name, "bending.both.B"));
        assert_close(&name, "2HB", reading.width / 9.80665e-3, given(&name, "bending.both.2HB"));
    }
}

/// End of a polygon of `sides` equal sides that turns by `turn` from the x axis, half a corner at each end.
fn polygon(turn: f64, length: f64, sides: usize) -> Vec3 {
    let (corner, side) = (turn / sides as f64, length / sides as f64);
    (0..sides)
        .map(|k| {
            let heading = corner * (k as f64 + 0.5);
            Vec3::new(heading.cos(), 0.0, heading.sin()) * side
        })
        .sum()
}
