//! Identities that hold in any pose of any fabric: balance, force and stiffness as derivatives, symmetries, dissipation, energy.

use super::{
    Context, Findings, Row,
    mesh::{self, Mesh},
    strip,
};
use crate::{
    fabric::{self, Fabric},
    grid::{Cell, Edit},
    math::{Mat3, Vec3},
    minimize::Method,
    model::Setup,
    world::{Budget, Command, Refused, World},
};
use nalgebra::Rotation3;
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::{f64::consts::TAU, sync::Arc};

/// Identities at random poses of random fabrics.
#[derive(Clone, Debug, clap::Args)]
pub struct Identities {
    /// Poses.
    #[arg(long, default_value_t = Identities::default().poses)]
    pub poses: usize,
    /// Particles along the longer side, at the most.
    #[arg(long, default_value_t = Identities::default().particles)]
    pub particles: usize,
    /// Meshes; lattices of graded ones are as much finer as their largest cells are larger than the finest.
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["uniform"])]
    pub mesh: Vec<Mesh>,
    /// Step of the motion whose energy is balanced [s]; implicit Euler loses some in each.
    #[arg(long, default_value_t = Identities::default().step)]
    pub step: f64,
}

impl Default for Identities {
    fn default() -> Identities {
        Identities { poses: 4, particles: 13, mesh: vec![Mesh::Uniform], step: 2e-4 }
    }
}

const STEP: f64 = 0.02;
const BUDGET: Budget<'static> = Budget::solves(20);
/// Shift of the hand for differences [m].
const SHIFT: f64 = 5e-6;
/// The hand goes so far astray before, and half of it back [m]: hysteresis that slid then sticks, and forces have one slope there.
const ASTRAY: f64 = 3e-4;
/// Time of the motion whose energy is balanced [s], and the way of the hand [m].
const TIME: f64 = 0.5;
const LIFT: f64 = 0.03;

impl Identities {
    /// The suite's checks.
    pub fn suite(quick: bool) -> Vec<Identities> {
        let full = Identities::default();
        let graded =
            Identities { poses: 1, particles: 7, mesh: vec![Mesh::Random, Mesh::Adapted], ..full.clone() };
        if quick {
            let graded = Identities { particles: 6, mesh: vec![Mesh::Adapted], step: 1e-3, ..graded };
            return vec![Identities { poses: 1, particles: 9, ..full }, graded];
        }
        vec![full, graded]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        strip::allow("poses", self.poses as f64, [1.0, 1000.0])?;
        strip::allow("particles", self.particles as f64, [6.0, 40.0])?;
        strip::allow("step", self.step, [1e-5, 1e-2])?;
        let mut findings = Findings::default();
        for &mesh in &self.mesh {
            self.poses(mesh, context, &mut findings.rows)?;
        }
        if !self.mesh.contains(&Mesh::Uniform) {
            return Ok(findings);
        }
        let mut random = Pcg64::seed_from_u64(context.seed);
        for name in fabric::list() {
            findings.rows.push(strain_loops(&name, &mut random)?);
        }
        Ok(findings)
    }

    /// Poses on a mesh.
    fn poses(&self, mesh: Mesh, context: &Context, rows: &mut Vec<Row>) -> Result<(), Refused> {
        let (mut found, mut drawn) = (0, 0);
        while found < self.poses {
            if drawn == 4 * self.poses + 4 {
                return Err(Refused(format!("of {drawn} poses only {found} came to rest{}", mesh.case())));
            }
            let mut random = Pcg64::seed_from_u64(context.seed.wrapping_mul(1000).wrapping_add(drawn as u64));
            drawn += 1;
            // A pose that finds no rest says nothing about rest.
            let Ok(pose) = Pose::new(mesh, self.particles, &mut random)? else { continue };
            pose.check(self.step, &mut random, rows)?;
            found += 1;
            (context.progress)(found as f64 / self.poses as f64);
        }
        let name = format!("poses drawn, for so many at rest{}", mesh.case());
        rows.push(Row::report(&name, "", drawn as f64, found as f64));
        Ok(())
    }
}

/// A sheet of some fabric at rest, hung from the hand and from a pin, both anywhere at its border.
struct Pose {
    world: World,
    hand: [usize; 2],
    pin: [usize; 2],
    case: String,
}

