//! `kesi fabric`: lists, shows, checks and plots fabrics.

use crate::fabric::{FabricFile, Library, library};
use clap::{Args, Subcommand};
use std::{
    error::Error,
    io::{ErrorKind, Write},
    path::{Path, PathBuf},
};

/// Lists, shows, checks and plots fabrics.
#[derive(Debug, Args)]
pub struct FabricCommand {
    /// Folder with more fabric files; they go before the built-in ones.
    #[arg(long, global = true, value_name = "DIR")]
    fabrics: Option<PathBuf>,
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Lists all fabrics and where their tensile, bending and shear numbers come from.
    List {
        /// Prints JSON.
        #[arg(long)]
        json: bool,
    },
    /// Shows one fabric: every quantity in KES units and SI, its provenance, notes.
    Show {
        /// Name, or a path that ends in .toml.
        name: String,
        /// Prints JSON.
        #[arg(long)]
        json: bool,
    },
    /// Checks a fabric file and the curves it names; tells all faults at once.
    Check {
        /// The file.
        file: PathBuf,
    },
    /// Draws a fabric's laws.
    #[cfg(feature = "plot")]
    Plot {
        /// Name, or a path that ends in .toml.
        name: String,
        /// SVG file to write.
        #[arg(long, value_name = "FILE.svg")]
        out: PathBuf,
    },
}

/// Runs the command; the error is in words for the user.
pub fn run(command: &FabricCommand) -> Result<(), Box<dyn Error>> {
    match execute(command, &mut std::io::stdout().lock()) {
        // Whoever closes the pipe early has read enough.
        Err(e) if e.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == ErrorKind::BrokenPipe) => {
            Ok(())
        }
        done => done,
    }
}

fn execute(command: &FabricCommand, out: &mut impl Write) -> Result<(), Box<dyn Error>> {
    let library = Library { folder: command.fabrics.clone() };
    match &command.action {
        Action::List { json } => {
            let files: Vec<FabricFile> =
                library.names().iter().map(|n| library.read(n)).collect::<Result<_, _>>()?;
            if *json {
                return Ok(writeln!(out, "{}", serde_json::to_string_pretty(&files)?)?);
            }
            writeln!(out, "{}", FabricFile::heading())?;
            files.iter().try_for_each(|f| writeln!(out, "{}", f.line()))?;
        }
        Action::Show { name, json } => {
            let file = find(&library, name)?;
            if *json {
                writeln!(out, "{}", serde_json::to_string_pretty(&file)?)?;
            } else {
                write!(out, "{}", file.sheet())?;
            }
        }
        Action::Check { file } => {
            let read =
                library::read_file(file).map_err(|faults| format!("faults: {}\n{faults}", faults.0.len()))?;
            read.warnings.iter().try_for_each(|w| writeln!(out, "{}: warning: {w}", file.display()))?;
            writeln!(out, "{}: {} is good, curves {}", file.display(), read.name, read.kind)?;
        }
        #[cfg(feature = "plot")]
        Action::Plot { name, out: path } => {
            if path.extension().is_none_or(|e| e != "svg") {
                return Err(format!("--out is {}, allowed: a file that ends in .svg", path.display()).into());
            }
            let svg = crate::fabric::plot::svg(&find(&library, name)?)?;
            std::fs::write(path, svg).map_err(|e| format!("{}: {e}", path.display()))?;
            writeln!(out, "{}", path.display())?;
        }
    }
    Ok(())
}

/// A fabric by name, or by the path of its file.
pub(super) fn find(library: &Library, name: &str) -> Result<FabricFile, Box<dyn Error>> {
    if name.ends_with(".toml") { Ok(library::read_file(Path::new(name))?) } else { Ok(library.read(name)?) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Cli {
        #[command(flatten)]
        fabric: FabricCommand,
    }

    fn kesi(line: &str) -> Result<String, String> {
        let cli = Cli::try_parse_from(std::iter::once("fabric").chain(line.split(' ')))
            .map_err(|e| e.to_string())?;
        let mut out = Vec::new();
        execute(&cli.fabric, &mut out).map_err(|e| e.to_string())?;
        Ok(String::from_utf8(out).unwrap())
    }

    #[test]
    fn list_shows_every_fabric_with_its_provenance() {
        let list = kesi("list").unwrap();
        assert_eq!(list.lines().count(), 10);
        let faille = list.lines().find(|l| l.starts_with("polyester-faille")).unwrap();
        let words: Vec<&str> = faille.split_whitespace().collect();
        assert_eq!(words[1..6], ["104", "g/m2", "borrowed", "measured", "borrowed"]);
    }

    #[test]
    fn show_tells_published_numbers_and_json_has_both_units() {
        let sheet = kesi("show denim-a").unwrap();
        assert!(sheet.contains("published: 0.825") && sheet.contains("substituted"), "{sheet}");
        let json: serde_json::Value = serde_json::from_str(&kesi("show denim-a --json").unwrap()).unwrap();
        assert_eq!(json["kind"], "from_parameters");
        let density = &json["quantities"][0];
        assert_eq!((density["value"].as_f64(), density["unit_si"].as_str()), (Some(32.4), Some("kg/m2")));
        assert!(kesi("show felt").unwrap_err().contains("there are: cotton-broad"));
    }

    #[test]
    fn check_refuses_with_the_number_of_faults() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("thin.toml");
        std::fs::write(&path, "name = \"thin\"").unwrap();
        let told = kesi(&format!("check {}", path.display())).unwrap_err();
        assert!(told.starts_with("faults: 9\n") && told.contains("thickness: missing"), "{told}");
        assert!(kesi("check kes_data/denim-a.toml").unwrap().contains("denim-a is good"));
    }

    #[cfg(feature = "plot")]
    #[test]
    fn plots_say_what_is_not_measured() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("f.svg");
        kesi(&format!("plot wool-tropical --out {}", path.display())).unwrap();
        assert!(kesi("plot wool-tropical --out f.png").unwrap_err().contains(".svg"));
        let svg = std::fs::read_to_string(path).unwrap();
        for words in ["curve made from parameters, not measured", "borrowed", "shear angle [deg]", "chosen"] {
            assert!(svg.contains(words), "{words}");
        }
    }
}
