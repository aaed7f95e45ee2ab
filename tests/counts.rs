//! Instructions that a tick takes, counted by valgrind: they tell a slower kernel from a busy machine.
//!
//! Without arguments it runs itself under callgrind, which knows AVX2 but not AVX-512, and compares with `golden/counts.json`; `--update`
//! writes that file anew. Not a part of the suite, because what runs under valgrind must be small.

use kesi::{
    cores::{self, Core},
    math::Vec3,
    scene::Scene,
    world::{Budget, Command, Method, World},
};
use std::{collections::BTreeMap, env, fs, path::Path, process::Command as Process};

/// Ticks of both runs; their difference is counted.
const TICKS: [u32; 2] = [2, 7];
/// Share by which a count may grow before it is a failure: compilers differ.
const GROWTH: f64 = 0.05;
/// Ticks by name: their scene and solver.
const KINDS: [(&str, &str, Method); 3] = [
    ("multigrid", "hang", Method::Multigrid),
    ("fronts", "hang", Method::Fronts),
    ("contact", "drape", Method::Multigrid),
];

/// Steps the falling sheet of a scene `ticks` times by 1 ms, its hand at 0.1 m/s; on the drape's box it lies from the start.
fn step(scene: &str, method: Method, ticks: u32) {
    // Without a core for it, nothing that another thread had not finished at the end is left out of the count.
    let _claimed: Vec<Core> = std::iter::from_fn(cores::claim).collect();
    let mut scene = Scene { particles: [21, 21], ..Scene::named(scene).unwrap() };
    if scene.name == "drape" {
        scene.placement.origin_m[2] = 0.2011;
    }
    let mut world = World::with_method(scene.setup().unwrap(), method).unwrap();
    let particle = world.setup().hand.unwrap();
    world.step(&[Command::Grab { particle }], 0.001, Budget::solves(1));
    let start = world.report().hand.unwrap().position;
    for k in 1..=ticks {
        let position = start + Vec3::new(0.8, 0.0, 0.6) * (1e-4 * f64::from(k));
        world.step(&[Command::Move { position }], 0.001, Budget::solves(1));
    }
    assert_eq!(world.report().contact.pairs > 0, scene.name == "drape");
}

/// Instructions of this binary with these arguments.
fn counted(kind: &str, ticks: u32) -> f64 {
    let run = Process::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(env::current_exe().unwrap())
        .args([kind, &ticks.to_string()])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(run.status.success(), "{text}");
    let count = text.lines().find_map(|line| line.split_once("Collected :")?.1.trim().parse().ok());
    count.unwrap_or_else(|| panic!("no count in: {text}"))
}

fn main() {
    let arguments: Vec<String> = env::args().skip(1).collect();
    if let [kind, ticks] = &arguments[..]
        && let (Some((_, scene, method)), Ok(ticks)) = (KINDS.iter().find(|k| k.0 == kind), ticks.parse())
    {
        return step(scene, *method, ticks);
    }
    if Process::new("valgrind").arg("--version").output().is_err() {
        return println!("valgrind is not installed: instructions not counted");
    }
    #[cfg(target_arch = "x86_64")]
    let comparable = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    #[cfg(not(target_arch = "x86_64"))]
    let comparable = false;
    if !comparable {
        return println!("no AVX2 here: instructions not counted");
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/counts.json");
    let [few, many] = TICKS;
    let counts: BTreeMap<&str, f64> = KINDS
        .iter()
        .map(|&(name, ..)| (name, (counted(name, many) - counted(name, few)) / f64::from(many - few)))
        .collect();
    if arguments.iter().any(|a| a == "--update") {
        fs::write(&path, serde_json::to_string_pretty(&counts).unwrap() + "\n").unwrap();
        return println!("{counts:?} written to {}", path.display());
    }
    let known: BTreeMap<String, f64> = serde_json::from_str(&fs::read_to_string(&path).unwrap()).unwrap();
    for (name, count) in &counts {
        let growth = count / known[*name] - 1.0;
        println!("{name}: {:.3} million instructions per tick, {:+.1} %", count * 1e-6, growth * 100.0);
        assert!(
            growth <= GROWTH,
            "{name}: a tick takes more instructions than {:.0}; if that is meant, run `cargo test --release --test counts -- --update`",
            known[*name]
        );
    }
}
