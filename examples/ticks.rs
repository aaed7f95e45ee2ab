use kesi::{adapt::Settings, math::Vec3, phase::*, scene::Scene, world::*};
use std::time::Instant;
fn settle(w: &mut World) {
    for k in 0..4000 {
        let prepared = if k % 4 == 0 { w.probe().and_then(|p| p.prepare()) } else { None };
        if let Some(p) = prepared {
            w.adopt(p);
        }
        if w.step(&[], 0.02, Budget::solves(8)).resting {
            return;
        }
    }
}
fn rep_big(_: &World) -> bool {
    false
}
fn main() {
    if std::env::var("FTZ").is_ok() {
        #[allow(deprecated)]
        unsafe {
            std::arch::x86_64::_mm_setcsr(std::arch::x86_64::_mm_getcsr() | 0x8040);
        }
    }
    let a: Vec<String> = std::env::args().collect();
    let (n, adaptive, dt, solves, ticks, speed): (usize, bool, f64, u32, u32, f64) = (
        a[1].parse().unwrap(),
        a[2] == "a",
        a[3].parse().unwrap(),
        a[4].parse().unwrap(),
        a[5].parse().unwrap(),
        a[6].parse().unwrap(),
    );
    let scene = Scene { particles: [n, n], ..Scene::named(a.get(7).map_or("hang", |s| s)).unwrap() };
    let mut w = World::new(scene.setup().unwrap()).unwrap();
    if std::env::var_os("EARLY").is_some() {
        w.set_adaptive(Some(Settings::default()));
    }
    settle(&mut w);
    let hand = w.setup().hand.unwrap();
    w.step(&[Command::Grab { particle: hand }], 0.02, Budget::solves(8));
    if adaptive && std::env::var_os("EARLY").is_none() {
        w.set_adaptive(Some(Settings::default()));
        let position = w.report().hand.unwrap().position + Vec3::z() * 2e-6;
        w.step(&[Command::Move { position }], 0.02, Budget::solves(8));
        settle(&mut w);
    }
    w.set_method(Method::Multigrid);
    w.observe_every(OBSERVATION);
    let h = w.report().hand.unwrap().position;
    let [_, columns] = w.grid().counts;
    let other = w.positions()[w.grid().index([0, columns - 1])];
    let edge = (other - h).normalize();
    let normal = edge.cross(&Vec3::z()).normalize();
    let rise = edge * 0.8 + Vec3::z() * 0.6;
    let r = 0.02;
    let sw = Stopwatch::default();
    let ended = |p| sw.ended(p);
    let b = Budget { watch: Watch(Some(&ended)), ..Budget::solves(solves) };
    let mut all: Vec<Vec<f64>> = vec![vec![]; 1 + Phase::ALL.len()];
    let mut its = vec![];
    let mut sol = vec![];
    let mut turned = 0.0;
    let every = (0.08 / dt) as u32;
    let mut sum = Vec3::zeros();
    for k in 0..ticks {
        let s = speed * ((f64::from(k) + 0.5) * dt / 0.05).min(1.0);
        let j = if std::env::var_os("JIT").is_some() {
            [0.5, 1.5, 1.0, 1.0, 1.5, 0.5, 1.0, 0.5, 1.5, 1.0][(k as usize * 7 + (k as usize / 10) * 3) % 10]
        } else {
            1.0
        };
        turned += j * s * dt / r;
        let position = if std::env::var_os("CIRC").is_some() {
            h + (Vec3::z() * (1.0 - f64::cos(turned)) + Vec3::x() * f64::sin(turned)) * r
        } else {
            h + (rise * (1.0 - f64::cos(turned)) + normal * f64::sin(turned)) * r
        };
        if adaptive
            && k % every == 0
            && let Some(p) = w.probe().and_then(|p| p.prepare())
        {
            w.adopt(p);
        }
        sw.start();
        let t = Instant::now();
        let rep = w.step(&[Command::Move { position }], dt, b).clone();
        all[0].push(t.elapsed().as_secs_f64() * 1e3);
        if std::env::var_os("TR").is_some() && rep.solves > 2 {
            println!(
                "tick {k} solves {} res {:.1e} {:?} epoch {}",
                rep.solves,
                rep.residual,
                rep.outcome,
                w.grid().epoch
            );
        }
        sum += rep.hand.unwrap().force;
        for (i, p) in Phase::ALL.iter().enumerate() {
            all[1 + i].push(sw.lap(*p).seconds * 1e3);
        }
        its.push(sw.lap(Phase::Iteration).count as f64);
        sol.push(rep.solves as f64);
    }
    let q = |v: &Vec<f64>| {
        let mut v = v.clone();
        v.sort_by(f64::total_cmp);
        let l = v.len();
        format!(
            "{:7.3} {:7.3} {:7.3} {:7.3} mean {:7.3}",
            v[l / 10],
            v[l / 2],
            v[l * 95 / 100],
            v[l * 99 / 100],
            v.iter().sum::<f64>() / l as f64
        )
    };
    println!(
        "active {} mean force {:?} p10 p50 p95 p99",
        w.report().particles_active,
        (sum / f64::from(ticks)).as_slice()
    );
    println!("{:10} {}", "all", q(&all[0]));
    for (i, p) in Phase::ALL.iter().enumerate() {
        println!("{:10} {}", p.name(), q(&all[1 + i]));
    }
    println!("{:10} {}", "its", q(&its));
    println!("{:10} {}", "solves", q(&sol));
}
