//! A case: everything random of a scene and of what is done to it, drawn from one seed and written as one line.
//!
//! Each part is drawn from a stream of its own, so that a part can be left out or made smaller and the others stay the same.

use crate::{fabric, minimize::Method, stress::abuse::Kind};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::fmt;

/// Fabric that is made up: a name, as those of files are.
pub const SYNTHETIC: &str = "synthetic";

/// What a stream of random numbers is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Topic {
    Case = 1,
    Sheet = 2,
    Fabric = 3,
    Obstacle = 4,
    Act = 5,
    Judge = 6,
    Mesher = 7,
}

/// The stream of a topic's `place`.
pub(super) fn stream(seed: u64, topic: Topic, place: usize) -> Pcg64 {
    let mixed = seed
        .wrapping_mul(0x9e37_79b9_7f4a_7c15)
        .wrapping_add((topic as u64).wrapping_mul(0xbf58_476d_1ce4_e5b9))
        .wrapping_add((place as u64).wrapping_mul(0x94d0_49bb_1331_11eb));
    Pcg64::seed_from_u64(mixed)
}

/// A value between bounds, its logarithm even.
pub(super) fn logarithmic(random: &mut Pcg64, [low, high]: [f64; 2]) -> f64 {
    (random.random_range(low.ln()..high.ln())).exp()
}

/// A scene and what is done to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Case {
    /// Seed of all that is random.
    pub seed: u64,
    /// Particles along warp and weft.
    pub mesh: [usize; 2],
    /// A built-in fabric, or `synthetic`.
    pub fabric: String,
    /// Places of the obstacles that are there, of those that the seed draws.
    pub obstacles: Vec<usize>,
    /// Places and kinds of the manipulations, in order.
    pub acts: Vec<(usize, Kind)>,
    /// Steps of each manipulation.
    pub ticks: usize,
    /// Length of a step [s].
    pub tick: f64,
    /// Solves of a step at the most: what a budget of time comes to.
    pub solves: u32,
    /// Who solves.
    pub solver: Method,
    /// Whether the mesh adapts.
    pub adaptive: bool,
    /// Whether it then adapts as in sessions, not down to the fewest particles.
    pub as_sessions: bool,
}

/// Obstacles and manipulations of a case at the most.
const MOST_OBSTACLES: usize = 3;
const MOST_ACTS: usize = 5;
/// Lengths of steps [s].
const TICKS: [f64; 7] = [1e-4, 5e-4, 1e-3, 4e-3, 8e-3, 0.02, 0.05];
/// Solves of a step; 0 still makes one.
const SOLVES: [u32; 8] = [0, 1, 1, 2, 2, 3, 4, 8];
/// Classes of meshes: chance, and particles along a side. Small ones are cheap, so many are tried.
const MESHES: [(f64, [usize; 2]); 5] =
    [(0.81, [3, 9]), (0.13, [10, 20]), (0.045, [21, 39]), (0.012, [40, 77]), (0.003, [78, 153])];
/// Particles times steps of all manipulations together, about, and steps of one within bounds.
const WORK: usize = 8_000;
const STEPS: [usize; 2] = [4, 80];

impl Case {
    /// The case of a seed.
    pub fn draw(seed: u64) -> Case {
        let mut random = stream(seed, Topic::Case, 0);
        let mesh = mesh(&mut random);
        let names = fabric::list();
        let fabric = if random.random_bool(0.5) {
            names[random.random_range(0..names.len())].clone()
        } else {
            SYNTHETIC.to_owned()
        };
        let obstacles = (0..random.random_range(0..=MOST_OBSTACLES)).collect();
        let count = random.random_range(1..=MOST_ACTS);
        let acts = (0..count).map(|k| (k, Kind::ALL[random.random_range(0..Kind::ALL.len())])).collect();
        Case {
            seed,
            ticks: (WORK / (mesh[0] * mesh[1] * count)).clamp(STEPS[0], STEPS[1]),
            mesh,
            fabric,
            obstacles,
            acts,
            tick: TICKS[random.random_range(0..TICKS.len())],
            solves: SOLVES[random.random_range(0..SOLVES.len())],
            solver: if random.random_bool(0.5) { Method::Fronts } else { Method::Multigrid },
            adaptive: random.random_bool(0.4),
            as_sessions: stream(seed, Topic::Mesher, 0).random_bool(0.5),
        }
    }

