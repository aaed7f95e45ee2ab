//! The report of the table: one HTML file with the table, work-precision plots, cost curves and shapes coloured by their error.

use super::{Measured, Moment, Row};
use crate::{
    cli::{
        output,
        validate::report::{STYLE, escape, svg},
    },
    math::Vec3,
    validate::{Plot, Series},
};
use plotters::prelude::*;
use std::{error::Error, fmt::Write, path::Path};

/// Size of a shape's picture [px].
const PICTURE: (u32, u32) = (360, 300);
/// Particles along a side of a drawn shape at the most.
const DRAWN: usize = 39;

pub(super) fn write(
    folder: &Path,
    measured: &[Measured],
    finest: usize,
    cap: f64,
) -> Result<(), Box<dyn Error>> {
    std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    let file = folder.join("table.html");
    let text = html(measured, finest, cap)?;
    std::fs::write(&file, text).map_err(|e| format!("{}: {e}", file.display()).into())
}

fn html(measured: &[Measured], finest: usize, cap: f64) -> Result<String, Box<dyn Error>> {
    let mut text =
        String::from("<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>kesi</title>\n");
    let (command, machine, version) = (output::command(), output::machine(), env!("CARGO_PKG_VERSION"));
    writeln!(
        text,
        "<style>{STYLE}td{{white-space:nowrap}}td:nth-child(3),th:nth-child(3){{text-align:left}}</style>\n<h1>kesi {}</h1>",
        escape(&command)
    )?;
    writeln!(
        text,
        "<p>Version {version}, seed 0 (nothing is random); {}. Scene drape, corner held, from the flat start to rest. Errors are
        against uniform {finest} with newton; what had not arrived after {cap} s is shown where it was then, and speeds relative to a
        capped method are lower bounds. Peak memory is the process's.</p>",
        escape(&machine)
    )?;
    write_table(&mut text, measured)?;
    for plot in plots(measured) {
        writeln!(text, "<figure>{}<figcaption>{}</figcaption></figure>", svg(&plot)?, escape(&plot.title))?;
    }
    let reference = &measured[0].shape;
    writeln!(text, "<h2>Shapes, with the distance from the finest one in colour</h2>")?;
    for m in measured {
        let Row { mesh, minimizer, criterion, shape_max_m, .. } = &m.row;
        let caption = format!("{mesh}, {minimizer}, {criterion}: red is {:.3} mm", shape_max_m * 1e3);
        writeln!(
            text,
            "<figure style=\"display:inline-block\">{}<figcaption>{}</figcaption></figure>",
            picture(&m.shape, reference, finest, *shape_max_m)?,
            escape(&caption)
        )?;
    }
    text.push_str("</html>\n");
    Ok(text)
}

fn write_table(text: &mut String, measured: &[Measured]) -> std::fmt::Result {
    let heads = "mesh,minimizer,criterion,wall s,user s,peak MB,particles start,end,mean,iterations,solves,residual N,cost,newton,\
        stretch,bend,shear,quality error,shape RMS mm,% of edge,max mm,% of edge,force error,K error,penetration mm,dissipated mJ,\
        speed to finer,speed to paper,arrived";
    writeln!(
        text,
        "<div style=\"overflow-x:auto\"><table><tr>{}",
        heads.split(',').fold(String::new(), |all, h| all + "<th>" + h.trim())
    )?;
    let tiny = |v: f64| format!("{v:.1e}");
    let maybe = |v: Option<f64>, f: &dyn Fn(f64) -> String| v.map_or("–".to_owned(), f);
    for Measured { row: r, .. } in measured {
        let cells = [
            escape(&r.mesh),
            r.minimizer.into(),
            escape(&r.criterion),
            format!("{:.2}", r.wall_s),
            maybe(r.user_s, &|v| format!("{v:.2}")),
            maybe(r.peak_memory_bytes.map(|b| b as f64), &|b| format!("{:.0}", b / 1e6)),
            r.particles_start.to_string(),
            r.particles_end.to_string(),
            format!("{:.0}", r.particles_mean),
            r.iterations.to_string(),
            r.solves.to_string(),
            tiny(r.residual_n),
            tiny(r.cost_total),
            tiny(r.cost_newton),
            tiny(r.cost_stretch),
            tiny(r.cost_bend),
            tiny(r.cost_shear),
            maybe(r.quality_error, &tiny),
            format!("{:.3}", r.shape_rms_m * 1e3),
            format!("{:.3}", r.shape_rms_of_edge * 100.0),
            format!("{:.3}", r.shape_max_m * 1e3),
            format!("{:.3}", r.shape_max_of_edge * 100.0),
            format!("{:.2} %", r.force_error * 100.0),
            maybe(r.stiffness_error, &|v| format!("{:.1} %", v * 100.0)),
            format!("{:.3}", r.penetration_m * 1e3),
            maybe(r.dissipated_j, &|v| format!("{:.3}", v * 1e3)),
            maybe(r.speed_to_finer, &|v| format!("{v:.2}")),
            maybe(r.speed_to_paper, &|v| format!("{v:.1}")),
            if r.converged { "yes".into() } else { "capped".into() },
        ];
        writeln!(text, "<tr>{}", cells.iter().fold(String::new(), |all, c| all + "<td>" + c))?;
    }
    writeln!(text, "</table></div>")
}

