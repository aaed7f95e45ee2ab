//! JSON messages of the haptic socket.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// What a client says on the haptic socket.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "op", rename_all = "snake_case")]
pub enum ClientMessage {
    /// Names the client and its device. Optional.
    Hello {
        /// Name of the client, for logs.
        #[serde(default)]
        client: String,
        /// What the device can do; the defaults hold without it.
        #[serde(default)]
        device: Device,
    },
    /// Takes a particle.
    Grab {
        /// Which one.
        at: At,
    },
    /// Moves the hand; the binary form is shorter.
    Move {
        /// Number of the move, rising.
        seq: u32,
        /// The client's clock [µs].
        t_us: u64,
        /// Position of the hand [m].
        position_m: [f64; 3],
    },
    /// Opens the hand.
    Release {
        /// False: the particle stays pinned where it is. True: it is free.
        #[serde(default)]
        let_go: bool,
    },
    /// Renews the lease and asks for a `pong`.
    Ping {
        /// The client's clock [µs].
        t_us: u64,
    },
}

/// Which particle a grab means.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum At {
    /// A corner of the sheet.
    Corner(Corner),
    /// A particle `[i, j]` of the lattice.
    Particle([u32; 2]),
    /// The particle nearest to a point [m].
    NearestM([f64; 3]),
}

/// A corner of the sheet: first its place along the warp, then along the weft.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Corner {
    /// i = 0, j = 0.
    #[serde(rename = "00")]
    Origin,
    /// i = I − 1, j = 0.
    #[serde(rename = "I0")]
    Warp,
    /// i = 0, j = J − 1.
    #[serde(rename = "0J")]
    Weft,
    /// i = I − 1, j = J − 1.
    #[serde(rename = "IJ")]
    Opposite,
}

impl Corner {
    /// The corner's place `[i, j]` in a lattice of `[I, J]` particles.
    pub fn site(self, counts: [usize; 2]) -> [usize; 2] {
        let [i, j] = [counts[0] - 1, counts[1] - 1];
        match self {
            Corner::Origin => [0, 0],
            Corner::Warp => [i, 0],
            Corner::Weft => [0, j],
            Corner::Opposite => [i, j],
        }
    }
}

/// What a haptic device can do.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Device {
    /// Largest force [N]. The server does not clamp the force: the device does, where it is safe to.
    pub max_force_n: f64,
    /// Largest stiffness that the device renders stably [N/m]; K is clamped to it.
    pub max_stiffness_n_per_m: f64,
    /// Rate of the device's own loop [Hz]: poses come as fast, models no faster.
    pub rate_hz: f64,
}

impl Default for Device {
    fn default() -> Device {
        Device { max_force_n: 3.3, max_stiffness_n_per_m: 400.0, rate_hz: 1000.0 }
    }
}

impl Device {
    /// Time between two turns of its loop, an hour at the most.
    pub fn interval(&self) -> Duration {
        Duration::from_secs_f64((1.0 / self.rate_hz).min(3600.0))
    }
    /// Says which field is out of range, if one is.
    pub fn check(&self) -> Result<(), String> {
        for (field, value, most) in [
            ("max_force_n", self.max_force_n, 1e3),
            ("max_stiffness_n_per_m", self.max_stiffness_n_per_m, 1e6),
            ("rate_hz", self.rate_hz, 1e5),
        ] {
            if !(value > 0.0 && value <= most) {
                return Err(format!("device.{field} is {value}, allowed: above 0, at most {most}"));
            }
        }
        Ok(())
    }
}

/// What the server says on the haptic socket in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "op", rename_all = "snake_case")]
pub enum ServerMessage {
    /// First message.
    Hello {
        /// The subprotocol.
        protocol: String,
        /// Name and version of the server.
        server: String,
        /// Id of the session.
        session: String,
        /// Ticks per second.
        tick_hz: f64,
        /// Silence after which a grab is lost [ms].
        lease_ms: f64,
    },
    /// The client holds the particle.
    Granted {
        /// Its place `[i, j]`.
        particle: [usize; 2],
        /// Where it is [m].
        position_m: [f64; 3],
        /// Silence after which the grab is lost [ms].
        lease_ms: f64,
    },
    /// The grab was refused.
    Denied {
        /// Why, for programs.
        code: Denied,
        /// Why, for people.
        message: String,
    },
    /// The client holds nothing any more.
    Released {
        /// Why, for programs.
        code: Released,
        /// Why, for people.
        message: String,
    },
    /// Answer to `ping`.
    Pong {
        /// The client's clock, as sent [µs].
        t_us: u64,
    },
    /// Something about the session.
    Status(Status),
    /// A message that changed nothing.
    Error {
        /// Which kind.
        code: ErrorCode,
        /// Field, value got and what is allowed.
        message: String,
    },
}

/// Something a session tells all its clients.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Status {
    /// How bad it is.
    pub level: Level,
    /// Which kind, for programs.
    pub code: String,
    /// What happened, for people.
    pub message: String,
}

/// How bad a status is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// All is well.
    Info,
    /// Quality is reduced.
    Warning,
    /// Something was lost.
    Error,
}

/// Why a grab was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Denied {
    /// Another client holds a particle of this session.
    HeldByAnother,
    /// The lattice has no such particle, or the point is not finite.
    NoSuchParticle,
    /// The cloth cannot be held there now.
    Refused,
}

/// Why a grab ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Released {
    /// The client asked.
    Client,
    /// The client was silent for longer than its lease.
    Silent,
    /// The session ended.
    SessionEnded,
    /// The server is shutting down.
    Shutdown,
}

/// Kinds of client mistakes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ErrorCode {
    /// Text that is no message: not JSON, an unknown `op`, a field missing or of another type.
    BadMessage,
    /// Binary that is no message: another opcode or length.
    BadFrame,
    /// A device that cannot be.
    BadDevice,
    /// A viewer's rate out of range.
    BadRate,
    /// A pose that is not finite.
    NotFinite,
    /// A pose farther than 10 m from the origin.
    TooFar,
    /// A `seq` that is not above the last one.
    StaleSeq,
    /// A move or release without a grab.
    NotHolding,
    /// A message larger than 4096 bytes; the socket closes.
    TooLarge,
    /// More messages than the session takes; the socket closes.
    Overflow,
}
