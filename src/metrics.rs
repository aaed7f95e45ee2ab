//! What the server counts, as Prometheus text: per session by the label `session`, in base units.
//!
//! A session's counters are handed out once and are then plain atomics: counting takes no lock that a tick could wait
//! for, but for the histogram's own.

use crate::phase::{Phase, Stopwatch};
use prometheus_client::{
    encoding::{EncodeLabelSet, text::encode},
    metrics::{counter::Counter, family::Family, gauge::Gauge, histogram::Histogram},
    registry::{Registry, Unit},
};
use std::sync::{Mutex, atomic::AtomicU64};

/// Upper bounds of the histograms [s].
const TICK_BUCKETS: [f64; 14] =
    [50e-6, 100e-6, 250e-6, 500e-6, 1e-3, 2e-3, 3e-3, 4e-3, 6e-3, 10e-3, 20e-3, 50e-3, 0.1, 0.5];

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Label {
    session: String,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct PhaseLabel {
    session: String,
    phase: &'static str,
}

type Counters = Family<Label, Counter>;
type Seconds = Counter<f64, AtomicU64>;
type Phases = Family<PhaseLabel, Seconds>;
type Gauges = Family<Label, Gauge>;
type Hertz = Gauge<f64, AtomicU64>;
type Rates = Family<Label, Hertz>;
type Histograms = Family<Label, Histogram, fn() -> Histogram>;

/// All metrics of a server.
#[derive(Debug)]
pub struct Metrics {
    registry: Mutex<Registry>,
    tick: Histograms,
    remesh: Histograms,
    adopt: Histograms,
    phases: Phases,
    rates: Rates,
    counters: Vec<Counters>,
    gauges: Vec<Gauges>,
}

/// The counters of one session.
#[derive(Clone, Debug)]
pub struct SessionMetrics {
    /// Duration of a tick: its step, its frame and its recording [s].
    pub tick_seconds: Histogram,
    /// Time that a thread beside the ticks took to look at the mesh and to prepare a new one [s].
    pub remesh_seconds: Histogram,
    /// Time that a change to a prepared mesh took from the ticks [s].
    pub adopt_seconds: Histogram,
    /// Time spent in each phase of the steps [s].
    pub phase_seconds: [Seconds; Phase::ALL.len()],
    /// Ticks per second that are aimed at [Hz].
    pub tick_rate: Hertz,
    /// Iterations of conjugate gradients.
    pub iterations: Counter,
    /// Changes of the mesh.
    pub mesh_changes: Counter,
    /// Steps of the physics.
    pub steps: Counter,
    /// Linear solves.
    pub solves: Counter,
    /// Ticks whose time had passed before they could begin.
    pub missed_ticks: Counter,
    /// Ticks that were not needed because the cloth was at rest.
    pub slept_ticks: Counter,
    /// Hand poses that were too old to be part of a path when their tick came.
    pub poses_dropped: Counter,
    /// Steps rolled back because a number was not finite.
    pub not_finite: Counter,
    /// Force models sent.
    pub models_sent: Counter,
    /// Force models withheld because they told nothing.
    pub models_withheld: Counter,
    /// View frames encoded; each is shared by all viewers it is due for.
    pub frames_encoded: Counter,
    /// View frames sent.
    pub frames_sent: Counter,
    /// View frames that were due but skipped because the viewer had two unacknowledged.
    pub frames_skipped: Counter,
    /// Sockets closed because a write or an answer took too long.
    pub clients_dropped: Counter,
    /// Pieces of a recording that were dropped.
    pub recording_dropped: Gauge,
    /// Haptic sockets open.
    pub haptic_clients: Gauge,
    /// View sockets open.
    pub viewers: Gauge,
    /// 1 while the cloth is at rest.
    pub resting: Gauge,
    /// Particles that carry degrees of freedom.
    pub particles_active: Gauge,
}

const COUNTERS: [(&str, &str); 14] = [
    ("kesi_iterations", "Iterations of conjugate gradients"),
    ("kesi_mesh_changes", "Changes of the mesh"),
    ("kesi_steps", "Steps of the physics"),
    ("kesi_solves", "Linear solves"),
    ("kesi_missed_ticks", "Ticks whose time had passed before they could begin"),
    ("kesi_slept_ticks", "Ticks not needed because the cloth was at rest"),
    ("kesi_poses_dropped", "Hand poses for which there was no room between two ticks"),
    ("kesi_not_finite", "Steps rolled back because a number was not finite"),
    ("kesi_force_models_sent", "Force models sent"),
    (
        "kesi_force_models_withheld",
        "Force models withheld because their error is far beyond the device's range",
    ),
    ("kesi_view_frames_encoded", "View frames encoded"),
    ("kesi_view_frames_sent", "View frames sent"),
    ("kesi_view_frames_skipped", "View frames due but skipped for want of acknowledgement"),
    ("kesi_clients_dropped", "Sockets closed because a write or an answer took too long"),
];

const GAUGES: [(&str, &str); 5] = [
    ("kesi_recording_dropped", "Pieces of the recording that were dropped"),
    ("kesi_haptic_clients", "Haptic sockets open"),
    ("kesi_viewers", "View sockets open"),
    ("kesi_resting", "1 while the cloth is at rest"),
    ("kesi_particles_active", "Particles that carry degrees of freedom"),
];

impl SessionMetrics {
    /// Adds what a step's stopwatch measured.
    pub fn add_phases(&self, watch: &Stopwatch) {
        for (phase, seconds) in Phase::ALL.into_iter().zip(&self.phase_seconds) {
            seconds.inc_by(watch.lap(phase).seconds);
        }
        self.iterations.inc_by(u64::from(watch.lap(Phase::Iteration).count));
    }
}

impl Default for Metrics {
    fn default() -> Metrics {
        let mut registry = Registry::default();
        let mut histogram = |name: &str, help: &str| {
            let family = Family::new_with_constructor((|| Histogram::new(TICK_BUCKETS)) as fn() -> Histogram);
            registry.register_with_unit(name, help, Unit::Seconds, family.clone());
            family
        };
        let tick = histogram("kesi_tick", "Duration of a tick");
        let remesh =
            histogram("kesi_remesh", "Looking at the mesh and preparing a new one, beside the ticks");
        let adopt = histogram("kesi_adopt", "Time that a change to a prepared mesh takes from the ticks");
        let phases = Phases::default();
        registry.register_with_unit(
            "kesi_phase",
            "Time spent in a phase of the steps",
            Unit::Seconds,
            phases.clone(),
        );
        let rates = Rates::default();
        registry.register_with_unit(
            "kesi_tick_rate",
            "Ticks per second that are aimed at while the cloth moves",
            Unit::Other("hertz".into()),
            rates.clone(),
        );
        let counters = COUNTERS.map(|(name, help)| {
            let family = Counters::default();
            registry.register(name, help, family.clone());
            family
        });
        let gauges = GAUGES.map(|(name, help)| {
            let family = Gauges::default();
            registry.register(name, help, family.clone());
            family
        });
        Metrics {
            registry: Mutex::new(registry),
            tick,
            remesh,
            adopt,
            phases,
            rates,
            counters: counters.into(),
            gauges: gauges.into(),
        }
    }
}

impl Metrics {
    /// Counters of a session, from zero.
    pub fn session(&self, id: &str) -> SessionMetrics {
        let label = Label { session: id.into() };
        let mut counters = self.counters.iter().map(|f| f.get_or_create(&label).clone());
        let mut counter = || counters.next().expect("one family per field");
        let mut gauges = self.gauges.iter().map(|f| f.get_or_create(&label).clone());
        let mut gauge = || gauges.next().expect("one family per field");
        SessionMetrics {
            tick_seconds: self.tick.get_or_create(&label).clone(),
            remesh_seconds: self.remesh.get_or_create(&label).clone(),
            adopt_seconds: self.adopt.get_or_create(&label).clone(),
            phase_seconds: Phase::ALL.map(|phase| {
                let label = PhaseLabel { session: id.into(), phase: phase.name() };
                self.phases.get_or_create(&label).clone()
            }),
            tick_rate: self.rates.get_or_create(&label).clone(),
            iterations: counter(),
            mesh_changes: counter(),
            steps: counter(),
            solves: counter(),
            missed_ticks: counter(),
            slept_ticks: counter(),
            poses_dropped: counter(),
            not_finite: counter(),
            models_sent: counter(),
            models_withheld: counter(),
            frames_encoded: counter(),
            frames_sent: counter(),
            frames_skipped: counter(),
            clients_dropped: counter(),
            recording_dropped: gauge(),
            haptic_clients: gauge(),
            viewers: gauge(),
            resting: gauge(),
            particles_active: gauge(),
        }
    }

    /// Forgets the counters of a session that ended.
    pub fn forget(&self, id: &str) {
        let label = Label { session: id.into() };
        [&self.tick, &self.remesh, &self.adopt].into_iter().for_each(|f| _ = f.remove(&label));
        for phase in Phase::ALL {
            self.phases.remove(&PhaseLabel { session: id.into(), phase: phase.name() });
        }
        self.rates.remove(&label);
        self.counters.iter().for_each(|f| _ = f.remove(&label));
        self.gauges.iter().for_each(|f| _ = f.remove(&label));
    }

    /// Everything in the Prometheus text format.
    pub fn text(&self) -> String {
        let mut out = String::new();
        let registry = self.registry.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        encode(&mut out, &registry).expect("writing to a string does not fail");
        out
    }
}
