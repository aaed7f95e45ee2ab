//! Fabric files: TOML in KES units as published, every quantity with where it comes from; read into a `Fabric` in SI.
//!
//! With `measured`, `units` and `instrument` the only code that knows gf, cm and degrees. Nothing is hidden: doubtful
//! numbers stay in the file as `published`, beside the one that is used.

use crate::fabric::{
    Fabric,
    document::{Document, Fault, Faults, Problem, Section},
    file::{FabricFile, Origin, PROVENANCES, Provenance, Quantity, kind, si},
    isotropic_twist,
    law::Law,
    measured::{self, Curve, Reading, Test},
    parameters::{Bending, Chosen, Shear, Tensile},
    rigidity,
    units::*,
};

/// Opens a CSV file that a fabric file names.
pub type OpenCurve<'a> = &'a dyn Fn(&str) -> Result<String, String>;

/// A quantity's key, unit and allowed range in that unit, ends included.
struct Rule(&'static str, &'static str, f64, f64);

const AREAL_DENSITY: Rule = Rule("areal_density", "mg/cm2", 0.5, 300.0);
const THICKNESS: Rule = Rule("thickness", "mm", 0.01, 10.0);
const FRICTION: Rule = Rule("friction", "1", 0.0, 2.0);
const MAX_LOAD: Rule = Rule("max_load", "gf/cm", 1.0, 5000.0);
const EMT: Rule = Rule("EMT", "%", 0.05, 150.0);
const LT: Rule = Rule("LT", "1", 0.05, 0.999);
const WT: Rule = Rule("WT", "gf.cm/cm2", 0.001, 5000.0);
const RT: Rule = Rule("RT", "%", 5.0, 100.0);
const B: Rule = Rule("B", "gf.cm2/cm", 1e-4, 20.0);
const HB2: Rule = Rule("2HB", "gf.cm/cm", 0.0, 20.0);
const READ_AT: Rule = Rule("read_at", "1/cm", 0.5, 1.5);
const G: Rule = Rule("G", "gf/(cm.deg)", 0.01, 50.0);
const HG2: Rule = Rule("2HG", "gf/cm", 0.0, 100.0);
const HG5: Rule = Rule("2HG5", "gf/cm", 0.0, 200.0);
const DRAPE: [Rule; 2] = [Rule("coefficient", "%", 1.0, 100.0), Rule("nodes", "1", 0.0, 50.0)];
const CHOSEN: [Rule; 8] = [
    Rule("residual_strain", "1", 0.01, 0.9),
    Rule("compression", "1", 1e-3, 1.0),
    Rule("compression_blend", "1", 1e-6, 1e-2),
    Rule("tensile_stick", "1", 1e-4, 0.1),
    Rule("bending_stick", "1/cm", 1e-3, 0.2),
    Rule("shear_stick", "deg", 1e-3, 0.2),
    Rule("shear_rounding", "deg", 0.01, 0.45),
    Rule("twist", "gf.cm2/cm", 0.0, 40.0),
];

/// Deviation past which a number that follows from others is warned of.
const DEVIATION: f64 = 0.03;

/// Reads a fabric file. `file` names it in faults, `stem` is the name it must carry; all faults are returned at once.
pub fn read(file: &str, stem: Option<&str>, text: &str, open: OpenCurve) -> Result<FabricFile, Faults> {
    let document = Document::new(file, text);
    let root = document.parse();
    let mut reader = Reader { quantities: vec![], origins: vec![], warnings: vec![], foreign: vec![], open };
    let read = reader.fabric(&document.section(&root), stem);
    let foreign = reader.foreign;
    let mut faults = document.faults();
    faults.extend(foreign);
    match read {
        Some(file) if faults.is_empty() => Ok(file),
        _ => Err(Faults(faults)),
    }
}

struct Reader<'a> {
    quantities: Vec<Quantity>,
    origins: Vec<(String, Origin)>,
    warnings: Vec<String>,
    /// Faults in CSV files.
    foreign: Vec<Fault>,
    open: OpenCurve<'a>,
}