    /// Reads a case: `seed:N`, then what differs from the seed's own, as `Display` writes it.
    pub fn parse(text: &str) -> Result<Case, String> {
        let mut parts = text.split(';').map(str::trim).filter(|p| !p.is_empty());
        let seed =
            parts.next().and_then(|p| p.strip_prefix("seed:")).ok_or("case: must begin with seed:N")?;
        let mut case = Case::draw(number(seed, "seed")?);
        for part in parts {
            let (key, value) =
                part.split_once(':').ok_or_else(|| format!("case: got {part:?}, allowed: key:value"))?;
            case.set(key, value)?;
        }
        Ok(case)
    }

    fn set(&mut self, key: &str, value: &str) -> Result<(), String> {
        let list = || value.split(',').filter(|v| !v.is_empty());
        match key {
            "mesh" => {
                let (i, j) = value
                    .split_once('x')
                    .ok_or_else(|| format!("mesh: got {value:?}, allowed: IxJ, such as 7x9"))?;
                self.mesh = [within(i, "mesh", [2, 400])?, within(j, "mesh", [2, 400])?];
            }
            "fabric" if value == SYNTHETIC || fabric::list().iter().any(|n| n == value) => {
                self.fabric = value.to_owned();
            }
            "fabric" => {
                let known = fabric::list().join(", ");
                return Err(format!("fabric: got {value:?}, allowed: {SYNTHETIC}, {known}"));
            }
            "obstacles" => {
                self.obstacles = list()
                    .map(|v| within(v, "obstacles", [0, MOST_OBSTACLES - 1]))
                    .collect::<Result<_, _>>()?;
            }
            "acts" => {
                let act = |text: &str| {
                    let (place, name) = text
                        .split_once('-')
                        .ok_or_else(|| format!("acts: got {text:?}, allowed: PLACE-KIND, such as 2-shake"))?;
                    Ok((within(place, "acts", [0, 1000])?, Kind::parse(name)?))
                };
                self.acts = list().map(act).collect::<Result<_, String>>()?;
            }
            "ticks" => self.ticks = within(value, "ticks", [1, 1_000_000])?,
            "tick" => {
                self.tick = value
                    .parse()
                    .ok()
                    .filter(|t| (1e-6..=1.0).contains(t))
                    .ok_or_else(|| format!("tick: got {value:?}, allowed: 1e-6 to 1 s"))?;
            }
            "solves" => self.solves = within(value, "solves", [0, 1000])? as u32,
            "solver" => {
                self.solver = clap::ValueEnum::from_str(value, false)
                    .map_err(|_| format!("solver: got {value:?}, allowed: fronts, faer, multigrid"))?;
            }
            "adaptive" => {
                self.adaptive = match value {
                    "on" => true,
                    "off" => false,
                    _ => return Err(format!("adaptive: got {value:?}, allowed: on, off")),
                }
            }
            "mesher" => {
                self.as_sessions = match value {
                    "sessions" => true,
                    "fewest" => false,
                    _ => return Err(format!("mesher: got {value:?}, allowed: sessions, fewest")),
                }
            }
            _ => {
                return Err(format!(
                    "case: got the key {key:?}, allowed: mesh, fabric, obstacles, acts, ticks, tick, solves, solver, adaptive, mesher"
                ));
            }
        }
        Ok(())
    }