impl Pose {
    /// Draws a pose; the inner error is one that finds no rest.
    fn new(mesh: Mesh, most: usize, random: &mut impl Rng) -> Result<Result<Pose, Refused>, Refused> {
        let names = fabric::list();
        let name = &names[random.random_range(0..names.len())];
        let fabric = fabric::load(name).map_err(|e| Refused(e.to_string()))?;
        let coarsest = mesh.coarsest();
        let counts = [0, 1].map(|_| (random.random_range(6..=most) - 1) * coarsest + 1);
        // Cells shorter than the fabric's bending length: coarser ones fold sharply and then move by jerks.
        let size = [0, 1].map(|k| {
            let length = (fabric.rigidity(k) / (fabric.areal_density * strip::GRAVITY)).cbrt();
            random.random_range(0.3..0.7) * length * (counts[k] - 1) as f64 / coarsest as f64
        });
        let on_border = |random: &mut dyn FnMut(usize) -> usize| {
            let mut site = [random(counts[0]), random(counts[1])];
            let side = random(4);
            site[side % 2] = if side < 2 { 0 } else { counts[side % 2] - 1 };
            site
        };
        let mut draw = |n: usize| random.random_range(0..n);
        let hand = on_border(&mut draw);
        let mut pin = on_border(&mut draw);
        while hand.iter().zip(&pin).map(|(a, b)| a.abs_diff(*b)).sum::<usize>() < coarsest * most / 3 {
            pin = on_border(&mut draw);
        }
        let turns: [f64; 3] = std::array::from_fn(|_| random.random_range(-3.0..3.0));
        let turn = Rotation3::from_euler_angles(turns[0], turns[1], turns[2]);
        let at = |n: usize| {
            let site = [n / counts[1], n % counts[1]];
            let [x, y] = [0, 1].map(|k| size[k] * site[k] as f64 / (counts[k] - 1) as f64);
            turn * Vec3::new(x, y, 0.01 * (x + y) * (40.0 * x + 25.0 * y).sin())
        };
        let setup = Setup {
            positions: (0..counts[0] * counts[1]).map(at).collect(),
            particles: counts,
            size,
            fabric: Arc::new(fabric),
            pins: vec![pin],
            hand: Some(hand),
            obstacles: Vec::new(),
            gravity: strip::GRAVITY,
            drag: 2.0,
            cut: None,
            particles_only: false,
        };
        let mut world = mesh.world(setup, |_| false, random)?;
        world.step(&[Command::Grab { particle: hand }], STEP, BUDGET);
        let place = |world: &World, site: [usize; 2]| world.positions()[world.grid().index(site)];
        // The hand comes nearer to the pin, so that the sheet hangs slack.
        let from = place(&world, hand);
        let way = (place(&world, pin) - from) * random.random_range(0.15..0.4)
            + Vec3::from_fn(|_, _| random.random_range(-0.1..0.1)) * size[0].min(size[1]);
        for k in 1..=100 {
            world.step(&[Command::Move { position: from + way * f64::from(k) / 100.0 }], STEP, BUDGET);
        }
        if let Err(unrest) = mesh::settle(&mut world, STEP, 2000) {
            return Ok(Err(unrest));
        }
        let active = world.grid().tally()[0];
        let case = format!("{name}, {active} of {} × {}, hand {hand:?}{}", counts[0], counts[1], mesh.case());
        Ok(Ok(Pose { world, hand, pin, case }))
    }

    fn check(mut self, step: f64, random: &mut impl Rng, rows: &mut Vec<Row>) -> Result<(), Refused> {
        self.balance(rows);
        self.derivatives(random, rows)?;
        self.symmetries(random, rows)?;
        self.hand_loop(rows);
        self.energy(step, rows)
    }

    /// Forces and moments of what holds the sheet against its weight.
    fn balance(&self, rows: &mut Vec<Row>) {
        let world = &self.world;
        let (x, weight) = (world.positions(), world.model().weight());
        let gravity = |n: usize| Vec3::z() * -(world.model().mass(n) * world.model().gravity);
        let held = [self.hand, self.pin]
            .map(|site| (world.grid().index(site), world.reaction(site).unwrap_or_default()));
        let about = x[held[1].0];
        let mut force: Vec3 = (0..x.len()).map(gravity).sum();
        // The weight of merged cells acts where the lattice had it: dead loads turn what has moved to their corners back.
        let turns = |n: usize| (x[n] - about).cross(&(gravity(n) + world.state().load(n)));
        let mut moment: Vec3 = (0..x.len()).map(turns).sum();
        for (n, pull) in held {
            force -= pull;
            moment -= (x[n] - about).cross(&pull);
        }
        let size = world.grid().size[0].max(world.grid().size[1]);
        rows.push(Row::vanishes("balance of forces", &self.case, force.norm() / weight, 1e-5));
        rows.push(Row::vanishes("balance of moments", &self.case, moment.norm() / (weight * size), 1e-5));
    }

