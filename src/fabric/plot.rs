//! A fabric's laws as an SVG picture: branches, envelope, the loop that the instrument would draw, and what of it is measured.

use crate::fabric::{
    file::{FabricFile, Origin, PROVENANCES, Provenance},
    instrument::{self, BENDING_RANGE, SHEAR_RANGE},
    law::Law,
    sheet::{short, with_unit},
    units::*,
};
use plotters::{coord::Shift, prelude::*};

type Failure = Box<dyn std::error::Error>;
type Canvas<'a> = DrawingArea<SVGBackend<'a>, Shift>;

const LOADING: RGBColor = RGBColor(0x1b, 0x5f, 0xaa);
const UNLOADING: RGBColor = RGBColor(0xc8, 0x6a, 0x10);
const STICK: RGBColor = RGBColor(0xc2, 0x18, 0x2b);
const BEYOND: RGBColor = RGBColor(0x8a, 0x8a, 0x8a);
const QUIET: RGBColor = RGBColor(0x55, 0x55, 0x55);
/// The plotting crate puts points on whole pixels: the picture is drawn so much larger and shown at its size.
const FINE: i32 = 4;
/// Width and height of a panel, of the head and of the foot [px].
const PANEL: [i32; 2] = [500, 492];
const HEAD: i32 = 92;
const FOOT: i32 = 84;

/// One law with its axes.
struct Panel<'a> {
    title: String,
    key: &'static str,
    law: &'a Law,
    /// Name, unit and SI size of one unit, of strain and force.
    x: (&'static str, &'static str, f64),
    y: (&'static str, &'static str, f64),
    /// The instrument's turns, in strain.
    turns: Vec<f64>,
    /// Strains shown, and those within the instrument's range.
    shown: [f64; 2],
    tested: [f64; 2],
    origin: String,
}

/// The picture as SVG text.
pub fn svg(file: &FabricFile) -> Result<String, Failure> {
    let panels = panels(file);
    let columns = panels.len().min(3);
    let rows = panels.len().div_ceil(columns);
    let [width, height] = [columns as i32 * PANEL[0], rows as i32 * PANEL[1] + HEAD + FOOT];
    let [fine_width, fine_height] = [width * FINE, height * FINE];
    let mut text = String::new();
    {
        let size = (fine_width as u32, fine_height as u32);
        let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
        root.fill(&WHITE)?;
        let (head, rest) = root.split_vertically(HEAD * FINE);
        let (body, foot) = rest.split_vertically(rows as i32 * PANEL[1] * FINE);
        draw_head(&head, file)?;
        for (panel, area) in panels.iter().zip(body.split_evenly((rows, columns))) {
            draw_panel(&area, panel, file)?;
        }
        draw_foot(&foot)?;
        root.present()?;
    }
    let drawn = format!("width=\"{fine_width}\" height=\"{fine_height}\"");
    Ok(text.replacen(&drawn, &format!("width=\"{width}\" height=\"{height}\""), 1))
}

/// A line of this width [px].
fn line(color: impl Color, width: i32) -> ShapeStyle {
    color.stroke_width((width * FINE) as u32)
}

fn panels(file: &FabricFile) -> Vec<Panel<'_>> {
    let fabric = &file.fabric;
    let origin = |key: &str| {
        let found = file.origins.iter().find(|o| o.0 == key || o.0 == key.replace("warp", "both"));
        found.map_or_else(String::new, |o| match &o.1 {
            Origin::Parameters { .. } => "curve made from parameters, not measured".to_owned(),
            curve => curve.words(),
        })
    };
    let twice = |key: &str| file.origins.iter().any(|o| o.0 == format!("{key}.weft"));
    let ways = |key: &str| {
        if twice(key) {
            vec![(0, "along the warp"), (1, "along the weft")]
        } else {
            vec![(0, "warp and weft")]
        }
    };
    let mut panels = Vec::new();
    for (n, way) in ways("tensile") {
        let law = &fabric.tensile[n];
        let key = ["tensile.warp", "tensile.weft"][n];
        let emt = law.knots().last().unwrap_or(0.0);
        panels.push(Panel {
            title: format!("Tension, {way}"),
            key: if twice("tensile") { key } else { "tensile.both" },
            law,
            x: ("tensile strain", "%", PERCENT),
            y: ("tension", "gf/cm", GF_PER_CM),
            turns: vec![emt, 0.0],
            shown: [-0.08 * emt, 1.08 * emt],
            tested: [0.0, emt],
            origin: origin(key),
        });
    }
    for (n, way) in ways("bending") {
        let key = ["bending.warp", "bending.weft"][n];
        panels.push(Panel {
            title: format!("Bending, {way}"),
            key: if twice("bending") { key } else { "bending.both" },
            law: &fabric.bending[n],
            x: ("curvature", "1/cm", PER_CM),
            y: ("moment per width", "gf.cm/cm", GF_CM_PER_CM),
            turns: vec![BENDING_RANGE, -BENDING_RANGE, 0.0],
            shown: [-1.1 * BENDING_RANGE, 1.1 * BENDING_RANGE],
            tested: [-BENDING_RANGE, BENDING_RANGE],
            origin: origin(key),
        });
    }
    panels.push(Panel {
        title: "Shear".to_owned(),
        key: "shear",
        law: &fabric.shear,
        x: ("shear angle", "deg", DEGREE),
        y: ("shear force", "gf/cm", GF_PER_CM),
        turns: vec![SHEAR_RANGE, -SHEAR_RANGE, 0.0],
        shown: [-1.1 * SHEAR_RANGE, 1.1 * SHEAR_RANGE],
        tested: [-SHEAR_RANGE, SHEAR_RANGE],
        origin: origin("shear"),
    });
    panels
}

