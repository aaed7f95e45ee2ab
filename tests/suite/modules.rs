//! The dependency order of `lib.rs`, read from the sources themselves: a module uses itself and those declared above it.

use std::{
    fs,
    path::{Path, PathBuf},
};

fn source() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src")
}

/// Modules in the order of their declarations.
fn declared(lib: &str) -> Vec<String> {
    let name = |line: &str| Some(line.trim().strip_prefix("pub mod ")?.strip_suffix(';')?.to_string());
    lib.lines().filter_map(name).collect()
}

/// The code of a file without its `//` comments, whose links may point anywhere.
fn without_comments(text: &str) -> String {
    text.lines().map(|l| l.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n")
}

fn word(text: &str) -> String {
    text.trim_start().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
}

/// The modules behind every `crate::` of some code, those of `crate::{…}` included.
fn used(code: &str) -> Vec<String> {
    let mut names = Vec::new();
    for (_, rest) in code.match_indices("crate::").map(|(at, path)| code.split_at(at + path.len())) {
        let Some(group) = rest.strip_prefix('{') else {
            names.push(word(rest));
            continue;
        };
        let mut depth = 0;
        names.push(word(group));
        for (at, c) in group.char_indices() {
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                ',' if depth == 0 => names.push(word(&group[at + 1..])),
                _ => {}
            }
        }
    }
    // A comma may stand last in a group.
    names.retain(|name| !name.is_empty());
    names
}

/// The files of a module: `name.rs`, and everything below `name/`.
fn files(module: &str) -> Vec<PathBuf> {
    let mut waiting = vec![source().join(format!("{module}.rs")), source().join(module)];
    let mut files = Vec::new();
    while let Some(path) = waiting.pop() {
        if path.is_dir() {
            waiting.extend(fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        } else if path.extension().is_some_and(|e| e == "rs") && path.is_file() {
            files.push(path);
        }
    }
    files
}

#[test]
fn every_module_uses_only_those_declared_above_it() {
    let order = declared(&fs::read_to_string(source().join("lib.rs")).unwrap());
    assert!(order.len() > 10, "modules found in lib.rs: {order:?}");
    let mut wrong = Vec::new();
    let mut seen = 0;
    for (place, module) in order.iter().enumerate() {
        let files = files(module);
        assert!(!files.is_empty(), "{module} has no file");
        for file in files {
            let code = without_comments(&fs::read_to_string(&file).unwrap());
            for name in used(&code) {
                seen += 1;
                if !order[..=place].contains(&name) {
                    wrong.push(format!("{}: crate::{name}", file.display()));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "used, but not declared above its user in lib.rs:\n{}", wrong.join("\n"));
    assert!(seen > 50, "only {seen} uses of `crate::` were found: the test reads the sources wrongly");
}

/// But for the library of fabrics, which is files, and the stopwatch, which callers bring along.
#[test]
fn physics_reads_no_clock_no_file_and_no_environment() {
    let order = declared(&fs::read_to_string(source().join("lib.rs")).unwrap());
    let last = order.iter().position(|module| module == "world").expect("physics ends with the world");
    let allowed = ["fabric/library.rs", "phase.rs"].map(|file| source().join(file));
    let files: Vec<PathBuf> =
        order[..=last].iter().filter(|m| *m != "protocol").flat_map(|m| files(m)).collect();
    assert!(files.len() > 50 && allowed.iter().all(|file| files.contains(file)), "{} files", files.len());
    for file in files.iter().filter(|file| !allowed.contains(file)) {
        let code = without_comments(&fs::read_to_string(file).unwrap());
        for reader in ["env::var", "env::args", "Instant", "SystemTime", "fs::", "File::"] {
            assert!(!code.contains(reader), "{}: {reader}", file.display());
        }
    }
}

#[test]
fn uses_are_found_in_groups_and_in_paths() {
    let code = "use crate::{\n    a::{self, b, c::{D, E}},\n    f::G,\n};\nfn x() { crate::h::i(); }\nuse crate::j::K;";
    assert_eq!(used(code), ["a", "f", "h", "j"]);
    assert_eq!(
        used(&without_comments("//! [`crate::later`]\nlet x = 1; // crate::too\n")),
        Vec::<String>::new()
    );
    assert_eq!(declared("pub mod a;\n#[cfg(feature = \"b\")]\npub mod b;\nmod private;\n"), ["a", "b"]);
}
