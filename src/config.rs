//! What the server can be told: defaults in `impl Default` alone, overlaid by a TOML file, then by flags.
//!
//! Every mistake is collected and shown at once; nothing is opened or bound here, but for reading the files named.

use serde::{Deserialize, Serialize};
use std::{
    net::{SocketAddr, ToSocketAddrs},
    path::{Path, PathBuf},
};
use toml::{Table, Value, de::DeTable};

/// The word that switches an optional part off.
pub const OFF: &str = "off";

/// Configuration of `kesi serve`, as in its TOML file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Address and port; port 0 takes a free one.
    pub listen: String,
    /// Scene of the session `default`: a built-in name or a TOML file.
    pub scene: String,
    /// Folder of recordings, or `off`.
    pub record: String,
    /// Address where live rerun viewers may connect, or `off`.
    pub rerun_serve: String,
    /// Web origins besides the server's own that may connect, as `https://host:port`.
    pub allow_origin: Vec<String>,
    /// What a tick may cost, and how late ones are made good.
    pub session: Pace,
    /// What clients may use.
    pub limits: Limits,
}

impl Default for Config {
    fn default() -> Config {
        Config {
            listen: "127.0.0.1:8080".into(),
            scene: "drape".into(),
            record: "recordings".into(),
            rerun_serve: OFF.into(),
            allow_origin: Vec::new(),
            session: Pace::default(),
            limits: Limits::default(),
        }
    }
}

/// Who solves a session's linear systems.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Solver {
    /// The faster of `fronts` and `multigrid`, measured on the scene when the session begins.
    #[default]
    Auto,
    /// Cholesky by dense fronts.
    Fronts,
    /// Cholesky by faer.
    Faer,
    /// Conjugate gradients with multigrid.
    Multigrid,
}

/// What a tick may cost, and how late ones are made good. How many there are in a second, the scene says, or their cost.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Pace {
    /// Linear solves per tick at the most; time ends them earlier.
    pub solves: u32,
    /// Linear solves per tick that time does not end; half as many in ticks of at most 5 ms. Longer ones with one left a sheet of
    /// 39 × 39 uneasy (measured); with two it rests as with more.
    pub least_solves: u32,
    /// Who solves: `auto`, `fronts`, `faer` or `multigrid`.
    pub solver: Solver,
    /// After missed ticks, one step covers the time gone by up to this; beyond it the cloth runs slow [s].
    pub longest_step_s: f64,
    /// Whether the mesh adapts: as few particles as force and folds allow.
    pub adaptive: bool,
}

impl Default for Pace {
    fn default() -> Pace {
        Pace { solves: 8, least_solves: 2, solver: Solver::default(), longest_step_s: 0.02, adaptive: true }
    }
}

/// What clients may use.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Sessions at once.
    pub sessions: usize,
    /// Sockets of one session, haptic and view together.
    pub clients_per_session: usize,
    /// Highest rate of view frames per viewer [Hz].
    pub view_hz: f64,
    /// A write that takes longer closes its socket [s].
    pub write_timeout_s: f64,
    /// A client that answers no ping for this long is dropped [s].
    pub idle_timeout_s: f64,
    /// Shutdown waits this long for sockets and recordings [s].
    pub shutdown_timeout_s: f64,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits {
            sessions: 8,
            clients_per_session: 128,
            view_hz: 60.0,
            write_timeout_s: 5.0,
            idle_timeout_s: 45.0,
            shutdown_timeout_s: 5.0,
        }
    }
}

/// A configuration that was checked, in the types the server uses.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Where to listen.
    pub listen: SocketAddr,
    /// Folder of recordings.
    pub record: Option<PathBuf>,
    /// Where live rerun viewers may connect.
    pub rerun_serve: Option<SocketAddr>,
    /// The configuration it came from.
    pub config: Config,
}

/// Everything that is wrong with a configuration.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct Mistakes(pub Vec<String>);

