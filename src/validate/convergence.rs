//! Error of force and shape over meshes: the same cloth on coarse meshes and on a fine one, which is the reference.
//!
//! Strips and sheets whose answer is smooth lie on one branch whatever the mesh; a sheet with folds may fall into others on the
//! way, which is marked. Air is thick here, so that cloth creeps to rest: hysteresis then remembers nearly the same way on every mesh.

use super::{Context, Findings, Plot, Row, Series, strip};
use crate::{
    compare::without_hysteresis,
    fabric::{self, Fabric},
    grid::Site,
    math::Vec3,
    model::{self, Setup},
    scene::Scene,
    world::{Budget, Command, Refused, World},
};
use std::sync::Arc;

/// Which cloth is meshed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Cloth {
    /// A strip clamped level at one end, the other end held nearer and lower; the force is the one there.
    Strip,
    /// The scene `hang`.
    Hang,
    /// The scene `flag`.
    Flag,
    /// The scene `drape`, which has folds.
    Drape,
}

/// Error of force and shape against mesh density, and the rule for choosing a mesh.
#[derive(Clone, Debug, clap::Args)]
pub struct Convergence {
    /// Cloths.
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["strip", "hang"])]
    pub scene: Vec<Cloth>,
    /// Fabrics, as in `kesi fabric list`.
    #[arg(long, value_delimiter = ',', default_values_t = Convergence::default().fabric)]
    pub fabric: Vec<String>,
    /// Particles from end to end.
    #[arg(long, value_delimiter = ',', default_values_t = Convergence::default().meshes)]
    pub meshes: Vec<usize>,
    /// Particles from end to end of the reference; none: twice the intervals of the finest mesh, four times those of a strip.
    #[arg(long)]
    pub reference: Option<usize>,
    /// Free length of the strip [m].
    #[arg(long, default_value_t = Convergence::default().length)]
    pub length: f64,
    /// Where the held end of the strip goes, over its length: along and down.
    #[arg(long, num_args = 2, default_values_t = Convergence::default().end)]
    pub end: Vec<f64>,
    /// Leaves out the fabrics' hysteresis: rest then depends on the mesh alone, not on the way there.
    #[arg(long)]
    pub elastic: bool,
}

impl Default for Convergence {
    fn default() -> Convergence {
        Convergence {
            scene: vec![Cloth::Strip, Cloth::Hang],
            fabric: ["denim-c", "denim-a", "polyester-faille"].map(String::from).to_vec(),
            meshes: vec![10, 20, 39],
            reference: None,
            length: 0.2,
            end: vec![0.6, 0.3],
            elastic: false,
        }
    }
}

/// Air drag in which cloth creeps to rest [kg/(m² s)].
const THICK: f64 = 10.0;
/// Length of steps and of those with contact [s].
const STEP: [f64; 2] = [0.05, 0.02];
/// Width of the strip [m].
const WIDTH: f64 = 0.02;
/// Steps of the way there.
const WAY: usize = 40;
/// A particle off by this part of the sheet's shorter side lies in another fold.
const OTHER_FOLD: f64 = 0.05;

/// A cloth at rest: what a mesh made of it.
struct Rest {
    /// Particles of the free part, and where they are [m].
    counts: [usize; 2],
    shape: Vec<Vec3>,
    /// Force on what holds the cloth [N].
    force: Vec3,
    /// Distance of particles over the bending length.
    coarseness: f64,
    /// Size of the free part [m].
    side: f64,
}

impl Cloth {
    fn name(self) -> &'static str {
        match self {
            Cloth::Strip => "strip",
            Cloth::Hang => "hang",
            Cloth::Flag => "flag",
            Cloth::Drape => "drape",
        }
    }
}

