//! Reduced runs of the benches through the binary: rows are there, named as documented, and filled.

use serde_json::Value;
use std::process::{Command, Stdio};

/// Rows of `kesi bench ARGS --json -`.
fn rows(args: &[&str]) -> Vec<Value> {
    let run = Command::new(env!("CARGO_BIN_EXE_kesi")).arg("bench").args(args).args(["--json", "-"]).output();
    let run = run.expect("the binary runs");
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let results: Value = serde_json::from_slice(&run.stdout).expect("one JSON object");
    results["rows"].as_array().expect("rows").clone()
}

#[test]
fn bench_table_reports_every_method_arrived_or_capped() {
    let rows =
        rows(&["table", "--particles", "9,17", "--beyond", "0", "--cap-s", "0.2", "--only", "uniform"]);
    let named = |mesh: &str, minimizer: &str| {
        let found = rows.iter().find(|r| r["mesh"] == mesh && r["minimizer"] == minimizer);
        found.unwrap_or_else(|| panic!("no row {mesh}, {minimizer}"))
    };
    for minimizer in ["newton", "steepest_descent", "conjugate_gradients"] {
        for mesh in ["uniform 9", "uniform 17"] {
            let row = named(mesh, minimizer);
            assert_ne!(row["converged"], row["capped"], "{row}");
            for key in ["wall_s", "cost_total", "quality_error", "shape_rms_m", "force_error", "residual_n"] {
                assert!(row[key].is_f64(), "{key} in {row}");
            }
        }
    }
    let finest = named("uniform 17", "newton");
    assert_eq!(finest["converged"], true);
    assert!(finest["quality_error"].as_f64().unwrap().abs() < 1e-9, "{finest}");
    assert_eq!((finest["force_error"].as_f64(), finest["shape_max_m"].as_f64()), (Some(0.0), Some(0.0)));
}

#[test]
fn a_bench_whose_table_nobody_reads_still_writes_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("rows.json");
    let sizes = "bench scaling --scenes hang --particles 5,9 --ticks 2 --cap-s 0 --json";
    let mut bench = Command::new(env!("CARGO_BIN_EXE_kesi"));
    bench.args(sizes.split(' ')).arg(&file).stdout(Stdio::piped());
    let mut bench = bench.spawn().unwrap();
    drop(bench.stdout.take());
    assert!(bench.wait().unwrap().success());
    let results: Value = serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
    assert_eq!(results["rows"].as_array().unwrap().len(), 3, "two sizes and a fit");
}

#[cfg(target_os = "linux")]
#[test]
fn a_table_that_a_full_disk_does_not_take_is_not_lost_in_silence() {
    let full = std::fs::File::create("/dev/full").unwrap();
    let sizes = "bench scaling --scenes hang --particles 5,9 --ticks 2 --cap-s 0";
    let run = Command::new(env!("CARGO_BIN_EXE_kesi")).args(sizes.split(' ')).stdout(full).output().unwrap();
    assert!(!run.status.success());
}

#[test]
fn bench_table_refuses_meshes_that_do_not_nest() {
    let run =
        Command::new(env!("CARGO_BIN_EXE_kesi")).args(["bench", "table", "--particles", "5,8"]).output();
    let text = String::from_utf8_lossy(&run.expect("the binary runs").stderr).into_owned();
    assert!(text.contains("--particles") && text.contains("[5, 8]"), "{text}");
}

#[test]
fn bench_scaling_measures_sizes_and_fits_their_growth() {
    let sizes = ["scaling", "--scenes", "hang", "--particles", "5,9,17", "--ticks", "2", "--cap-s", "0"];
    let rows = rows(&sizes);
    assert_eq!(rows.len(), 4, "three sizes and a fit");
    for (row, n) in rows.iter().zip([25, 81, 289]) {
        assert_eq!(row["particles"], n);
        assert!(row["tick_ms"].as_f64().unwrap() > 0.0 && row["rest_s"].is_null());
    }
    assert!(rows[3]["tick_exponent"].as_f64().unwrap().is_finite());
}

#[test]
fn bench_contact_counts_what_goes_wrong_and_times_rest() {
    let rows = rows(&["contact", "--particles", "9", "--manipulations", "12", "--rest-solves", "2"]);
    let scenes: Vec<&str> = rows.iter().map(|r| r["scene"].as_str().unwrap()).collect();
    assert_eq!(scenes, ["box", "sphere", "mesh", "drape", "drape", "rest"]);
    for row in &rows[..3] {
        assert_eq!(
            (&row["particles"], &row["manipulations"], &row["states"]),
            (&81.into(), &4.into(), &40.into())
        );
        for key in ["violations", "not_finite", "stalled"] {
            assert_eq!(row[key], 0, "{key} in {row}");
        }
        assert!(row["min_gap_m"].as_f64().unwrap() > 0.0, "{row}");
    }
    assert!(rows[3]["violations"].as_u64() > Some(0), "particles alone: {}", rows[3]);
    assert!(
        rows[5]["pairs"].as_u64() > Some(4) && rows[5]["cost_ratio"].as_f64().unwrap() > 0.0,
        "{}",
        rows[5]
    );
}

