//! A specimen between the clamps of a KES machine: FB1 pulls and shears it, FB2 bends it.
//!
//! Clamps are pinned particles that move along the machine's path at the machine's rate; the force is the reaction of those that
//! move. Not here: what is read from a loop (`fabric::instrument`), weight, which the machines do not see (FB1 lies flat under
//! tension, the axis of FB2 is upright), and viscosity, which KES does not measure [Kawabata 1980].

use crate::{
    fabric::{Fabric, instrument, law::Law, measured::Test},
    grid::{Direction, Site},
    math::Vec3,
    model::{Refused, Setup},
    world::{Budget, Command, Outcome, World},
};
use std::sync::Arc;

/// Width of every specimen [m].
pub const WIDTH: f64 = 0.2;
/// Length between the clamps of FB1 [m].
pub const GAUGE: f64 = 0.05;
/// Length between the clamps of FB2 [m].
pub const BENDING_GAUGE: f64 = 0.01;
/// Tension under which FB1 shears [N/m]: 10 gf/cm.
pub const PRETENSION: f64 = 9.80665;
/// Speeds of the moving clamp: tension 0.2 mm/s, shear 0.417 mm/s along a gauge of 5 cm, bending 0.5 1/cm per second; as
/// strain [1/s], angle [rad/s] and curvature [1/(m s)].
const RATES: [f64; 3] = [4e-3, 8.34e-3, 50.0];
/// Solves of one sample at the most.
const SOLVES: u32 = 20;
/// Residual over the largest load so far that still is balance. Slack specimens do not come nearer: their tension vanishes, and with it
/// what would hold the particles.
const BALANCE: f64 = 1e-3;
/// Bending rigidity [N·m] of FB1 specimens that are kept flat. Thin ones wrinkle at the free sides, where shear unloads half the lines
/// between the clamps; the parameters describe plane cloth, and in the plane bending has no part.
const FLAT: f64 = 1e-2;

/// A specimen in its machine.
pub struct Specimen {
    test: Test,
    direction: Direction,
    world: World,
    start: Vec<Vec3>,
    moving: Vec<Site>,
    /// Particles across the specimen, and between the clamps less one.
    across: usize,
    intervals: usize,
    /// Tensile strain under the pretension of shear [1].
    stretch: f64,
    strain: f64,
    /// Largest load on the moving clamp so far [N].
    largest: f64,
    troubled: bool,
}

impl Specimen {
    /// A virgin specimen cut along a direction, with so many intervals of particles between the clamps; `flat` keeps FB1's from
    /// wrinkling.
    pub fn new(
        fabric: &Fabric,
        test: Test,
        direction: Direction,
        intervals: usize,
        flat: bool,
    ) -> Result<Specimen, Refused> {
        if !(2..=100).contains(&intervals) {
            return Err(Refused(format!("intervals: got {intervals}, allowed: 2 to 100")));
        }
        // Light fabrics' 2HG needs a finer one: with eight intervals it reads 1.2 % high.
        let intervals = if test == Test::Shear { 3 * intervals / 2 } else { intervals };
        // The middle fifth of the clamp must be whole intervals for shear. The other tests are the same everywhere across.
        let across = if test == Test::Shear { 10 * intervals.div_ceil(5) + 1 } else { 5 };
        // A clamp of the bending test is two rows: the edge between them cannot turn.
        let grip = usize::from(test == Test::Bending);
        let gauge = if test == Test::Bending { BENDING_GAUGE } else { GAUGE };
        let spacing = gauge / intervals as f64;
        let rows = intervals + 1 + 2 * grip;
        let turned = |[along, over]: [usize; 2]| if direction == 0 { [along, over] } else { [over, along] };
        let particles = turned([rows, across]);
        let length = spacing * (rows - 1) as f64;
        let size = if direction == 0 { [length, WIDTH] } else { [WIDTH, length] };
        // The tested direction lies along x; the other so that warp × weft points up in both cases.
        let sign = if direction == 0 { 1.0 } else { -1.0 };
        let position = |n: usize| {
            let [along, over] = turned([n / particles[1], n % particles[1]]);
            let y = over as f64 / (across - 1) as f64 * WIDTH;
            Vec3::new((along as f64 - grip as f64) * spacing, sign * y, 0.0)
        };
        let row = |along: usize| (0..across).map(move |over| turned([along, over]));
        let [low, high] = [0..=grip, rows - 1 - grip..=rows - 1];
        let mut held = fabric.clone();
        if test != Test::Bending && flat {
            held.bending = [(); 2].map(|()| Law::linear(FLAT));
        }
        let setup = Setup {
            fabric: Arc::new(held),
            particles,
            size,
            positions: (0..rows * across).map(position).collect(),
            pins: low.chain(high.clone()).flat_map(row).collect(),
            hand: None,
            obstacles: vec![],
            gravity: 0.0,
            drag: 0.0,
            cut: None,
            particles_only: false,
        };
        Ok(Specimen {
            test,
            direction,
            start: setup.positions.clone(),
            world: World::new(setup)?,
            moving: high.flat_map(row).collect(),
            across,
            intervals,
            stretch: fabric.tensile[direction].strains(PRETENSION)[0],
            strain: 0.0,
            largest: 0.0,
            troubled: false,
        })
    }

