//! What a run costs: wall time, user time and peak memory of this process, as far as the system tells.

use std::{fs, time::Instant};

/// A running measurement.
pub(super) struct Meter {
    start: Instant,
    user: Option<f64>,
}

/// What a run cost.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Spent {
    /// Wall time [s].
    pub wall_s: f64,
    /// Processor time in user mode [s].
    pub user_s: Option<f64>,
    /// Largest resident memory of the process since the start [bytes]; what earlier runs left behind counts.
    pub peak_bytes: Option<u64>,
}

/// Ticks per second of the times in /proc, the same on every Linux.
const TICKS: f64 = 100.0;

impl Meter {
    pub(super) fn start() -> Meter {
        // Forgets the peak so far; where that is not allowed, the peak is that of the whole process.
        let _ = fs::write("/proc/self/clear_refs", "5");
        Meter { user: user(), start: Instant::now() }
    }

    /// Wall time so far [s].
    pub(super) fn wall(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }

    pub(super) fn stop(&self) -> Spent {
        let wall_s = self.wall();
        let user_s = user().zip(self.user).map(|(now, then)| now - then);
        Spent { wall_s, user_s, peak_bytes: status("VmHWM:") }
    }
}

/// Resident memory of the process [bytes].
pub(super) fn resident() -> Option<u64> {
    status("VmRSS:")
}

fn user() -> Option<f64> {
    let text = fs::read_to_string("/proc/self/stat").ok()?;
    // The name in brackets may hold spaces; user time is the 12th field after it.
    let field = text.rsplit_once(')')?.1.split_whitespace().nth(11)?;
    Some(field.parse::<f64>().ok()? / TICKS)
}

fn status(key: &str) -> Option<u64> {
    let text = fs::read_to_string("/proc/self/status").ok()?;
    let kilobytes =
        text.lines().find_map(|l| l.strip_prefix(key)?.split_whitespace().next()?.parse::<u64>().ok())?;
    Some(1024 * kilobytes)
}
