use kesi::{fabric::Fabric, math::Vec3, model::Setup, obstacle::*, world::*};
use std::{sync::Arc, time::Instant};
fn fabric() -> Arc<Fabric> {
    use kesi::fabric::parameters::*;
    let c = Chosen::default();
    let t = Tensile { max_load: 490.3325, emt: 0.05515, lt: 0.712, rt: 0.541 }.law(&c).unwrap();
    let b = Bending { b: 0.172 * 9.80665e-5, width: 0.139 * 9.80665e-3 }.law(&c).unwrap();
    let s = Shear { g: 2.18 * 56.188, width: 5.012 * 0.980665, width5: 7.412 * 0.980665 }.law(&c).unwrap();
    Arc::new(Fabric {
        name: "denim".into(),
        areal_density: 0.324,
        thickness: 1.066e-3,
        tensile: [t.clone(), t],
        bending: [b.clone(), b],
        shear: s,
        friction: 0.3,
    })
}
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let n: usize = args[2].parse().unwrap();
    let dt: f64 = args[3].parse().unwrap();
    let steps: usize = args[4].parse().unwrap();
    let solves: u32 = args[5].parse().unwrap();
    let l = 0.3;
    let h = l / (n - 1) as f64;
    let mut positions = vec![];
    let setup = match args[1].as_str() {
        "hang" => {
            // chord 0.9 arc 1: sin(a)/a = 0.9
            let mut a: f64 = 0.5;
            for _ in 0..100 {
                a = a - (a.sin() - 0.9 * a) / (a.cos() - 0.9);
            }
            for i in 0..n {
                for j in 0..n {
                    let s = j as f64 * h;
                    let r = l / (2.0 * a);
                    let th = -a + s / r;
                    positions.push(Vec3::new(r * th.sin(), r * (th.cos() - a.cos()), 0.5 - i as f64 * h));
                }
            }
            Setup {
                fabric: fabric(),
                particles: [n, n],
                size: [l, l],
                positions,
                pins: vec![[0, n - 1]],
                hand: Some([0, 0]),
                obstacles: vec![],
                gravity: 9.81,
                drag: 0.5,
            }
        }
        _ => {
            for i in 0..n {
                for j in 0..n {
                    let (x, y) = (i as f64 * h - l / 2.0, j as f64 * h - l / 2.0);
                    positions.push(Vec3::new(x, y, 0.125 + 1e-5 * ((i * 7 + j * 13) % 11) as f64 / 11.0));
                }
            }
            let pose = nalgebra::Isometry3::translation(0.0, 0.0, 0.06);
            Setup {
                fabric: fabric(),
                particles: [n, n],
                size: [l, l],
                positions,
                pins: vec![],
                hand: Some([0, 0]),
                obstacles: vec![Obstacle {
                    name: "box".into(),
                    shape: Shape::Cuboid { half: [0.06; 3] },
                    pose,
                }],
                gravity: 9.81,
                drag: 0.5,
            }
        }
    };
    let t0 = Instant::now();
    let mut w = World::new(setup).unwrap();
    println!("setup {:.1} ms weight {:.5}", t0.elapsed().as_secs_f64() * 1e3, w.model().weight());
    let every = steps / 40;
    for k in 0..steps {
        let t = Instant::now();
        let r = w.step(&[], dt, Budget::solves(solves)).clone();
        let ms = t.elapsed().as_secs_f64() * 1e3;
        let v = w.state().velocities.iter().map(|v| v.norm()).fold(0.0, f64::max);
        if k % every.max(1) == 0 || r.resting {
            let f = r.hand.map(|h| h.force).unwrap_or_default();
            println!(
                "{k:5} t {:.3} {:?} solves {} res {:.2e} E {:.6} v {v:.2e} F {:.5} {:.5} {:.5} err {:.1e} gap {:.2e} pen {:.2e} ms {ms:.1}",
                r.time,
                r.outcome,
                r.solves,
                r.residual,
                r.energy,
                f.x,
                f.y,
                f.z,
                r.hand.map_or(0.0, |h| h.force_error),
                r.min_gap,
                r.max_penetration
            );
        }
        if r.resting {
            println!("K {}", r.hand.unwrap().stiffness);
            break;
        }
    }
    println!("total {:.2} s", t0.elapsed().as_secs_f64());
}