/// A built-in scene of square sheets.
fn scene(name: &str, fabric: &Arc<Fabric>, particles: usize, dt: f64) -> Result<Rest, Refused> {
    let scene = Scene::named(name).map_err(Refused)?;
    let longer = scene.size_m[0].max(scene.size_m[1]);
    let intervals = scene.size_m.map(|l| (l / longer * (particles - 1) as f64).round() as usize);
    let scene = Scene { particles: intervals.map(|n| n + 1), drag_kg_per_m2_s: THICK, ..scene };
    let faults = |f: Vec<_>| Refused(fabric::document::Faults(f).to_string());
    let mut world = World::new(Setup { fabric: fabric.clone(), ..scene.setup().map_err(faults)? })?;
    strip::settle(&mut world, dt, 4000)?;
    let force = world.report().hand.map_or(Vec3::zeros(), |h| h.force);
    Ok(Rest {
        counts: world.grid().counts,
        shape: world.positions().to_vec(),
        force,
        coarseness: coarseness(&world, 2),
        side: world.grid().size[0].min(world.grid().size[1]),
    })
}

fn coarseness(world: &World, directions: usize) -> f64 {
    let of = |k: usize| world.grid().spacing(k) / world.model().bending_length(k);
    (0..directions).map(of).fold(0.0, f64::max)
}

impl Rest {
    /// Particles from end to end.
    fn longer(&self) -> usize {
        self.counts[0].max(self.counts[1])
    }

    /// Place of the material point at parts of the free size [m], by cubics through the particles.
    fn at(&self, part: [f64; 2]) -> Vec3 {
        let [(first, along), (beside, across)] = [0, 1].map(|k| lagrange(part[k], self.counts[k]));
        let mut sum = Vec3::zeros();
        for (i, a) in along.iter().enumerate() {
            for (j, b) in across.iter().enumerate() {
                sum += self.shape[(first + i) * self.counts[1] + beside + j] * (a * b);
            }
        }
        sum
    }

    /// Material coordinates of the particles as parts of the size.
    fn parts(&self) -> impl Iterator<Item = [f64; 2]> + '_ {
        let [i, j] = self.counts;
        (0..i * j).map(move |n| [(n / j) as f64 / (i - 1) as f64, (n % j) as f64 / (j - 1) as f64])
    }
}

/// Weights of up to four neighbours of a line for the polynomial through them at a part of its length, and which is the first.
fn lagrange(part: f64, count: usize) -> (usize, Vec<f64>) {
    let place = part * (count - 1) as f64;
    let nodes = count.min(4);
    let first = (place.floor() as usize).saturating_sub(1).min(count - nodes);
    let weight = |n: usize| {
        let others = (0..nodes).filter(|m| *m != n);
        others.map(|m| (place - (first + m) as f64) / (n as f64 - m as f64)).product()
    };
    (first, (0..nodes).map(weight).collect())
}

/// What meshes tend to: a fine mesh or, where one of half its density is at hand, the limit of both for errors of second order.
struct Limit<'a> {
    fine: &'a Rest,
    half: Option<&'a Rest>,
}

impl Limit<'_> {
    fn of(&self, field: impl Fn(&Rest) -> Vec3) -> Vec3 {
        let fine = field(self.fine);
        self.half.map_or(fine, |half| fine + (fine - field(half)) / 3.0)
    }
}

/// Errors of a mesh, relative: of the force, and of the shape over the side, root of the mean square and largest.
struct Errors {
    coarseness: f64,
    intervals: f64,
    force: f64,
    rms: f64,
    max: f64,
}

impl Errors {
    fn of(rest: &Rest, limit: &Limit) -> Errors {
        let force = limit.of(|r| r.force);
        let off: Vec<f64> = rest
            .parts()
            .zip(&rest.shape)
            .map(|(part, p)| (p - limit.of(|r| r.at(part))).norm() / rest.side)
            .collect();
        Errors {
            coarseness: rest.coarseness,
            intervals: (rest.longer() - 1) as f64,
            force: (rest.force - force).norm() / force.norm(),
            rms: (off.iter().map(|d| d * d).sum::<f64>() / off.len() as f64).sqrt(),
            max: off.iter().copied().fold(0.0, f64::max),
        }
    }
}

