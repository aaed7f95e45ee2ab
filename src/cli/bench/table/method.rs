//! The methods of the table: which mesh, which minimizer, what decides about the mesh.

use super::solve::{self, Solution};
use crate::{
    adapt::{Criterion, Settings},
    compare::{Refinement, Rule, Sign, coarsened, without_hysteresis},
    cost::Coefficients,
    grid::{Cell, Edit},
    model::Setup,
    world::World,
};
use std::{error::Error, sync::Arc};

/// How the mesh follows the cloth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Mesh {
    /// It does not.
    Uniform,
    /// Dense at the start; cells merge.
    Coarsening(Settings),
    /// Coarse at the start; cells split.
    Refinement(Refinement),
    /// Coarse at the start; all cells split when the cloth is quiet.
    Staged,
}

/// How a mesh is solved.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Minimizer {
    Newton,
    Steepest,
    Conjugate,
    /// Conjugate gradients, in turn on balance and bending, and on stretch alone.
    TwoPhase,
}

/// A row of the table before it is measured.
#[derive(Clone, Debug)]
pub(super) struct Method {
    /// What the row is called.
    pub name: String,
    /// What decides about the mesh, and its threshold.
    pub criterion: String,
    pub particles: usize,
    pub mesh: Mesh,
    pub minimizer: Minimizer,
    /// Without the hysteresis of the fabric.
    pub elastic: bool,
}

/// Ticks between looks at the mesh.
const EVERY: u64 = 5;
/// Speed [m/s] below which a staged mesh is refined.
const QUIET: f64 = 0.02;
/// Largest cell of a mesh that starts coarse, in intervals.
const COARSE: usize = 4;

impl Minimizer {
    pub(super) fn name(self) -> &'static str {
        match self {
            Minimizer::Newton => "newton",
            Minimizer::Steepest => "steepest_descent",
            Minimizer::Conjugate => "conjugate_gradients",
            Minimizer::TwoPhase => "two_phase",
        }
    }
}

impl Method {
    pub(super) fn uniform(particles: usize, minimizer: Minimizer) -> Method {
        Method {
            name: format!("uniform {particles}"),
            criterion: "none".into(),
            particles,
            mesh: Mesh::Uniform,
            minimizer,
            elastic: false,
        }
    }

    fn named(name: &str, criterion: String, particles: usize, mesh: Mesh) -> Method {
        Method { name: name.into(), criterion, mesh, ..Method::uniform(particles, Minimizer::Newton) }
    }

    /// All rows on these uniform meshes; the last is the finest, which adaptive ones may reach.
    pub(super) fn all(particles: &[usize], quick: bool) -> Vec<Method> {
        let mut methods = Vec::new();
        let finest = particles[particles.len() - 1];
        for minimizer in [Minimizer::Newton, Minimizer::Steepest, Minimizer::Conjugate] {
            methods.extend(particles.iter().map(|&n| Method::uniform(n, minimizer)));
        }
        let paper = [Criterion::BendingCost, Criterion::BendingStretchingCost];
        for (criterion, name) in paper.into_iter().zip(["bending cost", "bending + stretching cost"]) {
            for &cost in if quick { &[5.0][..] } else { &[0.05, 0.2, 1.0, 2.75, 5.0, 8.0, 16.0] } {
                // The paper knows neither rings nor a budget of force, and does not ask for compression.
                let free = Settings {
                    slenderest: 1,
                    rings: 0,
                    buckling: f64::INFINITY,
                    budget: [f64::INFINITY; 2],
                    ..Settings::default()
                };
                let settings = Settings { criterion, cost, refines: false, ..free };
                let text = format!("{name} {cost}");
                methods.push(Method::named("adaptive coarsening", text, finest, Mesh::Coarsening(settings)));
            }
        }
        let refine = |name: &str, text: &str, sign, thresholds: &[f64]| {
            let of = |&threshold: &f64| {
                let mesh = Mesh::Refinement(Refinement { sign, threshold });
                Method::named(name, format!("{text} {threshold}"), finest, mesh)
            };
            thresholds[if quick { thresholds.len() - 1 } else { 0 }..].iter().map(of).collect::<Vec<_>>()
        };
        methods.extend(refine("adaptive refinement", "bending cost", Sign::BendingCost, &[1.0, 0.2]));
        let both = Sign::BendingStretchingCost;
        methods.extend(refine("adaptive refinement", "bending + stretching cost", both, &[1.0, 0.2]));
        for &angle in if quick { &[0.3][..] } else { &[0.15, 0.2, 0.3, 0.4] } {
            let settings = Settings { angle, ..Settings::default() };
            let text = format!("bending angle {angle}");
            methods.push(Method::named("ours", text, finest, Mesh::Coarsening(settings)));
        }
        methods.extend(refine("hutchinson", "bending angle", Sign::Angle, &[0.3]));
        methods.extend(refine("villard", "two-beam curvature 1/m", Sign::Curvature, &[50.0]));
        methods.extend(refine("near obstacle", "cell side / gap", Sign::NearObstacle, &[1.0]));
        methods.push(Method::named("multi-density", "quiet".into(), finest, Mesh::Staged));
        methods.push(Method {
            name: format!("elastic, uniform {finest}"),
            elastic: true,
            ..Method::uniform(finest, Minimizer::Newton)
        });
        methods.push(Method::uniform(particles[0], Minimizer::TwoPhase));
        methods
    }

