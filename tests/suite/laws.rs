//! Behaviour of the hysteretic laws, the same for every law that a fabric can have.

use kesi::fabric::{
    self,
    instrument::{self, BENDING_RANGE, SHEAR_RANGE},
    law::Law,
    parameters::{Bending, Chosen, Shear, Tensile},
    units::*,
};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

/// Parameters of denim A, as published.
fn denim() -> (Tensile, Bending, Shear) {
    let max_load = 500.0 * GF_PER_CM;
    (
        Tensile { max_load, emt: 5.515 * PERCENT, lt: 0.712, rt: 54.1 * PERCENT },
        Bending { b: 0.172 * GF_CM2_PER_CM, width: 0.139 * GF_CM_PER_CM },
        Shear { g: 2.180 * GF_PER_CM_DEGREE, width: 5.012 * GF_PER_CM, width5: 7.412 * GF_PER_CM },
    )
}

/// Every law of every fabric with the strain range over which it is exercised.
fn laws() -> Vec<(String, Law, [f64; 2])> {
    let mut laws = vec![("linear".into(), Law::linear(100.0), [-1.0, 1.0])];
    for name in fabric::list() {
        let cloth = fabric::load(&name).unwrap();
        let [tensile, _] = cloth.tensile;
        let [bending, _] = cloth.bending;
        let emt = tensile.knots().last().unwrap();
        let [bend, angle] = [1.4 * BENDING_RANGE, 1.4 * SHEAR_RANGE];
        laws.push((format!("{name} tensile"), tensile, [-0.01, 1.1 * emt]));
        laws.push((format!("{name} bending"), bending, [-bend, bend]));
        laws.push((format!("{name} shear"), cloth.shear, [-angle, angle]));
    }
    laws
}

fn close(what: &str, got: f64, given: f64) {
    assert!((got / given - 1.0).abs() < 1e-3, "{what}: {got} instead of {given}");
}

#[test]
fn the_instrument_reads_the_same_parameters_whatever_stick_is_chosen() {
    let (tensile, bending, shear) = denim();
    let drive = |law: &Law, turns: &[f64]| instrument::drive(law, &instrument::path(turns, 4000));
    for part in [0.1, 1.0, 3.0] {
        let default = Chosen::default();
        let chosen = Chosen {
            tensile_stick: part * default.tensile_stick,
            bending_stick: part * default.bending_stick,
            shear_stick: part * default.shear_stick,
            ..default
        };
        let read =
            instrument::read_tensile(&drive(&tensile.law(&chosen).unwrap(), &[tensile.emt, 0.0])).unwrap();
        close("EMT", read.emt, tensile.emt);
        close("Fm", read.max_load, tensile.max_load);
        close("LT", read.lt, tensile.lt);
        close("RT", read.rt, tensile.rt);
        close("WT", read.wt, tensile.lt * tensile.max_load * tensile.emt / 2.0);

        let r = BENDING_RANGE;
        let samples = drive(&bending.law(&chosen).unwrap(), &[r, -r, 0.0]);
        for station in [0.5, 1.0] {
            let read = instrument::read_bending(&samples, station * PER_CM).unwrap();
            close("B", read.b, bending.b);
            close("2HB", read.width, bending.width);
        }

        let r = SHEAR_RANGE;
        let read = instrument::read_shear(&drive(&shear.law(&chosen).unwrap(), &[r, -r, 0.0])).unwrap();
        close("G", read.g, shear.g);
        close("2HG", read.width, shear.width);
        close("2HG5", read.width5, shear.width5);
    }
}

#[test]
fn a_cloth_that_gives_all_work_back_has_no_hysteresis() {
    let (tensile, ..) = denim();
    let law = Tensile { rt: 1.0, ..tensile }.law(&Chosen::default()).unwrap();
    let samples = instrument::drive(&law, &instrument::path(&[tensile.emt, 0.0], 4000));
    close("RT", instrument::read_tensile(&samples).unwrap().rt, 1.0);
    assert_eq!(law.commit(0.03, law.virgin()), law.virgin());
}

#[test]
fn random_strain_steps_never_leave_the_envelope() {
    for (name, law, [low, high]) in laws() {
        let mut rng = Pcg64::seed_from_u64(7);
        let [mut p, mut x] = [law.virgin(), 0.0];
        for _ in 0..10_000 {
            let size = 10f64.powf(rng.random_range(-5.0..0.0)) * (high - low);
            x = (x + rng.random_range(-size..size)).clamp(low, high);
            let force = law.evaluate(x, p).force;
            p = law.commit(x, p);
            let [lower, upper] = law.envelope(x);
            let slack = 1e-12 * (1.0 + force.abs());
            assert!(force >= lower - slack && force <= upper + slack, "{name} at {x}: {force}");
        }
    }
}

