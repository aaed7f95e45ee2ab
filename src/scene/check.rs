//! What a scene may be: every field's range, all faults at once.

use crate::{
    fabric::{
        FabricError, Library,
        document::{Fault, Problem},
    },
    math::Vec3,
    scene::{Grip, Pin, Rotation, Scene, SceneObstacle, SceneShape, start},
};

/// A fault of a field that no range describes.
pub fn fault(key: &str, problem: String) -> Fault {
    Fault { file: "scene".to_owned(), line: 0, key: key.to_owned(), problem: Problem::Contradiction(problem) }
}

/// All faults of a scene.
pub fn faults(scene: &Scene, library: &Library) -> Vec<Fault> {
    let mut check = Check(Vec::new());
    check.name("name", &scene.name);
    if let Err(e) = library.read(&scene.fabric) {
        match e {
            FabricError::Unknown { name, known } => check.range("fabric", format!("\"{name}\""), &known),
            FabricError::Faulty(faults) => check.0.extend(faults.0),
        }
    }
    let [i, j] = scene.particles;
    for (n, count) in scene.particles.iter().enumerate() {
        if !(2..=400).contains(count) {
            check.range(&format!("particles[{n}]"), count.to_string(), "2 to 400");
        }
    }
    if i.saturating_mul(j) > 100_000 {
        check.range("particles", format!("{i} × {j} = {}", i.saturating_mul(j)), "100000 together at most");
    }
    check.numbers("size_m", &scene.size_m, 0.01, 10.0);
    check.number("gravity_m_per_s2", scene.gravity_m_per_s2, 0.0, 100.0);
    check.number("drag_kg_per_m2_s", scene.drag_kg_per_m2_s, 0.0, 100.0);
    if let Some(rate) = scene.tick_hz {
        check.number("tick_hz", rate, 1.0, 1000.0);
    }
    check.placement(scene);
    for (n, pin) in scene.pins.iter().enumerate() {
        if let Pin::Particle(site) = *pin {
            check.site(&format!("pins[{n}].particle"), site, scene.particles);
        }
    }
    if let Some(Grip::Particle(site)) = scene.hand {
        check.site("hand.particle", site, scene.particles);
    }
    check.obstacles(&scene.obstacles);
    if check.0.is_empty() {
        check.clearance(scene);
    }
    check.0
}

struct Check(Vec<Fault>);

impl Check {
    fn range(&mut self, key: &str, got: String, allowed: &str) {
        let problem = Problem::Range { got, allowed: allowed.to_owned() };
        self.0.push(Fault { file: "scene".to_owned(), line: 0, key: key.to_owned(), problem });
    }

    fn name(&mut self, key: &str, name: &str) {
        if !(1..=64).contains(&name.chars().count()) || name.chars().any(char::is_control) {
            self.range(key, format!("{name:?}"), "1 to 64 printable characters");
        }
    }

    fn number(&mut self, key: &str, value: f64, low: f64, high: f64) {
        if !(low..=high).contains(&value) {
            self.range(key, value.to_string(), &format!("{low} to {high}"));
        }
    }

    fn numbers(&mut self, key: &str, values: &[f64], low: f64, high: f64) {
        for (n, &value) in values.iter().enumerate() {
            self.number(&format!("{key}[{n}]"), value, low, high);
        }
    }

    /// A direction of any length.
    fn direction(&mut self, key: &str, values: &[f64]) -> bool {
        let length = values.iter().map(|v| v * v).sum::<f64>().sqrt();
        let fits = (1e-6..=1e6).contains(&length);
        if !fits {
            self.range(key, format!("{values:?}"), "finite numbers, not all of them zero");
        }
        fits
    }

    fn placement(&mut self, scene: &Scene) {
        let placement = &scene.placement;
        self.numbers("placement.origin_m", &placement.origin_m, -10.0, 10.0);
        let axes =
            [("placement.warp_axis", placement.warp_axis), ("placement.weft_axis", placement.weft_axis)];
        if axes.map(|(key, axis)| self.direction(key, &axis)) == [true, true] {
            let [warp, weft] = axes.map(|(_, axis)| Vec3::from(axis).normalize());
            if warp.dot(&weft).abs() > 1e-6 {
                let angle = format!("{:.4}° to warp_axis", warp.angle(&weft).to_degrees());
                self.range("placement.weft_axis", angle, "90°");
            }
        }
        self.number("placement.bow", placement.bow, 0.0, 0.5);
        self.number("placement.imperfection_m", placement.imperfection_m, 0.0, 0.01);
    }

