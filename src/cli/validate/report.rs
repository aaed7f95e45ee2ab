//! The report of a validation as one HTML file: table, plots as inline SVG, no script, nothing from elsewhere.

use crate::{
    cli::output,
    validate::{Findings, Plot, Row},
};
use plotters::{coord::Shift, prelude::*};
use std::{error::Error, fmt::Write, ops::Range};

type Canvas<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Size of a plot [px].
const SIZE: [u32; 2] = [560, 420];
/// The plotting crate puts points on whole pixels: a plot is drawn so much larger and shown at its size.
const FINE: u32 = 4;
/// Series up to which a plot holds their names; the names of more stand below it, in lines of this height [px].
const NAMES: usize = 6;
const LINE: u32 = 17;
const COLORS: [RGBColor; 14] = [
    RGBColor(0x1b, 0x5f, 0xaa),
    RGBColor(0xc8, 0x6a, 0x10),
    RGBColor(0x2e, 0x7d, 0x32),
    RGBColor(0xc2, 0x18, 0x2b),
    RGBColor(0x6a, 0x3d, 0x9a),
    RGBColor(0x55, 0x55, 0x55),
    RGBColor(0x00, 0x8b, 0x8b),
    RGBColor(0xd8, 0x5a, 0x9c),
    RGBColor(0x8a, 0x7a, 0x00),
    RGBColor(0x7f, 0xb2, 0xe6),
    RGBColor(0xf2, 0xa9, 0x5c),
    RGBColor(0x7c, 0xc4, 0x7f),
    RGBColor(0x7a, 0x3b, 0x12),
    RGBColor(0xb3, 0x9d, 0xdb),
];
pub const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:1180px;margin:2em auto;padding:0 1em;color:#222}\
table{border-collapse:collapse;font-variant-numeric:tabular-nums}td,th{padding:.15em .7em;text-align:right;border-bottom:1px solid #ddd}\
td:nth-child(-n+2),th:nth-child(-n+2),td:last-child{text-align:left}.fail{background:#fdd}svg{max-width:100%;height:auto}";

/// The report as HTML text: findings, each under its name.
pub fn html(findings: &[(String, &Findings)], seed: u64) -> Result<String, Box<dyn Error>> {
    let rows = || findings.iter().flat_map(|f| &f.1.rows);
    let failed = rows().filter(|r| !r.pass).count();
    let mut text =
        String::from("<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>kesi</title>\n");
    let (command, machine, version) = (output::command(), output::machine(), env!("CARGO_PKG_VERSION"));
    writeln!(text, "<style>{STYLE}</style>\n<h1>kesi {}</h1>", escape(&command))?;
    writeln!(
        text,
        "<p>Version {version}, seed {seed}; {}. {} of {} rows hold.</p>",
        escape(&machine),
        rows().count() - failed,
        rows().count()
    )?;
    for (name, findings) in findings {
        writeln!(
            text,
            "<h2>{}</h2>\n<table><tr><th>quantity<th>case<th>measured<th>reference",
            escape(name)
        )?;
        writeln!(text, "<th>relative error<th>allowed<th>")?;
        findings.rows.iter().try_for_each(|row| write_row(&mut text, row))?;
        writeln!(text, "</table>")?;
        for plot in &findings.plots {
            writeln!(
                text,
                "<figure>{}<figcaption>{}</figcaption></figure>",
                svg(plot)?,
                escape(&plot.title)
            )?;
        }
    }
    text.push_str("</html>\n");
    Ok(text)
}

fn write_row(text: &mut String, row: &Row) -> std::fmt::Result {
    let number = |v: Option<f64>| v.map_or("–".to_owned(), |v| format!("{v:.6}"));
    let fraction = |v: Option<f64>| v.map_or("–".to_owned(), |v| format!("{v:.1e}"));
    let class = if row.pass { "" } else { " class=fail" };
    let [name, case] = [&row.name, &row.case].map(|t| escape(t));
    let measured = number(row.measured);
    let reference = number(Some(row.reference));
    let [error, allowed] = [row.relative_error, row.tolerance].map(fraction);
    let verdict = if row.pass { "holds" } else { "fails" };
    let note = row.note.as_ref().map_or(String::new(), |n| format!(": {}", escape(n)));
    writeln!(
        text,
        "<tr{class}><td>{name}<td>{case}<td>{measured}<td>{reference}<td>{error}<td>{allowed}<td>{verdict}{note}"
    )
}

pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// A plot as SVG text.
pub fn svg(plot: &Plot) -> Result<String, Box<dyn Error>> {
    sheet(std::slice::from_ref(plot), 1)
}

/// Plots beside and below each other as one SVG text; with titles where there are several.
pub fn sheet(plots: &[Plot], columns: usize) -> Result<String, Box<dyn Error>> {
    let cells = [columns, plots.len().div_ceil(columns)];
    let below = plots.iter().map(names_below).max().unwrap_or(0);
    let shown = [SIZE[0] * cells[0] as u32, (SIZE[1] + below) * cells[1] as u32];
    let [width, height] = shown.map(|s| s * FINE);
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, (width, height)).into_drawing_area();
        root.fill(&WHITE)?;
        for (area, plot) in root.split_evenly((cells[1], cells[0])).iter().zip(plots) {
            if plots.len() > 1 {
                draw(&area.margin(4 * FINE, 0, 0, 0).titled(&plot.title, ("sans-serif", 15 * FINE))?, plot)?;
            } else {
                draw(area, plot)?;
            }
        }
        root.present()?;
    }
    let drawn = format!("width=\"{width}\" height=\"{height}\"");
    Ok(text.replacen(&drawn, &format!("width=\"{}\" height=\"{}\"", shown[0], shown[1]), 1))
}

