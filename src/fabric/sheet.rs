//! A fabric file as text for people: quantities, provenance, notes, warnings.

use crate::fabric::file::{FabricFile, Origin, Quantity};
use std::fmt::Write;

impl Origin {
    /// What a law was made from, in words.
    pub fn words(&self) -> String {
        match self {
            Origin::Parameters { provenance } => format!("from parameters ({})", provenance.name()),
            Origin::Curve { file, kind, .. } => format!("along the {kind} curve {file}"),
        }
    }
}

/// A number with five significant digits, without trailing zeros.
pub fn short(value: f64) -> String {
    if value != 0.0 && !(1e-3..1e6).contains(&value.abs()) {
        return format!("{value:.4e}");
    }
    let decimals = if value == 0.0 { 0.0 } else { (4.0 - value.abs().log10().floor()).max(0.0) };
    let text = format!("{value:.*}", decimals as usize);
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// A value with its unit.
pub fn with_unit(value: f64, unit: &str) -> String {
    if unit == "1" { short(value) } else { format!("{} {unit}", short(value)) }
}

impl Quantity {
    fn row(&self) -> String {
        let kes = with_unit(self.value, self.unit);
        let si = with_unit(self.value_si, self.unit_si);
        let mut row = format!("  {:<24} {kes:>18} {si:>22}  {:<15}", self.key, self.provenance.name());
        if let Some(published) = self.published {
            let _ = write!(row, " published: {}", short(published));
        }
        row.trim_end().to_owned()
    }
}

impl FabricFile {
    /// One line of a list.
    pub fn line(&self) -> String {
        let weight = format!("{:.0} g/m2", 1e3 * self.fabric.areal_density);
        let origin = |key: &str| {
            let found = self.origins.iter().find(|o| o.0.starts_with(key)).map(|o| &o.1);
            match found {
                Some(Origin::Parameters { provenance }) => provenance.name().to_owned(),
                Some(Origin::Curve { kind, .. }) => format!("{kind} curve"),
                None => String::new(),
            }
        };
        let [tensile, bending, shear] = ["tensile", "bending", "shear"].map(origin);
        let Self { name, kind, title, .. } = self;
        format!("{name:<20} {weight:>9}  {tensile:<12} {bending:<12} {shear:<12} {kind:<16} {title}")
    }

    /// Heading of a list.
    pub fn heading() -> String {
        let [name, weight, tensile, bending, shear] = ["name", "weight", "tensile", "bending", "shear"];
        format!("{name:<20} {weight:>9}  {tensile:<12} {bending:<12} {shear:<12} {:<16} fabric", "curves")
    }

    /// Everything, for people.
    pub fn sheet(&self) -> String {
        let mut text = format!("{}: {}\n", self.name, self.title);
        if !self.structure.is_empty() {
            let _ = writeln!(text, "{}", self.structure);
        }
        let _ = writeln!(text, "\nQuantities: in KES units, in SI, provenance");
        for quantity in &self.quantities {
            let _ = writeln!(text, "{}", quantity.row());
            for remark in quantity.source.iter().chain(&quantity.note) {
                let _ = writeln!(text, "      {remark}");
            }
        }
        let _ = writeln!(text, "\nCurves");
        for (key, origin) in &self.origins {
            let _ = writeln!(text, "  {key:<24} {}", origin.words());
        }
        for (heading, lines) in [("Notes", &self.notes), ("Warnings", &self.warnings)] {
            if !lines.is_empty() {
                let _ = writeln!(text, "\n{heading}");
                lines.iter().for_each(|line| {
                    let _ = writeln!(text, "  - {line}");
                });
            }
        }
        let _ = writeln!(text, "\nSource: {}\nLicence: {}", self.source, self.licence);
        text
    }
}
