//! Fabric files and measured curves: what is shipped, what is refused and in which words.

use kesi::fabric::{
    self, Library,
    instrument::{self, BENDING_RANGE, SHEAR_RANGE},
    kes::{self, FabricFile, Origin, Provenance},
    law::Law,
    library::read_file,
    units::*,
};
use std::path::Path;

const DENIM: &str = include_str!("../../kes_data/denim-a.toml");

fn check(text: &str) -> Result<FabricFile, Vec<String>> {
    let none = |_: &str| Err("no curves here".to_owned());
    kes::read("f.toml", None, text, &none).map_err(|f| f.0.iter().map(ToString::to_string).collect())
}

fn value(file: &FabricFile, key: &str) -> f64 {
    file.quantities.iter().find(|q| q.key == key).unwrap_or_else(|| panic!("{key}")).value
}

fn drive(law: &Law, turns: &[f64]) -> Vec<[f64; 2]> {
    instrument::drive(law, &instrument::path(turns, 4000))
}

#[test]
fn every_shipped_fabric_gives_its_parameters_back_to_the_instrument() {
    let names = fabric::list();
    assert_eq!(names.len(), 9);
    for name in names {
        let file = Library::default().read(&name).unwrap();
        assert_eq!(file.warnings, Vec::<String>::new(), "{name}");
        let close = |key: &str, got: f64| {
            let given = value(&file, key);
            assert!((got / given - 1.0).abs() < 1e-3, "{name} {key}: {got} instead of {given}");
        };
        let cloth = &file.fabric;
        let emt = value(&file, "tensile.both.EMT") * PERCENT;
        for law in &cloth.tensile {
            let read = instrument::read_tensile(&drive(law, &[emt, 0.0])).unwrap();
            close("tensile.both.max_load", read.max_load / GF_PER_CM);
            close("tensile.both.LT", read.lt);
            close("tensile.both.RT", read.rt / PERCENT);
            let wt = value(&file, "tensile.both.WT");
            assert!((read.wt / GF_CM_PER_CM2 / wt - 1.0).abs() < 0.03, "{name} WT, redundant in the source");
        }
        for law in &cloth.bending {
            let samples = drive(law, &[BENDING_RANGE, -BENDING_RANGE, 0.0]);
            let read = instrument::read_bending(&samples, PER_CM).unwrap();
            close("bending.both.B", read.b / GF_CM2_PER_CM);
            close("bending.both.2HB", read.width / GF_CM_PER_CM);
        }
        let read = instrument::read_shear(&drive(&cloth.shear, &[SHEAR_RANGE, -SHEAR_RANGE, 0.0])).unwrap();
        close("shear.G", read.g / GF_PER_CM_DEGREE);
        close("shear.2HG", read.width / GF_PER_CM);
        close("shear.2HG5", read.width5 / GF_PER_CM);
    }
}

#[test]
fn doubtful_numbers_stay_visible() {
    let denim = Library::default().read("denim-a").unwrap();
    let mass = &denim.quantities.iter().find(|q| q.key == "areal_density").unwrap();
    assert_eq!((mass.provenance, mass.published), (Provenance::Substituted, Some(104.0)));
    assert!((denim.fabric.areal_density - 0.324).abs() < 1e-12);
    let wt = denim.quantities.iter().find(|q| q.key == "tensile.both.WT").unwrap();
    assert_eq!(wt.published, Some(0.825));

    let faille = Library::default().read("polyester-faille").unwrap();
    let from = |key: &str| &faille.origins.iter().find(|o| o.0 == key).unwrap().1;
    assert_eq!(from("shear"), &Origin::Parameters { provenance: Provenance::Borrowed });
    assert_eq!(from("bending.both"), &Origin::Parameters { provenance: Provenance::Measured });
    assert_eq!((value(&faille, "drape.coefficient"), value(&faille, "drape.nodes")), (28.3, 7.0));
}

