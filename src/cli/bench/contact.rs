//! `kesi bench contact`: violent manipulations near obstacles, judged by an independent check; and the paper's scene with contact
//! of particles alone beside contact of the whole surface.
//!
//! The check goes over all triangles and obstacles in every accepted state by parry's algorithms (`obstacle::witness`).

use super::Output;
use crate::{
    cli::{positive, sorted::median},
    fabric,
    math::Vec3,
    model::Setup,
    obstacle::{Obstacle, Polyhedron, Shape, witness::Witness},
    scene::Scene,
    stress::scene::ring,
    world::{Adaptive, Budget, Command, Outcome, World},
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;
use std::{error::Error, sync::Arc, time::Instant};

/// Violent manipulations near obstacles.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Particles along warp and weft.
    #[arg(long, value_delimiter = ',', default_value = "20,39,77")]
    particles: Vec<usize>,
    /// Manipulations in all, shared among the obstacles and sizes: most to the smallest.
    #[arg(long, default_value_t = 1000)]
    manipulations: u32,
    /// Obstacles, each in its own world: box, sphere, mesh, capsule, hull, plane.
    #[arg(long, value_delimiter = ',', default_value = "box,sphere,mesh")]
    obstacles: Vec<String>,
    #[command(flatten)]
    violence: Violence,
    /// Leaves the paper's scene and the cost of rest out.
    #[arg(long)]
    no_scene: bool,
    /// Timed solves of a cloth at rest, at the largest size.
    #[arg(long, default_value_t = 60)]
    rest_solves: u32,
    #[command(flatten)]
    output: Output,
}

/// How manipulations are made.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct Violence {
    /// Length of a tick [s].
    #[arg(long, default_value_t = 0.01, value_parser = positive, allow_negative_numbers = true)]
    pub tick_s: f64,
    /// Solves of a tick at the most.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..))]
    pub solves: u32,
    /// Seed of the manipulations.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Lets the mesh adapt every fifth tick.
    #[arg(long)]
    pub adaptive: bool,
}

/// What came of a row of manipulations.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Row {
    /// Obstacle, or `drape`.
    pub scene: String,
    /// `surface`, or `particles` where only particles meet obstacles.
    pub contact: &'static str,
    /// Particles.
    pub particles: usize,
    /// Manipulations.
    pub manipulations: u32,
    /// Accepted states that were checked.
    pub states: u64,
    /// Smallest gap in any of them [m]; 0 where the surface met an obstacle.
    pub min_gap_m: f64,
    /// States with a gap of 0.
    pub violations: u64,
    /// Steps whose numbers were not finite; they were rolled back.
    pub not_finite: u64,
    /// Longest row of steps that stalled.
    pub stalled: u64,
    /// Deepest point of the surface inside an obstacle [m], sampled.
    pub max_penetration_m: f64,
}

/// What contact costs a cloth that rests on the box.
#[derive(Clone, Debug, Serialize)]
pub struct RestRow {
    /// `rest`.
    pub scene: &'static str,
    /// Particles.
    pub particles: usize,
    /// Timed solves of either kind, one per tick.
    pub solves: u32,
    /// Pairs that press.
    pub pairs: usize,
    /// Median time of a tick of one solve on the box, and of the same sheet between two corners [ms].
    pub solve_ms: f64,
    pub solve_without_ms: f64,
    /// Their ratio.
    pub cost_ratio: f64,
}

#[derive(Serialize)]
#[serde(untagged)]
enum Line {
    Manipulated(Row),
    Rest(RestRow),
}

/// Side of the sheet [m].
const SIDE: f64 = 0.3;
/// Fastest hand [m/s].
const FASTEST: f64 = 20.0;
/// Farthest jump [m].
const JUMP: f64 = 1.0;

