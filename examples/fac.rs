use kesi::{
    fabric::{Fabric, law::Law},
    math::Vec3,
    minimize::factor::*,
    model::*,
    potential::{system::*, *},
    state::*,
};
use std::sync::Arc;
#[repr(C)]
struct Ts {
    s: i64,
    n: i64,
}
unsafe extern "C" {
    fn clock_gettime(c: i32, t: *mut Ts) -> i32;
}
fn cpu() -> f64 {
    let mut t = Ts { s: 0, n: 0 };
    unsafe {
        clock_gettime(3, &mut t);
    }
    t.s as f64 * 1e3 + t.n as f64 * 1e-6
}
fn main() {
    let n: usize = std::env::args().nth(1).unwrap().parse().unwrap();
    let t = Law::linear(3171.0);
    let fabric = Arc::new(Fabric {
        name: "denim".into(),
        areal_density: 0.324,
        thickness: 1.066e-3,
        tensile: [t.clone(), t],
        bending: [Law::linear(1.69e-5), Law::linear(1.69e-5)],
        shear: Law::linear(122.0),
        friction: 0.3,
    });
    let h = 0.3 / (n - 1) as f64;
    let positions: Vec<Vec3> = (0..n * n)
        .map(|k| Vec3::new((k / n) as f64 * h, (k % n) as f64 * h, 0.001 * (k as f64 * 0.7).sin()))
        .collect();
    let setup = Setup {
        fabric,
        particles: [n, n],
        size: [0.3; 2],
        positions: positions.clone(),
        pins: vec![],
        hand: Some([0, 0]),
        obstacles: vec![],
        gravity: 9.81,
        drag: 0.5,
    };
    let model = Model::new(&setup).unwrap();
    let state = State::new(&model, positions.clone());
    let pattern = Arc::new(Pattern::new(&model.grid, &model.elements));
    let mut system = System::new(pattern.clone());
    let mut pull = Pull::none(&model);
    pull.set_inertia(&model, &state, 0.005);
    let potential = Potential { model: &model, state: &state, pull: &pull };
    let strains = vec![0.0; model.elements.edges.len()];
    let mut f = Factor::new(&pattern);
    let mut g = vec![Vec3::zeros(); n * n];
    let mut rhs = vec![1.0; 4 * 3 * n * n];
    let mut best = [1e9f64; 6];
    for _ in 0..20 {
        let mut k = 0;
        let mut time = |f: &mut dyn FnMut()| {
            let t = cpu();
            f();
            best[k] = best[k].min(cpu() - t);
            k += 1;
        };
        time(&mut || potential.gradient(&positions, &mut g));
        time(&mut || {
            system.clear();
            potential.hessian(&positions, &strains, Curvature::Exact, &mut system)
        });
        time(&mut || {
            system.clear();
            potential.hessian(&positions, &strains, Curvature::Clamped, &mut system)
        });
        time(&mut || {
            let _ = f.factorize(&pattern, &system.values);
        });
        time(&mut || f.solve(&mut rhs, 4));
        time(&mut || f.solve(&mut rhs[..3 * n * n], 1));
    }
    println!(
        "gradient {:.2} exact {:.2} clamped {:.2} factor {:.2} solve4 {:.2} solve1 {:.2} | len_val {}",
        best[0],
        best[1],
        best[2],
        best[3],
        best[4],
        best[5],
        f.len()
    );
}
