//! The binary as a user runs it: one line on stdout, mistakes all at once, signals, and a driven hand.

use std::{
    io::{BufRead, BufReader, Read},
    process::{Child, Command, Output, Stdio},
};

fn kesi(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_kesi"));
    command.args(args).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn run(args: &[&str]) -> (Output, String, String) {
    let out = kesi(args).output().unwrap();
    let text = |b: &[u8]| String::from_utf8_lossy(b).into_owned();
    (out.clone(), text(&out.stdout), text(&out.stderr))
}

/// A served process, killed if the test fails.
struct Served(Child);

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn configuration_is_printed_and_all_mistakes_are_shown_at_once() {
    let (out, text, _) = run(&["serve", "--print-config", "--listen", "127.0.0.1:1"]);
    assert!(
        out.status.success() && text.contains("listen = \"127.0.0.1:1\"") && text.contains("[limits]"),
        "{text}"
    );

    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("kesi.toml");
    let text = "scene = 3\n[session]\nsolves = \"many\"\n[limits]\nview_hz = 9999\n";
    std::fs::write(&file, text).unwrap();
    let args = ["serve", "--config", file.to_str().unwrap(), "--listen", "nowhere", "--allow-origin", "x"];
    let (out, text, errors) = run(&args);
    assert!(!out.status.success() && text.is_empty());
    for word in [
        "kesi.toml:1: scene",
        "kesi.toml:3: session.solves",
        "limits.view_hz is 9999, allowed: 1 to 1000",
        "listen is \"nowhere\"",
        "allow_origin",
    ] {
        assert!(errors.contains(word), "{word} is not in: {errors}");
    }
}

#[cfg(unix)]
#[test]
fn serves_with_one_line_on_stdout_is_driven_and_ends_on_sigterm() {
    let mut served =
        Served(kesi(&["--listen", "127.0.0.1:0", "--scene", "hang", "--record", "off"]).spawn().unwrap());
    let mut out = BufReader::new(served.0.stdout.take().unwrap());
    let mut line = String::new();
    out.read_line(&mut line).unwrap();
    let url = line.trim_end().strip_prefix("kesi listening on ").expect("the one line").to_string();

    let dir = tempfile::tempdir().unwrap();
    let trace = dir.path().join("trace.csv");
    let (done, text, errors) = run(&[
        "drive",
        "--url",
        &url,
        "--seconds",
        "1",
        "--rate-hz",
        "200",
        "--out",
        trace.to_str().unwrap(),
    ]);
    assert!(done.status.success(), "{text}{errors}");
    assert!(text.contains("round trip p50"), "{text}");
    let rows = std::fs::read_to_string(&trace).unwrap();
    assert!(rows.lines().any(|l| l.starts_with("move,")) && rows.lines().any(|l| l.starts_with("model,")));
    let (done, _, errors) = run(&["drive", "--url", &url, "--session", "none", "--seconds", "1"]);
    assert!(!done.status.success() && errors.contains("none") && errors.contains("404"), "{errors}");

    let pid = served.0.id().to_string();
    assert!(Command::new("kill").args(["-TERM", &pid]).status().unwrap().success());
    assert!(served.0.wait().unwrap().success(), "ends in order");
    let mut rest = String::new();
    out.read_to_string(&mut rest).unwrap();
    assert_eq!(rest, "", "one line on stdout");
}

#[test]
fn mistakes_on_the_command_line_name_the_flag_the_value_and_what_is_allowed() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    for (args, words) in [
        (
            &["serve", "--record", "off", "--listen", &address][..],
            &[address.as_str(), "in use", "port 0"][..],
        ),
        (&["serve", "--scene", "nosuch"], &["scene", "nosuch", "drape"]),
        (&["serve", "--config", "none.toml"], &["config", "none.toml"]),
        (&["drive", "--rate-hz", "-1"], &["--rate-hz", "-1", "above 0"]),
        (&["bench", "live", "--speed", "-1"], &["--speed", "-1", "above 0"]),
        (&["bench", "settle", "--solves", "0"], &["--solves", "0", "1.."]),
        (&["bench", "settle", "--scenes", "nosuch"], &["scene", "nosuch", "drape"]),
        (&["bench", "settle", "--json", "/nonexistent/f.json"], &["--json", "/nonexistent"]),
    ] {
        let (out, _, errors) = run(args);
        assert!(!out.status.success(), "{args:?}");
        words.iter().for_each(|word| assert!(errors.contains(word), "{args:?}: {word} is not in: {errors}"));
    }
}

#[test]
fn driving_a_server_that_is_not_there_says_so() {
    let (out, _, errors) = run(&["drive", "--url", "ws://127.0.0.1:9", "--seconds", "1"]);
    assert!(!out.status.success() && errors.contains("127.0.0.1:9"), "{errors}");
    let (out, _, errors) = run(&["drive", "--url", "wss://x", "--seconds", "1"]);
    assert!(!out.status.success() && errors.contains("allowed"), "{errors}");
}