    /// The force is minus the derivative of the minimized energy in the hand's place, the stiffness minus that of the force.
    fn derivatives(&mut self, random: &mut impl Rng, rows: &mut Vec<Row>) -> Result<(), Refused> {
        let Some(felt) = self.world.report().hand else { return Ok(()) };
        let way = Vec3::from_fn(|_, _| random.random_range(-1.0..1.0)).normalize() * ASTRAY;
        for part in [1.0, 0.5] {
            self.world.step(&[Command::Move { position: felt.position + way * part }], 10.0, BUDGET);
            strip::settle(&mut self.world, 10.0, 200)?;
        }
        let rest = self.world.snapshot();
        let Some(felt) = self.world.report().hand else { return Ok(()) };
        let (mut force, mut stiffness) = (Vec3::zeros(), Mat3::zeros());
        for axis in 0..3 {
            let mut ends = [(0.0, Vec3::zeros()); 2];
            for (end, sign) in ends.iter_mut().zip([1.0, -1.0]) {
                self.world.restore(&rest);
                let position = felt.position + Vec3::ith(axis, sign * SHIFT);
                self.world.step(&[Command::Move { position }], 10.0, BUDGET);
                strip::settle(&mut self.world, 10.0, 200)?;
                let report = self.world.report();
                let pull = report.hand.map_or(Vec3::zeros(), |h| h.force);
                *end = (report.energy + report.dissipated + of_loads(&self.world), pull);
            }
            force[axis] = -(ends[0].0 - ends[1].0) / (2.0 * SHIFT);
            stiffness.set_column(axis, &(-(ends[0].1 - ends[1].1) / (2.0 * SHIFT)));
        }
        self.world.restore(&rest);
        let k = felt.stiffness;
        let off = (force - felt.force).norm() / felt.force.norm();
        rows.push(Row::vanishes("force against energy", &self.case, off, 1e-3));
        rows.push(Row::vanishes(
            "stiffness, symmetry",
            &self.case,
            (k - k.transpose()).norm() / k.norm(),
            1e-9,
        ));
        rows.push(Row::vanishes(
            "stiffness against force",
            &self.case,
            (stiffness - k).norm() / k.norm(),
            2e-2,
        ));
        Ok(())
    }

    /// Turning everything about the vertical turns the force; exchanging warp and weft changes nothing. All sheets start as virgins from
    /// where this one rests.
    fn symmetries(&self, random: &mut impl Rng, rows: &mut Vec<Row>) -> Result<(), Refused> {
        let start = Setup { positions: self.world.positions().to_vec(), ..self.world.setup().clone() };
        let merged = mesh::merges_of(self.world.grid());
        let swap = |[a, b]: [usize; 2]| [b, a];
        let rest = |setup: Setup, exchanged: bool| -> Result<(Vec3, f64), Refused> {
            let turned = |cell: &Cell| Cell { corner: swap(cell.corner), size: swap(cell.size) };
            let merged: Vec<Cell> =
                if exchanged { merged.iter().map(turned).collect() } else { merged.clone() };
            let edits: Vec<Edit> = merged.into_iter().map(Edit::Coarsen).collect();
            let mut world = World::with_mesh(setup, Method::default(), &edits)?;
            strip::settle(&mut world, STEP, 6000)?;
            Ok((world.report().hand.map_or(Vec3::zeros(), |h| h.force), world.report().energy))
        };
        let plain = rest(start.clone(), false)?;
        let turn = Rotation3::from_axis_angle(&Vec3::z_axis(), random.random_range(0.5..3.0));
        let turned = rest(
            Setup { positions: start.positions.iter().map(|p| turn * p).collect(), ..start.clone() },
            false,
        )?;
        let [rows_, columns] = start.particles;
        let Fabric { tensile: [t0, t1], bending: [b0, b1], .. } = (*start.fabric).clone();
        let exchanged = rest(
            Setup {
                fabric: Arc::new(Fabric { tensile: [t1, t0], bending: [b1, b0], ..(*start.fabric).clone() }),
                particles: swap(start.particles),
                size: [start.size[1], start.size[0]],
                positions: (0..rows_ * columns)
                    .map(|n| start.positions[(n % rows_) * columns + n / rows_])
                    .collect(),
                pins: start.pins.iter().map(|s| swap(*s)).collect(),
                hand: start.hand.map(swap),
                ..start.clone()
            },
            true,
        )?;
        let force = |f: Vec3| (f - plain.0).norm() / plain.0.norm();
        let energy = |e: f64| ((e - plain.1) / plain.1).abs();
        let case = &self.case;
        rows.push(Row::vanishes(
            "rotation about gravity, force",
            case,
            force(turn.inverse() * turned.0),
            1e-5,
        ));
        rows.push(Row::vanishes("rotation about gravity, energy", case, energy(turned.1), 1e-7));
        rows.push(Row::vanishes("warp and weft exchanged, force", case, force(exchanged.0), 1e-5));
        rows.push(Row::vanishes("warp and weft exchanged, energy", case, energy(exchanged.1), 1e-7));
        Ok(())
    }