fn text(area: &Canvas, words: &str, at: (i32, i32), size: f64, color: RGBColor) -> Result<(), Failure> {
    let style = ("sans-serif", size * f64::from(FINE)).into_font().color(&color);
    area.draw(&Text::new(words.to_owned(), (at.0 * FINE, at.1 * FINE), style))?;
    Ok(())
}

fn draw_head(area: &Canvas, file: &FabricFile) -> Result<(), Failure> {
    text(area, &file.title, (24, 14), 25.0, BLACK)?;
    let about: Vec<String> = ["areal_density", "thickness", "friction"]
        .iter()
        .filter_map(|key| file.quantities.iter().find(|q| q.key == *key))
        .map(|q| {
            format!("{} {} ({})", q.key.replace('_', " "), with_unit(q.value, q.unit), q.provenance.name())
        })
        .collect();
    text(area, &format!("{} · {}", file.name, about.join(" · ")), (24, 46), 15.0, QUIET)?;
    let source: String = file.source.chars().take(190).collect();
    let more = if source.len() < file.source.len() { " …" } else { "" };
    text(area, &format!("{source}{more}"), (24, 68), 12.5, QUIET)
}

/// Color of a provenance.
fn color(provenance: Provenance) -> RGBColor {
    match provenance {
        Provenance::Measured => RGBColor(0x1a, 0x7f, 0x37),
        Provenance::Digitised => RGBColor(0x0f, 0x76, 0x6e),
        Provenance::FromParameters => RGBColor(0x4b, 0x5b, 0x8c),
        Provenance::Borrowed => RGBColor(0xb4, 0x53, 0x09),
        Provenance::Substituted => RGBColor(0x86, 0x2e, 0x9c),
        Provenance::Chosen => STICK,
    }
}

/// Strains over `range`, dense enough to meet every bend of the law.
fn strains(law: &Law, [low, high]: [f64; 2]) -> Vec<f64> {
    let even = (0..=300).map(|n| low + (high - low) * f64::from(n) / 300.0);
    let mut strains: Vec<f64> = even.chain(law.knots().filter(|x| *x > low && *x < high)).collect();
    strains.sort_by(f64::total_cmp);
    strains
}