impl Convergence {
    /// The suite's checks: strips of two lengths, and coarse sheets beside references that take seconds.
    pub fn suite(quick: bool) -> Vec<Convergence> {
        let full = Convergence::default();
        let one = vec!["denim-a".to_owned()];
        let strip = Convergence { scene: vec![Cloth::Strip], meshes: vec![10, 20, 39, 77], ..full.clone() };
        if quick {
            return vec![Convergence { fabric: one, ..strip }];
        }
        let short = Convergence { length: 0.1, fabric: fabric::list(), ..strip.clone() };
        let hang = Convergence { scene: vec![Cloth::Hang], fabric: one.clone(), ..full.clone() };
        let drape = Convergence { scene: vec![Cloth::Drape], fabric: one, meshes: vec![10, 20], ..full };
        vec![strip, short, hang, drape]
    }

    /// Runs the check.
    pub fn run(&self, context: &Context) -> Result<Findings, Refused> {
        let most = self.meshes.iter().copied().max().unwrap_or(0);
        strip::allow("meshes: how many", self.meshes.len() as f64, [2.0, 20.0])?;
        for &n in self.meshes.iter().chain(&self.reference) {
            strip::allow("meshes, reference", n as f64, [5.0, 400.0])?;
        }
        strip::allow("length", self.length, [0.02, 2.0])?;
        strip::allow("end: straight distance", self.end[0].hypot(self.end[1]), [0.05, 0.98])?;
        let mut findings = Findings::default();
        let mut plots = plots();
        let runs = (self.scene.len() * self.fabric.len()) as f64;
        for (c, &cloth) in self.scene.iter().enumerate() {
            for (f, name) in self.fabric.iter().enumerate() {
                let mut fabric = fabric::load(name).map_err(|e| Refused(e.to_string()))?;
                if self.elastic {
                    fabric = without_hysteresis(&fabric).map_err(|e| Refused(e.to_string()))?;
                }
                let fabric = Arc::new(fabric);
                let finer = if cloth == Cloth::Strip { 4 } else { 2 };
                let reference = self.reference.unwrap_or(finer * (most - 1) + 1);
                strip::allow("reference", reference as f64, [most as f64 + 1.0, 400.0])?;
                let rests = self.meshes.iter().map(|&n| self.rest(cloth, &fabric, n));
                let rests = rests.collect::<Result<Vec<_>, _>>()?;
                let fine = self.rest(cloth, &fabric, reference)?;
                let half = rests.iter().find(|r| 2 * (r.longer() - 1) == reference - 1);
                let limit = Limit { fine: &fine, half };
                let errors: Vec<Errors> = rests.iter().map(|r| Errors::of(r, &limit)).collect();
                let case = format!("{}, {name}", cloth.name());
                rows(cloth, &case, &limit, &rests, &errors, &mut findings.rows);
                for (plot, point) in plots.iter_mut().zip(POINTS) {
                    plot.series.push(Series::dots(&case, errors.iter().map(point).collect()));
                }
                (context.progress)((c * self.fabric.len() + f + 1) as f64 / runs);
            }
        }
        findings.plots.extend(plots);
        Ok(findings)
    }
}

impl Convergence {
    /// A cloth at rest on a mesh.
    fn rest(&self, cloth: Cloth, fabric: &Arc<Fabric>, particles: usize) -> Result<Rest, Refused> {
        match cloth {
            Cloth::Strip => self.strip(fabric, particles),
            Cloth::Drape => scene(cloth.name(), fabric, particles, STEP[1]),
            _ => scene(cloth.name(), fabric, particles, STEP[0]),
        }
    }

