//! What a recording says once: the mesh, the obstacles, the names of the plots, and how the viewer lays it all out.
//!
//! The messages are made beforehand in memory, so that every file of a session can begin with them.

use super::frames::{ARROW_LIMIT, ARROW_SCALE, LEVEL_COLORS, SERIES, single};
use crate::{
    obstacle::{Obstacle, Shape},
    world::World,
};
use rerun::{
    Arrows3D, Boxes3D, Capsules3D, Color, Ellipsoids3D, EntityPath, FillMode, MediaType, Mesh3D, Points3D,
    Radius, RecordingStream, RecordingStreamBuilder, RecordingStreamResult, Rgba32, SeriesLines,
    TextDocument, ViewCoordinates,
    blueprint::components::{PanelState, PlayState},
    blueprint::{
        Blueprint, BlueprintPanel, ContainerLike, Horizontal, SelectionPanel, Spatial3DView, Tabs,
        TextDocumentView, TextLogView, TimePanel, TimeSeriesView, Vertical,
    },
    log::LogMsg,
};

/// Viewers keep their layout per application: this name never changes.
const APPLICATION: &str = "kesi";

const OBSTACLE: u32 = 0x8C_86_7C_FF;
const HAND: u32 = 0xF5_C5_42_FF;

/// The messages every file of a session's recording begins with.
pub(super) fn preamble(session: &str, world: &World) -> RecordingStreamResult<Vec<LogMsg>> {
    let fabric = &world.setup().fabric.name;
    let (stream, memory) = RecordingStreamBuilder::new(APPLICATION)
        .enabled(true)
        .recording_name(format!("{session}: {fabric}"))
        .with_blueprint(blueprint())
        .memory()?;
    stream.log_static("/", &ViewCoordinates::RIGHT_HAND_Z_UP())?;
    stream.log_static(
        "scene",
        &TextDocument::new(description(session, world)).with_media_type(MediaType::MARKDOWN),
    )?;
    stream.log_static(
        "cloth",
        &Mesh3D::update_fields()
            .with_triangle_indices(world.grid().triangles())
            .with_albedo_factor(Rgba32(LEVEL_COLORS[0])),
    )?;
    for obstacle in &world.setup().obstacles {
        log_shape(&stream, obstacle, world)?;
    }
    let radius = Radius::new_scene_units(0.004);
    stream.log_static(
        "hand",
        &Points3D::update_fields().with_colors([Color::from_u32(HAND)]).with_radii([radius]),
    )?;
    let radius = Radius::new_scene_units(0.0015);
    stream.log_static(
        "hand/force",
        &Arrows3D::update_fields().with_colors([Color::from_u32(HAND)]).with_radii([radius]),
    )?;
    for series in &SERIES {
        let lines = SeriesLines::new().with_names([series.name]).with_colors([Color::from_u32(series.color)]);
        stream.log_static(series.path, &lines.with_widths([1.5]))?;
    }
    Ok(memory.take())
}

/// Where the obstacles are, in their order.
pub(super) fn obstacle_paths(world: &World) -> Vec<EntityPath> {
    world.setup().obstacles.iter().map(path_of).collect()
}

fn path_of(obstacle: &Obstacle) -> EntityPath {
    EntityPath::from(vec!["obstacles".into(), obstacle.name.as_str().into()])
}