/// Runs the bench.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let out = &args.output;
    out.line("scene   contact    particles  manipulations  states   min gap m  violations  not finite  stalled  depth mm");
    let mut rows = Vec::new();
    let sizes = args.particles.len() as u32;
    for (k, &n) in args.particles.iter().enumerate() {
        // Half of what is left to each size, all that is left to the last.
        let share = if k as u32 + 1 == sizes { 0.5_f64.powi(k as i32) } else { 0.5_f64.powi(k as i32 + 1) };
        for name in &args.obstacles {
            let count = (f64::from(args.manipulations) * share / args.obstacles.len() as f64).ceil() as u32;
            let row = manipulate(name, n, count, args.violence)?;
            print(out, &row);
            rows.push(Line::Manipulated(row));
        }
    }
    if !args.no_scene {
        for particles_only in [true, false] {
            let row = pull_beside_the_box(particles_only)?;
            print(out, &row);
            rows.push(Line::Manipulated(row));
        }
        let largest = args.particles.iter().copied().max().unwrap_or(77);
        let row = cost_of_rest(largest, args.rest_solves)?;
        out.line(&format!(
            "A tick of one solve at rest on the box, {} particles, {} pairs: {:.2} ms, without the box {:.2} ms, ratio {:.3}",
            row.particles, row.pairs, row.solve_ms, row.solve_without_ms, row.cost_ratio
        ));
        rows.push(Line::Rest(row));
    }
    out.write(args.violence.seed, &rows)
}

fn print(out: &Output, row: &Row) {
    out.line(&format!(
        "{:7} {:9} {:10} {:14} {:7}   {:.3e} {:11} {:11} {:8}  {:8.3}",
        row.scene,
        row.contact,
        row.particles,
        row.manipulations,
        row.states,
        row.min_gap_m,
        row.violations,
        row.not_finite,
        row.stalled,
        row.max_penetration_m * 1e3
    ));
}

/// So many random manipulations of a sheet of n × n particles over an obstacle: yanks and jumps of the hand, releases, pushes.
pub fn manipulate(
    obstacle: &str,
    n: usize,
    manipulations: u32,
    violence: Violence,
) -> Result<Row, Box<dyn Error>> {
    let Violence { tick_s: dt, solves, seed, adaptive } = violence;
    let mut world = World::new(sheet_over(shape(obstacle)?, n)?)?;
    world.set_adaptive(adaptive.then(Adaptive::default));
    let mut rng = Pcg64Mcg::seed_from_u64(seed ^ n as u64);
    let mut random = move || Vec3::from_fn(|_, _| rng.random_range(-1.0..1.0));
    let mut judge = Judge::new(&world);
    let mut row = Row {
        scene: obstacle.into(),
        contact: "surface",
        particles: n * n,
        manipulations,
        min_gap_m: f64::INFINITY,
        ..Row::default()
    };
    for k in 0..manipulations {
        let mut commands = Vec::new();
        let dice = random();
        let start = world.report().hand.map_or(Vec3::zeros(), |h| h.position);
        let mut velocity = Vec3::zeros();
        match k % 5 {
            // Another particle is taken, the old one let go.
            0 => {
                let site = [dice.x, dice.y].map(|d| ((0.5 + 0.5 * d) * (n - 1) as f64).round() as usize);
                commands.extend([Command::Release { let_go: true }, Command::Grab { particle: site }]);
                velocity = random().normalize() * FASTEST * dice.z.abs();
            }
            1 => commands.push(Command::Move { position: start + random() * JUMP }),
            // Straight into the obstacle and beyond.
            2 => commands.push(Command::Move { position: -start * (0.5 + dice.x.abs()) }),
            3 => velocity = random().normalize() * FASTEST * dice.x.abs(),
            _ => {
                let turn = UnitQuaternion::from_scaled_axis(random() * 1.5);
                let pose = Isometry3::from_parts(Translation3::from(random() * 0.15), turn);
                commands.push(Command::Push { obstacle: 0, pose, duration: 0.05 * dice.x.abs() });
            }
        }
        let mut position = start;
        for tick in 0..10 {
            if velocity != Vec3::zeros() {
                position += velocity * dt;
                commands.push(Command::Move { position });
            }
            if tick == 5 {
                velocity = -velocity;
            }
            world.step(&commands, dt, Budget::solves(solves));
            commands.clear();
            if tick % 5 == 0 {
                world.adapt();
            }
            judge.see(&world, &mut row);
        }
    }
    Ok(row)
}

