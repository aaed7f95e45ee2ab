//! What a step leaves in a recording, and how a batch of steps becomes rerun chunks.
//!
//! Scalars go in columns, one chunk per series and batch; mesh frames carry positions and normals, the triangles being static, and
//! the poses of the obstacles, their shapes being static.

use crate::{grid::Grid, math::Vec3, world::Report};
use rerun::{
    AsComponents, Color, EntityPath, Mesh3D, Quaternion, Scalars, TextLog, TextLogLevel, TimeColumn,
    TimePoint, Timeline, Transform3D,
    log::{Chunk, ChunkId, ChunkResult, RowId},
};
use std::sync::Arc;

/// Length of the force arrow per force [m/N].
pub(super) const ARROW_SCALE: f64 = 0.15;
/// Longest force arrow [m]: a jerk of many newtons would else carry the viewer's camera far from the cloth.
pub(super) const ARROW_LIMIT: f64 = 0.5;

/// Colours of the cloth by level, the finest first; the last is that of all coarser ones.
pub(super) const LEVEL_COLORS: [u32; 3] = [0x6F_8F_C8_FF, 0x72_B7_B2_FF, 0xF5_C5_42_FF];

/// A scalar over time.
pub(super) struct Series {
    pub path: &'static str,
    /// Name with its unit, as the plots show it.
    pub name: &'static str,
    pub color: u32,
    /// The value after a step that took so many milliseconds; not finite where there is none.
    value: fn(&Report, f64) -> f64,
}

const fn series(
    path: &'static str,
    name: &'static str,
    color: u32,
    value: fn(&Report, f64) -> f64,
) -> Series {
    Series { path, name, color, value }
}

fn force(report: &Report, part: fn(&Vec3) -> f64) -> f64 {
    report.hand.map_or(f64::NAN, |hand| part(&hand.force))
}

/// Every scalar that is recorded.
pub(super) const SERIES: [Series; 16] = [
    series("force/x", "Fx [N]", 0xE4_57_56_FF, |r, _| force(r, |f| f.x)),
    series("force/y", "Fy [N]", 0x54_A2_4B_FF, |r, _| force(r, |f| f.y)),
    series("force/z", "Fz [N]", 0x4C_78_A8_FF, |r, _| force(r, |f| f.z)),
    series("force/magnitude", "|F| [N]", 0xF5_C5_42_FF, |r, _| force(r, |f| f.norm())),
    series("cost/total", "total", 0xE8_E8_E8_FF, |r, _| r.cost.total()),
    series("cost/newton", "newton", 0xF5_85_18_FF, |r, _| r.cost.newton),
    series("cost/stretch", "stretch", 0x72_B7_B2_FF, |r, _| r.cost.stretch),
    series("cost/bend", "bend", 0xB2_79_A2_FF, |r, _| r.cost.bend),
    series("cost/shear", "shear", 0x9D_75_5D_FF, |r, _| r.cost.shear),
    series("residual", "residual [N]", 0xF5_85_18_FF, |r, _| r.residual),
    series("particles_active", "active particles", 0x72_B7_B2_FF, |r, _| r.particles_active as f64),
    series("tick_ms", "tick [ms]", 0x54_A2_4B_FF, |_, tick_ms| tick_ms),
    series("solves", "solves per step", 0xB2_79_A2_FF, |r, _| f64::from(r.solves)),
    series("energy", "stored [J]", 0x4C_78_A8_FF, |r, _| r.energy),
    series("dissipated", "dissipated [J]", 0xE4_57_56_FF, |r, _| r.dissipated),
    series("penetration", "penetration [m]", 0xE4_57_56_FF, |r, _| r.max_penetration),
];

/// A point on both timelines.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Moment {
    pub step: u64,
    /// Simulated time [s].
    pub time: f64,
}

impl Moment {
    pub fn of(report: &Report) -> Moment {
        Moment { step: report.step, time: report.time }
    }

