//! Scenes: what hangs, lies or flies where, as TOML files and as JSON from clients; made into a `model::Setup`.
//!
//! A scene holds numbers at their edges' units (the unit is in the name); it knows no forces and takes no step.

mod check;
mod start;

use crate::{
    fabric::{
        Library,
        document::{Fault, Faults, Problem, line_of_key},
    },
    grid::Site,
    model::Setup,
    obstacle::{Obstacle, Polyhedron, Shape, Unfit},
};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// One fault of a scene: field, value got, allowed range; file and line where it came from a file.
pub type SceneError = Fault;

/// A scene. Every field has a default; unknown fields are refused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub struct Scene {
    /// Name shown to people, 1 to 64 characters.
    pub name: String,
    /// Name of the fabric, as in `kes_data/NAME.toml`.
    pub fabric: String,
    /// Particles along warp and weft, `[I, J]`: 2 to 400 each, 100,000 together.
    pub particles: [usize; 2],
    /// Rest lengths of the sheet along warp and weft [m], 0.01 to 10 each.
    pub size_m: [f64; 2],
    /// Where the sheet starts, and in which shape.
    pub placement: Placement,
    /// What is pinned at the start.
    pub pins: Vec<Pin>,
    /// Particle given to the hand: pinned until somebody grabs it. None: a client has to grab one.
    pub hand: Option<Grip>,
    /// Rigid obstacles, at most 64.
    pub obstacles: Vec<SceneObstacle>,
    /// Gravity along −z [m/s²], 0 to 100.
    pub gravity_m_per_s2: f64,
    /// Air drag per area [kg/(m² s)], 0 to 100. Chosen: enough for a falling sheet to come to rest.
    pub drag_kg_per_m2_s: f64,
    /// Ticks per second, 1 to 1000. None: as many as can be kept, 50 to 1000.
    pub tick_hz: Option<f64>,
}

impl Default for Scene {
    /// One square sheet of the paper's size, pinned nowhere, alone in the air.
    fn default() -> Scene {
        Scene {
            name: "sheet".to_owned(),
            fabric: "denim-a".to_owned(),
            particles: [39, 39],
            size_m: [0.3, 0.3],
            placement: Placement::default(),
            pins: Vec::new(),
            hand: None,
            obstacles: Vec::new(),
            gravity_m_per_s2: 9.81,
            drag_kg_per_m2_s: 0.5,
            tick_hz: None,
        }
    }
}

/// Where the sheet starts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub struct Placement {
    /// Position of particle (0, 0) [m], within 10 m of the origin.
    pub origin_m: [f64; 3],
    /// Direction of growing i; any length, at right angles to `weft_axis`.
    pub warp_axis: [f64; 3],
    /// Direction of growing j; any length.
    pub weft_axis: [f64; 3],
    /// Part of their length by which the ends of every weft line come nearer, 0 to 0.5: each line is bent to an arc
    /// towards warp × weft, no edge is stretched.
    pub bow: f64,
    /// Largest deviation from the smooth start shape along warp × weft [m], 0 to 0.01. It decides which way a flat sheet
    /// folds, the same way each time.
    pub imperfection_m: f64,
    /// Number of the imperfection's shape.
    pub seed: u64,
}

impl Default for Placement {
    fn default() -> Placement {
        Placement {
            origin_m: [-0.15, -0.15, 0.3],
            warp_axis: [1.0, 0.0, 0.0],
            weft_axis: [0.0, 1.0, 0.0],
            bow: 0.0,
            imperfection_m: 1e-5,
            seed: 1,
        }
    }
}

/// A corner of the sheet: i then j, 0 at the start of the direction, I or J at its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub enum Corner {
    /// i = 0, j = 0.
    #[serde(rename = "00")]
    StartStart,
    /// i = I − 1, j = 0.
    #[serde(rename = "I0")]
    EndStart,
    /// i = 0, j = J − 1.
    #[serde(rename = "0J")]
    StartEnd,
    /// i = I − 1, j = J − 1.
    #[serde(rename = "IJ")]
    EndEnd,
}

/// An edge of the sheet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub enum Edge {
    /// All particles with i = 0.
    #[serde(rename = "i=0")]
    WarpStart,
    /// All particles with i = I − 1.
    #[serde(rename = "i=I")]
    WarpEnd,
    /// All particles with j = 0.
    #[serde(rename = "j=0")]
    WeftStart,
    /// All particles with j = J − 1.
    #[serde(rename = "j=J")]
    WeftEnd,
}

/// What is pinned.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub enum Pin {
    /// One corner: "00", "I0", "0J" or "IJ".
    Corner(Corner),
    /// One particle, `[i, j]`.
    Particle([usize; 2]),
    /// All particles of an edge, free to turn about it: "i=0", "i=I", "j=0" or "j=J".
    Edge(Edge),
    /// An edge and the row beside it: it cannot turn.
    Clamp(Edge),
}

/// What the hand holds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub enum Grip {
    /// One corner: "00", "I0", "0J" or "IJ".
    Corner(Corner),
    /// One particle, `[i, j]`.
    Particle([usize; 2]),
}

