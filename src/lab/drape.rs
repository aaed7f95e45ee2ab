//! Cusick's drape meter: a disc of cloth lies on a smaller round support, its rim hangs down in folds, and a beam of parallel light
//! gives the area of its shadow.
//!
//! The specimen lies between two plates of the support's size, so its particles over the support are simply held: that is the
//! machine's clamp, and needs no friction that nobody measured. The fall is slow: air drag is `chosen` so large that
//! nothing swings, as the machine lowers the cloth by hand and a swing would leave its trace in the hysteresis. Then the
//! support shakes the cloth up and down a few times, as such testers are used: it brings the folds over the friction in the fabric.

use crate::{
    cut::Cut,
    fabric::Fabric,
    grid::Site,
    math::Vec3,
    model::{Refused, Setup},
    world::{Budget, World},
};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::{
    f64::consts::{PI, TAU},
    sync::Arc,
};

/// Solves in a step.
const SOLVES: Budget = Budget::solves(2);
/// Directions in which the shadow is measured.
const DIRECTIONS: usize = 3600;
/// Points of the rim.
const RIM: usize = 2880;
/// Peak acceleration of the support while it shakes [m/s²]: a light shake, 1 cm to both sides at 3 Hz.
const SHAKE: f64 = 3.55;
/// Shakes per second.
const SHAKE_RATE: f64 = 3.0;
/// Gravity [m/s²].
const GRAVITY: f64 = 9.81;
/// Height between a fold's crest and the valleys beside it, over the overhang, from which on it counts.
const FOLD: f64 = 0.05;

/// One test.
#[derive(Clone, Debug)]
pub struct DrapeTest {
    /// The fabric.
    pub fabric: Arc<Fabric>,
    /// Radii of specimen and support [m].
    pub radii: [f64; 2],
    /// Particles along the diameter, warp and weft.
    pub particles: usize,
    /// Which start.
    pub seed: u64,
    /// Largest height of the start's unevenness [m].
    pub unevenness: f64,
    /// Times the support shakes the specimen up and down before its shadow is taken.
    pub shakes: u32,
    /// Air drag per area [kg/(m² s)].
    pub drag: f64,
    /// Length of a step [s].
    pub step: f64,
    /// Steps at the most.
    pub most_steps: usize,
}

impl DrapeTest {
    /// A test with the usual start.
    pub fn new(fabric: Arc<Fabric>, particles: usize, seed: u64) -> DrapeTest {
        let radii = [0.15, 0.09];
        let most_steps = 600;
        DrapeTest {
            fabric,
            radii,
            particles,
            seed,
            unevenness: 1e-3,
            shakes: 3,
            drag: 2.0,
            step: 0.02,
            most_steps,
        }
    }

    /// The specimen, flat but for its unevenness.
    pub fn setup(&self) -> Setup {
        let n = self.particles;
        let [radius, support] = self.radii;
        let spacing = 2.0 * radius / (n - 1) as f64;
        let place = |site: Site| site.map(|k| k as f64 * spacing - radius);
        let cut = Cut { center: [radius; 2], radius };
        let waves = Waves::new(self.seed);
        let sites = (0..n * n).map(|k| [k / n, k % n]);
        let positions = sites.clone().map(|site| {
            let [x, y] = place(site);
            let out = ((x.hypot(y) - support) / (radius - support)).clamp(0.0, 1.0);
            Vec3::new(x, y, self.unevenness * out * out * waves.at(y.atan2(x)))
        });
        let held = |site: &Site| is_held(place(*site), spacing, support);
        Setup {
            fabric: self.fabric.clone(),
            particles: [n, n],
            size: [2.0 * radius; 2],
            positions: positions.collect(),
            pins: sites.filter(held).collect(),
            hand: None,
            obstacles: vec![],
            gravity: GRAVITY,
            drag: self.drag,
            cut: Some(cut),
            particles_only: false,
        }
    }

    /// Lets the specimen fall until it rests, and reads its shadow.
    pub fn run(&self) -> Result<DrapeReading, Refused> {
        let mut world = World::new(self.setup())?;
        self.rest(&mut world);
        if self.shakes > 0 {
            self.shake(&mut world);
            self.rest(&mut world);
        }
        Ok(self.read(&world))
    }

    fn rest(&self, world: &mut World) {
        for _ in 0..self.most_steps {
            if world.step(&[], self.step, SOLVES).resting {
                break;
            }
        }
    }

    /// Shakes the support; seen from it, gravity swings.
    fn shake(&self, world: &mut World) {
        let turn = TAU * SHAKE_RATE * self.step;
        let steps = (f64::from(self.shakes) * TAU / turn).round() as u32;
        for k in 1..=steps {
            world.set_gravity(GRAVITY + SHAKE * (turn * f64::from(k)).sin());
            world.step(&[], self.step, SOLVES);
        }
        world.set_gravity(GRAVITY);
    }

    /// Reads the shadow of a specimen in a world of this test.
    pub fn read(&self, world: &World) -> DrapeReading {
        let [radius, support] = self.radii;
        let shadow = shadow(world, self.radii);
        let area: f64 = shadow.iter().map(|r| 0.5 * r * r * TAU / DIRECTIONS as f64).sum();
        let [held, all] = [support, radius].map(|r| PI * r * r);
        DrapeReading {
            coefficient: (area - held) / (all - held),
            nodes: crests(&shadow, FOLD * (radius - support)),
            resting: world.report().resting,
            steps: world.report().step,
            shadow,
        }
    }
}