impl Reader<'_> {
    fn fabric(&mut self, root: &Section, stem: Option<&str>) -> Option<FabricFile> {
        root.only(&[
            "name",
            "title",
            "structure",
            "source",
            "licence",
            "notes",
            "areal_density",
            "thickness",
            "friction",
            "tensile",
            "bending",
            "shear",
            "chosen",
            "drape",
        ]);
        let name = root.required_text("name", "the fabric's name, as the file's");
        if let (Some(name), Some(stem)) = (&name, stem)
            && name != stem
        {
            root.fault("name", Problem::Range { got: format!("\"{name}\""), allowed: format!("\"{stem}\"") });
        }
        let title = root.required_text("title", "a name for people");
        let source = root.required_text("source", "who measured it");
        let licence = root.required_text("licence", "the terms of use of the numbers");
        let structure = root.text("structure").unwrap_or_default();
        let notes = root.texts("notes");

        let areal_density = self.required(root, &AREAL_DENSITY);
        let thickness = self.required(root, &THICKNESS);
        let friction = self.required(root, &FRICTION);
        let chosen = self.chosen(root);
        let tensile = self.directions(root, "tensile", |r, s| r.tensile(s, &chosen));
        let bending = self.directions(root, "bending", |r, s| r.bending(s, &chosen));
        let shear = self.section(root, "shear").and_then(|s| self.shear(&s, &chosen));
        if let Some(drape) = root.section("drape") {
            drape.only(&[DRAPE[0].0, DRAPE[1].0]);
            DRAPE.iter().for_each(|rule| {
                self.optional(&drape, rule);
            });
        }
        let (name, bending) = (name?, bending?);
        let twist = chosen.twist.unwrap_or_else(|| self.isotropic_twist(&bending));
        let fabric = Fabric {
            name: name.clone(),
            areal_density: areal_density? * MG_PER_CM2,
            thickness: thickness? * MM,
            tensile: tensile?,
            bending,
            shear: shear?,
            twist,
            friction: friction?,
        };
        let (title, source, licence) = (title?, source?, licence?);
        Some(FabricFile {
            name,
            title,
            structure,
            source,
            licence,
            notes,
            kind: kind(&self.origins),
            quantities: std::mem::take(&mut self.quantities),
            origins: std::mem::take(&mut self.origins),
            warnings: std::mem::take(&mut self.warnings),
            chosen,
            fabric,
        })
    }

    /// A quantity that may be missing.
    fn optional(&mut self, section: &Section, rule: &Rule) -> Option<f64> {
        let Rule(key, unit, low, high) = *rule;
        let (_, value) = section.value(key)?;
        if !value.is_table() {
            let expected = format!("a table {{ value, unit = \"{unit}\", provenance }}");
            let got = value.type_str().to_owned();
            section.fault(key, Problem::Kind { got: format!("a bare {got}"), expected });
            return None;
        }
        let table = section.section(key)?;
        table.only(&["value", "unit", "provenance", "published", "source", "note"]);
        if !table.has("value") {
            table.fault("value", Problem::Missing(format!("allowed: {low} to {high} {unit}")));
        }
        let number = table.number("value");
        let allowed = number.filter(|n| (low..=high).contains(n));
        if let (Some(number), None) = (number, allowed) {
            let shown = if unit == "1" { "" } else { unit };
            let allowed = format!("{low} to {high} {shown}").trim_end().to_owned();
            table.fault("value", Problem::Range { got: number.to_string(), allowed });
        }
        let given = table.text("unit");
        if given.as_deref().unwrap_or("1") != unit {
            let problem = match given {
                Some(given) => Problem::Range { got: format!("\"{given}\""), allowed: format!("\"{unit}\"") },
                None => Problem::Missing(format!("allowed: \"{unit}\"")),
            };
            table.fault("unit", problem);
        }
        let words = PROVENANCES.map(|p| p.0).join(", ");
        let word = table.required_text("provenance", &format!("one of {words}"))?;
        let Some(&(_, provenance)) = PROVENANCES.iter().find(|p| p.0 == word) else {
            table.fault("provenance", Problem::Range { got: format!("\"{word}\""), allowed: words });
            return None;
        };
        if matches!(provenance, Provenance::Borrowed | Provenance::Substituted) && !table.has("source") {
            table.fault("source", Problem::Missing(format!("a {word} quantity names where it comes from")));
        }
        self.quantities.push(Quantity {
            key: section.path(key),
            value: allowed?,
            unit,
            value_si: allowed? * si(unit).0,
            unit_si: si(unit).1,
            provenance,
            published: table.number("published"),
            source: table.text("source"),
            note: table.text("note"),
        });
        allowed
    }

    fn required(&mut self, section: &Section, rule: &Rule) -> Option<f64> {
        let Rule(key, unit, low, high) = *rule;
        if !section.has(key) {
            section.fault(key, Problem::Missing(format!("allowed: {low} to {high} {unit}")));
        }
        self.optional(section, rule)
    }

    fn section<'s>(&self, root: &Section<'s>, key: &str) -> Option<Section<'s>> {
        if !root.has(key) {
            root.fault(key, Problem::Missing("a fabric has tensile, bending and shear".to_owned()));
        }
        root.section(key)
    }

    /// Laws along warp and weft, given twice or once for both.
    fn directions(
        &mut self,
        root: &Section,
        key: &str,
        mut law: impl FnMut(&mut Self, &Section) -> Option<Law>,
    ) -> Option<[Law; 2]> {
        let section = self.section(root, key)?;
        section.only(&["both", "warp", "weft"]);
        if section.has("both") && !section.has("warp") && !section.has("weft") {
            let both = law(self, &section.section("both")?)?;
            return Some([both.clone(), both]);
        }
        if section.has("both") || !section.has("warp") || !section.has("weft") {
            section.fault("", Problem::Missing("give either `both`, or `warp` and `weft`".to_owned()));
        }
        let [warp, weft] = ["warp", "weft"].map(|d| section.section(d).and_then(|s| law(self, &s)));
        Some([warp?, weft?])
    }

    /// The default of the twist rigidity [N·m], told among the quantities like one of the file.
    fn isotropic_twist(&mut self, bending: &[Law; 2]) -> f64 {
        let twist = isotropic_twist(bending.each_ref().map(rigidity));
        let Rule(key, unit, ..) = CHOSEN[7];
        self.quantities.push(Quantity {
            key: format!("chosen.{key}"),
            value: twist / si(unit).0,
            unit,
            value_si: twist,
            unit_si: si(unit).1,
            provenance: Provenance::Chosen,
            published: None,
            source: None,
            note: Some(
                "no KES test measures twist: that of a sheet alike in all directions, twice B".to_owned(),
            ),
        });
        twist
    }

    fn chosen(&mut self, root: &Section) -> Chosen {
        let mut chosen = Chosen::default();
        let Some(section) = root.section("chosen") else { return chosen };
        section.only(&CHOSEN.each_ref().map(|r| r.0));
        let [residual, compression, blend, tensile, bending, shear, rounding, twist] =
            CHOSEN.each_ref().map(|rule| self.optional(&section, rule));
        chosen.residual_strain = residual.or(chosen.residual_strain);
        chosen.twist = twist.map(|v| v * GF_CM2_PER_CM);
        let set = |field: &mut f64, value: Option<f64>, factor: f64| {
            *field = value.map_or(*field, |v| v * factor);
        };
        set(&mut chosen.compression, compression, 1.0);
        set(&mut chosen.compression_blend, blend, 1.0);
        set(&mut chosen.tensile_stick, tensile, 1.0);
        set(&mut chosen.bending_stick, bending, PER_CM);
        set(&mut chosen.shear_stick, shear, DEGREE);
        set(&mut chosen.shear_rounding, rounding, DEGREE);
        chosen
    }

    fn tensile(&mut self, section: &Section, chosen: &Chosen) -> Option<Law> {
        section.only(&["curve", "max_load", "EMT", "LT", "WT", "RT"]);
        if section.has("curve") {
            let given = [MAX_LOAD, EMT, LT, WT, RT].map(|rule| (self.optional(section, &rule), rule.0));
            let curve = self.curve(section, Test::Tensile)?;
            if let Reading::Tensile(r) = curve.reading {
                let read =
                    [r.max_load / GF_PER_CM, r.emt / PERCENT, r.lt, r.wt / GF_CM_PER_CM2, r.rt / PERCENT];
                self.compare(section, given.into_iter().zip(read));
                self.compare(section, curve.max_load.map(|m| ((Some(m / GF_PER_CM), "max load"), read[0])));
            }
            return self.law(section, curve.law(chosen));
        }
        // The load is the instrument's setting: where it comes from says nothing about the fabric's numbers.
        let load = self.required(section, &MAX_LOAD);
        let first = self.quantities.len();
        let [emt, lt, rt] = [EMT, LT, RT].map(|rule| self.required(section, &rule));
        let provenance = self.worst(first);
        let wt = self.optional(section, &WT);
        let (max_load, emt, lt, rt) = (load? * GF_PER_CM, emt? * PERCENT, lt?, rt? * PERCENT);
        let follows = lt * max_load * emt / 2.0 / GF_CM_PER_CM2;
        self.compare(section, wt.map(|wt| ((Some(wt), "WT"), follows)));
        self.origins.push((section.name().to_owned(), Origin::Parameters { provenance }));
        let residual = chosen.residual_strain.unwrap_or(0.5 * (1.0 - rt));
        let highest = 0.999 * (1.0 - residual) / lt;
        if rt > highest && rt < 1.0 {
            let allowed = format!("less than {:.2} % with this LT and residual strain", 100.0 * highest);
            section.fault("RT", Problem::Range { got: (rt / PERCENT).to_string(), allowed });
            return None;
        }
        self.law(section, Tensile { max_load, emt, lt, rt }.law(chosen))
    }

    fn bending(&mut self, section: &Section, chosen: &Chosen) -> Option<Law> {
        section.only(&["curve", "B", "2HB", "read_at"]);
        self.optional(section, &READ_AT);
        if section.has("curve") {
            let given = [B, HB2].map(|rule| (self.optional(section, &rule), rule.0));
            let curve = self.curve(section, Test::Bending)?;
            if let Reading::Bending(r) = curve.reading {
                self.compare(section, given.into_iter().zip([r.b / GF_CM2_PER_CM, r.width / GF_CM_PER_CM]));
            }
            return self.law(section, curve.law(chosen));
        }
        let first = self.quantities.len();
        let [b, width] = [B, HB2].map(|rule| self.required(section, &rule));
        let provenance = self.worst(first);
        self.origins.push((section.name().to_owned(), Origin::Parameters { provenance }));
        self.law(section, Bending { b: b? * GF_CM2_PER_CM, width: width? * GF_CM_PER_CM }.law(chosen))
    }

    fn shear(&mut self, section: &Section, chosen: &Chosen) -> Option<Law> {
        section.only(&["curve", "G", "2HG", "2HG5"]);
        if section.has("curve") {
            let given = [G, HG2, HG5].map(|rule| (self.optional(section, &rule), rule.0));
            let curve = self.curve(section, Test::Shear)?;
            if let Reading::Shear(r) = curve.reading {
                let read = [r.g / GF_PER_CM_DEGREE, r.width / GF_PER_CM, r.width5 / GF_PER_CM];
                self.compare(section, given.into_iter().zip(read));
            }
            return self.law(section, curve.law(chosen));
        }
        let first = self.quantities.len();
        let [g, width, width5] = [G, HG2, HG5].map(|rule| self.required(section, &rule));
        let provenance = self.worst(first);
        self.origins.push(("shear".to_owned(), Origin::Parameters { provenance }));
        let (g, width, width5) = (g?, width?, width5?);
        // Half the loop is HG + h'(|φ| − 0.5°), h' = (2HG5 − 2HG)/9: positive from 0° to 8°, and no branch may fall.
        let span = 9.0;
        let at_zero = 0.5 - 0.5 * chosen.shear_rounding / DEGREE;
        let [low, high] = [
            width * (1.0 - 0.5 * span / 7.5),
            (width + 0.5 * span * g).min(width * (1.0 + 0.5 * span / at_zero)),
        ];
        if !(low..=high).contains(&width5) {
            let allowed = format!(
                "{low:.3} to {high:.3} gf/cm with this G and 2HG (the loop must stay open and no branch fall)"
            );
            section.fault("2HG5", Problem::Range { got: width5.to_string(), allowed });
            return None;
        }
        let shear = Shear { g: g * GF_PER_CM_DEGREE, width: width * GF_PER_CM, width5: width5 * GF_PER_CM };
        self.law(section, shear.law(chosen))
    }

    /// The provenance furthest from a measurement among the quantities read since `first`.
    fn worst(&self, first: usize) -> Provenance {
        self.quantities[first..].iter().map(|q| q.provenance).max().unwrap_or(Provenance::Chosen)
    }

    fn law(&self, section: &Section, law: Result<Law, crate::fabric::law::Unfit>) -> Option<Law> {
        law.map_err(|e| section.fault("", Problem::Contradiction(e.to_string()))).ok()
    }

    /// The curve that a section names, of the right test.
    fn curve(&mut self, section: &Section, test: Test) -> Option<Curve> {
        let file = section.text("curve")?;
        let text = (self.open)(&file).map_err(|e| section.fault("curve", Problem::Unreadable(e))).ok()?;
        let curve = measured::read(&file, &text).map_err(|faults| self.foreign.extend(faults)).ok()?;
        if curve.test != test {
            let problem = format!("{file} is a {:?} test, not {test:?}", curve.test);
            section.fault("curve", Problem::Contradiction(problem));
            return None;
        }
        let path = section.name().to_owned();
        if curve.direction != "both" && test != Test::Shear && !path.ends_with(&curve.direction) {
            let problem = format!("{file} was measured along the {}", curve.direction);
            section.fault("curve", Problem::Contradiction(problem));
        }
        let Curve { kind, source, licence, .. } = curve.clone();
        self.origins.push((path, Origin::Curve { file, kind, source, licence }));
        Some(curve)
    }

    /// Warns of given numbers that differ from those that follow.
    fn compare<'k>(
        &mut self,
        section: &Section,
        pairs: impl IntoIterator<Item = ((Option<f64>, &'k str), f64)>,
    ) {
        for ((given, key), follows) in pairs {
            let Some(given) = given else { continue };
            let deviation = (given - follows).abs() / follows.abs().max(1e-12);
            if deviation > DEVIATION {
                self.warnings.push(format!(
                    "line {}: {} is given as {given} but {follows:.4} follows ({:.1} % apart)",
                    section.line_of(key),
                    section.path(key),
                    100.0 * deviation
                ));
            }
        }
    }
}