    /// The strip; `particles` from the clamp on, two across.
    fn strip(&self, fabric: &Arc<Fabric>, particles: usize) -> Result<Rest, Refused> {
        let spacing = self.length / (particles - 1) as f64;
        let mut setup =
            strip::setup(Fabric::clone(fabric), particles + 1, [self.length + spacing, WIDTH], |i| {
                [i as f64 * spacing - spacing, 0.0]
            });
        let end = [[particles, 0], [particles, 1]];
        setup.drag = THICK;
        setup.pins = [[0, 0], [0, 1], [1, 0], [1, 1]].into_iter().chain(end).collect();
        let mut world = World::new(setup)?;
        for step in 1..=WAY {
            let part = step as f64 / WAY as f64;
            let [x, z] = [1.0 - part * (1.0 - self.end[0]), -part * self.end[1]].map(|v| v * self.length);
            let to = |particle: Site| Command::Drive {
                particle,
                position: Vec3::new(x, particle[1] as f64 * WIDTH, z),
            };
            world.step(&end.map(to), STEP[0], Budget::solves(40));
        }
        strip::settle(&mut world, STEP[0], 4000)?;
        Ok(Rest {
            counts: [particles, 2],
            shape: world.positions()[2..].to_vec(),
            force: end.into_iter().filter_map(|site| world.reaction(site)).sum(),
            coarseness: coarseness(&world, 1),
            side: self.length,
        })
    }
}

/// Abscissa and ordinate of the plots.
const POINTS: [fn(&Errors) -> [f64; 2]; 4] = [
    |e| [e.coarseness, e.force],
    |e| [e.intervals, e.force],
    |e| [e.coarseness, e.rms],
    |e| [e.intervals, e.rms],
];

fn plots() -> [Plot; 4] {
    let plot = |title: &str, x: &str, y: &str| Plot {
        title: title.into(),
        labels: [x.into(), y.into()],
        logarithmic: true,
        ..Plot::default()
    };
    let [lengths, intervals] = ["spacing over bending length", "intervals"];
    let [force, shape] = ["relative error of the force", "RMS over side"];
    [
        plot("Error of the force over h/ℓ", lengths, force),
        plot("Error of the force over the mesh", intervals, force),
        plot("Error of the shape over h/ℓ", lengths, shape),
        plot("Error of the shape over the mesh", intervals, shape),
    ]
}

/// Lowest order of convergence of a strip's force and shape, where the coarser mesh is not too coarse.
const ORDER: f64 = 1.8;

fn rows(cloth: Cloth, case: &str, limit: &Limit, rests: &[Rest], errors: &[Errors], rows: &mut Vec<Row>) {
    let force = limit.of(|r| r.force).norm();
    for (rest, e) in rests.iter().zip(errors) {
        let case = format!("{case}, {} particles, h/ℓ {:.3}", rest.longer(), e.coarseness);
        let judged = matches!(cloth, Cloth::Strip | Cloth::Hang) && e.coarseness <= model::TOO_COARSE;
        let row = |name: &str, values: [f64; 2], error: f64| {
            let allowed = if judged { model::force_error(e.coarseness) } else { f64::INFINITY };
            let row = Row::with_error(name, &case, values, error, allowed);
            let row = Row { tolerance: judged.then_some(allowed), ..row };
            if e.max > OTHER_FOLD { row.because("other folds than the reference's") } else { row }
        };
        rows.extend([
            row("error of the force", [rest.force.norm(), force], e.force),
            row("error of the shape, RMS/side", [e.rms, 0.0], e.rms),
            row("error of the shape, max/side", [e.max, 0.0], e.max),
        ]);
    }
    for n in 1..errors.len() {
        let [a, b] = [&errors[n - 1], &errors[n]];
        let case = format!("{case}, {} to {} particles", rests[n - 1].longer(), rests[n].longer());
        for (name, [coarse, fine]) in
            [("order of the force", [a.force, b.force]), ("order of the shape, RMS", [a.rms, b.rms])]
        {
            let order = (coarse / fine).ln() / (b.intervals / a.intervals).ln();
            rows.push(if cloth == Cloth::Strip && a.coarseness <= model::TOO_COARSE {
                Row::at_least(name, &case, order, ORDER)
            } else {
                Row::report(name, &case, order, 2.0)
            });
        }
    }
}