#[test]
fn bench_tick_measures_every_mesh_and_hand() {
    let rows = rows(&[
        "tick",
        "--particles",
        "9",
        "--adaptive",
        "33",
        "--speed",
        "0.1",
        "--ticks",
        "3",
        "--methods",
        "fronts",
        "--runs",
        "2",
    ]);
    let got: Vec<String> = rows
        .iter()
        .map(|r| format!("{} {} {}", r["scene"], r["hand"], r["particles"]).replace('"', ""))
        .collect();
    // A sheet that hangs has nothing to be pressed against.
    let expected = [
        "hang free 81",
        "hang free 1089",
        "drape free 81",
        "drape pressing 81",
        "drape free 1089",
        "drape pressing 1089",
    ];
    assert_eq!(got, expected);
    assert!(rows.iter().all(|r| r["adaptive"] == (r["particles"] == 1089)), "{rows:?}");
    assert!(rows[1]["particles_active"].as_u64() < Some(1089), "{}", rows[1]);
    for row in &rows {
        assert_eq!(row["runs"], 2);
        assert!(row["tick_ms_p50"].as_f64() > Some(0.0) && row["force_error_median"].is_f64(), "{row}");
        let of_solves = row["of_solves"]["force_error_median"].as_f64();
        assert_eq!(of_solves.is_some(), row["adaptive"] == true, "{row}");
    }
    // What a mesh errs by is not what its solves do.
    let [whole, solves] = [&rows[1]["force_error_median"], &rows[1]["of_solves"]["force_error_median"]];
    assert!(solves.as_f64() < whole.as_f64(), "{}", rows[1]);
}

#[test]
fn bench_skip_finds_the_same_result_with_and_without_the_work() {
    let rows = rows(&["skip", "--particles", "9", "--ticks", "5"]);
    let kinds: Vec<&str> = rows.iter().map(|r| r["kind"].as_str().unwrap()).collect();
    let mut expected = vec![
        "sleeping",
        "foreseen gradient",
        "stale levels",
        "no candidates",
        "flat regions",
        "weightless terms",
    ];
    expected.extend(cfg!(feature = "server").then_some("no viewers"));
    expected.extend(cfg!(feature = "recording").then_some("no recording"));
    assert_eq!(kinds, expected);
    for row in rows {
        assert!(row["saved_fraction"].as_f64().unwrap() < 1.0, "{row}");
        assert!(row["result_difference"].as_f64() <= row["tolerance"].as_f64(), "{row}");
    }
}

#[test]
fn bench_follow_compares_an_adaptive_sheet_with_the_dense_one() {
    let sheet = ["follow", "--scenes", "hang", "--particles", "29"];
    let hand = ["--seconds", "0.4", "--speed", "0.1", "--slowest", "0.08", "--nudge", "1e-6"];
    let row = &rows(&[&sheet[..], &hand].concat())[0];
    let at = |key: &str| row.pointer(&format!("/{key}")).and_then(Value::as_f64);
    let number = |key: &str| at(key).unwrap_or_else(|| panic!("{key}: {row}"));
    assert!(number("particles_active") < 0.9 * 29.0 * 29.0, "{row}");
    let nudged = number("twin/force_error_max");
    assert!(nudged > 0.0 && nudged < 0.01, "a micrometre is hardly felt where a sheet hangs: {row}");
    assert!(number("force_error_median") < 0.01 && number("jump_max_relative") < 0.01, "{row}");
    assert_eq!((number("branch_changes"), number("changes_at_rest")), (0.0, 0.0), "{row}");
    assert_eq!(number("branch_tests"), 0.0, "{row}");
    // Where so little is suspect, resting copies tell that both are on one branch after all, and each tick counts.
    let suspect = (0.9 * number("force_error_max")).to_string();
    let tested = &rows(&[&sheet[..], &hand, &["--suspect", &suspect]].concat())[0];
    let of = |key: &str| tested[key].as_f64();
    assert!(of("branch_tests") > Some(0.0) && of("branch_changes") == Some(0.0), "{tested}");
    assert_eq!(of("force_error_max"), at("force_error_max"), "{tested}");
}

#[test]
fn bench_follow_refuses_a_hand_that_slows_down_to_more_than_its_speed() {
    let hand = ["bench", "follow", "--speed", "0.3,0.1", "--slowest", "0.2"];
    let run = Command::new(env!("CARGO_BIN_EXE_kesi")).args(hand).output().expect("the binary runs");
    let text = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(
        !run.status.success() && text.contains("--slowest 0.2: must be above 0 and at most --speed 0.1 m/s"),
        "{text}"
    );
}
