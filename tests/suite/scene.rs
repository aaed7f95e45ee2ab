//! Scenes: the built-in ones, their start shapes, and what is refused.

use kesi::{
    fabric::Library,
    scene::{Pin, Scene},
};

/// Longest relative deviation of an edge from its rest length.
fn strain(scene: &Scene) -> f64 {
    let setup = scene.setup().unwrap();
    let [i, j] = setup.particles;
    let rest = [setup.size[0] / (i - 1) as f64, setup.size[1] / (j - 1) as f64];
    let mut worst: f64 = 0.0;
    for a in 0..i {
        for b in 0..j {
            let here = setup.positions[a * j + b];
            for (inside, next, rest) in
                [(a + 1 < i, (a + 1) * j + b, rest[0]), (b + 1 < j, a * j + b + 1, rest[1])]
            {
                if inside {
                    worst = worst.max(((setup.positions[next] - here).norm() / rest - 1.0).abs());
                }
            }
        }
    }
    worst
}

#[test]
fn built_in_scenes_start_unstretched_and_valid() {
    assert_eq!(Scene::names(), ["drape", "hang", "flag"]);
    for name in Scene::names() {
        let scene = Scene::built_in(name).unwrap();
        assert_eq!(scene.name, name);
        scene.validate().unwrap();
        // On a bowed sheet the imperfection stretches a little, to first order in its slope.
        assert!(strain(&scene) < 1e-4, "{name}: {}", strain(&scene));
    }
}

#[test]
fn the_default_scene_is_the_papers() {
    let setup = Scene::built_in(Scene::names()[0]).unwrap().setup().unwrap();
    assert_eq!((setup.particles, setup.size, setup.hand), ([77, 77], [0.3, 0.3], Some([0, 0])));
    assert!(setup.pins.is_empty());
    let top = setup.obstacles[0].pose.translation.z + 0.06;
    for p in &setup.positions {
        assert!((p.z - top - 0.005).abs() <= 1e-5);
    }
    let center = setup.positions.iter().sum::<kesi::math::Vec3>() / setup.positions.len() as f64;
    assert!(center.xy().norm() < 1e-12);
    let flat = setup.positions.iter().all(|p| p.z == setup.positions[0].z);
    assert!(!flat, "something must say which way it folds");
}

#[test]
fn hang_brings_its_corners_nearer_without_stretching() {
    let scene = Scene::built_in("hang").unwrap();
    let mut smooth = scene.clone();
    smooth.placement.imperfection_m = 0.0;
    assert!(strain(&smooth) < 1e-12);
    let setup = smooth.setup().unwrap();
    assert_eq!((setup.hand, &setup.pins[..]), (Some([0, 0]), &[[0, 38]][..]));
    let span = setup.positions[38] - setup.positions[0];
    assert!((span.norm() - 0.27).abs() < 1e-12 && span.z.abs() < 1e-12);
    let below = setup.positions[38 * 39] - setup.positions[0];
    assert!((below.z + 0.3).abs() < 1e-12);
}

#[test]
fn flag_pins_a_whole_edge() {
    let setup = Scene::built_in("flag").unwrap().setup().unwrap();
    assert_eq!(setup.pins.len(), 46);
    assert_eq!(setup.hand, Some([30, 45]));
    assert!(setup.positions[30 * 46 + 45].z > setup.positions[30 * 46].z);
}

#[test]
fn a_start_is_the_same_bits_each_time_and_another_for_another_seed() {
    let scene = Scene::built_in("drape").unwrap();
    let bits = |s: &Scene| s.setup().unwrap().positions.iter().map(|p| p.z.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&scene), bits(&scene));
    let mut other = scene.clone();
    other.placement.seed = 2;
    assert_ne!(bits(&scene), bits(&other));
}

#[test]
fn clamps_are_two_rows_and_overlapping_pins_count_once() {
    let text = "particles = [4, 5]\npins = [{ clamp = \"j=J\" }, { edge = \"i=0\" }, { particle = [0, 0] }, { corner = \"IJ\" }]";
    let setup = Scene::from_toml("s.toml", text).unwrap().setup().unwrap();
    assert_eq!(
        setup.pins,
        [[0, 0], [0, 1], [0, 2], [0, 3], [0, 4], [1, 3], [1, 4], [2, 3], [2, 4], [3, 3], [3, 4]]
    );
}

