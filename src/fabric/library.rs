//! Where fabrics are found: the files of `kes_data/`, built into the binary, and a folder of the user's own.

use crate::fabric::{
    Fabric,
    document::{Fault, Faults, Problem},
    kes::{self, FabricFile},
};
use std::path::{Path, PathBuf};

macro_rules! built_in {
    ($($name:literal),* $(,)?) => {
        &[$(($name, include_str!(concat!("../../kes_data/", $name, ".toml")))),*]
    };
}

/// The files of `kes_data/`.
const BUILT_IN: &[(&str, &str)] = built_in![
    "cotton-broad",
    "denim-a",
    "denim-b",
    "denim-c",
    "denim-d",
    "denim-f",
    "polyester-faille",
    "polyester-tropical",
    "wool-tropical",
];

/// Why a fabric cannot be had.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FabricError {
    /// No such fabric.
    #[error("no fabric \"{name}\"; there are: {known}")]
    Unknown { name: String, known: String },
    /// A file with faults.
    #[error("{0}")]
    Faulty(#[from] Faults),
}

/// Fabrics built in, and those of a folder, which go first.
#[derive(Clone, Debug, Default)]
pub struct Library {
    /// Folder with more `NAME.toml`.
    pub folder: Option<PathBuf>,
}

impl Library {
    /// Names of all fabrics, in order.
    pub fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = BUILT_IN.iter().map(|f| f.0.to_owned()).collect();
        let entries = self.folder.iter().filter_map(|f| std::fs::read_dir(f).ok()).flatten().flatten();
        for path in entries.map(|e| e.path()).filter(|p| p.extension().is_some_and(|e| e == "toml")) {
            names.extend(path.file_stem().map(|s| s.to_string_lossy().into_owned()));
        }
        names.sort();
        names.dedup();
        names
    }

    /// Reads and checks a fabric's file.
    pub fn read(&self, name: &str) -> Result<FabricFile, FabricError> {
        // Only names that are there are opened, so that no name can lead out of the folder.
        let names = self.names();
        if !names.iter().any(|n| n == name) {
            return Err(FabricError::Unknown { name: name.to_owned(), known: names.join(", ") });
        }
        if let Some(path) = self.folder.iter().map(|f| f.join(format!("{name}.toml"))).find(|p| p.is_file()) {
            return Ok(read_file(&path)?);
        }
        let text = BUILT_IN.iter().find(|f| f.0 == name).map_or("", |f| f.1);
        let open = |file: &str| Err(format!("{file} is not built in"));
        Ok(kes::read(&format!("kes_data/{name}.toml"), Some(name), text, &open)?)
    }

    /// A fabric as the mechanics needs it.
    pub fn load(&self, name: &str) -> Result<Fabric, FabricError> {
        self.read(name).map(|file| file.fabric)
    }
}

/// Reads and checks a fabric file, with the CSV files it names beside it.
pub fn read_file(path: &Path) -> Result<FabricFile, Faults> {
    let file = path.display().to_string();
    let text = std::fs::read_to_string(path).map_err(|e| {
        let problem = Problem::Unreadable(e.to_string());
        Faults(vec![Fault { file: file.clone(), line: 0, key: String::new(), problem }])
    })?;
    let folder = path.parent().unwrap_or(Path::new("."));
    let open = |name: &str| {
        std::fs::read_to_string(folder.join(name))
            .map_err(|e| format!("{}: {e}", folder.join(name).display()))
    };
    let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned());
    kes::read(&file, stem.as_deref(), &text, &open)
}
