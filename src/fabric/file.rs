//! A fabric file once read: every quantity with where it comes from, every law with what it was made from.

use crate::fabric::{Fabric, parameters::Chosen, units::*};
use serde::Serialize;

/// Where a number comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub enum Provenance {
    /// Measured on this fabric.
    Measured,
    /// Read off a printed curve of this fabric.
    Digitised,
    /// Follows from other numbers of this fabric.
    FromParameters,
    /// Measured on another fabric.
    Borrowed,
    /// Put in place of a published number that is not credible.
    Substituted,
    /// Chosen by somebody.
    Chosen,
}

/// The words used in files.
pub const PROVENANCES: [(&str, Provenance); 6] = [
    ("measured", Provenance::Measured),
    ("digitised", Provenance::Digitised),
    ("from_parameters", Provenance::FromParameters),
    ("borrowed", Provenance::Borrowed),
    ("substituted", Provenance::Substituted),
    ("chosen", Provenance::Chosen),
];

impl Provenance {
    /// The word used in files.
    pub fn name(self) -> &'static str {
        PROVENANCES.iter().find(|p| p.1 == self).map_or("", |p| p.0)
    }
}

/// A number with its unit and where it comes from.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub struct Quantity {
    /// Dotted key in the file.
    pub key: String,
    /// Value in `unit`.
    pub value: f64,
    /// Unit; "1" for none.
    pub unit: &'static str,
    /// The same in SI.
    pub value_si: f64,
    /// SI unit.
    pub unit_si: &'static str,
    /// Where the value comes from.
    pub provenance: Provenance,
    /// What the source prints, where that is not the value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub published: Option<f64>,
    /// Source, where it is not the file's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
    /// Remark.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

/// What a law was made from.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case", tag = "from")]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub enum Origin {
    /// The short formulas through KES parameters.
    Parameters {
        /// The worst of them.
        provenance: Provenance,
    },
    /// The branches of a curve in a file of this kind.
    Curve {
        /// Name of the file, beside the fabric's.
        file: String,
        /// `measured` or `digitised`.
        kind: String,
        /// Who measured it.
        source: String,
        /// Terms of use.
        licence: String,
    },
}

/// A fabric file, read and checked.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(feature = "wire", derive(schemars::JsonSchema))]
pub struct FabricFile {
    /// Name, the same as the file's.
    pub name: String,
    /// Name for people.
    pub title: String,
    /// Weave.
    pub structure: String,
    /// Source of all quantities that name no other.
    pub source: String,
    /// Terms of use of the numbers.
    pub licence: String,
    /// What the reader should know.
    pub notes: Vec<String>,
    /// What the curves are: `measured`, `digitised` or `from_parameters`; the last as soon as one law is.
    pub kind: String,
    /// Every quantity of the file, in the file's units.
    pub quantities: Vec<Quantity>,
    /// Where the laws come from, by `tensile.warp` and so on.
    pub origins: Vec<(String, Origin)>,
    /// What is odd without being wrong.
    pub warnings: Vec<String>,
    /// What nobody measured.
    #[serde(skip)]
    pub chosen: Chosen,
    /// The fabric in SI.
    #[serde(skip)]
    pub fabric: Fabric,
}

/// Factor to SI and the SI unit of a unit of fabric files.
pub fn si(unit: &str) -> (f64, &'static str) {
    match unit {
        "mg/cm2" => (MG_PER_CM2, "kg/m2"),
        "mm" => (MM, "m"),
        "%" => (PERCENT, "1"),
        "gf/cm" => (GF_PER_CM, "N/m"),
        "gf.cm/cm2" => (GF_CM_PER_CM2, "J/m2"),
        "gf.cm2/cm" => (GF_CM2_PER_CM, "N.m"),
        "gf.cm/cm" => (GF_CM_PER_CM, "N"),
        "1/cm" => (PER_CM, "1/m"),
        "gf/(cm.deg)" => (GF_PER_CM_DEGREE, "N/(m.rad)"),
        "deg" => (DEGREE, "rad"),
        _ => (1.0, "1"),
    }
}

/// The kind of a fabric's curves: a curve made from parameters is never called measured.
pub fn kind(origins: &[(String, Origin)]) -> String {
    let kind = |origin: &Origin| match origin {
        Origin::Parameters { .. } => Provenance::FromParameters.name().to_owned(),
        Origin::Curve { kind, .. } => kind.clone(),
    };
    let kinds: Vec<String> = origins.iter().map(|o| kind(&o.1)).collect();
    ["from_parameters", "digitised", "measured"]
        .into_iter()
        .find(|k| kinds.iter().any(|kind| kind == k))
        .unwrap_or("from_parameters")
        .to_owned()
}
