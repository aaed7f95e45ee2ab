//! TOML documents read with the line of every value, and all faults of a file collected before anything is refused.

use std::{cell::RefCell, fmt, ops::Range};
use toml::{
    Spanned,
    de::{DeTable, DeValue},
};

/// What is wrong with a value.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Problem {
    /// Not TOML, or not UTF-8, or not there.
    #[error("{0}")]
    Unreadable(String),
    /// A key that must be there is not.
    #[error("missing; {0}")]
    Missing(String),
    /// A key that nobody reads.
    #[error("unknown key; known here: {0}")]
    Unknown(String),
    /// A value of another kind.
    #[error("{got} is not {expected}")]
    Kind { got: String, expected: String },
    /// A number outside its range.
    #[error("{got} is out of range; allowed: {allowed}")]
    Range { got: String, allowed: String },
    /// Values that contradict each other.
    #[error("{0}")]
    Contradiction(String),
}

/// One fault: where, what value, what is allowed.
#[derive(Clone, Debug, PartialEq)]
pub struct Fault {
    /// File as named by the user.
    pub file: String,
    /// Line, counted from 1; 0 when the file as a whole is meant.
    pub line: usize,
    /// Dotted key.
    pub key: String,
    /// What is wrong.
    pub problem: Problem,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Fault { file, line, key, problem } = self;
        write!(f, "{file}")?;
        if *line > 0 {
            write!(f, ":{line}")?;
        }
        if !key.is_empty() {
            write!(f, ": {key}")?;
        }
        write!(f, ": {problem}")
    }
}

/// All faults of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Faults(pub Vec<Fault>);

impl std::error::Error for Faults {}

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let lines: Vec<String> = self.0.iter().map(Fault::to_string).collect();
        f.write_str(&lines.join("\n"))
    }
}

/// Line of a byte of `text`, counted from 1.
pub fn line_at(text: &str, byte: usize) -> usize {
    1 + text.as_bytes()[..byte.min(text.len())].iter().filter(|&&b| b == b'\n').count()
}

/// A file's text and the faults found in it so far.
pub struct Document<'t> {
    file: &'t str,
    text: &'t str,
    faults: RefCell<Vec<Fault>>,
}

impl<'t> Document<'t> {
    /// Reads `text`, named `file` in faults.
    pub fn new(file: &'t str, text: &'t str) -> Document<'t> {
        Document { file, text, faults: RefCell::default() }
    }

    /// Parses the text; syntax errors become faults and the rest is read on.
    pub fn parse(&self) -> Spanned<DeTable<'t>> {
        let (root, errors) = DeTable::parse_recoverable(self.text);
        for error in errors {
            let line = error.span().map_or(0, |s| line_at(self.text, s.start));
            self.fault(line, "", Problem::Unreadable(error.message().replace('\n', "; ")));
        }
        root
    }

    /// The document's outermost section.
    pub fn section<'a>(&'a self, root: &'a Spanned<DeTable<'t>>) -> Section<'a> {
        Section { document: self, path: String::new(), line: 0, table: root.get_ref() }
    }

    /// Notes a fault.
    pub fn fault(&self, line: usize, key: &str, problem: Problem) {
        let (file, key) = (self.file.to_owned(), key.to_owned());
        self.faults.borrow_mut().push(Fault { file, line, key, problem });
    }

    /// All faults, by line.
    pub fn faults(self) -> Vec<Fault> {
        let mut faults = self.faults.into_inner();
        faults.sort_by_key(|f| f.line);
        faults
    }

    fn line(&self, span: Range<usize>) -> usize {
        line_at(self.text, span.start)
    }
}

/// One table of a document.
#[derive(Clone)]
pub struct Section<'a> {
    document: &'a Document<'a>,
    path: String,
    /// Line where the table begins.
    pub line: usize,
    table: &'a DeTable<'a>,
}

impl<'a> Section<'a> {
    /// Dotted path of this section.
    pub fn name(&self) -> &str {
        &self.path
    }

