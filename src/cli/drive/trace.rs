//! What a driven hand did and felt: a CSV row per pose and per force model, and a summary.
//!
//! The round trip of a move is the time from sending it to the first force model that includes it or a later one; only
//! the newest move of a model counts.

use crate::protocol::pose::{ForceModel, Move};
use std::{collections::VecDeque, fmt, fs::File, path::Path, time::Duration};

const COLUMNS: [&str; 19] = [
    "event",
    "t_s",
    "move_seq",
    "x_m",
    "y_m",
    "z_m",
    "vx_m_per_s",
    "vy_m_per_s",
    "vz_m_per_s",
    "fx_n",
    "fy_n",
    "fz_n",
    "force_error_n",
    "model_seq",
    "server_s",
    "round_trip_ms",
    "solve_ms",
    "particles_active",
    "flags",
];

/// A trace being taken.
pub(super) struct Trace {
    out: Option<csv::Writer<File>>,
    waiting: VecDeque<Move>,
    summary: Summary,
}

/// What a trace comes to.
#[derive(Debug, Default)]
pub(super) struct Summary {
    moves: usize,
    models: usize,
    round_trips: Vec<f64>,
    strongest: f64,
}

impl Trace {
    /// Opens the file, if one is wanted.
    pub(super) fn create(path: Option<&Path>) -> Result<Trace, String> {
        let open = |p: &Path| {
            let mut out = csv::Writer::from_path(p).map_err(|e| format!("{}: {e}", p.display()))?;
            out.write_record(COLUMNS).map_err(|e| format!("{}: {e}", p.display()))?;
            Ok::<_, String>(out)
        };
        Ok(Trace { out: path.map(open).transpose()?, waiting: VecDeque::new(), summary: Summary::default() })
    }

    fn row(&mut self, fields: [String; 19]) -> csv::Result<()> {
        self.out.as_mut().map_or(Ok(()), |out| out.write_record(fields))
    }

    /// A pose is being sent.
    pub(super) fn moved(&mut self, pose: &Move) -> csv::Result<()> {
        self.summary.moves += 1;
        self.waiting.push_back(*pose);
        let mut fields: [String; 19] = Default::default();
        fields[0] = "move".into();
        fields[1] = format!("{:.6}", pose.t_us as f64 * 1e-6);
        fields[2] = pose.seq.to_string();
        (0..3).for_each(|k| fields[3 + k] = pose.position[k].to_string());
        self.row(fields)
    }

    /// A model came, `now` after the first move.
    pub(super) fn felt(&mut self, model: &ForceModel, now: Duration) -> csv::Result<()> {
        self.summary.models += 1;
        let mut newest = None;
        while let Some(pose) = self.waiting.pop_front_if(|pose| pose.seq <= model.move_seq) {
            newest = Some(pose);
        }
        let trip = newest.map(|pose| now.as_secs_f64() * 1e3 - pose.t_us as f64 * 1e-3);
        self.summary.round_trips.extend(trip);
        let strength = model.force.iter().map(|f| f * f).sum::<f64>().sqrt();
        self.summary.strongest = self.summary.strongest.max(strength);
        let mut fields: [String; 19] = Default::default();
        fields[0] = "model".into();
        fields[1] = format!("{:.6}", now.as_secs_f64());
        fields[2] = model.move_seq.to_string();
        (0..3).for_each(|k| fields[3 + k] = model.position[k].to_string());
        (0..3).for_each(|k| fields[6 + k] = model.velocity[k].to_string());
        (0..3).for_each(|k| fields[9 + k] = model.force[k].to_string());
        fields[12] = model.force_error.to_string();
        fields[13] = model.seq.to_string();
        fields[14] = format!("{:.6}", model.server_us as f64 * 1e-6);
        fields[15] = trip.map_or(String::new(), |t| format!("{t:.3}"));
        fields[16] = model.solve_ms.to_string();
        fields[17] = model.active.to_string();
        fields[18] = model.flags.to_string();
        self.row(fields)
    }

    /// Writes what is left, and sums up.
    pub(super) fn finish(mut self) -> std::io::Result<Summary> {
        if let Some(out) = &mut self.out {
            out.flush()?;
        }
        self.summary.round_trips.sort_by(f64::total_cmp);
        Ok(self.summary)
    }
}

impl Summary {
    /// A quantile of the round trips [ms].
    fn round_trip(&self, part: f64) -> Option<f64> {
        let last = self.round_trips.len().checked_sub(1)?;
        Some(self.round_trips[(part * last as f64).round() as usize])
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "{} moves, {} force models, strongest force {:.3} N; ",
            self.moves, self.models, self.strongest
        )?;
        match (self.round_trip(0.5), self.round_trip(0.99)) {
            (Some(p50), Some(p99)) => write!(f, "round trip p50 {p50:.2} ms, p99 {p99:.2} ms"),
            _ => write!(f, "no move came back"),
        }
    }
}
