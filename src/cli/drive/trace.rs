//! What a driven hand did and felt: a CSV row per pose and per force model, and a summary.
//!
//! The round trip of a move is the time from sending it to the first force model that includes it or a later one; only
//! the newest move of a model counts. The ripple of the force is how far it is from its mean over a tenth of a second around it.

use crate::{
    cli::sorted::Sorted,
    math::Vec3,
    protocol::pose::{ForceModel, Move},
};
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
    /// Server time [s] and force [N] of every model.
    forces: Vec<(f64, Vec3)>,
}

/// Time over which a force is averaged to tell its ripple [s].
const SMOOTHING: f64 = 0.1;

/// Fewest forces that tell a mean.
const FEWEST: usize = 5;

/// How far each force is from the mean of those around it, where they are enough [N].
fn ripples(forces: &[(f64, Vec3)]) -> Vec<f64> {
    let near = |t: f64| {
        let [from, to] =
            [t - SMOOTHING / 2.0, t + SMOOTHING / 2.0].map(|end| forces.partition_point(|f| f.0 < end));
        &forces[from..to]
    };
    let ripple = |(t, force): &(f64, Vec3)| {
        let near = near(*t);
        let mean = near.iter().map(|f| f.1).sum::<Vec3>() / near.len() as f64;
        (near.len() >= FEWEST).then(|| (force - mean).norm())
    };
    forces.iter().filter_map(ripple).collect()
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
        let force = Vec3::from(model.force);
        self.summary.strongest = self.summary.strongest.max(force.norm());
        let time = model.server_us as f64 * 1e-6;
        // A state that is told again is no further one.
        if self.summary.forces.last().is_none_or(|last| last.0 < time) {
            self.summary.forces.push((time, force));
        }
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
        Ok(self.summary)
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "{} moves, {} force models, strongest force {:.3} N; ",
            self.moves, self.models, self.strongest
        )?;
        if self.round_trips.is_empty() {
            write!(f, "no move came back")?;
        } else {
            let trips = Sorted::of(self.round_trips.iter().copied());
            write!(f, "round trip p50 {:.2} ms, p99 {:.2} ms", trips.at(0.5), trips.at(0.99))?;
        }
        let ripples = ripples(&self.forces);
        if !ripples.is_empty() {
            let ripples = Sorted::of(ripples.iter().map(|ripple| ripple * 1e3));
            write!(f, "; ripple p50 {:.1} mN, p95 {:.1} mN", ripples.at(0.5), ripples.at(0.95))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ripple_is_what_a_mean_over_a_tenth_of_a_second_leaves() {
        let forces = |wave: f64| -> Vec<(f64, Vec3)> {
            let force =
                |k: i32| Vec3::new(0.0, 0.0, -1.0 + 0.01 * f64::from(k) + wave * f64::from(1 - 2 * (k % 2)));
            (0..200).map(|k| (0.005 * f64::from(k), force(k))).collect()
        };
        let middle =
            |forces: &[(f64, Vec3)]| ripples(forces)[50..150].iter().fold(0.0, |a: f64, b| a.max(*b));
        assert!(middle(&forces(0.0)) < 0.006, "a force that grows evenly has next to none");
        assert!((middle(&forces(0.1)) - 0.1).abs() < 0.006);
        assert!(ripples(&forces(0.1)[..4]).is_empty());
    }
}