#[test]
fn json_and_toml_are_the_same_scene_and_round_trip() {
    for name in Scene::names() {
        let scene = Scene::built_in(name).unwrap();
        let json = serde_json::to_string(&scene).unwrap();
        assert_eq!(serde_json::from_str::<Scene>(&json).unwrap(), scene);
        assert_eq!(Scene::from_toml("x", &toml::to_string(&scene).unwrap()).unwrap(), scene);
    }
    assert_eq!(serde_json::from_str::<Scene>("{}").unwrap(), Scene::default());
    assert!(serde_json::from_str::<Scene>("{\"colour\": 1}").unwrap_err().to_string().contains("colour"));
}

#[test]
fn all_faults_of_a_scene_are_told_at_once_with_file_and_line() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.toml");
    let text = "fabric = \"felt\"\nparticles = [1, 500]\nsize_m = [0.001, 0.3]\ntick_hz = inf\n\
                pins = [{ particle = [0, 0] },\n  { particle = [9, 0] }]\n\
                [placement]\nweft_axis = [1, 1, 0]\nbow = 0.9\n\
                [[obstacles]]\nname = \"a\"\nshape = { sphere = { radius_m = -1 } }\n\
                [[obstacles]]\nname = \"a\"\nshape = { plane = {} }\nrotation = { quaternion = [0, 0, 0, 0] }\n";
    std::fs::write(&path, text).unwrap();
    let faults = Scene::read(&path, &Library::default()).unwrap_err().to_string();
    let file = path.display();
    for expected in [
        "1: fabric: \"felt\" is out of range; allowed: cotton-broad, denim-a",
        "2: particles[0]: 1 is out of range; allowed: 2 to 400",
        "2: particles[1]: 500 is out of range; allowed: 2 to 400",
        "3: size_m[0]: 0.001 is out of range; allowed: 0.01 to 10",
        "4: tick_hz: inf is out of range; allowed: 1 to 1000",
        "6: pins[1].particle: [9, 0] is out of range; allowed: i from 0 to 0, j from 0 to 499",
        "8: placement.weft_axis: 45.0000° to warp_axis is out of range; allowed: 90°",
        "9: placement.bow: 0.9 is out of range; allowed: 0 to 0.5",
        "12: obstacles[0].shape.sphere.radius_m: -1 is out of range; allowed: 0.001 to 10",
        "14: obstacles[1].name: \"a\" a second time is out of range; allowed: names that differ",
        "16: obstacles[1].rotation.quaternion: [0.0, 0.0, 0.0, 0.0] is out of range; allowed: finite numbers",
    ] {
        assert!(faults.contains(&format!("{file}:{expected}")), "{expected} in\n{faults}");
    }
}

#[test]
fn all_fields_of_the_wrong_form_are_told_at_once() {
    let text = "particles = \"many\"\ncolour = 1\npins = [{ corner = \"00\" }, { corner = \"middle\" }]\n";
    let faults = Scene::from_toml("s.toml", text).unwrap_err().to_string();
    for part in [
        "s.toml:1: particles: ",
        "s.toml:2: colour: unknown field `colour`",
        "s.toml:3: pins[1]: unknown variant `middle`",
    ] {
        assert!(faults.contains(part), "{part} in\n{faults}");
    }
}

#[test]
fn a_sheet_inside_an_obstacle_is_refused() {
    let mut scene = Scene::built_in("drape").unwrap();
    scene.obstacles[0].position_m[2] += 0.01;
    let faults = scene.validate().unwrap_err();
    assert!(
        faults[0].to_string().contains("obstacles[0].position_m: the sheet starts 0.005"),
        "{}",
        faults[0]
    );
    scene.pins = vec![Pin::Particle([77, 0])];
    assert!(scene.setup().is_err());
}