/// Counts what goes wrong.
struct Judge {
    witnesses: Vec<Witness>,
    stalls: u64,
}

impl Judge {
    fn new(world: &World) -> Judge {
        Judge { witnesses: world.setup().obstacles.iter().map(Witness::new).collect(), stalls: 0 }
    }

    fn see(&mut self, world: &World, row: &mut Row) {
        let report = world.report();
        row.states += 1;
        row.not_finite += u64::from(report.outcome == Outcome::NotFinite);
        self.stalls = if report.outcome == Outcome::Stalled { self.stalls + 1 } else { 0 };
        row.stalled = row.stalled.max(self.stalls);
        let mut smallest = f64::INFINITY;
        for (witness, pose) in self.witnesses.iter().zip(&world.state().poses) {
            let triangles = &world.model().surface.triangles;
            let gap = witness.distance(pose, world.positions(), triangles, smallest);
            // `min` would drop a NaN.
            smallest = if gap.is_nan() { 0.0 } else { smallest.min(gap) };
        }
        row.min_gap_m = row.min_gap_m.min(smallest);
        row.violations += u64::from(smallest <= 0.0);
    }
}

/// A sheet 2 cm above an obstacle around the origin, its corner in the hand.
fn sheet_over(shape: Shape, n: usize) -> Result<Setup, Box<dyn Error>> {
    let step = SIDE / (n - 1) as f64;
    let place =
        |k: usize| Vec3::new((k / n) as f64 * step - 0.5 * SIDE, (k % n) as f64 * step - 0.5 * SIDE, 0.08);
    Ok(Setup {
        fabric: Arc::new(fabric::load("denim-a")?),
        particles: [n, n],
        size: [SIDE, SIDE],
        positions: (0..n * n).map(place).collect(),
        pins: vec![],
        hand: Some([0, 0]),
        obstacles: vec![Obstacle { name: "it".into(), shape, pose: Isometry3::identity(), friction: None }],
        gravity: 9.81,
        drag: 0.5,
        cut: None,
        particles_only: false,
    })
}

fn shape(name: &str) -> Result<Shape, Box<dyn Error>> {
    Ok(match name {
        "box" => Shape::Cuboid { half: [0.06, 0.06, 0.06] },
        "sphere" => Shape::Sphere { radius: 0.06 },
        "mesh" => Shape::Polyhedron(Arc::new(ring(1.0)?)),
        "capsule" => Shape::Capsule { half: 0.05, radius: 0.03 },
        "hull" => Shape::Polyhedron(Arc::new(Polyhedron::hull(&shape("box")?.features().points)?)),
        "plane" => Shape::Plane,
        _ => {
            let allowed = "box, sphere, mesh, capsule, hull, plane";
            return Err(format!("--obstacles: got {name:?}, allowed: {allowed}").into());
        }
    })
}

