//! JSON bodies of the HTTP interface.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Body of every answer that is not a success.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Failure {
    /// What went wrong.
    pub error: FailureDetail,
}

/// What went wrong.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FailureDetail {
    /// Which kind, for programs.
    pub code: String,
    /// The field, the value got and what is allowed.
    pub message: String,
}

/// Answer of `GET /v1/sessions`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SessionList {
    /// Every live session, by id.
    pub sessions: Vec<SessionSummary>,
}

/// One session, as in `GET /v1/sessions/{id}`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SessionSummary {
    /// Id, as in the paths.
    pub id: String,
    /// Name of its scene.
    pub scene: String,
    /// Name of its fabric.
    pub fabric: String,
    /// Particles along warp and weft.
    pub particles: [usize; 2],
    /// Ticks per second now, while the cloth moves.
    pub tick_hz: f64,
    /// Time simulated so far [s].
    pub time_s: f64,
    /// True when the cloth is at rest and the session sleeps.
    pub resting: bool,
    /// True while a client's hand holds a particle.
    pub held: bool,
    /// Haptic sockets.
    pub haptic_clients: usize,
    /// View sockets.
    pub viewers: usize,
    /// What is doubtful about the scene, in sentences: a mesh too coarse for its fabric.
    pub warnings: Vec<String>,
}

/// Body of `POST /v1/sessions/{id}/obstacles/{name}`: where an obstacle is to go.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Push {
    /// Position of its origin [m].
    pub position_m: [f64; 3],
    /// Rotation, world from obstacle, as a quaternion of any length but zero; none by default.
    #[serde(default = "no_turn")]
    pub rotation_xyzw: [f64; 4],
    /// Time it takes [s], 0 to 3600; 0 by default: as fast as the cloth allows.
    #[serde(default)]
    pub duration_s: f64,
}

fn no_turn() -> [f64; 4] {
    [0.0, 0.0, 0.0, 1.0]
}

/// Answer of `GET /v1/sessions/{id}/state`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct State {
    /// Time simulated so far [s].
    pub time_s: f64,
    /// Steps so far.
    pub step: u64,
    /// True when the cloth is at rest and the session sleeps.
    pub resting: bool,
    /// Particles of the finest lattice.
    pub particles_total: usize,
    /// Particles that carry degrees of freedom.
    pub particles_active: usize,
    /// Particles slaved to others.
    pub particles_ghost: usize,
    /// Active particles by level: those beside the finest cells first, then beside cells twice as large, and so on.
    pub particles_by_level: Vec<usize>,
    /// Changes of the mesh since the start.
    pub mesh_changes: u64,
    /// The paper's cost, dimensionless.
    pub cost: Cost,
    /// Largest force out of balance on a free particle [N].
    pub residual_n: f64,
    /// Strain and gravity energy [J].
    pub energy_j: f64,
    /// The hand, where the scene or a client has one.
    pub hand: Option<Hand>,
    /// Deepest penetration into an obstacle [m].
    pub max_penetration_m: f64,
    /// Time the newest step took [ms].
    pub solve_ms: f64,
    /// Ticks per second now, while the cloth moves.
    pub tick_hz: f64,
    /// Who solves its linear systems now: `fronts`, `faer` or `multigrid`.
    pub solver: String,
    /// What is doubtful about the scene, as in the session.
    pub warnings: Vec<String>,
}

/// The paper's cost by term, dimensionless.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Cost {
    /// Sum of the terms.
    pub total: f64,
    /// Violation of Newton's law.
    pub newton: f64,
    /// Violation of the tensile envelope.
    pub stretch: f64,
    /// Violation of the bending envelope.
    pub bend: f64,
    /// Violation of the shear envelope.
    pub shear: f64,
}

/// The hand in a snapshot.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Hand {
    /// Particle `[i, j]`.
    pub particle: [usize; 2],
    /// True while a client holds it; false while it is only pinned.
    pub held: bool,
    /// Position [m].
    pub position_m: [f64; 3],
    /// Force of the cloth on the hand [N].
    pub force_n: [f64; 3],
    /// Bound on the error of the force from incomplete minimization [N].
    pub force_error_n: f64,
    /// Condensed stiffness, rows of a symmetric 3 × 3 matrix [N/m], not clamped to a device.
    pub stiffness_n_per_m: [[f64; 3]; 3],
}