    /// A hand that goes round twice: the second round ends where it began, and the fabric has dissipated, never given back.
    fn hand_loop(&mut self, rows: &mut Vec<Row>) {
        let rest = self.world.snapshot();
        let Some(felt) = self.world.report().hand else { return };
        let (mut least, mut start) = (f64::INFINITY, 0.0);
        for k in 0..=200 {
            let angle = TAU * f64::from(k) / 100.0;
            let way = Vec3::new(angle.sin(), 0.0, 1.0 - angle.cos()) * 0.01;
            let before = self.world.report().dissipated;
            self.world.step(&[Command::Move { position: felt.position + way }], 0.1, BUDGET);
            least = least.min(self.world.report().dissipated - before);
            if k == 100 {
                start = self.world.report().dissipated;
            }
        }
        let lost = self.world.report().dissipated - start;
        let scale = lost.abs().max(1e-12);
        rows.push(Row::at_least("hand's round, least dissipation in a step", &self.case, least / scale, 0.0));
        self.world.restore(&rest);
    }

    /// Work of the hand against stored, dissipated and kinetic energy, without drag.
    fn energy(&self, step: f64, rows: &mut Vec<Row>) -> Result<(), Refused> {
        let setup =
            Setup { positions: self.world.positions().to_vec(), drag: 0.0, ..self.world.setup().clone() };
        let edits: Vec<Edit> = mesh::merges_of(self.world.grid()).into_iter().map(Edit::Coarsen).collect();
        let mut world = World::with_mesh(setup, Method::default(), &edits)?;
        strip::settle(&mut world, STEP, 6000)?;
        world.step(&[Command::Grab { particle: self.hand }], step, BUDGET);
        let kinetic = |world: &World| -> f64 {
            let speeds = world.state().velocities.iter().enumerate();
            speeds.map(|(n, v)| 0.5 * world.model().mass(n) * v.norm_squared()).sum()
        };
        let whole = |world: &World| world.report().energy + world.report().dissipated + kinetic(world);
        let Some(mut last) = world.report().hand else { return Ok(()) };
        let (from, before) = (last.position, whole(&world));
        let (mut work, mut most) = (0.0, 0.0_f64);
        let steps = (TIME / step).round() as usize;
        for k in 1..=steps {
            let part = k as f64 / steps as f64;
            let lift = LIFT * part.powi(3) * (10.0 - 15.0 * part + 6.0 * part * part);
            let position = from + Vec3::new(0.3 * lift, 0.2 * lift, lift);
            world.step(&[Command::Move { position }], step, BUDGET);
            let Some(felt) = world.report().hand else { return Ok(()) };
            // The cloth pulls the hand by `force`: the hand's work is against it.
            work -= 0.5 * (felt.force + last.force).dot(&(felt.position - last.position));
            most = most.max(kinetic(&world));
            last = felt;
        }
        let gained = whole(&world) - before;
        let note = format!("kinetic energy {:.1} % of the work at the most", 100.0 * most / work);
        rows.push(
            Row::compare("energy of a motion against work", &self.case, gained, work, 1e-2).because(&note),
        );
        Ok(())
    }
}

/// Energy of dead loads [J].
fn of_loads(world: &World) -> f64 {
    -world.positions().iter().zip(world.state().all_loads()).map(|(x, load)| x.dot(&load)).sum::<f64>()
}

/// Strain loops of each law, random but closed: the second time round, the work is what was dissipated, and positive.
fn strain_loops(name: &str, random: &mut impl Rng) -> Result<Row, Refused> {
    let fabric = fabric::load(name).map_err(|e| Refused(e.to_string()))?;
    let ranges = [(0.0, 0.03), (0.0, 0.03), (-200.0, 200.0), (-200.0, 200.0), (-0.12, 0.12)];
    let laws = fabric.tensile.iter().chain(&fabric.bending).chain([&fabric.shear]);
    let mut worst = 0.0_f64;
    for (law, (low, high)) in laws.zip(ranges) {
        for _ in 0..50 {
            let corners: Vec<f64> = (0..8).map(|_| random.random_range(low..high)).collect();
            let (mut x, mut p) = (corners[7], law.virgin());
            let mut rounds = [[0.0; 2]; 3];
            for [work, lost] in &mut rounds {
                for &corner in &corners {
                    for part in 1..=20 {
                        let from = x + (corner - x) * f64::from(part) / 20.0;
                        *work += law.evaluate(from, p).energy - law.evaluate(x, p).energy;
                        let next = law.commit(from, p);
                        *lost += law.dissipated(p, next);
                        (x, p) = (from, next);
                    }
                }
            }
            let [_, _, [work, lost]] = rounds;
            let scale = lost.max(1e-12);
            worst = worst.max((work - lost).abs() / scale);
            if work < 0.0 {
                worst = f64::INFINITY;
            }
        }
    }
    Ok(Row::vanishes("closed strain loops, work against dissipation", name, worst, 1e-6))
}