    fn point(&self) -> TimePoint {
        TimePoint::default()
            .with(Timeline::new_duration("time"), (self.time * 1e9).round() as i64)
            .with(Timeline::new_sequence("step"), self.step as i64)
    }
}

/// The scalars and the hand of one step.
#[derive(Debug)]
pub(super) struct Row {
    at: Moment,
    values: [f64; SERIES.len()],
    /// Position [m] and force arrow [m] of the hand.
    hand: Option<([f32; 3], [f32; 3])>,
}

impl Row {
    pub fn of(report: &Report, tick_ms: f64) -> Row {
        Row {
            at: Moment::of(report),
            values: std::array::from_fn(|k| (SERIES[k].value)(report, tick_ms)),
            hand: report.hand.map(|hand| {
                (single(&hand.position), single(&(hand.force * ARROW_SCALE).cap_magnitude(ARROW_LIMIT)))
            }),
        }
    }
}

/// The mesh at one step.
#[derive(Debug)]
pub(super) struct Frame {
    pub at: Moment,
    /// Positions [m], one per particle.
    pub positions: Vec<[f32; 3]>,
    /// Poses of the obstacles, world from obstacle: position [m] and quaternion x y z w.
    pub poses: Vec<([f32; 3], [f32; 4])>,
    /// The mesh, where it is no longer the one of the recording's start.
    pub remeshed: Option<Arc<Remeshed>>,
}

/// A mesh that adapted.
#[derive(Debug)]
pub(super) struct Remeshed {
    triangles: Vec<[u32; 3]>,
    /// One per particle, by its level.
    colors: Vec<Color>,
}

impl Remeshed {
    pub fn of(grid: &Grid) -> Remeshed {
        let coarsest = LEVEL_COLORS.len() - 1;
        let color = |n: usize| Color::from_u32(LEVEL_COLORS[usize::from(grid.level(n)).min(coarsest)]);
        Remeshed { triangles: grid.triangles(), colors: (0..grid.particles()).map(color).collect() }
    }
}

/// A line of text.
#[derive(Debug)]
pub(super) struct Event {
    pub at: Moment,
    pub text: String,
}

/// What was recorded since the last write.
#[derive(Debug, Default)]
pub(super) struct Batch {
    pub rows: Vec<Row>,
    pub frames: Vec<Frame>,
    pub events: Vec<Event>,
}

impl Batch {
    /// Whether the batch is as large as one write should be.
    pub fn full(&self) -> bool {
        self.rows.len() >= 4096 || self.frames.len() >= 32
    }

    /// The batch as chunks; `triangles` is the mesh of the recording's start, `obstacles` are the obstacles' paths.
    pub fn chunks(&self, triangles: &[[u32; 3]], obstacles: &[EntityPath]) -> ChunkResult<Vec<Chunk>> {
        let mut chunks = Vec::new();
        // Mesh first: its latest frame is what a reader of a cut file misses most.
        for (path, remeshed) in [("cloth", false), ("cloth/remeshed", true)] {
            let frames = self.frames.iter().filter(|f| f.remeshed.is_some() == remeshed);
            chunks.extend(rows_chunk(path, frames.map(|f| (f.at, mesh_frame(f, triangles))))?);
        }
        if self.frames.iter().any(|f| f.remeshed.is_some()) {
            let clear = self.frames.iter().filter(|f| f.remeshed.is_some()).take(1);
            chunks.extend(rows_chunk("cloth", clear.map(|f| (f.at, rerun::Clear::flat())))?);
        }
        for (k, path) in obstacles.iter().enumerate() {
            let placed = |f: &Frame| {
                let (position, turn) = f.poses[k];
                Transform3D::from_translation_rotation(position, Quaternion::from_xyzw(turn))
            };
            chunks.extend(rows_chunk(path.clone(), self.frames.iter().map(|f| (f.at, placed(f))))?);
        }
        for (k, series) in SERIES.iter().enumerate() {
            let rows = || self.rows.iter().filter(|r| r.values[k].is_finite());
            let columns = Scalars::new(rows().map(|r| r.values[k])).columns_of_unit_batches();
            chunks.extend(columns_chunk(series.path, rows().map(|r| r.at), columns)?);
        }
        let touched = || self.rows.iter().filter_map(|r| r.hand.map(|hand| (r.at, hand)));
        let points = rerun::Points3D::update_fields().with_positions(touched().map(|(_, (p, _))| p));
        chunks.extend(columns_chunk("hand", touched().map(|t| t.0), points.columns_of_unit_batches())?);
        let arrows = rerun::Arrows3D::update_fields()
            .with_origins(touched().map(|(_, (p, _))| p))
            .with_vectors(touched().map(|(_, (_, f))| f));
        chunks.extend(columns_chunk("hand/force", touched().map(|t| t.0), arrows.columns_of_unit_batches())?);
        let events =
            self.events.iter().map(|e| (e.at, TextLog::new(e.text.as_str()).with_level(TextLogLevel::INFO)));
        chunks.extend(rows_chunk("events", events)?);
        Ok(chunks)
    }
}