/// The shape in its own frame; frames say where that is.
fn log_shape(stream: &RecordingStream, obstacle: &Obstacle, world: &World) -> RecordingStreamResult<()> {
    let path = path_of(obstacle);
    let center = [0.0_f32; 3];
    match &obstacle.shape {
        Shape::Cuboid { half } => stream.log_static(
            path,
            &Boxes3D::from_centers_and_half_sizes([center], [half.map(|h| h as f32)])
                .with_fill_mode(FillMode::Solid)
                .with_colors([Color::from_u32(OBSTACLE)]),
        ),
        Shape::Sphere { radius } => stream.log_static(
            path,
            &Ellipsoids3D::from_centers_and_radii([center], [*radius as f32])
                .with_fill_mode(FillMode::Solid)
                .with_colors([Color::from_u32(OBSTACLE)]),
        ),
        // rerun's capsules begin at the origin.
        Shape::Capsule { half, radius } => stream.log_static(
            path,
            &Capsules3D::from_lengths_and_radii([2.0 * *half as f32], [*radius as f32])
                .with_translations([[0.0, 0.0, -*half as f32]])
                .with_fill_mode(FillMode::Solid)
                .with_colors([Color::from_u32(OBSTACLE)]),
        ),
        Shape::Polyhedron(solid) => stream.log_static(
            path,
            &Mesh3D::new(solid.points().iter().map(single))
                .with_triangle_indices(solid.faces().iter().copied())
                .with_albedo_factor(Rgba32(OBSTACLE)),
        ),
        // A plane has no end: shown is a square of three times the sheet's longer side.
        Shape::Plane => {
            let reach = 1.5 * world.setup().size[0].max(world.setup().size[1]) as f32;
            let corners: [[f32; 3]; 4] = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
                .map(|[x, y]| [x * reach, y * reach, 0.0]);
            stream.log_static(
                path,
                &Mesh3D::new(corners)
                    .with_triangle_indices([[0, 1, 2], [0, 2, 3]])
                    .with_vertex_normals([[0.0, 0.0, 1.0]; 4])
                    .with_albedo_factor(Rgba32(OBSTACLE)),
            )
        }
    }
}

/// The scene in words, for the viewer's text view.
fn description(session: &str, world: &World) -> String {
    let setup = world.setup();
    let [i, j] = setup.particles;
    let mut text = format!(
        "**{session}** · kesi {version}\n\n- fabric {fabric}, {density} kg/m²\n- sheet {warp} m × {weft} m, {i} × {j} particles\n\
         - gravity {gravity} m/s², air drag {drag} kg/(m² s)\n- force arrow: {ARROW_SCALE} m per newton, at most {ARROW_LIMIT} m\n",
        version = env!("CARGO_PKG_VERSION"),
        fabric = setup.fabric.name,
        density = setup.fabric.areal_density,
        warp = setup.size[0],
        weft = setup.size[1],
        gravity = setup.gravity,
        drag = setup.drag,
    );
    for obstacle in &setup.obstacles {
        text += &format!("- {}: {:?}\n", obstacle.name, obstacle.shape);
    }
    text
}

/// The cloth large on the left, what it did on the right; follows the newest data, in a file the end.
fn blueprint() -> Blueprint {
    let cloth = Spatial3DView::new("Cloth").with_origin("/").with_contents([
        "/cloth/**",
        "/obstacles/**",
        "/hand/**",
    ]);
    let plot = |name: &str, paths: &[&str]| -> ContainerLike {
        TimeSeriesView::new(name).with_contents(paths.iter().copied()).into()
    };
    let left = Vertical::new([
        cloth.into(),
        Horizontal::new([
            TextLogView::new("Events").with_origin("/events").into(),
            TextDocumentView::new("Scene").with_origin("/scene").into(),
        ])
        .into(),
    ])
    .with_row_shares(vec![4.0, 1.0]);
    let right = Vertical::new([
        plot("Force on the hand [N]", &["/force/**"]),
        plot("Cost [1]", &["/cost/**"]),
        plot("Tick [ms]", &["/tick_ms"]),
        Tabs::new([
            plot("Residual [N]", &["/residual"]),
            plot("Active particles", &["/particles_active"]),
            plot("Energy [J]", &["/energy", "/dissipated"]),
            plot("Penetration [m]", &["/penetration"]),
            plot("Solves", &["/solves"]),
        ])
        .into(),
    ]);
    Blueprint::new(Horizontal::new([left.into(), right.into()]).with_column_shares(vec![3.0, 2.0]))
        .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
        .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
        .with_time_panel(
            TimePanel::new()
                .with_state(PanelState::Collapsed)
                .with_timeline("time")
                .with_play_state(PlayState::Following),
        )
}