#[test]
fn all_faults_of_a_file_are_told_at_once_with_line_key_value_and_range() {
    let text = DENIM
        .replace("LT = { value = 0.712", "LT = { value = 1.3")
        .replace("unit = \"gf.cm2/cm\"", "unit = \"N.m\"")
        .replace("G = { value = 2.180", "G = { value = \"stiff\"")
        .replace("[thickness]", "[thickness]\ncolour = \"blue\"")
        .replace("provenance = \"substituted\"", "provenance = \"guessed\"");
    let faults = check(&text).unwrap_err();
    let line = |part: &str| text.lines().position(|l| l.contains(part)).unwrap() + 1;
    let words = "measured, digitised, from_parameters, borrowed, substituted, chosen";
    let expected = [
        format!(
            "f.toml:{}: areal_density.provenance: \"guessed\" is out of range; allowed: {words}",
            line("guessed")
        ),
        format!(
            "f.toml:{}: thickness.colour: unknown key; known here: value, unit, provenance, published, source, note",
            line("colour")
        ),
        format!(
            "f.toml:{}: tensile.both.LT.value: 1.3 is out of range; allowed: 0.05 to 0.999",
            line("1.3,")
        ),
        format!(
            "f.toml:{}: bending.both.B.unit: \"N.m\" is out of range; allowed: \"gf.cm2/cm\"",
            line("N.m\"")
        ),
        format!("f.toml:{}: shear.G.value: \"stiff\" is not a finite number", line("stiff")),
    ];
    assert_eq!(faults, expected);
}

#[test]
fn what_is_missing_is_named() {
    let text = DENIM.replace("RT = {", "# RT = {").replace("[shear]", "[bending.sideways]");
    let faults = check(&text).unwrap_err().join("\n");
    for part in [
        "tensile.both.RT: missing; allowed: 5 to 100 %",
        "shear: missing",
        "bending.sideways: unknown key; known here: both, warp, weft",
    ] {
        assert!(faults.contains(part), "{part} in\n{faults}");
    }
    assert!(check("").unwrap_err().len() >= 9);
}

#[test]
fn broken_syntax_and_contradictions_are_told() {
    let broken = check("name = \n[tensile").unwrap_err().join("\n");
    assert!(broken.contains("f.toml:1: ") && broken.contains("f.toml:2: "), "{broken}");
    let crossing = check(&DENIM.replace("2HG5 = { value = 7.412", "2HG5 = { value = 1.9")).unwrap_err();
    assert!(crossing[0].contains("shear.2HG5: 1.9 is out of range; allowed: 2.005 to"), "{crossing:?}");
    let returned =
        check(&DENIM.replace("RT = { value = 54.100", "RT = { value = 98").replace("0.712", "0.998"));
    assert!(returned.is_ok() || returned.unwrap_err()[0].contains("tensile.both.RT"));
    let odd = check(&DENIM.replace("WT = { value = 9.817", "WT = { value = 0.825")).unwrap();
    assert!(odd.warnings[0].contains("tensile.both.WT is given as 0.825 but 9.8"), "{:?}", odd.warnings);
}

#[test]
fn warp_and_weft_may_differ_and_choices_can_be_overridden() {
    let stiff =
        "[chosen]\ntensile_stick = { value = 0.02, unit = \"1\", provenance = \"chosen\" }\n[bending.warp]";
    let weft = "B = { value = 0.1, unit = \"gf.cm2/cm\", provenance = \"measured\" }\n\
                2HB = { value = 0.1, unit = \"gf.cm/cm\", provenance = \"measured\" }";
    let text = DENIM.replace("[bending.both]", stiff) + &format!("\n[bending.weft]\n{weft}\n");
    let file = check(&text).unwrap();
    assert_eq!(file.chosen.tensile_stick, 0.02);
    let [warp, weft] = file.fabric.bending.each_ref().map(|l| l.evaluate(0.0, 0.0).stiffness);
    assert!(warp > weft);
}

/// A curve file as the instrument would have written it for the law.
fn csv(test: &str, units: [(&str, f64); 2], samples: &[[f64; 2]]) -> String {
    let [(x_unit, x), (y_unit, y)] = units;
    let mut text = format!(
        "# fabric: mine\n# test: {test}\n# direction: both\n# x unit: {x_unit}\n# y unit: {y_unit}\n\
         # max load: 500 gf/cm\n# pretension: 10 gf/cm\n# kind: measured\n# source: us\n# licence: CC0\nx,y\n"
    );
    for s in samples {
        text += &format!("{},{}\n", s[0] / x, s[1] / y);
    }
    text
}

fn write(folder: &Path, tensile: &str, bending: &str, shear: &str) -> std::path::PathBuf {
    std::fs::write(folder.join("tensile.csv"), tensile).unwrap();
    std::fs::write(folder.join("bending.csv"), bending).unwrap();
    std::fs::write(folder.join("shear.csv"), shear).unwrap();
    let mut text = DENIM.replace("\"denim-a\"", "\"mine\"");
    for (section, file) in
        [("[tensile.both]", "tensile"), ("[bending.both]", "bending"), ("[shear]", "shear")]
    {
        text = text.replace(section, &format!("{section}\ncurve = \"{file}.csv\""));
    }
    std::fs::write(folder.join("mine.toml"), text).unwrap();
    folder.join("mine.toml")
}