/// Whether the support holds the particle at this place [m]. Its rim lies between particles; the nearer one along the line that
/// crosses it most steeply is taken for it, so that the held area is right in the mean.
fn is_held([x, y]: [f64; 2], spacing: f64, support: f64) -> bool {
    let [near, far] = [x.abs().min(y.abs()), x.abs().max(y.abs())];
    near.hypot((far - 0.5 * spacing).max(0.0)) <= support
}

/// What the drape meter says.
#[derive(Clone, Debug)]
pub struct DrapeReading {
    /// Drape coefficient: shadow of the hanging part over that part's area [1].
    pub coefficient: f64,
    /// Number of folds.
    pub nodes: usize,
    /// Radius of the shadow [m] in even directions.
    pub shadow: Vec<f64>,
    /// Whether the cloth came to rest.
    pub resting: bool,
    /// Steps it took.
    pub steps: u64,
}

/// Farthest point of the vertical projection in each direction [m], the support's rim at least.
fn shadow(world: &World, [radius, support]: [f64; 2]) -> Vec<f64> {
    let (grid, x) = (world.grid(), world.positions());
    let mut shadow = vec![support; DIRECTIONS];
    let at = |u: f64, v: f64| {
        let [a, b] = [u, v].map(|s| (s + radius) / grid.spacing(0));
        let [i, j] = [a, b].map(|s| (s.floor().max(0.0) as usize).min(grid.counts[0] - 2));
        let [s, t] = [a - i as f64, b - j as f64];
        let corner = |di: usize, dj: usize| x[grid.index([i + di, j + dj])];
        (corner(0, 0) * (1.0 - s) + corner(1, 0) * s) * (1.0 - t)
            + (corner(0, 1) * (1.0 - s) + corner(1, 1) * s) * t
    };
    let rim = |k: usize| {
        let turn = TAU * k as f64 / RIM as f64;
        at(radius * turn.cos(), radius * turn.sin())
    };
    for k in 0..RIM {
        cast(&mut shadow, rim(k), rim(k + 1));
    }
    // Where a fold leans out over the rim, its crest makes the shadow.
    let inside = |n: u32| {
        let [u, v] = grid.site(n as usize).map(|k| k as f64 * grid.spacing(0) - radius);
        u.hypot(v) <= radius
    };
    for edge in world.model().elements.edges.iter().filter(|e| e.nodes.iter().all(|n| inside(*n))) {
        let [a, b] = edge.nodes.map(|n| x[n as usize]);
        cast(&mut shadow, a, b);
    }
    shadow
}

/// Lengthens the shadow where a segment reaches farther.
fn cast(shadow: &mut [f64], a: Vec3, b: Vec3) {
    let [from, to] = [a, b].map(|p| p.y.atan2(p.x));
    let turn = (to - from + 3.0 * PI).rem_euclid(TAU) - PI;
    let (low, high) = if turn < 0.0 { (from + turn, from) } else { (from, from + turn) };
    let step = TAU / shadow.len() as f64;
    let along = b - a;
    // A direction that two segments share must not fall between them.
    let hair = 1e-9;
    for k in (low / step - hair).ceil() as i64..=(high / step + hair).floor() as i64 {
        let angle = k as f64 * step;
        let (sine, cosine) = angle.sin_cos();
        let across = cosine * along.y - sine * along.x;
        if across != 0.0 {
            let radius = (a.x * along.y - a.y * along.x) / across;
            let place = &mut shadow[k.rem_euclid(DIRECTIONS as i64) as usize];
            *place = place.max(radius);
        }
    }
}

/// Maxima of a closed curve that stand `height` or more over the minima on both sides.
fn crests(curve: &[f64], height: f64) -> usize {
    let lowest = (0..curve.len()).min_by(|a, b| curve[*a].total_cmp(&curve[*b])).unwrap_or(0);
    let (mut low, mut high, mut rising, mut crests) = (f64::INFINITY, f64::NEG_INFINITY, false, 0);
    for k in 0..=curve.len() {
        let value = curve[(lowest + k) % curve.len()];
        (low, high) = (low.min(value), high.max(value));
        if !rising && value > low + height {
            (rising, high) = (true, value);
        } else if rising && value < high - height {
            (rising, low, crests) = (false, value, crests + 1);
        }
    }
    crests
}

/// A smooth periodic unevenness: the first twelve harmonics with random phases and weights, at most 1 high.
struct Waves([[f64; 2]; 12]);

impl Waves {
    fn new(seed: u64) -> Waves {
        let mut random = Pcg64::seed_from_u64(seed);
        let mut waves = [(); 12].map(|()| [random.random_range(0.0..TAU), random.random_range(0.0..1.0)]);
        let sum: f64 = waves.iter().map(|w| w[1]).sum();
        waves.iter_mut().for_each(|w| w[1] /= sum);
        Waves(waves)
    }

    fn at(&self, angle: f64) -> f64 {
        (1..).zip(&self.0).map(|(k, [phase, weight])| weight * (f64::from(k) * angle + phase).cos()).sum()
    }
}
