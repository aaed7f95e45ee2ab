//! What is done to a cloth: hands that jump, shake, spin and tear, obstacles that sweep, worlds that change in flight.

use super::{
    case::{Case, Topic, stream},
    scene,
};
use crate::{
    grid::Site,
    math::Vec3,
    model::Setup,
    world::{Command, World},
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use rand::RngExt;
use rand_pcg::Pcg64;
use std::{f64::consts::TAU, sync::Arc};

named! {
    /// A kind of manipulation.
    Kind {
        /// Nothing is done.
        Calm = "calm",
        /// The hand is told to be 10 m away, and somewhere else soon after.
        Teleport = "teleport",
        /// The hand shakes at 1 kHz.
        Shake = "shake",
        /// The hand spins.
        Spin = "spin",
        /// Particles from all over are taken, pinned and drawn to one point.
        Crumple = "crumple",
        /// The hand draws the sheet to ten times its length.
        Stretch = "stretch",
        /// The hand is told to go inside an obstacle.
        Inside = "inside",
        /// All that is pinned is let go.
        Drop = "drop",
        /// Two hands in turn: one holds while the other moves.
        TwoHands = "two-hands",
        /// Clamps jump by up to 10 m, singly and all at once.
        Clamps = "clamps",
        /// Obstacles sweep through the sheet.
        Sweep = "sweep",
        /// The sheet becomes another fabric, obstacles come and go.
        Refit = "refit",
        /// The mesh adapts, stays, adapts again.
        Remesh = "remesh",
        /// The world goes back to a snapshot, at random.
        Rewind = "rewind",
        /// Commands that must be refused.
        Nonsense = "nonsense",
        /// All of it at once.
        Everything = "everything",
    }
}

/// Farthest jump of a hand [m].
const JUMP: f64 = 10.0;
/// Places of a hand per second of shaking [1/s]; poses come no faster.
const RATE: f64 = 4000.0;
/// Frequency of shaking [1/s].
const FREQUENCY: f64 = 1000.0;
/// Places on the hand's path in one step at the most.
const MOST_PLACES: usize = 16;

impl Kind {
    /// The kind of a name.
    pub fn parse(name: &str) -> Result<Kind, String> {
        Kind::ALL.iter().copied().find(|k| k.name() == name).ok_or_else(|| {
            let known: Vec<&str> = Kind::ALL.iter().map(|k| k.name()).collect();
            format!("acts: got {name:?}, allowed: {}", known.join(", "))
        })
    }
}

/// A manipulation that goes on.
pub struct Act<'a> {
    case: &'a Case,
    kind: Kind,
    place: usize,
    random: Pcg64,
    /// Longer side of the sheet [m].
    side: f64,
    /// Where it is aimed [m].
    aim: Vec3,
    /// A direction.
    along: Vec3,
    /// How hard it is, from 0 to 1.
    strength: f64,
    taken: Vec<Site>,
    kept: Option<crate::world::Snapshot>,
}

/// What a manipulation asks for in one step.
#[derive(Default)]
pub struct Wish {
    /// Commands of the step.
    pub commands: Vec<Command>,
    /// A world that goes on from here in place of the present one.
    pub world: Option<Box<World>>,
    /// The world goes back to a snapshot before the step.
    pub rewind: Option<crate::world::Snapshot>,
    /// The mesh adapts from now on, or does not.
    pub adaptive: Option<bool>,
}

