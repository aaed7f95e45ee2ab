//! Numerical stress: random scenes under random abuse, judged after every step, and brought to rest when the abuse stops.
//!
//! Everything comes from a case, which is one line of text; the same line gives the same result. Nothing here prints or reads a clock.

/// An enum whose variants have names for people and for the lines of cases.
macro_rules! named {
    ($(#[$about:meta])* $of:ident { $($(#[$doc:meta])* $variant:ident = $name:literal,)* }) => {
        $(#[$about])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum $of {
            $($(#[$doc])* $variant,)*
        }

        impl $of {
            /// All of them.
            pub const ALL: &[$of] = &[$($of::$variant),*];

            /// Its name.
            pub fn name(self) -> &'static str {
                match self {
                    $($of::$variant => $name,)*
                }
            }
        }
    };
}

pub mod case;
pub mod scene;
pub mod abuse;
pub mod judge;
pub mod reduce;
pub mod soak;

use crate::{
    adapt::Settings,
    grid::Site,
    math::Vec3,
    world::{Budget, Command, Outcome, Refused, World},
};
use abuse::{Act, Wish};
pub use case::Case;
use judge::Rest;
pub use judge::{Invariant, Judge, Tally, Violation};
pub use reduce::reduce;
use std::collections::BTreeMap;

/// What came of a case.
#[derive(Clone, Debug, Default)]
pub struct Findings {
    /// What was tried: pairs of a group and a name in it, with how often.
    pub tried: BTreeMap<(&'static str, String), u64>,
    /// How each invariant fared.
    pub tallies: BTreeMap<Invariant, Tally>,
    /// The first violation.
    pub violation: Option<Violation>,
    /// Steps.
    pub steps: u64,
    /// Linear solves.
    pub solves: u64,
    /// Simulated time [s].
    pub simulated: f64,
    /// Steps that were rolled back because a number was not finite, and that stalled.
    pub trouble: [u64; 2],
    /// Changes of the mesh.
    pub remeshed: u64,
}

impl Findings {
    fn tried(&mut self, group: &'static str, name: impl Into<String>) {
        *self.tried.entry((group, name.into())).or_default() += 1;
    }

    /// Adds another case's.
    pub fn add(&mut self, other: &Findings) {
        for (key, count) in &other.tried {
            *self.tried.entry(key.clone()).or_default() += count;
        }
        for (invariant, tally) in &other.tallies {
            let sum = self.tallies.entry(*invariant).or_default();
            sum.checks += tally.checks;
            sum.violations += tally.violations;
            sum.worst = sum.worst.max(tally.worst);
        }
        self.steps += other.steps;
        self.solves += other.solves;
        self.simulated += other.simulated;
        self.remeshed += other.remeshed;
        (0..2).for_each(|k| self.trouble[k] += other.trouble[k]);
    }
}

/// Steps between looks at an adaptive mesh.
const LOOK: usize = 5;
/// Length [s] and solves of a step when the abuse has stopped.
const CALM: (f64, u32) = (0.02, 4);
/// Particles up to which rest is waited for, and particles times steps that it may take.
const MOST_RESTING: usize = 150;
const REST_WORK: usize = 40_000;
const REST_STEPS: [usize; 2] = [500, 1200];
/// Speed [m/s] of a cloth that stands still for so many steps, none stalled, where `World` does not let it rest: on a plane without
/// friction, or about a single pin, no place is better than another.
const STILL: f64 = 1e-9;
const STILL_STEPS: usize = 50;
/// Speed [m/s] of what creeps: a tenth of a millimetre in the time of a case.
const CREEP: f64 = 1e-5;
/// Steps of two twins that are compared bit by bit.
const REPEATED: usize = 12;
/// Rest energies differ by so much of the energy scale at the most, on the same branch.
const REST_ENERGY: f64 = 1e-6;

/// Runs a case to its end or to its first violation; a panic is one.
pub fn run(case: &Case) -> Findings {
    let result = std::panic::catch_unwind(|| run_through(case));
    result.unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<String>().cloned();
        let text = text.or_else(|| panic.downcast_ref::<&str>().map(|s| (*s).to_owned()));
        let note = text.unwrap_or_default();
        let mut findings = Findings::default();
        let violation =
            Violation { invariant: Invariant::Panic, ratio: f64::INFINITY, step: 0, act: 0, note };
        findings.tallies.insert(Invariant::Panic, Tally { checks: 1, violations: 1, worst: f64::INFINITY });
        findings.violation = Some(violation);
        findings
    })
}

fn run_through(case: &Case) -> Findings {
    let mut findings = Findings::default();
    let mut judge = Judge::new(case.seed);
    judge.record(Invariant::Panic, 0.0, &String::new);
    match scene::build(case) {
        Ok(scene) => {
            describe(case, &scene, &mut findings);
            let pins = scene.world.setup().pins.clone();
            let mut run = Run { case, world: scene.world, judge, findings, adaptive: false, pins };
            run.set_adaptive(case.adaptive);
            run.judge.meet(&run.world);
            run.judge.state(&judge::Look::at(&run.world));
            run.abuse();
            run.come_to_rest(scene.floor);
            (findings, judge) = (run.findings, run.judge);
        }
        // No scene is drawn that a world refuses in the end.
        Err(Refused(why)) => judge.record(Invariant::Panic, f64::INFINITY, &|| format!("no world: {why}")),
    }
    findings.tallies = judge.tallies;
    findings.violation = judge.first;
    findings.steps = judge.steps;
    findings.trouble = judge.trouble;
    findings
}

fn describe(case: &Case, scene: &scene::Scene, findings: &mut Findings) {
    let setup = scene.world.setup();
    findings.tried("mesh", case.class());
    findings.tried("fabric", &case.fabric);
    findings.tried("solver", case.solver.name());
    let adapts = match (case.adaptive, case.as_sessions) {
        (false, _) => "no",
        (true, true) => "as in sessions",
        (true, false) => "to the fewest particles",
    };
    findings.tried("mesh adapts", adapts);
    findings.tried("tick [s]", case.tick.to_string());
    findings.tried("solves", case.solves.to_string());
    findings.tried("gravity [m/s²]", setup.gravity.to_string());
    findings.tried("obstacles", scene.obstacles.len().to_string());
    scene.obstacles.iter().for_each(|kind| findings.tried("obstacle", *kind));
    let decade = |v: f64| format!("1e{}", v.log10().floor());
    findings.tried("density [kg/m²] from", decade(setup.fabric.areal_density));
    let side = setup.size[0].max(setup.size[1]);
    let law = &setup.fabric.tensile[0];
    let tension = 100.0 * 0.5 * (law.loading(0.01) + law.unloading(0.01));
    let ratio = tension * side * side / setup.fabric.rigidity(0);
    findings.tried("tension side² over bending from", decade(ratio));
    if setup.cut.is_some() {
        findings.tried("sheet", "cut to a disc");
    }
}

/// A case that runs.
struct Run<'a> {
    case: &'a Case,
    world: World,
    judge: Judge,
    findings: Findings,
    adaptive: bool,
    /// Pins of the scene.
    pins: Vec<Site>,
}