#[test]
fn random_closed_strain_loops_never_return_energy() {
    for (name, law, [low, high]) in laws() {
        let mut rng = Pcg64::seed_from_u64(11);
        for _ in 0..60 {
            let start = rng.random_range(low..high);
            let turns = rng.random_range(1..6);
            let mut stations: Vec<f64> = (0..turns).map(|_| rng.random_range(low..high)).collect();
            stations.push(start);
            // Wherever the history stands: any p that the start allows.
            let mut p = law.commit(start, law.enclosed(start) + law.stick() * rng.random_range(-1.0..1.0));
            let store = |p: f64| law.evaluate(start, p).energy;
            for round in 0..2 {
                let [before, mut x, mut work, mut lost] = [store(p), start, 0.0, 0.0];
                let mut effort = 0.0;
                for &to in &stations {
                    let (from, steps) = (x, 2000);
                    for s in 1..=steps {
                        let next = from + (to - from) * f64::from(s) / f64::from(steps);
                        let force = |x: f64, p: f64| law.evaluate(x, p).force;
                        let middle = 0.5 * (x + next);
                        let simpson = force(x, p) + 4.0 * force(middle, p) + force(next, p);
                        work += simpson * (next - x) / 6.0;
                        effort += (simpson * (next - x) / 6.0).abs();
                        let after = law.commit(next, p);
                        lost += law.dissipated(p, after);
                        [x, p] = [next, after];
                    }
                }
                let balance = work - (store(p) - before) - lost;
                assert!(balance.abs() < 1e-4 * effort, "{name}: {balance} of {effort} unaccounted for");
                assert!(lost >= 0.0);
                // A loop that has been gone around once has its own history: from then on nothing stored can come out.
                assert!(round == 0 || work > -1e-6 * effort, "{name}: {work} of {effort} returned");
            }
        }
    }
}

#[test]
fn held_force_survives_tremor() {
    for (name, law, [_, high]) in laws() {
        let x = 0.4 * high;
        let strains = instrument::path(&[x], 500);
        let p0 = strains.iter().fold(law.virgin(), |p, &x| law.commit(x, p));
        let held = law.evaluate(x, p0).force;
        // A tremor that starts by letting go keeps the force whole; one around the strain must not creep with the cycles.
        for tremor in [1e-4, 1e-3, 1e-2] {
            let a = tremor * x;
            let mut p = p0;
            for _ in 0..50 {
                p = law.commit(x, law.commit(x - a, p));
            }
            let ratio = law.evaluate(x, p).force / held;
            assert!(ratio >= 0.99, "{name}: {ratio} of the force left, tremor {tremor}");
            let mut p = p0;
            let mut first = 0.0;
            for cycle in 0..50 {
                p = law.commit(x, law.commit(x - a, law.commit(x + a, p)));
                let force = law.evaluate(x, p).force;
                if cycle == 0 {
                    first = force;
                }
                assert!(force >= 0.99 * first, "{name}: crept to {force} from {first}");
            }
        }
    }
}

/// Order at which the error of a first-order expansion falls when the step is halved.
fn order(error: impl Fn(f64) -> f64, h: f64) -> f64 {
    (error(h).abs() / error(0.5 * h).abs()).log2()
}

#[test]
fn force_and_stiffness_are_exact_derivatives() {
    for (name, law, [low, high]) in laws() {
        let mut rng = Pcg64::seed_from_u64(3);
        let mut tested = 0;
        for _ in 0..2000 {
            let x = rng.random_range(low..high);
            let p = law.enclosed(x) + law.stick() * rng.random_range(-1.5..1.5);
            let h = 1e-5 * (high - low);
            let u = |x: f64| (law.enclosed(x) - p) / law.stick();
            let near = |c: f64| (u(x + h) - c) * (u(x - h) - c) <= 0.0;
            if near(1.0) || near(-1.0) || law.knots().any(|k| (k - x).abs() <= h) {
                continue;
            }
            let here = law.evaluate(x, p);
            let energy = |h: f64| law.evaluate(x + h, p).energy - here.energy - here.force * h;
            let force = |h: f64| law.evaluate(x + h, p).force - here.force - here.stiffness * h;
            // Where the expansion is exact to rounding there is no order to read.
            if energy(h).abs() > 1e-9 * here.energy.abs() + 1e-16 {
                let order = order(energy, h);
                assert!(order > 1.9, "{name} energy at {x}: {order}");
                tested += 1;
            }
            if force(h).abs() > 1e-8 * here.force.abs() + 1e-16 {
                let order = order(force, h);
                assert!(order > 1.9, "{name} force at {x}: {order}");
            }
        }
        assert!(tested > 100, "{name}: {tested} places tested");
    }
}

#[test]
fn strains_invert_the_envelope() {
    for (name, law, [low, high]) in laws() {
        for step in 0..=200 {
            let x = low * 1.2 + (high - low) * 1.3 * f64::from(step) / 200.0;
            let [lower, upper] = law.envelope(x);
            for force in [lower, upper] {
                let [min, max] = law.strains(force);
                let slack = 1e-7 * (high - low);
                assert!(min <= x + slack && x <= max + slack, "{name}: {x} outside {min}..{max}");
                let scale = 1e-8 * law.loading(high).abs();
                assert!((law.loading(min) - force).abs() < scale, "{name} {min}");
                assert!((law.unloading(max) - force).abs() < scale, "{name} {max}");
            }
        }
    }
}

#[test]
fn virgin_cloth_starts_on_the_loading_branch_without_force() {
    let (tensile, ..) = denim();
    let law = tensile.law(&Chosen::default()).unwrap();
    let response = law.evaluate(0.0, law.virgin());
    assert!(response.force.abs() < 1e-9);
    let gravity = law.evaluate(3e-4, law.virgin());
    assert!((gravity.force - law.loading(3e-4)).abs() < 1e-6);
    assert!((gravity.stiffness / response.stiffness - 1.0).abs() < 0.02);
}

#[test]
fn a_strain_that_is_not_a_number_leaves_the_history_alone() {
    for (_, law, _) in laws() {
        assert!(law.evaluate(f64::NAN, law.virgin()).force.is_nan());
        assert_eq!(law.commit(f64::NAN, 0.25 * law.stick()), 0.25 * law.stick());
    }
}