/// An error of a row.
type Measure = fn(&Row) -> f64;

/// Time against each error, one line per method; and the cost on the way.
fn plots(measured: &[Measured]) -> Vec<Plot> {
    let mut names: Vec<String> = Vec::new();
    let line_of = |r: &Row| {
        // A method's line runs over densities or thresholds.
        let mesh = r.mesh.trim_end_matches(|c: char| c.is_ascii_digit()).trim();
        let criterion = r.criterion.trim_end_matches(|c: char| c.is_ascii_digit() || c == '.').trim();
        format!("{mesh}, {criterion}, {}", r.minimizer).replace(", none", "")
    };
    measured.iter().map(|m| line_of(&m.row)).for_each(|name| {
        if !names.contains(&name) {
            names.push(name);
        }
    });
    let errors: [(&str, Measure); 3] = [
        ("quality error", |r| r.quality_error.unwrap_or(0.0)),
        ("shape error RMS, m", |r| r.shape_rms_m),
        ("force error at the hand", |r| r.force_error),
    ];
    let mut plots = Vec::new();
    for (label, error) in errors {
        let mut series = Vec::new();
        for name in &names {
            // The reference itself, the first, has no error but rounding's to show on a logarithmic axis.
            let others = measured.iter().skip(1).map(|m| &m.row);
            let of = others.filter(|r| line_of(r) == *name && error(r) > 0.0);
            let points: Vec<[f64; 2]> = of.map(|r| [r.wall_s, error(r)]).collect();
            if !points.is_empty() {
                series.push(Series::line(name, points.clone()));
                series.push(Series::dots("", points));
            }
        }
        plots.push(Plot {
            title: format!("Time to the end against {label}"),
            labels: ["wall time, s".into(), label.into()],
            logarithmic: true,
            square: false,
            series,
        });
    }
    let uniform = |r: &Row| r.mesh.starts_with("uniform");
    // The paper's run: its own scene and criterion, no re-refinement.
    let paper = |r: &Row| {
        let coarsens = r.mesh == "adaptive coarsening" && r.criterion.starts_with("bending cost");
        coarsens || (r.mesh == measured[0].row.mesh && r.minimizer == "newton")
    };
    plots.push(ways(measured, "Cost over time on uniform meshes", ["wall time, s", "cost"], uniform, |m| {
        [m.wall_s, m.cost]
    }));
    let title = "Cost over iterations while the mesh coarsens";
    plots.push(ways(measured, title, ["ticks", "cost"], paper, |m| [m.iterations as f64, m.cost]));
    let title = "Active particles over iterations while the mesh coarsens";
    plots.push(ways(measured, title, ["ticks", "particles"], paper, |m| {
        [m.iterations as f64, m.particles as f64]
    }));
    plots
}

/// What some rows did on their way.
fn ways(
    measured: &[Measured],
    title: &str,
    labels: [&str; 2],
    of: impl Fn(&Row) -> bool,
    point: impl Fn(&Moment) -> [f64; 2],
) -> Plot {
    let line = |m: &Measured| {
        let points = m.row.curve.iter().map(&point).filter(|p| p[0] > 0.0 && p[1] > 0.0).collect();
        let Row { mesh, minimizer, criterion, .. } = &m.row;
        Series::line(&format!("{mesh}, {criterion}, {minimizer}").replace(", none", ""), points)
    };
    Plot {
        title: title.into(),
        labels: labels.map(String::from),
        logarithmic: true,
        square: false,
        series: measured.iter().filter(|m| of(&m.row)).map(line).collect(),
    }
}

/// A shape seen from above one corner, its particles coloured by their distance from the reference.
fn picture(shape: &[Vec3], reference: &[Vec3], n: usize, worst: f64) -> Result<String, Box<dyn Error>> {
    let seen = |p: &Vec3| (0.866 * (p.x - p.y), p.z + 0.4 * (p.x + p.y));
    let step = n.div_ceil(DRAWN);
    let drawn = || (0..n * n).filter(|k| (k / n).is_multiple_of(step) && (k % n).is_multiple_of(step));
    let points = || drawn().flat_map(|k| [seen(&shape[k]), seen(&reference[k])]);
    let range = |of: fn((f64, f64)) -> f64| {
        let (low, high) =
            points().map(of).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        low - 0.01..high + 0.01
    };
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, PICTURE).into_drawing_area();
        let mut chart = ChartBuilder::on(&root).build_cartesian_2d(range(|p| p.0), range(|p| p.1))?;
        let row =
            |x: &[Vec3], i: usize| (0..n).step_by(step).map(|j| seen(&x[i * n + j])).collect::<Vec<_>>();
        for i in (0..n).step_by(step) {
            chart.draw_series(LineSeries::new(row(reference, i), RGBColor(200, 200, 200)))?;
        }
        let color = |k: usize| {
            let part = (shape[k] - reference[k]).norm() / worst.max(1e-12);
            RGBColor((255.0 * part) as u8, 60, (255.0 * (1.0 - part)) as u8)
        };
        chart.draw_series(drawn().map(|k| Circle::new(seen(&shape[k]), 1, color(k).filled())))?;
        root.present()?;
    }
    Ok(text)
}