    /// Runs the method on the scene until it arrives or the cap [s] is over.
    pub(super) fn run(&self, mut setup: Setup, cap: f64) -> Result<Solution, Box<dyn Error>> {
        if self.elastic {
            setup.fabric = Arc::new(without_hysteresis(&setup.fabric)?);
        }
        let whole = Coefficients::default();
        let shape = Coefficients { stretch: 0.0, ..whole };
        let length = Coefficients { newton: 0.0, bend: 0.0, shear: 0.0, ..whole };
        match self.minimizer {
            Minimizer::Newton => self.settle(World::new(setup)?, cap),
            Minimizer::Steepest => solve::descent(&setup, Rule::SteepestDescent, &[whole], cap),
            Minimizer::Conjugate => solve::descent(&setup, Rule::ConjugateGradients, &[whole], cap),
            Minimizer::TwoPhase => solve::descent(&setup, Rule::ConjugateGradients, &[shape, length], cap),
        }
    }

    fn settle(&self, mut world: World, cap: f64) -> Result<Solution, Box<dyn Error>> {
        let coarse = coarsened(world.grid(), COARSE);
        match self.mesh {
            Mesh::Uniform => solve::newton(world, cap, &mut |_, _| {}),
            Mesh::Coarsening(settings) => {
                world.set_adaptive(Some(settings));
                solve::newton(world, cap, &mut |world, tick| {
                    if tick % EVERY == 0 {
                        world.adapt();
                    }
                })
            }
            Mesh::Refinement(refinement) => {
                start_coarse(&mut world, coarse)?;
                solve::newton(world, cap, &mut |world, tick| {
                    if tick % EVERY == 0 {
                        let edits = refinement.edits(world.model(), world.state());
                        change(world, edits);
                    }
                })
            }
            Mesh::Staged => {
                start_coarse(&mut world, coarse)?;
                solve::newton(world, cap, &mut |world, tick| {
                    let fastest = world.state().velocities.iter().map(|v| v.norm()).fold(0.0, f64::max);
                    let quiet = tick % EVERY == 0 && fastest < QUIET;
                    let large = |c: &&Cell| c.is_coarse();
                    if quiet || !world.grid().cells().iter().any(|c| large(&c)) {
                        let split: Vec<Cell> = world.grid().cells().iter().filter(large).copied().collect();
                        let edits = world.grid().clone().refine(split);
                        change(world, edits);
                    }
                })
            }
        }
    }
}

fn start_coarse(world: &mut World, edits: Vec<Edit>) -> Result<(), Box<dyn Error>> {
    world.set_adaptive(Some(Settings { rings: 0, ..Settings::default() }));
    if !edits.is_empty() && !change(world, edits) {
        return Err("--particles: the finest mesh cannot start coarse; allowed: 4 n + 1".into());
    }
    Ok(())
}

/// Changes the mesh; without edits it is good as it is.
fn change(world: &mut World, edits: Vec<Edit>) -> bool {
    if edits.is_empty() {
        world.keep_mesh();
        return false;
    }
    let prepared = world.probe().and_then(|probe| probe.change_to(edits));
    prepared.is_some_and(|prepared| world.adopt(prepared))
}