    /// Name of the mesh's class, for tables.
    pub fn class(&self) -> String {
        let [least, most] = [self.mesh[0].min(self.mesh[1]), self.mesh[0].max(self.mesh[1])];
        let range = MESHES.iter().map(|m| m.1).find(|r| most <= r[1]).unwrap_or([154, 400]);
        let shape = if 4 * least <= most {
            "strip"
        } else if least == most {
            "square"
        } else {
            "oblong"
        };
        format!("{shape}, to {}", range[1])
    }
}

impl fmt::Display for Case {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let own = Case::draw(self.seed);
        write!(f, "seed:{}", self.seed)?;
        if self.mesh != own.mesh {
            write!(f, ";mesh:{}x{}", self.mesh[0], self.mesh[1])?;
        }
        if self.fabric != own.fabric {
            write!(f, ";fabric:{}", self.fabric)?;
        }
        if self.obstacles != own.obstacles {
            let list: Vec<String> = self.obstacles.iter().map(|o| o.to_string()).collect();
            write!(f, ";obstacles:{}", list.join(","))?;
        }
        if self.acts != own.acts {
            let list: Vec<String> =
                self.acts.iter().map(|(k, kind)| format!("{k}-{}", kind.name())).collect();
            write!(f, ";acts:{}", list.join(","))?;
        }
        if self.ticks != own.ticks {
            write!(f, ";ticks:{}", self.ticks)?;
        }
        if self.tick != own.tick {
            write!(f, ";tick:{}", self.tick)?;
        }
        if self.solves != own.solves {
            write!(f, ";solves:{}", self.solves)?;
        }
        if self.solver != own.solver {
            write!(f, ";solver:{}", self.solver.name())?;
        }
        if self.adaptive != own.adaptive {
            write!(f, ";adaptive:{}", if self.adaptive { "on" } else { "off" })?;
        }
        if self.as_sessions != own.as_sessions {
            write!(f, ";mesher:{}", if self.as_sessions { "sessions" } else { "fewest" })?;
        }
        Ok(())
    }
}

fn mesh(random: &mut Pcg64) -> [usize; 2] {
    let mut dice = random.random_range(0.0..1.0);
    let class = MESHES.iter().find(|(chance, _)| {
        dice -= chance;
        dice < 0.0
    });
    let [low, high] = class.unwrap_or(&MESHES[0]).1;
    let [i, j] = [0, 1].map(|_| random.random_range(low..=high));
    match random.random_range(0..10) {
        0 => [i, 2 + j % 3],
        1 => [2 + i % 3, j],
        2..6 => [i, i],
        _ => [i, j],
    }
}

fn number(text: &str, what: &str) -> Result<u64, String> {
    text.parse().map_err(|_| format!("{what}: got {text:?}, allowed: a whole number"))
}

fn within(text: &str, what: &str, [low, high]: [usize; 2]) -> Result<usize, String> {
    let value = number(text, what)? as usize;
    if (low..=high).contains(&value) {
        Ok(value)
    } else {
        Err(format!("{what}: got {value}, allowed: {low} to {high}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_case_comes_back_from_its_line() {
        for seed in 0..200 {
            let mut case = Case::draw(seed);
            assert_eq!(Case::parse(&case.to_string()).unwrap(), case);
            case.mesh = [3, 4];
            case.acts.truncate(1);
            case.obstacles.clear();
            case.ticks += 1;
            case.tick = 2.5e-3;
            case.solves = 7;
            case.adaptive = !case.adaptive;
            case.as_sessions = !case.as_sessions;
            assert_eq!(Case::parse(&case.to_string()).unwrap(), case);
        }
    }

    #[test]
    fn a_line_that_says_nothing_sensible_is_refused_by_name() {
        for (line, word) in [
            ("mesh:3x3", "seed"),
            ("seed:1;mesh:1x9", "mesh"),
            ("seed:1;fabric:tin", "tin"),
            ("seed:1;acts:1-dance", "dance"),
            ("seed:1;tick:9", "tick"),
            ("seed:1;colour:red", "colour"),
        ] {
            assert!(Case::parse(line).unwrap_err().contains(word), "{line}");
        }
    }
}
