//! Arbitrary histories of manipulation: in a machine whose clamp turns where it likes, and under a hand that carries a sheet about.
//!
//! KES measures one loop; the cloth must answer any history by a continuous path inside the envelope of that loop. Here such paths
//! are recorded and judged: every element of the sheet in every step, the specimen as a whole.

use super::specimen::Specimen;
use crate::{
    fabric::{Fabric, instrument, law::Law, measured::Test},
    math::Vec3,
    model::{Refused, Setup},
    potential::{Potential, Pull, contact::candidates::Candidates, shear, triple},
    world::{Budget, Command, World},
};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::sync::Arc;

/// How a recorded path lies to its law's envelope.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Verdict {
    /// Largest force outside the envelope, over the largest force met.
    pub outside: f64,
    /// Largest change of force between two samples over what the law's stiffness allows; a jump where it exceeds 1.
    pub jump: f64,
}

impl Verdict {
    /// The worse of both.
    pub fn worse(self, other: Verdict) -> Verdict {
        Verdict { outside: self.outside.max(other.outside), jump: self.jump.max(other.jump) }
    }
}

/// Judges a path of strain and force under a law.
pub fn judge(law: &Law, path: &[[f64; 2]]) -> Verdict {
    let largest = path.iter().map(|s| s[1].abs()).fold(f64::MIN_POSITIVE, f64::max);
    let outside = path.iter().map(|&[x, force]| {
        let [low, high] = law.envelope(x);
        (force - high).max(low - force).max(0.0) / largest
    });
    // What rounding makes of equal forces is no jump.
    let rounding = 1e-9 * largest;
    let jumps = path.windows(2).map(|s| {
        let allowed = steepest(law, s[0][0], s[1][0]) * (s[1][0] - s[0][0]).abs() + rounding;
        (s[1][1] - s[0][1]).abs() / allowed
    });
    Verdict { outside: outside.fold(0.0, f64::max), jump: jumps.fold(0.0, f64::max) }
}

/// Upper bound of the law's stiffness between two strains, whatever its history.
fn steepest(law: &Law, from: f64, to: f64) -> f64 {
    let at = |x: f64| {
        let branches = law.branches(x);
        let half = 0.5 * (branches.loading[0] - branches.unloading[0]);
        branches.loading[1].max(branches.unloading[1]) + half * half / law.stick()
    };
    let inside = law.knots().filter(|x| (*x - from) * (*x - to) < 0.0);
    let even = (0..=8).map(|k| from + (to - from) * f64::from(k) / 8.0);
    // Between these points the bound is exceeded by less than the margin.
    1.1 * even.chain(inside).map(at).fold(0.0, f64::max)
}

/// Drives a clamp through random turns within the machine's range, `samples` to a whole range; the path of the specimen.
pub fn in_machine(
    fabric: &Fabric,
    test: Test,
    intervals: usize,
    [turns, samples]: [usize; 2],
    seed: u64,
) -> Result<Vec<[f64; 2]>, Refused> {
    let mut specimen = Specimen::new(fabric, test, 0, intervals, true)?;
    let [low, high] = match test {
        Test::Tensile => [0.0, specimen.law().knots().last().unwrap_or(0.0)],
        Test::Bending => [-instrument::BENDING_RANGE, instrument::BENDING_RANGE],
        Test::Shear => [-instrument::SHEAR_RANGE, instrument::SHEAR_RANGE],
    };
    let mut random = Pcg64::seed_from_u64(seed);
    let stride = (high - low) / samples as f64;
    let mut strain = 0.0;
    let mut path = vec![[0.0, specimen.drive(0.0)]];
    for _ in 0..turns {
        let turn = random.random_range(low..high);
        let steps = ((turn - strain) / stride).abs().ceil().max(1.0);
        let from = strain;
        for k in 1..=steps as usize {
            strain = from + (turn - from) * k as f64 / steps;
            path.push([strain, specimen.drive(strain)]);
        }
    }
    Ok(path)
}

/// A sheet that hangs from two corners, one of them in a hand that wanders about.
#[derive(Clone, Debug)]
pub struct Carried {
    /// The fabric.
    pub fabric: Arc<Fabric>,
    /// Particles along each side.
    pub particles: usize,
    /// Steps of 8 ms.
    pub steps: usize,
    /// Seed of the hand's way.
    pub seed: u64,
}

/// What the elements of a carried sheet went through.
#[derive(Clone, Debug)]
pub struct Carry {
    /// Tensile, bending and shear, each over all its elements and steps.
    pub verdicts: [Verdict; 3],
    /// The path of the element that lost most energy, of each.
    pub paths: [Vec<[f64; 2]>; 3],
    /// Paths judged.
    pub elements: usize,
}