    /// Dotted path of a key of this section.
    pub fn path(&self, key: &str) -> String {
        if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) }
    }

    /// Notes a fault at a key of this section; at the section itself where the key is not there.
    pub fn fault(&self, key: &str, problem: Problem) {
        let line = self.value(key).map_or(self.line, |(line, _)| line);
        let path = if key.is_empty() { self.path.clone() } else { self.path(key) };
        self.document.fault(line, &path, problem);
    }

    /// True when the key is there.
    pub fn has(&self, key: &str) -> bool {
        self.value(key).is_some()
    }

    /// Line of a key, or of the section.
    pub fn line_of(&self, key: &str) -> usize {
        self.value(key).map_or(self.line, |(line, _)| line)
    }

    /// Line and value of a key.
    pub fn value(&self, key: &str) -> Option<(usize, &'a DeValue<'a>)> {
        let (name, value) = self.table.iter().find(|(name, _)| name.get_ref() == key)?;
        Some((self.document.line(name.span()), value.get_ref()))
    }

    /// Notes every key that is not `known`.
    pub fn only(&self, known: &[&str]) {
        for (name, _) in self.table.iter().filter(|(name, _)| !known.contains(&name.get_ref().as_ref())) {
            self.fault(name.get_ref(), Problem::Unknown(known.join(", ")));
        }
    }

    /// A table.
    pub fn section(&self, key: &str) -> Option<Section<'a>> {
        let (line, value) = self.value(key)?;
        match value.as_table() {
            Some(table) => Some(Section { document: self.document, path: self.path(key), line, table }),
            None => self.wrong(key, value, "a table"),
        }
    }

    /// A text.
    pub fn text(&self, key: &str) -> Option<String> {
        let (_, value) = self.value(key)?;
        match value.as_str() {
            Some(text) => Some(text.to_owned()),
            None => self.wrong(key, value, "a text in quotes"),
        }
    }

    /// A text that must be there.
    pub fn required_text(&self, key: &str, what: &str) -> Option<String> {
        if !self.has(key) {
            self.fault(key, Problem::Missing(what.to_owned()));
        }
        self.text(key)
    }

    /// A list of texts; empty where it is not there.
    pub fn texts(&self, key: &str) -> Vec<String> {
        let Some((_, value)) = self.value(key) else { return Vec::new() };
        let texts = value
            .as_array()
            .and_then(|list| list.iter().map(|v| v.get_ref().as_str().map(str::to_owned)).collect());
        texts.or_else(|| self.wrong(key, value, "a list of texts")).unwrap_or_default()
    }

    /// A finite number.
    pub fn number(&self, key: &str) -> Option<f64> {
        let (_, value) = self.value(key)?;
        number(value).or_else(|| self.wrong(key, value, "a finite number"))
    }

    fn wrong<T>(&self, key: &str, value: &DeValue, expected: &str) -> Option<T> {
        self.fault(key, Problem::Kind { got: shown(value), expected: expected.to_owned() });
        None
    }
}

/// Line of a dotted key in a TOML text (list items by their number); 0 where it is not there.
pub fn line_of_key(text: &str, key: &str) -> usize {
    let (root, _) = DeTable::parse_recoverable(text);
    let (mut line, mut table, mut list) = (0, Some(root.get_ref()), None);
    for part in key.split(['.', '[', ']']).filter(|p| !p.is_empty()) {
        let next: Option<(Range<usize>, &DeValue)> = match (table, list) {
            (Some(t), _) => t.iter().find(|(n, _)| n.get_ref() == part).map(|(n, v)| (n.span(), v.get_ref())),
            (_, Some(l)) => {
                let l: &toml::de::DeArray = l;
                part.parse().ok().and_then(|i: usize| l.get(i)).map(|v| (v.span(), v.get_ref()))
            }
            _ => None,
        };
        let Some((span, value)) = next else { break };
        line = line_at(text, span.start);
        (table, list) = (value.as_table(), value.as_array());
    }
    line
}

fn number(value: &DeValue) -> Option<f64> {
    let number = match value {
        DeValue::Integer(i) => i64::from_str_radix(i.as_str(), i.radix()).ok()? as f64,
        DeValue::Float(f) => f.as_str().parse().ok()?,
        _ => return None,
    };
    number.is_finite().then_some(number)
}

/// A value as the user wrote it, near enough to be found.
fn shown(value: &DeValue) -> String {
    match value {
        DeValue::String(s) => format!("\"{s}\""),
        DeValue::Integer(i) => i.to_string(),
        DeValue::Float(f) => f.to_string(),
        DeValue::Boolean(b) => b.to_string(),
        DeValue::Datetime(d) => d.to_string(),
        DeValue::Array(_) => "a list".to_owned(),
        DeValue::Table(_) => "a table".to_owned(),
    }
}