impl Act<'_> {
    /// A manipulation of a case, about to begin.
    pub fn new<'a>(case: &'a Case, place: usize, kind: Kind, world: &World) -> Act<'a> {
        let mut random = stream(case.seed, Topic::Act, place);
        let positions = world.positions();
        let middle = positions.iter().sum::<Vec3>() / positions.len() as f64;
        let along = direction(&mut random);
        let size = world.grid().size;
        Act {
            case,
            kind,
            place,
            side: size[0].max(size[1]),
            aim: middle,
            along,
            strength: random.random_range(0.0..1.0),
            random,
            taken: Vec::new(),
            kept: None,
        }
    }

    /// What is done in step `tick` of `ticks`.
    pub fn wish(&mut self, world: &World, tick: usize, ticks: usize) -> Wish {
        let kind = match self.kind {
            Kind::Everything => Kind::ALL[self.random.random_range(0..Kind::ALL.len() - 1)],
            kind => kind,
        };
        let mut wish = Wish::default();
        let part = (tick + 1) as f64 / ticks as f64;
        match kind {
            Kind::Calm | Kind::Everything => {}
            Kind::Teleport => {
                self.hold(world, &mut wish, tick);
                if tick.is_multiple_of(12) {
                    let position = self.hand(world) + direction(&mut self.random) * JUMP;
                    wish.commands.push(Command::Move { position });
                }
            }
            Kind::Shake => self.shake(world, &mut wish, tick),
            Kind::Spin => {
                self.hold(world, &mut wish, tick);
                let turns = 0.5 + 50.0 * self.strength;
                let angle = TAU * turns * self.case.tick * tick as f64;
                let around = Vec3::new(angle.cos(), angle.sin(), 0.3 * (2.0 * angle).sin());
                let position = self.aim + around * (0.5 * self.side);
                wish.commands.push(Command::Move { position });
            }
            Kind::Crumple => self.crumple(world, &mut wish, tick, ticks),
            Kind::Stretch => {
                self.hold(world, &mut wish, tick);
                let position = self.aim + self.along * (10.0 * self.side * part);
                wish.commands.push(Command::Move { position });
            }
            Kind::Inside => {
                self.hold(world, &mut wish, tick);
                let count = world.state().poses.len();
                let position = if count > 0 {
                    let pose = world.state().poses[self.place % count];
                    pose.translation.vector + direction(&mut self.random) * (0.02 * self.side)
                } else {
                    self.aim
                };
                wish.commands.push(Command::Move { position });
            }
            Kind::Drop => {
                if tick == 0 {
                    drop_all(world, &mut wish);
                }
            }
            Kind::TwoHands => {
                if tick.is_multiple_of(8) {
                    // The other hand keeps what it holds: it stays pinned.
                    let particle = self.particle(world);
                    wish.commands.push(Command::Grab { particle });
                } else {
                    let way = self.along * (0.05 * self.side * (0.2 + self.strength));
                    let way = if (tick / 8).is_multiple_of(2) { way } else { -way };
                    wish.commands.push(Command::Move { position: self.hand(world) + way });
                }
            }
            Kind::Clamps => self.clamps(world, &mut wish),
            Kind::Sweep => self.sweep(world, &mut wish, tick),
            Kind::Refit => {
                if tick % 10 == 5 {
                    wish.world = self.refit(world, tick);
                }
            }
            Kind::Remesh => {
                if tick.is_multiple_of(5) {
                    wish.adaptive = Some(!(tick / 5).is_multiple_of(2) || tick == 0);
                }
                if tick % 7 == 3 {
                    wish.commands.push(Command::Grab { particle: self.particle(world) });
                }
                let way = direction(&mut self.random) * (0.1 * self.side);
                wish.commands.push(Command::Move { position: self.hand(world) + way });
            }
            Kind::Rewind => {
                if tick % 9 == 2 {
                    self.kept = Some(world.snapshot());
                } else if tick % 9 == 7 {
                    wish.rewind = self.kept.clone();
                }
                self.hold(world, &mut wish, tick);
                let way = direction(&mut self.random) * (0.3 * self.side);
                wish.commands.push(Command::Move { position: self.hand(world) + way });
            }
            Kind::Nonsense => wish.commands = nonsense(world),
        }
        wish
    }

    /// Takes a particle where the hand holds none.
    fn hold(&mut self, world: &World, wish: &mut Wish, tick: usize) {
        let holds = world.report().hand.is_some_and(|h| h.held);
        if !holds || tick == 0 && self.strength > 0.5 {
            wish.commands.push(Command::Grab { particle: self.particle(world) });
        }
    }

    fn hand(&self, world: &World) -> Vec3 {
        world.report().hand.map_or(self.aim, |h| h.position)
    }

    /// A particle, a corner as often as not.
    fn particle(&mut self, world: &World) -> Site {
        let grid = world.grid();
        for _ in 0..50 {
            let corner = self.random.random_bool(0.5);
            let site = [0, 1].map(|k| {
                let last = grid.counts[k] - 1;
                if corner {
                    last * self.random.random_range(0..2)
                } else {
                    self.random.random_range(0..=last)
                }
            });
            if !grid.is_cut_away(grid.index(site)) {
                return site;
            }
        }
        [0, 0]
    }

    fn shake(&mut self, world: &World, wish: &mut Wish, tick: usize) {
        self.hold(world, wish, tick);
        if tick == 0 {
            self.aim = self.hand(world);
        }
        let tick_s = self.case.tick;
        let places = ((tick_s * RATE) as usize).clamp(1, MOST_PLACES);
        let reach = 0.1 * self.side * self.strength * self.strength + 1e-4;
        for k in 1..=places {
            let time = tick_s * (tick as f64 + k as f64 / places as f64);
            let position = self.aim + self.along * (reach * (TAU * FREQUENCY * time + 0.3).sin());
            wish.commands.push(Command::Move { position });
        }
    }

    fn crumple(&mut self, world: &World, wish: &mut Wish, tick: usize, ticks: usize) {
        let takes = (ticks / 4).clamp(2, 12);
        if tick < takes {
            let particle = self.particle(world);
            self.taken.push(particle);
            wish.commands.push(Command::Grab { particle });
            return;
        }
        let part = (tick - takes + 1) as f64 / (ticks - takes).max(1) as f64;
        for &particle in &self.taken {
            let from = world.positions()[world.grid().index(particle)];
            let position = from + (self.aim - from) * part;
            wish.commands.push(Command::Drive { particle, position });
        }
    }

    fn clamps(&mut self, world: &World, wish: &mut Wish) {
        let fixed: Vec<Site> = fixed(world);
        let together = self.random.random_bool(0.3);
        let way = direction(&mut self.random) * JUMP * self.random.random_range(0.0_f64..1.0).powi(4);
        for &particle in &fixed {
            if together || self.random.random_range(0..fixed.len()) == 0 {
                let position = world.positions()[world.grid().index(particle)] + way;
                wish.commands.push(Command::Drive { particle, position });
            }
        }
    }

    fn sweep(&mut self, world: &World, wish: &mut Wish, tick: usize) {
        let count = world.state().poses.len();
        if count == 0 || !tick.is_multiple_of(6) {
            return;
        }
        let obstacle = self.random.random_range(0..count);
        let turn = UnitQuaternion::from_scaled_axis(
            direction(&mut self.random) * self.random.random_range(0.0..3.0),
        );
        let to = self.aim + direction(&mut self.random) * self.side * self.random.random_range(0.0..1.0);
        let pose =
            Isometry3::from_parts(Translation3::from(to), turn * world.state().poses[obstacle].rotation);
        let duration = self.case.tick * f64::from(self.random.random_range(0_u32..20));
        wish.commands.push(Command::Push { obstacle, pose, duration });
    }

    /// The cloth where it is, of another fabric, among other obstacles; none where the new world is refused.
    fn refit(&mut self, world: &World, tick: usize) -> Option<Box<World>> {
        let setup = world.setup();
        let place = 1 + 100 * self.place + tick;
        let mut obstacles = setup.obstacles.clone();
        obstacles.iter_mut().zip(&world.state().poses).for_each(|(o, pose)| o.pose = *pose);
        let mut next = Setup {
            fabric: Arc::new(scene::fabric_of(self.case, place).ok()?),
            positions: world.positions().to_vec(),
            pins: fixed(world),
            hand: world.report().hand.map(|h| h.particle),
            obstacles,
            ..setup.clone()
        };
        next.drag *= next.fabric.areal_density / setup.fabric.areal_density;
        if self.random.random_bool(0.3) {
            next.obstacles.pop();
        } else if next.obstacles.len() < 4 && self.random.random_bool(0.5) {
            let (_, obstacle, _) = scene::obstacle(self.case, place, &next);
            next.obstacles.push(obstacle);
        }
        World::with_method(next, world.method()).ok().map(Box::new)
    }
}