/// A rigid obstacle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub struct SceneObstacle {
    /// Name, unique in the scene, 1 to 64 characters.
    pub name: String,
    /// Shape and size.
    pub shape: SceneShape,
    /// Position of the center; of any point of a plane [m].
    #[serde(default)]
    pub position_m: [f64; 3],
    /// Rotation; none by default.
    #[serde(default)]
    pub rotation: Rotation,
    /// Coulomb friction coefficient against this fabric, 0 to 10; the fabric's own by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub friction: Option<f64>,
}

/// Shape of an obstacle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub enum SceneShape {
    /// A box with these side lengths [m], 0.001 to 10.
    Box { size_m: [f64; 3] },
    /// A ball of this radius [m], 0.001 to 10.
    Sphere { radius_m: f64 },
    /// All points nearer than a radius to a segment of this length along the own z axis [m], 0.001 to 10 each.
    Capsule { length_m: f64, radius_m: f64 },
    /// The half space below the plane z = 0 of its own frame.
    Plane {},
    /// The convex hull of 4 to 1000 points [m].
    Hull { points_m: Vec<[f64; 3]> },
    /// A closed surface of 4 to 20000 triangles, indices into `points_m` [m], counter-clockwise seen from outside.
    Mesh { points_m: Vec<[f64; 3]>, triangles: Vec<[u32; 3]> },
}

impl SceneShape {
    /// The shape in SI, or why it is none.
    fn shape(&self) -> Result<Shape, Unfit> {
        let points = |points: &[[f64; 3]]| points.iter().map(|p| Vector3::from(*p)).collect::<Vec<_>>();
        Ok(match self {
            SceneShape::Box { size_m } => Shape::Cuboid { half: size_m.map(|s| 0.5 * s) },
            SceneShape::Sphere { radius_m } => Shape::Sphere { radius: *radius_m },
            SceneShape::Capsule { length_m, radius_m } => {
                Shape::Capsule { half: 0.5 * length_m, radius: *radius_m }
            }
            SceneShape::Plane {} => Shape::Plane,
            SceneShape::Hull { points_m } => {
                Shape::Polyhedron(Arc::new(Polyhedron::hull(&points(points_m))?))
            }
            SceneShape::Mesh { points_m, triangles } => {
                Shape::Polyhedron(Arc::new(Polyhedron::mesh(points(points_m), triangles.clone())?))
            }
        })
    }
}

/// A rotation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub enum Rotation {
    /// About an axis of any length by an angle in degrees.
    AxisAngle {
        /// Axis.
        axis: [f64; 3],
        /// Angle [degrees].
        angle_deg: f64,
    },
    /// A quaternion `[x, y, z, w]` of any length but zero.
    Quaternion([f64; 4]),
}

impl Default for Rotation {
    fn default() -> Rotation {
        Rotation::Quaternion([0.0, 0.0, 0.0, 1.0])
    }
}

impl Rotation {
    fn unit(&self) -> UnitQuaternion<f64> {
        match *self {
            Rotation::AxisAngle { axis, angle_deg } => {
                let axis = nalgebra::Unit::new_normalize(Vector3::from(axis));
                UnitQuaternion::from_axis_angle(&axis, angle_deg.to_radians())
            }
            Rotation::Quaternion([x, y, z, w]) => {
                UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
            }
        }
    }
}

impl SceneObstacle {
    /// The obstacle in SI; its shape must be valid.
    fn obstacle(&self) -> Result<Obstacle, Unfit> {
        let pose = Isometry3::from_parts(Translation3::from(self.position_m), self.rotation.unit());
        Ok(Obstacle { name: self.name.clone(), shape: self.shape.shape()?, pose, friction: self.friction })
    }
}

macro_rules! built_in {
    ($($name:literal),* $(,)?) => {
        &[$(($name, include_str!(concat!("../scenes/", $name, ".toml")))),*]
    };
}

/// The built-in scenes; the first is the default.
const BUILT_IN: &[(&str, &str)] = built_in!["drape", "hang", "flag"];