fn curves() -> [String; 3] {
    let denim = fabric::load("denim-a").unwrap();
    let drive = |law: &Law, turns: &[f64]| instrument::drive(law, &instrument::path(turns, 400));
    let (bend, angle) = (BENDING_RANGE, SHEAR_RANGE);
    [
        csv("tensile", [("%", PERCENT), ("gf/cm", GF_PER_CM)], &drive(&denim.tensile[0], &[0.05515, 0.0])),
        csv(
            "bending",
            [("1/cm", PER_CM), ("gf.cm/cm", GF_CM_PER_CM)],
            &drive(&denim.bending[0], &[bend, -bend, 0.0]),
        ),
        csv("shear", [("deg", DEGREE), ("gf/cm", GF_PER_CM)], &drive(&denim.shear, &[angle, -angle, 0.0])),
    ]
}

#[test]
fn measured_curves_make_a_law_that_follows_them() {
    let folder = tempfile::tempdir().unwrap();
    let [tensile, bending, shear] = curves();
    let file = read_file(&write(folder.path(), &tensile, &bending, &shear)).unwrap();
    assert_eq!(file.warnings, Vec::<String>::new());
    let is_curve = |o: &(String, Origin)| matches!(o.1, Origin::Curve { .. });
    assert!(file.origins.len() == 3 && file.origins.iter().all(is_curve));
    let denim = fabric::load("denim-a").unwrap();
    let near = |what: &str, got: f64, given: f64| {
        assert!((got / given - 1.0).abs() < 0.03, "{what}: {got}, {given}")
    };
    let [read, given] = [&file.fabric, &denim]
        .map(|f| instrument::read_tensile(&drive(&f.tensile[0], &[0.05515, 0.0])).unwrap());
    near("LT", read.lt, given.lt);
    near("RT", read.rt, given.rt);
    let turns = [BENDING_RANGE, -BENDING_RANGE, 0.0];
    let [read, given] = [&file.fabric, &denim]
        .map(|f| instrument::read_bending(&drive(&f.bending[0], &turns), PER_CM).unwrap());
    near("B", read.b, given.b);
    near("2HB", read.width, given.width);
    let turns = [SHEAR_RANGE, -SHEAR_RANGE, 0.0];
    let [read, given] =
        [&file.fabric, &denim].map(|f| instrument::read_shear(&drive(&f.shear, &turns)).unwrap());
    near("G", read.g, given.g);
    near("2HG", read.width, given.width);
    near("2HG5", read.width5, given.width5);
    assert_eq!(Library { folder: Some(folder.path().into()) }.names().len(), 10);
}

#[test]
fn bad_curve_files_are_refused_by_line() {
    let folder = tempfile::tempdir().unwrap();
    let [tensile, bending, shear] = curves();
    let backwards: String = {
        let (head, rows) = tensile.split_once("x,y\n").unwrap();
        let mut rows: Vec<&str> = rows.lines().collect();
        rows.reverse();
        // The same loop the other way around: up along the unloading branch, down along the loading branch.
        format!("{head}x,y\n{}\n", rows.join("\n"))
    };
    let faults = read_file(&write(
        folder.path(),
        &backwards,
        &bending.replace("# y unit: gf.cm/cm\n", ""),
        &shear.replace("x,y\n", "x,y\n0,zero\n"),
    ))
    .unwrap_err()
    .to_string();
    for part in [
        "tensile.csv: x,y: the loop runs backwards",
        "bending.csv: y unit: missing; the header needs `# y unit: …` (gf.cm/cm, N)",
        "shear.csv:12: x,y: `0,zero` is not two finite numbers",
    ] {
        assert!(faults.contains(part), "{part} in\n{faults}");
    }
}

#[test]
fn parameters_that_differ_from_the_curve_are_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let [tensile, bending, shear] = curves();
    let path = write(folder.path(), &tensile, &bending, &shear);
    let text = std::fs::read_to_string(&path).unwrap().replace("B = { value = 0.172", "B = { value = 0.150");
    std::fs::write(&path, text).unwrap();
    let warnings = read_file(&path).unwrap().warnings;
    assert!(
        warnings.len() == 1 && warnings[0].contains("bending.both.B is given as 0.15 but 0.172"),
        "{warnings:?}"
    );
}

#[test]
fn unknown_fabrics_are_answered_with_the_known_ones() {
    let error = fabric::load("../denim-a").unwrap_err().to_string();
    assert!(error.starts_with("no fabric \"../denim-a\"; there are: cotton-broad, denim-a"), "{error}");
}
