//! The virtual KES lab, coarse and short: every parameter of every fabric comes back, and the judge of histories sees faults.

use kesi::{
    fabric::{self, Library, instrument, measured::Test},
    lab::{
        kes::{Lab, TESTS},
        wander::{self, Carried},
    },
};
use std::sync::Arc;

#[test]
fn the_lab_gives_every_parameter_of_every_fabric_back() {
    let lab = Lab { intervals: 8, samples: 40, ..Lab::default() };
    for (k, name) in fabric::list().into_iter().enumerate() {
        let file = Library::default().read(&name).unwrap();
        for test in TESTS {
            // The built-in fabrics have the same laws in warp and weft: each tests one of them.
            let tested = lab.test(&file, test, k % 2).unwrap();
            for p in tested.parameters {
                let error = p.measured / p.reference - 1.0;
                assert!(error.abs() < 0.01, "{name} {}: {} for {}", p.name, p.measured, p.reference);
            }
        }
    }
}

#[test]
fn warp_and_weft_are_tested_alike() {
    let file = Library::default().read("denim-a").unwrap();
    let lab = Lab { intervals: 4, samples: 20, ..Lab::default() };
    for test in TESTS {
        let [warp, weft] = [0, 1].map(|direction| lab.test(&file, test, direction).unwrap().samples);
        let largest = warp.iter().map(|s| s[1]).fold(0.0, f64::max);
        for (a, b) in warp.iter().zip(&weft) {
            assert!((a[1] - b[1]).abs() < 1e-5 * largest, "{test:?}: {a:?} {b:?}");
        }
    }
}

#[test]
fn a_shear_specimen_left_to_itself_wrinkles() {
    let file = Library::default().read("denim-c").unwrap();
    let lab = Lab { intervals: 6, samples: 40, flat: false };
    let tested = lab.test(&file, Test::Shear, 0).unwrap();
    let g = &tested.parameters[0];
    assert!(g.measured < 0.99 * g.reference, "{} for {}", g.measured, g.reference);
}

#[test]
fn the_judge_sees_jumps_and_forces_outside_the_envelope() {
    let cloth = fabric::load("denim-a").unwrap();
    let [bending, _] = cloth.bending;
    let good = instrument::drive(&bending, &instrument::path(&[200.0, -150.0, 50.0], 50));
    let verdict = wander::judge(&bending, &good);
    assert!(verdict.outside < 1e-12 && verdict.jump <= 1.0, "{verdict:?}");
    // From the loading to the unloading branch at one curvature.
    let mut jumping = good.clone();
    jumping[30][1] = bending.unloading(jumping[30][0]);
    let verdict = wander::judge(&bending, &jumping);
    assert!(verdict.outside < 1e-12 && verdict.jump > 1.0, "{verdict:?}");
    let outside: Vec<[f64; 2]> = good.iter().map(|s| [s[0], 1.01 * s[1]]).collect();
    assert!(wander::judge(&bending, &outside).outside > 5e-3);
}

#[test]
fn elements_of_a_carried_sheet_stay_on_continuous_paths_in_their_envelopes() {
    let fabric = Arc::new(fabric::load("denim-f").unwrap());
    let carry = Carried { fabric, particles: 10, steps: 80, seed: 5 }.run().unwrap();
    for (verdict, path) in carry.verdicts.iter().zip(&carry.paths) {
        assert!(verdict.outside < 1e-9 && verdict.jump <= 1.0, "{verdict:?}");
        assert!(instrument::branches(path).len() > 2, "no history");
    }
}
