//! `kesi bench table`: every method on the drape scene, in one run, from the flat start to rest.
//!
//! The first row, Newton's method on the finest uniform mesh, is what the others are compared with. What does not arrive within
//! the cap is reported where it is then.

mod method;
#[cfg(feature = "plot")]
mod report;
mod solve;

use super::Output;
use crate::{
    cli::{output::progress, positive},
    compare::{Carried, carry, shape_error},
    math::Vec3,
    model::{Model, Setup},
    scene::Scene,
};
use method::{Method, Minimizer};
use serde::Serialize;
use solve::{Moment, Solution};
use std::error::Error;

/// The paper's comparison.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Particles along both sides of the uniform meshes, ascending; each has twice the intervals of the one before, or four times.
    #[arg(long, value_delimiter = ',', default_value = "20,39,77")]
    particles: Vec<usize>,
    /// Uniform mesh that tells how far the finest one is from the continuum; 0 for none.
    #[arg(long, default_value_t = 153)]
    beyond: usize,
    /// Wall time of a method at the most [s].
    #[arg(long, default_value_t = 600.0, value_parser = positive, allow_negative_numbers = true)]
    cap_s: f64,
    /// Meshes of 29 and 57, fewer thresholds, 8 s per method at the most: two minutes.
    #[arg(long)]
    quick: bool,
    /// Only methods whose name holds this text, and the finest mesh.
    #[arg(long)]
    only: Option<String>,
    /// Writes a report with plots into this folder.
    #[cfg(feature = "plot")]
    #[arg(long, value_name = "DIR")]
    report: Option<std::path::PathBuf>,
    #[command(flatten)]
    output: Output,
}

#[derive(Clone, Debug, Serialize)]
struct Row {
    mesh: String,
    minimizer: &'static str,
    criterion: String,
    wall_s: f64,
    user_s: Option<f64>,
    peak_memory_bytes: Option<u64>,
    particles_start: usize,
    particles_end: usize,
    particles_mean: f64,
    iterations: u64,
    solves: u64,
    residual_n: f64,
    cost_total: f64,
    cost_newton: f64,
    cost_stretch: f64,
    cost_bend: f64,
    cost_shear: f64,
    /// Cost of the state carried to the finest mesh minus the finest solution's.
    quality_error: Option<f64>,
    shape_rms_m: f64,
    shape_max_m: f64,
    /// The same over the length of the sheet's edge.
    shape_rms_of_edge: f64,
    shape_max_of_edge: f64,
    force_error: f64,
    stiffness_error: Option<f64>,
    penetration_m: f64,
    dissipated_j: Option<f64>,
    converged: bool,
    capped: bool,
    /// Wall time of the finest mesh with the same minimizer over this row's; a lower bound where that one was capped.
    speed_to_finer: Option<f64>,
    /// Wall time of conjugate gradients on the finest mesh over this row's; a lower bound where they were capped.
    speed_to_paper: Option<f64>,
    /// On the way.
    curve: Vec<Moment>,
}

/// A measured row with its shape on the finest lattice.
struct Measured {
    row: Row,
    #[cfg_attr(not(feature = "plot"), expect(dead_code, reason = "only the report draws it"))]
    shape: Vec<Vec3>,
}

/// Cap [s] of a quick run.
const QUICK_CAP: f64 = 8.0;
/// Least cap of the reference and of the mesh beyond it [s].
const REFERENCE_CAP: f64 = 1200.0;

/// Runs the bench.
pub fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    let quick = args.quick;
    let particles = if quick { vec![29, 57] } else { args.particles.clone() };
    let steps: Vec<usize> = particles.windows(2).map(|n| (n[1] - 1) / (n[0].max(2) - 1)).collect();
    let nested =
        particles.windows(2).zip(&steps).all(|(n, s)| (n[0] - 1) * s == n[1] - 1 && (*s == 2 || *s == 4));
    if particles.is_empty() || particles[0] < 3 || !nested {
        return Err(format!("--particles: got {particles:?}, allowed: 3 or more, each with 2 or 4 times the intervals of the one before").into());
    }
    let finest = particles[particles.len() - 1];
    let cap = if quick { args.cap_s.min(QUICK_CAP) } else { args.cap_s };
    let first = Method::uniform(finest, Minimizer::Newton);
    let mut methods = vec![first.clone()];
    if args.beyond > finest && !quick {
        methods.push(Method::uniform(args.beyond, Minimizer::Newton));
    }
    methods.extend(Method::all(&particles, quick).into_iter().filter(|m| {
        let wanted = args.only.as_ref().is_none_or(|text| m.name.contains(text.as_str()));
        wanted && (m.name != first.name || m.minimizer != first.minimizer)
    }));
    let out = &args.output;
    out.line(HEADING);
    let bar = progress(methods.len());
    let mut reference: Option<Solution> = None;
    let mut measured: Vec<Measured> = Vec::new();
    for method in &methods {
        bar.set_message(method.name.clone());
        // The reference has to arrive, and so has what tells how good it is.
        let trusted = reference.is_none() || method.particles > finest;
        let cap = if trusted { cap.max(REFERENCE_CAP) } else { cap };
        let solution = method.run(setup(method.particles)?, cap)?;
        if reference.is_none() && !solution.converged {
            return Err(format!("{}: no rest within {cap} s, so nothing to compare with", method.name).into());
        }
        let one = measure(method, &solution, reference.as_ref().unwrap_or(&solution));
        bar.suspend(|| out.line(&line(&one.row)));
        bar.inc(1);
        measured.push(one);
        reference.get_or_insert(solution);
    }
    bar.finish_and_clear();
    compare_speeds(&mut measured, finest);
    #[cfg(feature = "plot")]
    if let Some(folder) = &args.report {
        report::write(folder, &measured, finest, cap)?;
    }
    let rows: Vec<Row> = measured.into_iter().map(|m| m.row).collect();
    out.write(0, &rows)
}