/// Height that a plot's names take below it [px].
fn names_below(plot: &Plot) -> u32 {
    let names = plot.series.iter().filter(|s| !s.name.is_empty()).count();
    if names > NAMES { LINE * names as u32 } else { 0 }
}

fn draw(area: &Canvas, plot: &Plot) -> Result<(), Box<dyn Error>> {
    let below = names_below(plot);
    let (root, names) = area.split_vertically(area.dim_in_pixel().1 - below * FINE);
    let scale = |v: f64| if plot.logarithmic { v.log10() } else { v };
    let [mut x, mut y] = [0, 1].map(|k| {
        let all =
            plot.series.iter().flat_map(|s| &s.points).map(move |p| scale(p[k])).filter(|v| v.is_finite());
        let (low, high) = all.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        let margin = (0.05 * (high - low)).max(1e-9 * (1.0 + high.abs()));
        low - margin..high + margin
    });
    if x.is_empty() || y.is_empty() {
        return Ok(());
    }
    let emptiest = emptiest(plot.series.iter().flat_map(|s| &s.points).map(|p| p.map(scale)), &x, &y);
    let fine = FINE as i32;
    let [left, bottom, margin] = [70 * fine, 44 * fine, 12 * fine];
    if plot.square {
        let [w, h] = [SIZE[0] as i32 * fine - left - 2 * margin, SIZE[1] as i32 * fine - bottom - 2 * margin];
        equalize(&mut x, &mut y, f64::from(w) / f64::from(h));
    }
    let mut chart = ChartBuilder::on(&root)
        .margin(margin)
        .x_label_area_size(bottom)
        .y_label_area_size(left)
        .build_cartesian_2d(x, y)?;
    let label = |v: &f64| if plot.logarithmic { format!("{:.2e}", 10f64.powf(*v)) } else { tidy(*v) };
    chart
        .configure_mesh()
        .x_desc(&plot.labels[0])
        .y_desc(&plot.labels[1])
        .label_style(("sans-serif", 13 * fine))
        .x_label_formatter(&label)
        .y_label_formatter(&label)
        .x_labels(7)
        .max_light_lines(0)
        .draw()?;
    let mut color = COLORS.iter().cycle();
    let mut last = COLORS[0];
    let mut named = 0;
    for series in &plot.series {
        // A series without a name belongs to the one before.
        if !series.name.is_empty() {
            last = *color.next().expect("a cycle");
        }
        let points: Vec<(f64, f64)> = series.points.iter().map(|p| (scale(p[0]), scale(p[1]))).collect();
        let own = last;
        let drawn = if series.dots {
            chart.draw_series(points.iter().map(|p| Circle::new(*p, 2 * fine, own.filled())))?
        } else {
            chart.draw_series(LineSeries::new(points, own.stroke_width(FINE)))?
        };
        if series.name.is_empty() {
            continue;
        }
        let (length, y) = (16 * fine, named * LINE as i32 * fine);
        named += 1;
        if below > 0 {
            let (line, font) = (own.stroke_width(2 * FINE), ("sans-serif", 12 * fine));
            names.draw(&PathElement::new(vec![(left, y + 6 * fine), (left + length, y + 6 * fine)], line))?;
            names.draw(&Text::new(series.name.clone(), (left + length + 4 * fine, y), font))?;
        } else {
            drawn.label(&series.name).legend(move |(x, y)| {
                PathElement::new(vec![(x, y), (x + length, y)], own.stroke_width(2 * FINE))
            });
        }
    }
    if named > 0 && below == 0 {
        chart
            .configure_series_labels()
            .position(if plot.square { SeriesLabelPosition::MiddleRight } else { emptiest })
            .label_font(("sans-serif", 12 * fine))
            .legend_area_size(20 * fine)
            .margin(4 * fine)
            .background_style(WHITE.mix(0.85))
            .border_style(BLACK.mix(0.2))
            .draw()?;
    }
    Ok(())
}

/// The corner with the fewest points; the lower right one where others have as few.
fn emptiest(points: impl Iterator<Item = [f64; 2]>, x: &Range<f64>, y: &Range<f64>) -> SeriesLabelPosition {
    let mut counts = [[0; 2]; 2];
    for [a, b] in points {
        counts[usize::from(2.0 * a > x.start + x.end)][usize::from(2.0 * b > y.start + y.end)] += 1;
    }
    let corners = [
        (counts[1][0], SeriesLabelPosition::LowerRight),
        (counts[0][0], SeriesLabelPosition::LowerLeft),
        (counts[0][1], SeriesLabelPosition::UpperLeft),
        (counts[1][1], SeriesLabelPosition::UpperRight),
    ];
    let [first, ..] = corners.clone();
    corners.into_iter().fold(first, |best, corner| if corner.0 < best.0 { corner } else { best }).1
}

/// Widens the narrower range until a unit is as long on both axes, the plot being `aspect` times as wide as high.
fn equalize(x: &mut Range<f64>, y: &mut Range<f64>, aspect: f64) {
    let widen = |r: &mut Range<f64>, length: f64| {
        let middle = 0.5 * (r.start + r.end);
        *r = middle - 0.5 * length..middle + 0.5 * length;
    };
    let [wide, high] = [x.end - x.start, y.end - y.start];
    if wide < aspect * high { widen(x, aspect * high) } else { widen(y, wide / aspect) }
}

/// A number of an axis.
fn tidy(v: f64) -> String {
    if v.abs() < 1e-12 {
        return "0".to_owned();
    }
    if v != 0.0 && !(1e-3..1e5).contains(&v.abs()) {
        return format!("{v:.1e}");
    }
    let text = format!("{v:.4}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}
