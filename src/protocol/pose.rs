//! The two binary messages of the haptic socket: a hand's move (40 bytes) and the force model (128 bytes).

use super::{
    Malformed,
    bytes::{Reader, Writer},
};

/// A hand pose in the client's own time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Move {
    /// Number of the move, rising.
    pub seq: u32,
    /// The client's clock [µs]; echoed, never compared with the server's.
    pub t_us: u64,
    /// Position of the hand [m].
    pub position: [f64; 3],
}

impl Move {
    /// First byte of the message.
    pub const OPCODE: u8 = 0x01;
    /// Size [bytes].
    pub const SIZE: usize = 40;

    /// The 40 bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut w = Writer::new(Self::OPCODE, Self::SIZE);
        w.pad(4);
        w.u32(self.seq);
        w.u64(self.t_us);
        self.position.iter().for_each(|&x| w.f64(x));
        w.finish()
    }

    /// Reads exactly 40 bytes.
    pub fn decode(bytes: &[u8]) -> Result<Move, Malformed> {
        let mut r = Reader::new(bytes, "move", Self::OPCODE, Self::SIZE)?;
        if bytes.len() != Self::SIZE {
            return Err(Malformed::Length { what: "move", got: bytes.len(), expected: Self::SIZE });
        }
        r.skip(3);
        Ok(Move { seq: r.u32(), t_us: r.u64(), position: r.f64s() })
    }
}

/// What the hand feels: F(p, t) = F0 + G τ − K (p − p0 − v0 τ), τ = t − t0 within [0, horizon].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ForceModel {
    /// Bits of [`ForceModel::CONVERGED`] and its neighbours.
    pub flags: u8,
    /// Number of this model on its socket, +1 each.
    pub seq: u32,
    /// Server time of the state, since the session began [µs].
    pub server_us: u64,
    /// Client time of the newest move the state includes [µs]; 0: none yet.
    pub move_us: u64,
    /// Number of that move.
    pub move_seq: u32,
    /// With no newer model for this long the force falls to zero [ms].
    pub lease_ms: f64,
    /// Position of the hand p0 [m].
    pub position: [f64; 3],
    /// Velocity of the hand v0 [m/s].
    pub velocity: [f64; 3],
    /// Force of the cloth on the hand F0 [N].
    pub force: [f64; 3],
    /// Rate of the force along v0, G [N/s].
    pub rate: [f64; 3],
    /// Stiffness K against leaving the path: xx xy xz yy yz zz [N/m].
    pub stiffness: [f64; 6],
    /// Distance from the path within which the model holds [m].
    pub radius: f64,
    /// Time within which the model holds [ms].
    pub horizon_ms: f64,
    /// Bound on the error of F0 from incomplete minimization [N].
    pub force_error: f64,
    /// Active particles.
    pub active: u32,
    /// Solve time of this state [ms].
    pub solve_ms: f64,
}

impl ForceModel {
    /// First byte of the message.
    pub const OPCODE: u8 = 0x81;
    /// Size [bytes].
    pub const SIZE: usize = 128;
    /// Flag: the minimization converged.
    pub const CONVERGED: u8 = 1;
    /// Flag: the cloth is at rest.
    pub const RESTING: u8 = 2;
    /// Flag: the stiffness was clamped to the device.
    pub const CLAMPED: u8 = 4;
    /// Flag: the mesh changed since the last model.
    pub const REMESHED: u8 = 8;
    /// Flag: the contact set changed since the last model.
    pub const CONTACT: u8 = 16;

    /// The 128 bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut w = Writer::new(Self::OPCODE, Self::SIZE);
        w.u8(self.flags);
        w.u16(0);
        w.u32(self.seq);
        w.u64(self.server_us);
        w.u64(self.move_us);
        w.u32(self.move_seq);
        w.f32(self.lease_ms);
        for v in [self.position, self.velocity, self.force, self.rate] {
            w.f32s(&v);
        }
        w.f32s(&self.stiffness);
        w.f32(self.radius);
        w.f32(self.horizon_ms);
        w.f32(self.force_error);
        w.u32(self.active);
        w.f32(self.solve_ms);
        w.u32(0);
        w.finish()
    }

    /// Reads exactly 128 bytes.
    pub fn decode(bytes: &[u8]) -> Result<ForceModel, Malformed> {
        let mut r = Reader::new(bytes, "force model", Self::OPCODE, Self::SIZE)?;
        if bytes.len() != Self::SIZE {
            return Err(Malformed::Length { what: "force model", got: bytes.len(), expected: Self::SIZE });
        }
        let flags = r.u8();
        r.skip(2);
        Ok(ForceModel {
            flags,
            seq: r.u32(),
            server_us: r.u64(),
            move_us: r.u64(),
            move_seq: r.u32(),
            lease_ms: r.f32(),
            position: r.f32s(),
            velocity: r.f32s(),
            force: r.f32s(),
            rate: r.f32s(),
            stiffness: r.f32s(),
            radius: r.f32(),
            horizon_ms: r.f32(),
            force_error: r.f32(),
            active: r.u32(),
            solve_ms: r.f32(),
        })
    }

    /// Force on a hand at `p` [m], `tau` [s] after the model's own move [N].
    pub fn force_at(&self, p: [f64; 3], tau: f64) -> [f64; 3] {
        let tau = tau.clamp(0.0, self.horizon_ms * 1e-3);
        let d: [f64; 3] = std::array::from_fn(|i| p[i] - self.position[i] - self.velocity[i] * tau);
        let [xx, xy, xz, yy, yz, zz] = self.stiffness;
        let pull = [
            xx * d[0] + xy * d[1] + xz * d[2],
            xy * d[0] + yy * d[1] + yz * d[2],
            xz * d[0] + yz * d[1] + zz * d[2],
        ];
        std::array::from_fn(|i| self.force[i] + self.rate[i] * tau - pull[i])
    }
}