fn setup(n: usize) -> Result<Setup, Box<dyn Error>> {
    let scene = Scene::built_in("drape").ok_or("no drape scene")?;
    let faults =
        |f: Vec<crate::scene::SceneError>| f.iter().map(|e| e.to_string()).collect::<Vec<_>>().join("\n");
    Ok(Scene { particles: [n, n], ..scene }.setup().map_err(faults)?)
}

fn measure(method: &Method, s: &Solution, reference: &Solution) -> Measured {
    let fine = &reference.model;
    let carried = carry(&s.model, &s.state, &s.forces, fine);
    let cost = |c: &Carried| c.cost(fine, &reference.fixed).total();
    let quality_error = carried.as_ref().map(|c| cost(c) - reference.cost.total());
    let particles = fine.grid.particles();
    let shape = match carried {
        Some(carried) => carried.positions[..particles].to_vec(),
        None => thinned(&s.model, &s.state.positions, fine),
    };
    let [rms, max] = shape_error(&shape, &reference.state.positions[..particles]);
    let edge = fine.grid.size[0].min(fine.grid.size[1]);
    let stiffness_error = s.stiffness.zip(reference.stiffness).map(|(k, r)| (k - r).norm() / r.norm());
    let row = Row {
        mesh: method.name.clone(),
        minimizer: method.minimizer.name(),
        criterion: method.criterion.clone(),
        wall_s: s.spent.wall_s,
        user_s: s.spent.user_s,
        peak_memory_bytes: s.spent.peak_bytes,
        particles_start: s.particles[0] as usize,
        particles_end: s.particles[1] as usize,
        particles_mean: s.particles[2],
        iterations: s.iterations,
        solves: s.solves,
        residual_n: s.residual,
        cost_total: s.cost.total(),
        cost_newton: s.cost.newton,
        cost_stretch: s.cost.stretch,
        cost_bend: s.cost.bend,
        cost_shear: s.cost.shear,
        quality_error,
        shape_rms_m: rms,
        shape_max_m: max,
        shape_rms_of_edge: rms / edge,
        shape_max_of_edge: max / edge,
        force_error: (s.hand_force - reference.hand_force).norm() / reference.hand_force.norm(),
        stiffness_error,
        penetration_m: s.penetration,
        dissipated_j: s.dissipated,
        converged: s.converged,
        capped: s.capped,
        speed_to_finer: None,
        speed_to_paper: None,
        curve: s.curve.clone(),
    };
    Measured { row, shape }
}

/// The particles of a finer sheet that a coarser lattice has too.
fn thinned(model: &Model, x: &[Vec3], coarse: &Model) -> Vec<Vec3> {
    let step = [0, 1].map(|k| (model.grid.counts[k] - 1) / (coarse.grid.counts[k] - 1));
    let place = |n: usize| {
        let site = coarse.grid.site(n);
        model.grid.index([0, 1].map(|k| site[k] * step[k]))
    };
    (0..coarse.grid.particles()).map(|n| x[place(n)]).collect()
}

fn compare_speeds(measured: &mut [Measured], finest: usize) {
    let uniform = format!("uniform {finest}");
    let time = |minimizer: &str| {
        let row = measured.iter().map(|m| &m.row).find(|r| r.mesh == uniform && r.minimizer == minimizer);
        row.map(|r| r.wall_s)
    };
    let times =
        [Minimizer::Newton, Minimizer::Steepest, Minimizer::Conjugate].map(|m| (m.name(), time(m.name())));
    for m in measured {
        if m.row.converged {
            let finer = times.iter().find(|(name, _)| *name == m.row.minimizer).and_then(|(_, t)| *t);
            m.row.speed_to_finer = finer.map(|t| t / m.row.wall_s);
            m.row.speed_to_paper = times[2].1.map(|t| t / m.row.wall_s);
        }
    }
}

const HEADING: &str = "mesh                 minimizer          criterion                        wall s  start    end   iter. solves  residual N     cost  quality | rms mm  max mm   force     K | arrived";

fn line(row: &Row) -> String {
    let short = |v: Option<f64>| v.map_or("-".into(), |v| format!("{v:.1e}"));
    format!(
        "{:20} {:18} {:30} {:8.2} {:6} {:6} {:7} {:6}  {:10.1e} {:8.1e} {:>8} | {:6.2} {:7.2} {:7.4} {:>5} | {}",
        row.mesh,
        row.minimizer,
        row.criterion,
        row.wall_s,
        row.particles_start,
        row.particles_end,
        row.iterations,
        row.solves,
        row.residual_n,
        row.cost_total,
        short(row.quality_error),
        row.shape_rms_m * 1e3,
        row.shape_max_m * 1e3,
        row.force_error,
        row.stiffness_error.map_or("-".into(), |v| format!("{v:.3}")),
        if row.converged { "yes" } else { "no: capped" }
    )
}