/// Particles that are fixed and active.
pub fn fixed(world: &World) -> Vec<Site> {
    let grid = world.grid();
    let sites = (0..grid.particles()).map(|n| grid.site(n));
    sites.filter(|s| world.reaction(*s).is_some()).collect()
}

/// Lets everything go.
fn drop_all(world: &World, wish: &mut Wish) {
    wish.commands.push(Command::Release { let_go: true });
    for particle in fixed(world) {
        wish.commands.extend([Command::Grab { particle }, Command::Release { let_go: true }]);
    }
}

/// Commands that `World::check` must refuse.
fn nonsense(world: &World) -> Vec<Command> {
    let far = Vec3::new(0.0, 1e9, 0.0);
    let beyond = world.grid().counts;
    let still = Isometry3::identity();
    let mut commands = vec![
        Command::Grab { particle: beyond },
        Command::Move { position: far },
        Command::Move { position: Vec3::repeat(f64::NAN) },
        Command::Move { position: Vec3::repeat(f64::INFINITY) },
        Command::Drive { particle: beyond, position: Vec3::zeros() },
        Command::Drive { particle: [0, 0], position: far },
        Command::Push { obstacle: world.state().poses.len(), pose: still, duration: 0.0 },
    ];
    if !world.state().poses.is_empty() {
        let adrift = Isometry3::translation(f64::NAN, 0.0, 0.0);
        let push = |pose, duration| Command::Push { obstacle: 0, pose, duration };
        commands.extend([push(still, -1.0), push(still, f64::NAN), push(still, 1e9), push(adrift, 0.0)]);
    }
    commands
}

fn direction(random: &mut Pcg64) -> Vec3 {
    loop {
        let v = Vec3::from_fn(|_, _| random.random_range(-1.0..1.0));
        if (0.01..=1.0).contains(&v.norm()) {
            return v.normalize();
        }
    }
}