/// Side of the sheet [m], step [s], speed of the hand [m/s] and how far it goes [m].
const SIDE: f64 = 0.3;
const STEP: f64 = 8e-3;
const SPEED: f64 = 0.3;
const REACH: f64 = 0.05;

impl Carried {
    fn setup(&self) -> Setup {
        let n = self.particles;
        let spacing = SIDE / (n - 1) as f64;
        // Flat and upright, a little off the plane, so that it need not decide for a side.
        let positions = (0..n * n).map(|k| {
            let [i, j] = [k / n, k % n].map(|s| s as f64 * spacing);
            Vec3::new(j, 0.02 * (j / SIDE) * (1.0 - j / SIDE), -i)
        });
        Setup {
            fabric: self.fabric.clone(),
            particles: [n, n],
            size: [SIDE; 2],
            positions: positions.collect(),
            pins: vec![[0, n - 1]],
            hand: Some([0, 0]),
            obstacles: vec![],
            gravity: 9.81,
            drag: 0.5,
            cut: None,
            particles_only: false,
        }
    }

    /// Carries the sheet and judges every element's path.
    pub fn run(&self) -> Result<Carry, Refused> {
        let mut world = World::new(self.setup())?;
        let mut random = Pcg64::seed_from_u64(self.seed);
        let home = world.positions()[0];
        let (mut place, mut goal) = (home, home);
        let mut paths = vec![Vec::with_capacity(self.steps + 1); answers(&world).len()];
        let mut record = |world: &World| {
            paths.iter_mut().zip(answers(world)).for_each(|(path, answer)| path.push(answer));
        };
        record(&world);
        for k in 0..self.steps {
            let mut commands = Vec::new();
            if k == 0 {
                commands.push(Command::Grab { particle: [0, 0] });
            }
            while (goal - place).norm() < SPEED * STEP {
                // Towards the other corner rather than away: the sheet must stay slack enough to be carried.
                goal = home
                    + Vec3::from_fn(|d, _| {
                        random.random_range(if d == 0 { 0.02..2.0 * REACH } else { -REACH..REACH })
                    });
            }
            place += (goal - place).normalize() * (SPEED * STEP);
            commands.push(Command::Move { position: place });
            world.step(&commands, STEP, Budget::solves(2));
            record(&world);
        }
        Ok(judge_all(&world, &paths))
    }
}

/// Numbers of the elements of tension, bending and shear.
fn counts(world: &World) -> [usize; 3] {
    let elements = &world.model().elements;
    [elements.edges.len(), elements.triples.len(), elements.shears.len()]
}

/// Strain and force of every element now: edges, triples, shear cells.
fn answers(world: &World) -> Vec<[f64; 2]> {
    let (model, state) = (world.model(), world.state());
    let pull = Pull::none(model);
    let potential = Potential { model, state, candidates: &Candidates::new(model), pull: &pull };
    let (fabric, elements, history, x) = (&model.fabric, &model.elements, &state.history, &state.positions);
    let answer = |law: &Law, strain: f64, p: f64| [strain, law.evaluate(strain, p).force];
    let edges = elements.edges.iter().zip(&history.edges);
    let triples = elements.triples.iter().zip(&history.triples);
    let shears = elements.shears.iter().zip(&history.shears);
    edges
        .map(|(e, p)| answer(&fabric.tensile[e.direction], potential.strain(e, x).value, *p))
        .chain(triples.map(|(t, p)| {
            let kappa = potential.bend(t, &triple::Weights::new(t), x).value;
            answer(&fabric.bending[t.direction], kappa, *p)
        }))
        .chain(
            shears.map(|(s, p)| {
                answer(&fabric.shear, potential.angle(s, &shear::Weights::new(s), x).value, *p)
            }),
        )
        .collect()
}

fn judge_all(world: &World, paths: &[Vec<[f64; 2]>]) -> Carry {
    let (fabric, elements) = (&world.model().fabric, &world.model().elements);
    let [edges, triples, _] = counts(world);
    let law = |n: usize| match n {
        n if n < edges => (0, &fabric.tensile[elements.edges[n].direction]),
        n if n < edges + triples => (1, &fabric.bending[elements.triples[n - edges].direction]),
        _ => (2, &fabric.shear),
    };
    let mut carry = Carry { verdicts: Default::default(), paths: Default::default(), elements: paths.len() };
    let mut most = [f64::NEG_INFINITY; 3];
    for (n, path) in paths.iter().enumerate() {
        let (kind, law) = law(n);
        carry.verdicts[kind] = carry.verdicts[kind].worse(judge(law, path));
        // Work put in and not given back: what is stored at the end is small beside what many turns lose.
        let work = instrument::work(path);
        if work > most[kind] {
            most[kind] = work;
            carry.paths[kind].clone_from(path);
        }
    }
    carry
}