impl Config {
    /// The configuration as TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string_pretty(self).expect("a configuration is a TOML table")
    }

    /// Overlays the TOML file at `path`; every key that does not fit becomes one mistake, and keeps its default.
    pub fn read(path: &Path) -> (Config, Vec<String>) {
        let name = path.display();
        match std::fs::read_to_string(path) {
            Ok(text) => Config::parse(&text, &name.to_string()),
            Err(e) => (Config::default(), vec![format!("config {name}: {e}")]),
        }
    }

    /// Overlays TOML text from a file called `name`, as [`Config::read`].
    pub fn parse(text: &str, name: &str) -> (Config, Vec<String>) {
        let table: Table = match text.parse::<Table>() {
            Ok(table) => table,
            Err(e) => {
                let line = e.span().map_or(1, |s| line_of(text, s.start));
                return (Config::default(), vec![format!("{name}:{line}: {}", e.message())]);
            }
        };
        let mut merged = Table::try_from(Config::default()).expect("a configuration is a TOML table");
        let mut mistakes = Vec::new();
        for (path, value) in leaves(&table, &[]) {
            let mut trial = merged.clone();
            set(&mut trial, &path, value.clone());
            match Value::Table(trial.clone()).try_into::<Config>() {
                Ok(_) => merged = trial,
                Err(e) => {
                    let why = e.message().lines().next().unwrap_or_default().to_string();
                    let (key, line) = (path.join("."), line_of_key(text, &path));
                    mistakes.push(format!("{name}:{line}: {key} = {value}: {why}"));
                }
            }
        }
        (Value::Table(merged).try_into().expect("every key was tried"), mistakes)
    }

    /// Checks every range and address; `Err` names all that is wrong.
    pub fn check(self) -> Result<Settings, Mistakes> {
        let mut wrong = Vec::new();
        let listen = address("listen", &self.listen, &mut wrong);
        let rerun_serve = match self.rerun_serve.as_str() {
            OFF => None,
            text => Some(address("rerun_serve", text, &mut wrong)),
        };
        if self.record == OFF && rerun_serve.is_some() {
            wrong.push(format!(
                "rerun_serve is {:?}, but record is off: live viewers see what is recorded",
                self.rerun_serve
            ));
        }
        if self.record.is_empty() {
            wrong.push("record is empty, allowed: a folder, or `off`".into());
        }
        for origin in &self.allow_origin {
            let host = origin.strip_prefix("https://").or_else(|| origin.strip_prefix("http://"));
            if host.is_none_or(|h| h.is_empty() || h.contains(['/', '*', '@'])) {
                wrong.push(format!(
                    "allow_origin: {origin:?}, allowed: http://host[:port] or https://host[:port], no path"
                ));
            }
        }
        let (p, l) = (&self.session, &self.limits);
        for (key, value, least, most) in [
            ("session.solves", f64::from(p.solves), 1.0, 1000.0),
            ("session.least_solves", f64::from(p.least_solves), 1.0, f64::from(p.solves)),
            ("session.longest_step_s", p.longest_step_s, 0.001, 1.0),
            ("limits.sessions", l.sessions as f64, 1.0, 1024.0),
            ("limits.clients_per_session", l.clients_per_session as f64, 1.0, 65536.0),
            ("limits.view_hz", l.view_hz, 1.0, 1000.0),
            ("limits.write_timeout_s", l.write_timeout_s, 0.05, 600.0),
            ("limits.idle_timeout_s", l.idle_timeout_s, 1.0, 3600.0),
            ("limits.shutdown_timeout_s", l.shutdown_timeout_s, 0.1, 600.0),
        ] {
            if !(least..=most).contains(&value) {
                wrong.push(format!("{key} is {value}, allowed: {least} to {most}"));
            }
        }
        if !wrong.is_empty() {
            return Err(Mistakes(wrong));
        }
        let record = (self.record != OFF).then(|| PathBuf::from(&self.record));
        Ok(Settings { listen, record, rerun_serve, config: self })
    }
}

/// An address; on a mistake says so and returns one that is never used.
fn address(key: &str, text: &str, wrong: &mut Vec<String>) -> SocketAddr {
    match text.to_socket_addrs().map(|mut all| all.next()) {
        Ok(Some(address)) => address,
        _ => {
            wrong.push(format!("{key} is {text:?}, allowed: ADDRESS:PORT, as 127.0.0.1:8080"));
            SocketAddr::from(([0, 0, 0, 0], 0))
        }
    }
}

/// Every value of a table that is no table itself, with its path of keys.
fn leaves<'a>(table: &'a Table, above: &[&'a str]) -> Vec<(Vec<&'a str>, &'a Value)> {
    let mut all = Vec::new();
    for (key, value) in table {
        let path = [above, &[key.as_str()]].concat();
        match value {
            Value::Table(inner) if !inner.is_empty() => all.extend(leaves(inner, &path)),
            _ => all.push((path, value)),
        }
    }
    all
}

fn set(table: &mut Table, path: &[&str], value: Value) {
    let [key, rest @ ..] = path else { return };
    if rest.is_empty() {
        table.insert((*key).into(), value);
        return;
    }
    if let Value::Table(inner) = table.entry(*key).or_insert_with(|| Value::Table(Table::new())) {
        set(inner, rest, value);
    }
}

fn line_of(text: &str, byte: usize) -> usize {
    text.as_bytes()[..byte.min(text.len())].iter().filter(|&&b| b == b'\n').count() + 1
}

/// Line of the deepest key of a path that the text spells out.
fn line_of_key(text: &str, path: &[&str]) -> usize {
    let Ok(root) = DeTable::parse(text) else { return 1 };
    let (mut table, mut line) = (root.get_ref(), 1);
    for &name in path {
        let Some((key, value)) = table.iter().find(|(k, _)| k.get_ref().as_ref() == name) else { break };
        line = line_of(text, key.span().start);
        let Some(inner) = value.get_ref().as_table() else { break };
        table = inner;
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn printed_defaults_are_read_back() {
        let text = Config::default().to_toml();
        assert_eq!(Config::parse(&text, "printed"), (Config::default(), Vec::new()));
    }

    #[test]
    fn every_mistake_of_a_file_is_named_with_its_line() {
        let text =
            "listen = 5\n\n[session]\nsolves = \"many\"\nlongest_step_s = 0.1\n\n[limits]\nsesions = 2\n";
        let (config, all) = Config::parse(text, "kesi.toml");
        assert_eq!((config.listen, config.session.longest_step_s), (Config::default().listen, 0.1));
        assert_eq!(all.len(), 3, "{all:?}");
        for expected in ["kesi.toml:1: listen", "kesi.toml:4: session.solves", "kesi.toml:8: limits.sesions"]
        {
            assert!(all.iter().any(|m| m.starts_with(expected)), "{expected} is not in {all:?}");
        }
    }

    #[test]
    fn every_value_out_of_range_is_named() {
        let mut config =
            Config { listen: "nowhere".into(), allow_origin: vec!["*".into()], ..Config::default() };
        config.session.longest_step_s = f64::NAN;
        config.limits.sessions = 0;
        let Mistakes(all) = config.check().unwrap_err();
        assert_eq!(all.len(), 4, "{all:?}");
    }
}