    fn site(&mut self, key: &str, [i, j]: [usize; 2], [last_i, last_j]: [usize; 2]) {
        if i >= last_i || j >= last_j {
            let allowed =
                format!("i from 0 to {}, j from 0 to {}", last_i.saturating_sub(1), last_j.saturating_sub(1));
            self.range(key, format!("[{i}, {j}]"), &allowed);
        }
    }

    fn obstacles(&mut self, obstacles: &[SceneObstacle]) {
        if obstacles.len() > 64 {
            self.range("obstacles", obstacles.len().to_string(), "64 at most");
        }
        for (n, obstacle) in obstacles.iter().enumerate() {
            let key = |field: &str| format!("obstacles[{n}].{field}");
            self.name(&key("name"), &obstacle.name);
            if obstacles[..n].iter().any(|o| o.name == obstacle.name) {
                let got = format!("\"{}\" a second time", obstacle.name);
                self.range(&key("name"), got, "names that differ");
            }
            self.shape(n, &obstacle.shape);
            if let Some(friction) = obstacle.friction {
                self.number(&key("friction"), friction, 0.0, 10.0);
            }
            self.numbers(&key("position_m"), &obstacle.position_m, -10.0, 10.0);
            match obstacle.rotation {
                Rotation::AxisAngle { axis, angle_deg } => {
                    self.direction(&key("rotation.axis_angle.axis"), &axis);
                    self.number(&key("rotation.axis_angle.angle_deg"), angle_deg, -360.0, 360.0);
                }
                Rotation::Quaternion(q) => {
                    self.direction(&key("rotation.quaternion"), &q);
                }
            }
        }
    }

    fn shape(&mut self, n: usize, shape: &SceneShape) {
        let key = |field: &str| format!("obstacles[{n}].shape.{field}");
        let faults = self.0.len();
        match shape {
            SceneShape::Box { size_m } => self.numbers(&key("box.size_m"), size_m, 1e-3, 10.0),
            SceneShape::Sphere { radius_m } => self.number(&key("sphere.radius_m"), *radius_m, 1e-3, 10.0),
            SceneShape::Capsule { length_m, radius_m } => {
                self.number(&key("capsule.length_m"), *length_m, 1e-3, 10.0);
                self.number(&key("capsule.radius_m"), *radius_m, 1e-3, 10.0);
            }
            SceneShape::Plane {} => {}
            SceneShape::Hull { points_m } => {
                if !(4..=1000).contains(&points_m.len()) {
                    self.range(&key("hull.points_m"), points_m.len().to_string(), "4 to 1000 points");
                }
                points_m.iter().for_each(|p| self.numbers(&key("hull.points_m"), p, -10.0, 10.0));
            }
            SceneShape::Mesh { points_m, triangles } => {
                if !(4..=20_000).contains(&triangles.len()) {
                    self.range(&key("mesh.triangles"), triangles.len().to_string(), "4 to 20000 triangles");
                }
                points_m.iter().for_each(|p| self.numbers(&key("mesh.points_m"), p, -10.0, 10.0));
            }
        }
        if self.0.len() == faults
            && let Err(unfit) = shape.shape()
        {
            self.range(&key("mesh"), unfit.to_string(), "a closed surface around a volume");
        }
    }

    /// No particle starts inside an obstacle.
    fn clearance(&mut self, scene: &Scene) {
        let positions = start::positions(scene);
        for (n, obstacle) in scene.obstacles.iter().enumerate() {
            let Ok(solid) = obstacle.obstacle() else { continue };
            let reach = solid.shape.reach();
            let near = positions.iter().filter(|p| (**p - solid.pose.translation.vector).norm() <= reach);
            let depth = near.map(|p| -solid.gap(*p).value).fold(f64::NEG_INFINITY, f64::max);
            if depth > 0.0 {
                let got = format!("the sheet starts {depth:.6} m deep in \"{}\"", obstacle.name);
                self.range(&format!("obstacles[{n}].position_m"), got, "a start outside all obstacles");
            }
        }
    }
}