impl Run<'_> {
    fn set_adaptive(&mut self, on: bool) {
        self.adaptive = on;
        let in_sessions = Settings::of(self.case.solver);
        let settings = if self.case.as_sessions { in_sessions } else { Settings::default() };
        self.world.set_adaptive(on.then_some(settings));
    }

    fn is_over(&self) -> bool {
        self.judge.first.is_some()
    }

    fn abuse(&mut self) {
        for (number, &(place, kind)) in self.case.acts.iter().enumerate() {
            self.findings.tried("manipulation", kind.name());
            self.judge.act = number;
            let mut act = Act::new(self.case, place, kind, &self.world);
            for tick in 0..self.case.ticks {
                let wish = act.wish(&self.world, tick, self.case.ticks);
                if kind == abuse::Kind::Nonsense {
                    self.refuse(&wish.commands);
                }
                self.prepare(&wish);
                let Wish { commands, world, .. } = wish;
                if let Some(world) = world {
                    self.findings.tried("in flight", "another fabric or obstacle");
                    self.world = *world;
                    self.judge.meet(&self.world);
                    self.set_adaptive(self.adaptive);
                }
                self.step(&commands, self.case.tick, self.case.solves);
                if self.adaptive && tick.is_multiple_of(LOOK) {
                    self.adapt();
                }
                if self.is_over() {
                    return;
                }
            }
        }
    }

    fn prepare(&mut self, wish: &Wish) {
        if let Some(snapshot) = &wish.rewind {
            self.findings.tried("in flight", "back to a snapshot");
            self.world.restore(snapshot);
            self.judge.meet(&self.world);
            // The snapshot has the mesh's settings of its time.
            self.set_adaptive(self.adaptive);
        }
        if let Some(on) = wish.adaptive {
            self.set_adaptive(on);
        }
    }

    fn refuse(&mut self, commands: &[Command]) {
        let taken = commands.iter().find(|c| self.world.check(c).is_ok());
        let ratio = if taken.is_some() { f64::INFINITY } else { 0.0 };
        self.judge.record(Invariant::Refusal, ratio, &|| format!("{taken:?} was taken"));
    }

    fn step(&mut self, commands: &[Command], tick: f64, solves: u32) {
        let before = self.judge.before(&self.world);
        let time = self.world.report().time;
        let moves = commands.iter().filter(|c| matches!(c, Command::Move { .. })).count();
        let grid = self.world.grid();
        let grabbed = commands.iter().filter_map(|c| match c {
            Command::Grab { particle } => grid.contains(*particle).then(|| grid.index(*particle)),
            _ => None,
        });
        let grabbed: Vec<usize> = grabbed.collect();
        self.world.step(commands, tick, Budget::solves(solves));
        let report = self.world.report();
        self.findings.solves += u64::from(report.solves);
        self.findings.simulated += report.time - time;
        self.judge.after(&self.world, &before, moves, &grabbed);
    }

    /// Looks at the mesh; a change must keep mass and momentum.
    fn adapt(&mut self) {
        let momentum = |world: &World| -> Vec3 {
            let moving = world.grid().active().map(|n| (n, world.state().velocities[n]));
            moving.map(|(n, v)| v * world.model().mass(n)).sum()
        };
        let (before, speed) = (momentum(&self.world), self.speed());
        let resting = self.world.report().resting;
        if !self.world.adapt() {
            return;
        }
        self.findings.remeshed += 1;
        let off = (momentum(&self.world) - before).norm();
        let mass = self.world.model().fabric.areal_density * self.world.model().area;
        let allowed = 1e-10 * mass * speed + f64::MIN_POSITIVE;
        self.judge.record(Invariant::Transfer, off / allowed, &|| {
            format!("{off:e} kg m/s are lost, resting {resting}")
        });
        self.judge.state(&judge::Look::at(&self.world));
    }

    fn speed(&self) -> f64 {
        self.world.state().velocities.iter().map(|v| v.norm()).fold(0.0, f64::max)
    }

    /// The abuse stops: it must come to rest, and so must a twin, at the same energy where it is the same branch.
    fn come_to_rest(&mut self, floor: bool) {
        let particles = self.case.mesh[0] * self.case.mesh[1];
        if self.is_over() || particles > MOST_RESTING {
            return;
        }
        self.judge.act = self.case.acts.len();
        // What the abuse pinned is let go; the scene's own pins hold, and a hand where nothing else does.
        let mut commands = vec![Command::Release { let_go: false }];
        let fixed = abuse::fixed(&self.world);
        let (own, added): (Vec<Site>, Vec<Site>) =
            fixed.into_iter().partition(|site| self.pins.contains(site));
        for particle in added {
            commands.extend([Command::Grab { particle }, Command::Release { let_go: true }]);
        }
        if own.is_empty() && !floor {
            commands.push(Command::Grab { particle: self.any() });
        }
        self.step(&commands, CALM.0, CALM.1);
        let start = self.world.snapshot();
        let most = (REST_WORK / particles).clamp(REST_STEPS[0], REST_STEPS[1]);
        if self.is_over() || !self.wait(most) {
            return;
        }
        let (rest, scale) = (Rest::of(&self.world), self.energy_scale());
        if self.world.report().resting && !self.rests_again(rest.energy, scale, most) {
            return;
        }
        let elastic = self.is_elastic();
        let mut first = Vec::new();
        for repeated in [false, true] {
            self.world.restore(&start);
            self.judge.meet(&self.world);
            for tick in 0..REPEATED {
                self.step(&[], CALM.0, CALM.1);
                let sum = self.world.checksum();
                if repeated {
                    let differs = first[tick] != sum;
                    self.judge.record(Invariant::Repeat, if differs { 2.0 } else { 0.0 }, &|| {
                        format!("step {tick} after the snapshot ends otherwise")
                    });
                } else {
                    first.push(sum);
                }
            }
        }
        // Hysteresis and friction remember the way; only what forgets it must come back.
        if self.is_over() || !elastic || !self.wait(2 * most) {
            return;
        }
        let twin = Rest::of(&self.world);
        let look = judge::Look::at(&self.world);
        let candidates = look.candidates();
        let same = rest.is_same(&twin, |x| look.potential(&candidates, x));
        let found = match (same, rest.shares_mesh(&twin)) {
            (true, _) => "on the same branch",
            (false, true) => "on another branch",
            (false, false) => "on another mesh",
        };
        self.findings.tried("elastic twin", found);
        if same {
            let held_apart = rest.held_apart(&twin, |x| look.potential(&candidates, x));
            let off = ((twin.energy - rest.energy).abs() - held_apart) / scale;
            self.judge.record(Invariant::Twin, off / REST_ENERGY, &|| {
                let apart = rest.apart(&twin);
                format!(
                    "energies differ by {off:e} of {scale:e} J beyond what holds them, places by {apart:e} m"
                )
            });
        }
    }

    /// Wakes the cloth, gives it as many steps to come to rest again as it had before, and compares: whatever its history, nothing may have
    /// crept.
    fn rests_again(&mut self, energy: f64, scale: f64, most: usize) -> bool {
        self.world.set_gravity(self.world.model().gravity);
        let mut waited = 0;
        while waited < most && (waited == 0 || !self.world.report().resting) {
            self.step(&[], CALM.0, CALM.1);
            waited += 1;
        }
        let (report, speed) = (self.world.report(), self.speed());
        // On a plane without friction, or about a single pin, rounding decides whether rest is stable; and what creeps will rest.
        let off = if report.resting || speed < CREEP {
            (report.energy - energy).abs() / scale
        } else {
            f64::INFINITY
        };
        let note = format!("energies differ by {off:e} of {scale:e} J at {speed:e} m/s after {waited} steps");
        self.judge.record(Invariant::Wake, off / REST_ENERGY, &|| note.clone());
        !self.is_over()
    }

    /// Whether rest depends on what is held alone: no hysteresis, no friction.
    fn is_elastic(&self) -> bool {
        judge::Look::at(&self.world).is_elastic()
    }

    /// Weight times side, and the energy itself.
    fn energy_scale(&self) -> f64 {
        let size = self.world.grid().size;
        self.world.model().weight_on_earth() * size[0].max(size[1]) + self.world.report().energy.abs()
    }

    /// A corner that is there.
    fn any(&self) -> Site {
        let grid = self.world.grid();
        let first = grid.active().next().unwrap_or(0);
        grid.site(first)
    }

    /// Steps until rest; false where it does not come. That violates `Rest` where no energy was lost any more though all obstacles stood, and
    /// more than creeps. Where rounding alone may change energy by more than it did, it is enough that the cloth slows down.
    fn wait(&mut self, most: usize) -> bool {
        let (mut waited, mut still, mut pushed) = (0, 0, false);
        let (mut middle, mut fast) = (f64::INFINITY, f64::INFINITY);
        while !self.world.report().resting && waited < most && still < STILL_STEPS {
            self.step(&[], CALM.0, CALM.1);
            if self.adaptive && waited.is_multiple_of(LOOK) {
                self.adapt();
            }
            if self.is_over() {
                return false;
            }
            let outcome = self.world.report().outcome;
            let stands = self.speed() < STILL && matches!(outcome, Outcome::Converged | Outcome::Budget);
            still = if stands { still + 1 } else { 0 };
            waited += 1;
            if waited == most / 2 {
                (middle, fast) = (judge::Look::at(&self.world).under_loads(), self.speed());
            }
            pushed |= waited >= most / 2 && self.world.state().motions.iter().any(Option::is_some);
        }
        let rests = self.world.report().resting || still == STILL_STEPS;
        self.findings.tried(
            "after abuse",
            if self.world.report().resting {
                "rests"
            } else if rests {
                "stands still, no stable rest"
            } else {
                "moves on"
            },
        );
        let look = judge::Look::at(&self.world);
        let lost = middle - look.under_loads();
        let is_noise = lost.abs() <= (most / 2) as f64 * judge::rounding_of_energy(&look);
        let slows = is_noise && self.speed() < fast;
        let creeps = self.speed() < CREEP && lost.abs() <= REST_ENERGY * self.energy_scale();
        // What an obstacle moved since the middle may have gained energy.
        let stuck = !rests && lost <= 0.0 && !slows && !creeps && !pushed;
        let ratio = if stuck { f64::INFINITY } else { waited as f64 / most as f64 };
        let (report, speed) = (self.world.report().clone(), self.speed());
        self.judge.record(Invariant::Rest, ratio, &|| {
            format!(
                "no rest after {most} steps: {:?}, residual {:e} N, speed {speed:e} m/s, {} pairs touch, {} slide",
                report.outcome, report.residual, report.contact.pairs, report.contact.sliding
            )
        });
        rests
    }
}