/// The paper's scene at 20 × 20: the sheet drapes over the box, then its corner is pulled down beside it.
pub fn pull_beside_the_box(particles_only: bool) -> Result<Row, Box<dyn Error>> {
    let setup = Setup { particles_only, ..drape(20)? };
    let hand = setup.hand.ok_or("the scene has a hand")?;
    let mut world = World::new(setup)?;
    let mut judge = Judge::new(&world);
    let mut row = Row {
        scene: "drape".into(),
        contact: if particles_only { "particles" } else { "surface" },
        particles: 400,
        manipulations: 1,
        min_gap_m: f64::INFINITY,
        ..Row::default()
    };
    for _ in 0..1000 {
        let rests = world.step(&[], 0.02, Budget::solves(4)).resting;
        judge.see(&world, &mut row);
        if rests {
            break;
        }
    }
    world.step(&[Command::Grab { particle: hand }], 0.02, Budget::solves(4));
    let from = world.report().hand.ok_or("the hand holds")?.position;
    // Beside the box (half side 6 cm, top at 0.2 m) and below its top.
    let to = Vec3::new(-0.07, -0.07, 0.1);
    for k in 1..=100 {
        let position = from + (to - from) * (f64::from(k) / 100.0);
        world.step(&[Command::Move { position }], 0.02, Budget::solves(4));
        judge.see(&world, &mut row);
        row.max_penetration_m = row.max_penetration_m.max(sampled_depth(&world));
    }
    Ok(row)
}

/// The paper's scene with n × n particles.
fn drape(n: usize) -> Result<Setup, Box<dyn Error>> {
    let scene = Scene { particles: [n, n], ..Scene::built_in("drape").ok_or("the scene drape is built in")? };
    let faults =
        |f: Vec<crate::scene::SceneError>| f.iter().map(|e| e.to_string()).collect::<Vec<_>>().join("\n");
    Ok(scene.setup().map_err(faults)?)
}

/// Ticks of one solve of the drape at rest on the box and, in turn, of the same sheet at rest between two corners without the box.
pub fn cost_of_rest(n: usize, solves: u32) -> Result<RestRow, Box<dyn Error>> {
    const TICK: f64 = 0.008;
    let draped = drape(n)?;
    let hanging = Setup { obstacles: vec![], pins: vec![[n - 1, n - 1]], ..draped.clone() };
    let hand = draped.hand.ok_or("the scene has a hand")?;
    let at_rest = |setup: Setup| -> Result<World, Box<dyn Error>> {
        let mut world = World::new(setup)?;
        if !(0..3000).any(|_| world.step(&[], 0.02, Budget::solves(4)).resting) {
            return Err("the sheet did not come to rest".into());
        }
        world.step(&[Command::Grab { particle: hand }], TICK, Budget::solves(1));
        Ok(world)
    };
    let mut worlds = [at_rest(draped)?, at_rest(hanging)?];
    let starts = worlds.each_ref().map(World::snapshot);
    let mut times = [Vec::new(), Vec::new()];
    for _ in 0..solves.max(1) {
        for ((world, start), times) in worlds.iter_mut().zip(&starts).zip(&mut times) {
            world.restore(start);
            let position = world.report().hand.ok_or("the hand holds")?.position + Vec3::z() * 1e-5;
            let clock = Instant::now();
            let report = world.step(&[Command::Move { position }], TICK, Budget::solves(1));
            // An indefinite Hessian costs a second one.
            times.push(clock.elapsed().as_secs_f64() * 1e3 / f64::from(report.solves.max(1)));
        }
    }
    let [solve_ms, solve_without_ms] = times.map(median);
    Ok(RestRow {
        scene: "rest",
        particles: n * n,
        solves,
        pairs: worlds[0].report().contact.pairs,
        solve_ms,
        solve_without_ms,
        cost_ratio: solve_ms / solve_without_ms,
    })
}

/// Deepest point of the surface in an obstacle [m], over 45 points of every triangle.
fn sampled_depth(world: &World) -> f64 {
    const PARTS: usize = 8;
    let mut deepest = 0.0_f64;
    for (obstacle, pose) in world.setup().obstacles.iter().zip(&world.state().poses) {
        for nodes in &world.model().surface.triangles {
            let [a, b, c] = nodes.map(|n| world.positions()[n as usize]);
            for i in 0..=PARTS {
                for k in 0..=PARTS - i {
                    let [u, v] = [i, k].map(|w| w as f64 / PARTS as f64);
                    deepest = deepest.max(-obstacle.distance_at(pose, a + (b - a) * u + (c - a) * v));
                }
            }
        }
    }
    deepest
}