impl Scene {
    /// Names of the built-in scenes; the first is the default.
    pub fn names() -> Vec<&'static str> {
        BUILT_IN.iter().map(|s| s.0).collect()
    }

    /// A built-in scene.
    pub fn built_in(name: &str) -> Option<Scene> {
        let (name, text) = BUILT_IN.iter().find(|s| s.0 == name)?;
        Some(Scene::from_toml(&format!("{name}.toml"), text).expect("built-in scenes are tested"))
    }

    /// A built-in scene, or the sentence that says which there are.
    pub fn named(name: &str) -> Result<Scene, String> {
        let allowed = || format!("scene is {name:?}, allowed: {}", Scene::names().join(", "));
        Scene::built_in(name).ok_or_else(allowed)
    }

    /// Reads a scene from TOML; `file` names it in faults. Nothing is checked yet but the form.
    pub fn from_toml(file: &str, text: &str) -> Result<Scene, Faults> {
        let whole = |e: toml::de::Error| {
            let line = e.span().map_or(0, |s| crate::fabric::document::line_at(text, s.start));
            let problem = Problem::Unreadable(e.message().replace('\n', "; "));
            Faults(vec![Fault { file: file.to_owned(), line, key: String::new(), problem }])
        };
        let table: toml::Table = toml::from_str(text).map_err(whole)?;
        // Field by field, so that every field of the wrong form is told, not only the first.
        let mut faults = Vec::new();
        let mut check = |key: String, part: toml::Table| {
            if let Err(e) = part.try_into::<Scene>() {
                let line = line_of_key(text, &key);
                let problem = Problem::Unreadable(e.message().replace('\n', "; "));
                faults.push(Fault { file: file.to_owned(), line, key, problem });
            }
        };
        for (key, value) in &table {
            let alone = |value: toml::Value| toml::Table::from_iter([(key.clone(), value)]);
            match value {
                toml::Value::Array(items) if key == "obstacles" || key == "pins" => {
                    for (n, item) in items.iter().enumerate() {
                        check(format!("{key}[{n}]"), alone(toml::Value::Array(vec![item.clone()])));
                    }
                }
                _ => check(key.clone(), alone(value.clone())),
            }
        }
        if faults.is_empty() { toml::from_str(text).map_err(whole) } else { Err(Faults(faults)) }
    }

    /// Reads a TOML file and checks everything, all faults at once, with their lines.
    pub fn read(path: &std::path::Path, library: &Library) -> Result<Scene, Faults> {
        let file = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|e| {
            let problem = Problem::Unreadable(e.to_string());
            Faults(vec![Fault { file: file.clone(), line: 0, key: String::new(), problem }])
        })?;
        let scene = Scene::from_toml(&file, &text)?;
        scene.validate_with(library).map_err(|faults| {
            let place = |f: Fault| Fault { file: file.clone(), line: line_of_key(&text, &f.key), ..f };
            Faults(faults.into_iter().map(place).collect())
        })?;
        Ok(scene)
    }

    /// Checks everything against the built-in fabrics; all faults at once.
    pub fn validate(&self) -> Result<(), Vec<SceneError>> {
        self.validate_with(&Library::default())
    }

    /// Checks everything; all faults at once.
    pub fn validate_with(&self, library: &Library) -> Result<(), Vec<SceneError>> {
        let faults = check::faults(self, library);
        if faults.is_empty() { Ok(()) } else { Err(faults) }
    }

    /// What a world is made from, with a built-in fabric.
    pub fn setup(&self) -> Result<Setup, Vec<SceneError>> {
        self.setup_with(&Library::default())
    }

    /// What a world is made from.
    pub fn setup_with(&self, library: &Library) -> Result<Setup, Vec<SceneError>> {
        self.validate_with(library)?;
        let fabric = library.load(&self.fabric).map_err(|e| vec![check::fault("fabric", e.to_string())])?;
        let mut pins: Vec<Site> = self.pins.iter().flat_map(|pin| self.sites(*pin)).collect();
        pins.sort_unstable();
        pins.dedup();
        Ok(Setup {
            fabric: Arc::new(fabric),
            particles: self.particles,
            size: self.size_m,
            positions: start::positions(self),
            pins,
            hand: self.hand.map(|grip| self.grip(grip)),
            obstacles: self.obstacles.iter().filter_map(|o| o.obstacle().ok()).collect(),
            gravity: self.gravity_m_per_s2,
            drag: self.drag_kg_per_m2_s,
            cut: None,
            particles_only: false,
        })
    }

    /// Lattice place of a corner.
    fn corner(&self, corner: Corner) -> Site {
        let [i, j] = self.particles.map(|n| n - 1);
        match corner {
            Corner::StartStart => [0, 0],
            Corner::EndStart => [i, 0],
            Corner::StartEnd => [0, j],
            Corner::EndEnd => [i, j],
        }
    }

    fn grip(&self, grip: Grip) -> Site {
        match grip {
            Grip::Corner(corner) => self.corner(corner),
            Grip::Particle(site) => site,
        }
    }

    /// Lattice places of a pin.
    fn sites(&self, pin: Pin) -> Vec<Site> {
        match pin {
            Pin::Corner(corner) => vec![self.corner(corner)],
            Pin::Particle(site) => vec![site],
            Pin::Edge(edge) => self.row(edge, 0),
            Pin::Clamp(edge) => [self.row(edge, 0), self.row(edge, 1)].concat(),
        }
    }

    /// The row of particles `depth` rows from an edge.
    fn row(&self, edge: Edge, depth: usize) -> Vec<Site> {
        let [i, j] = self.particles;
        match edge {
            Edge::WarpStart => (0..j).map(|n| [depth, n]).collect(),
            Edge::WarpEnd => (0..j).map(|n| [i - 1 - depth, n]).collect(),
            Edge::WeftStart => (0..i).map(|n| [n, depth]).collect(),
            Edge::WeftEnd => (0..i).map(|n| [n, j - 1 - depth]).collect(),
        }
    }
}