/// A chunk of one archetype per moment; none when there is no moment.
fn rows_chunk<A: AsComponents>(
    path: impl Into<EntityPath>,
    rows: impl Iterator<Item = (Moment, A)>,
) -> ChunkResult<Option<Chunk>> {
    let mut builder = Chunk::builder(path.into());
    let mut any = false;
    for (at, archetype) in rows {
        builder = builder.with_archetype(RowId::new(), at.point(), &archetype);
        any = true;
    }
    if any { builder.build().map(Some) } else { Ok(None) }
}

/// A chunk of columns over moments; none when there is no moment.
fn columns_chunk<E: std::fmt::Debug>(
    path: &str,
    at: impl Iterator<Item = Moment> + Clone,
    columns: Result<impl Iterator<Item = rerun::SerializedComponentColumn>, E>,
) -> ChunkResult<Option<Chunk>> {
    if at.clone().next().is_none() {
        return Ok(None);
    }
    let time = TimeColumn::new_duration_nanos("time", at.clone().map(|m| (m.time * 1e9).round() as i64));
    let step = TimeColumn::new_sequence("step", at.map(|m| m.step as i64));
    let timelines = [time, step].into_iter().map(|column| (*column.timeline().name(), column)).collect();
    // Columns of plain numbers serialize; rerun's signature allows for types that do not.
    let columns = columns.expect("plain numbers serialize").collect();
    Chunk::from_auto_row_ids(ChunkId::new(), path.into(), timelines, columns).map(Some)
}

/// Positions and normals of a frame; its triangles, and colours by level, too when they are not the static ones.
fn mesh_frame(frame: &Frame, triangles: &[[u32; 3]]) -> Mesh3D {
    let triangles = frame.remeshed.as_deref().map_or(triangles, |mesh| &mesh.triangles);
    let shape = Mesh3D::update_fields()
        .with_vertex_positions(frame.positions.iter().copied())
        .with_vertex_normals(normals(&frame.positions, triangles));
    let Some(mesh) = &frame.remeshed else { return shape };
    shape.with_triangle_indices(triangles.iter().copied()).with_vertex_colors(mesh.colors.iter().copied())
}

/// Normals at the particles: sums of the adjoining triangles' area vectors, normalized.
fn normals(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Vec<[f32; 3]> {
    type V = nalgebra::Vector3<f32>;
    let at = |i: u32| V::from(positions[i as usize]);
    let mut sums = vec![V::zeros(); positions.len()];
    for &[a, b, c] in triangles {
        let area = (at(b) - at(a)).cross(&(at(c) - at(a)));
        for i in [a, b, c] {
            sums[i as usize] += area;
        }
    }
    sums.into_iter().map(|n| n.try_normalize(0.0).unwrap_or_else(V::z).into()).collect()
}

/// A vector in single precision, as rerun keeps it.
pub(super) fn single(v: &Vec3) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}