    /// The law that the machine measures.
    pub fn law(&self) -> &Law {
        let fabric = &self.world.model().fabric;
        match self.test {
            Test::Tensile => &fabric.tensile[self.direction],
            Test::Bending => &fabric.bending[self.direction],
            Test::Shear => &fabric.shear,
        }
    }

    /// The machine.
    pub fn test(&self) -> Test {
        self.test
    }

    /// True when a sample was not in balance.
    pub fn is_troubled(&self) -> bool {
        self.troubled
    }

    /// Moves the clamp to a strain [1], shear angle [rad] or curvature [1/m] at the machine's rate; the force it meets there: tension or
    /// shear force per width [N/m], bending moment per width [N].
    pub fn drive(&mut self, strain: f64) -> f64 {
        let rate = RATES[match self.test {
            Test::Tensile => 0,
            Test::Shear => 1,
            Test::Bending => 2,
        }];
        let place = |site: &Site| Command::Drive { particle: *site, position: self.place(*site, strain) };
        let commands: Vec<Command> = self.moving.iter().map(place).collect();
        let dt = ((strain - self.strain).abs() / rate).max(1e-3);
        self.strain = strain;
        let report = self.world.step(&commands, dt, Budget::solves(SOLVES));
        let (outcome, residual) = (report.outcome, report.residual);
        let load: f64 = self.moving.iter().filter_map(|s| self.world.reaction(*s)).map(|f| f.norm()).sum();
        self.largest = self.largest.max(load);
        self.troubled |= outcome == Outcome::NotFinite || residual > BALANCE * self.largest;
        self.force()
    }

    /// Where the machine has a particle of the moving clamp [m].
    fn place(&self, site: Site, strain: f64) -> Vec3 {
        let rest = self.start[self.world.grid().index(site)];
        match self.test {
            Test::Tensile => rest + Vec3::x() * (strain * GAUGE),
            Test::Shear => {
                // The circle on which the tension stays what it is.
                let length = GAUGE * (1.0 + self.stretch);
                rest + Vec3::new(length * strain.cos() - GAUGE, length * strain.sin(), 0.0)
            }
            Test::Bending => {
                let turn = strain * BENDING_GAUGE;
                let beyond = rest.x - BENDING_GAUGE;
                let end = arc(turn, BENDING_GAUGE, self.intervals);
                end + Vec3::new(turn.cos() * beyond, rest.y, turn.sin() * beyond)
            }
        }
    }

    fn reaction(&self, sites: &[Site]) -> Vec3 {
        sites.iter().filter_map(|s| self.world.reaction(*s)).sum()
    }

    /// What the machine's gauge shows.
    fn force(&self) -> f64 {
        match self.test {
            Test::Tensile => -self.reaction(&self.moving).x / WIDTH,
            Test::Shear => {
                // The free sides bear no shear, and their slackness reaches as far as shear force over pretension times half the
                // gauge: the middle fifth is beyond it.
                self.sideways(2 * (self.across - 1) / 5)
            }
            Test::Bending => {
                let grid = self.world.grid();
                let at = |site: Site| self.world.positions()[grid.index(site)];
                let pivot = arc(self.strain * BENDING_GAUGE, BENDING_GAUGE, self.intervals);
                let arm = |site: &Site| at(*site) - pivot;
                let moment: Vec3 =
                    self.moving.iter().filter_map(|s| Some(arm(s).cross(&self.world.reaction(*s)?))).sum();
                moment.y / WIDTH
            }
        }
    }

    /// Shear force per width [N/m] on the clamp without `margin` intervals at each side: the part across the lines between the clamps,
    /// in which their tension has no part.
    fn sideways(&self, margin: usize) -> f64 {
        let across = Vec3::new(-self.strain.sin(), self.strain.cos(), 0.0);
        let middle = &self.moving[margin..self.across - margin];
        let mut force = self.reaction(middle);
        if margin > 0 {
            force -= self.reaction(&[middle[0], middle[middle.len() - 1]]) * 0.5;
        }
        let width = WIDTH * (middle.len() - 1) as f64 / (self.across - 1) as f64;
        -force.dot(&across) * (1.0 + self.stretch) / width
    }

    /// The same over the whole clamp: smaller, as the free sides bear nothing.
    pub fn whole_clamp(&self) -> f64 {
        self.sideways(0)
    }
}

/// End of an arc in the plane of x and z that leaves along x and turns by `turn` over `length`: the polygon of as many equal sides
/// as the specimen has, so that bending alone does not compress it.
fn arc(turn: f64, length: f64, sides: usize) -> Vec3 {
    let [corner, side] = [turn, length].map(|v| v / sides as f64);
    (0..sides)
        .map(|k| {
            let heading = corner * (k as f64 + 0.5);
            Vec3::new(heading.cos(), 0.0, heading.sin()) * side
        })
        .sum()
}

/// Turns of the machine's path, in strain; none for tension, whose turn is a load.
pub fn turns(test: Test) -> &'static [f64] {
    match test {
        Test::Tensile => &[],
        Test::Bending => &[instrument::BENDING_RANGE, -instrument::BENDING_RANGE, 0.0],
        Test::Shear => &[instrument::SHEAR_RANGE, -instrument::SHEAR_RANGE, 0.0],
    }
}