fn draw_panel(area: &Canvas, panel: &Panel, file: &FabricFile) -> Result<(), Failure> {
    let law = panel.law;
    let scaled = |x: f64, force: f64| (x / panel.x.2, force / panel.y.2);
    let branch = |range: [f64; 2], side: usize| -> Vec<(f64, f64)> {
        strains(law, range).into_iter().map(|x| scaled(x, law.envelope(x)[side])).collect()
    };
    let [bottom, top] = [0, 1].map(|end| law.envelope(panel.shown[end])[end] / panel.y.2);
    let margin = 0.04 * (top - bottom);
    let [left, right] = panel.shown.map(|x| x / panel.x.2);

    text(area, &panel.title, (24, 6), 18.0, BLACK)?;
    text(area, &panel.origin, (24, 29), 13.0, QUIET)?;
    let (_, below) = area.split_vertically(48 * FINE);
    let (plot, table) = below.split_vertically(344 * FINE);
    let mut chart = ChartBuilder::on(&plot)
        .margin_left(14 * FINE)
        .margin_right(18 * FINE)
        .margin_top(6 * FINE)
        .x_label_area_size(44 * FINE)
        .y_label_area_size(54 * FINE)
        .build_cartesian_2d(left..right, bottom - margin..top + margin)?;
    chart
        .configure_mesh()
        .x_desc(format!("{} [{}]", panel.x.0, panel.x.1))
        .y_desc(format!("{} [{}]", panel.y.0, panel.y.1))
        .axis_desc_style(("sans-serif", 13 * FINE))
        .label_style(("sans-serif", 12 * FINE))
        .axis_style(line(BLACK.mix(0.6), 1))
        .light_line_style(TRANSPARENT)
        .bold_line_style(line(BLACK.mix(0.08), 1))
        .set_all_tick_mark_size(4 * FINE)
        .x_label_formatter(&|v| label(*v))
        .y_label_formatter(&|v| label(*v))
        .x_labels(8)
        .y_labels(8)
        .draw()?;

    let outline = branch(panel.shown, 1).into_iter().chain(branch(panel.shown, 0).into_iter().rev());
    chart.draw_series([Polygon::new(outline.collect::<Vec<_>>(), LOADING.mix(0.10).filled())])?;
    let axis = line(BLACK.mix(0.35), 1);
    chart.draw_series([PathElement::new(vec![(left, 0.0), (right, 0.0)], axis)])?;
    chart.draw_series([PathElement::new(vec![(0.0, bottom - margin), (0.0, top + margin)], axis)])?;
    for beyond in [[panel.shown[0], panel.tested[0]], [panel.tested[1], panel.shown[1]]] {
        for side in [0, 1] {
            chart.draw_series(DashedLineSeries::new(
                branch(beyond, side),
                4 * FINE,
                4 * FINE,
                line(BEYOND, 2),
            ))?;
        }
    }
    chart.draw_series(LineSeries::new(branch(panel.tested, 0), line(UNLOADING, 2)))?;
    chart.draw_series(LineSeries::new(branch(panel.tested, 1), line(LOADING, 2)))?;

    let driven = instrument::drive(law, &instrument::path(&panel.turns, 2000));
    for stuck in stuck(law, &driven) {
        let path: Vec<(f64, f64)> = stuck.iter().map(|s| scaled(s[0], s[1])).collect();
        chart.draw_series(LineSeries::new(path, line(STICK, 3)))?;
    }

    let quantities = file.quantities.iter().filter(|q| q.key.starts_with(panel.key));
    for (n, q) in quantities.enumerate() {
        let name = q.key.rsplit('.').next().unwrap_or(&q.key).replace('_', " ");
        let [x, y] = [24 + 240 * (n % 2) as i32, 6 + 23 * (n / 2) as i32];
        let words = format!("{name} {}", with_unit(q.value, q.unit));
        text(&table, &words, (x, y), 14.0, BLACK)?;
        text(&table, q.provenance.name(), (x + 134, y), 13.0, color(q.provenance))?;
    }
    Ok(())
}

/// A number at an axis.
fn label(value: f64) -> String {
    short(if value.abs() < 1e-9 { 0.0 } else { value })
}

/// The parts of a driven path on which the law sticks: strictly inside the envelope.
fn stuck<'s>(law: &Law, driven: &'s [[f64; 2]]) -> Vec<&'s [[f64; 2]]> {
    let inside = |s: &[f64; 2]| {
        let [lower, upper] = law.envelope(s[0]);
        let slack = 1e-6 * (upper - lower);
        upper - lower > 1e-9 && s[1] > lower + slack && s[1] < upper - slack
    };
    driven.chunk_by(|a, b| inside(a) == inside(b)).filter(|part| part.len() > 2 && inside(&part[0])).collect()
}

fn draw_foot(area: &Canvas) -> Result<(), Failure> {
    let lines = [
        ("loading branch", LOADING, 2, 34),
        ("unloading branch", UNLOADING, 2, 34),
        ("stick after a turn of the instrument: chosen", STICK, 3, 34),
        ("beyond the instrument: chosen", BEYOND, 2, 6),
    ];
    let at = |x: i32, y: i32| (x * FINE, y * FINE);
    area.draw(&Rectangle::new([at(24, 8), at(58, 24)], LOADING.mix(0.12).filled()))?;
    text(area, "envelope", (66, 8), 14.0, QUIET)?;
    let mut x = 160;
    for (words, color, width, dash) in lines {
        for start in (0..34).step_by(2 * dash) {
            let ends = [start as i32, (start + dash).min(34) as i32].map(|end| at(x + end, 17));
            area.draw(&PathElement::new(ends.to_vec(), line(color, width)))?;
        }
        text(area, words, (x + 42, 8), 14.0, QUIET)?;
        x += 76 + 7 * words.len() as i32;
    }
    text(area, "the numbers are", (24, 44), 14.0, QUIET)?;
    let mut x = 150;
    for (name, provenance) in PROVENANCES {
        text(area, name, (x, 44), 14.0, color(provenance))?;
        x += 28 + 8 * name.len() as i32;
    }
    Ok(())
}
