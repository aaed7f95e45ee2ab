//! Messages of the view socket: JSON greetings, binary topology (0x82) and frames (0x83).

use super::{
    Malformed,
    bytes::{Reader, Writer},
    haptic::{ErrorCode, Status},
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What a viewer says.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "op", rename_all = "snake_case")]
pub enum ViewerMessage {
    /// Asks for a rate. Optional; without it 30.
    Hello {
        /// Frames per second at the most [Hz].
        rate_hz: f64,
    },
    /// A frame, and all before it, was shown.
    Ack {
        /// Its number.
        frame: u32,
    },
}

/// What the server says on the view socket in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "op", rename_all = "snake_case")]
pub enum ServerMessage {
    /// First message.
    Hello(Hello),
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

/// What a viewer needs to know before the first frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Hello {
    /// The subprotocol.
    pub protocol: String,
    /// Name and version of the server.
    pub server: String,
    /// Id of the session.
    pub session: String,
    /// The scene.
    pub scene: SceneBrief,
    /// The fabric.
    pub fabric: FabricBrief,
    /// Rigid obstacles, where they start; frames say where they are.
    pub obstacles: Vec<ObstacleBrief>,
    /// Ticks per second.
    pub tick_hz: f64,
    /// Highest rate a viewer may ask for [Hz].
    pub view_hz_max: f64,
}

/// The scene, briefly.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SceneBrief {
    /// Name.
    pub name: String,
    /// Particles along warp and weft.
    pub particles: [usize; 2],
    /// Rest lengths along warp and weft [m].
    pub size_m: [f64; 2],
}

/// The fabric, briefly.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FabricBrief {
    /// Name.
    pub name: String,
    /// How its curves are known: `measured`, `digitised`, `from_parameters`.
    pub kind: String,
}

/// Kind of an obstacle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ShapeKind {
    /// Box, centered at its position.
    Box,
    /// Ball, centered at its position.
    Sphere,
    /// All points nearer than a radius to a segment along its own z axis, centered at its position.
    Capsule,
    /// Half space below its own plane z = 0.
    Plane,
    /// Triangles.
    Mesh,
}

/// A rigid obstacle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ObstacleBrief {
    /// Name, unique in the scene.
    pub name: String,
    /// Kind.
    pub shape: ShapeKind,
    /// Half lengths of a box along its own axes [m].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub half_m: Option<[f64; 3]>,
    /// Radius of a sphere or a capsule [m].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub radius_m: Option<f64>,
    /// Half the length of a capsule's segment [m].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub half_length_m: Option<f64>,
    /// Points of a mesh in its own frame [m].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub points_m: Vec<[f64; 3]>,
    /// Triangles of a mesh, indices into `points_m`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub triangles: Vec<[u32; 3]>,
    /// Position of its origin [m].
    pub position_m: [f64; 3],
    /// Rotation, world from obstacle, as a unit quaternion.
    pub rotation_xyzw: [f64; 4],
}

/// The mesh of an epoch.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Topology {
    /// Number of the mesh.
    pub epoch: u32,
    /// Particles of the finest lattice along warp and weft.
    pub counts: [u16; 2],
    /// Lattice index i·J + j of each vertex.
    pub vertices: Vec<u32>,
    /// Triangles, as indices into `vertices`.
    pub triangles: Vec<[u32; 3]>,
    /// Level of each vertex: 0 on the finest mesh.
    pub levels: Vec<u8>,
}

impl Topology {
    /// First byte of the message.
    pub const OPCODE: u8 = 0x82;
    /// Size before the arrays [bytes].
    pub const HEADER: usize = 24;

    /// Size with its arrays [bytes].
    pub fn size(vertices: usize, triangles: usize) -> usize {
        Self::HEADER + 4 * vertices + 12 * triangles + vertices.next_multiple_of(4)
    }

    /// The message.
    pub fn encode(&self) -> Vec<u8> {
        let mut w = Writer::new(Self::OPCODE, Self::size(self.vertices.len(), self.triangles.len()));
        w.pad(4);
        w.u32(self.epoch);
        w.u32(self.vertices.len() as u32);
        w.u32(self.triangles.len() as u32);
        w.u16(self.counts[0]);
        w.u16(self.counts[1]);
        w.u32(0);
        self.vertices.iter().chain(self.triangles.iter().flatten()).for_each(|&v| w.u32(v));
        self.levels.iter().for_each(|&level| w.u8(level));
        w.pad(4);
        w.finish()
    }

    /// Reads a message of exactly the size its header says.
    pub fn decode(bytes: &[u8]) -> Result<Topology, Malformed> {
        let mut r = Reader::new(bytes, "topology", Self::OPCODE, Self::HEADER)?;
        r.skip(3);
        let epoch = r.u32();
        let (v, t) = (r.u32() as usize, r.u32() as usize);
        let counts = [r.u16(), r.u16()];
        r.skip(4);
        let expected = Self::size(v, t);
        if bytes.len() != expected {
            return Err(Malformed::Length { what: "topology", got: bytes.len(), expected });
        }
        let vertices = (0..v).map(|_| r.u32()).collect();
        let triangles = (0..t).map(|_| std::array::from_fn(|_| r.u32())).collect();
        let levels = (0..v).map(|_| r.u8()).collect();
        Ok(Topology { epoch, counts, vertices, triangles, levels })
    }
}

/// One state of the cloth, for the eye.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frame {
    /// Bits of [`Frame::CONVERGED`] and its neighbours.
    pub flags: u8,
    /// Number of the frame in its session.
    pub number: u32,
    /// Server time of the state, since the session began [µs].
    pub server_us: u64,
    /// Mesh that the positions belong to.
    pub epoch: u32,
    /// Particles that carry degrees of freedom.
    pub active: u32,
    /// Lattice index of the hand's particle; [`Frame::NO_PARTICLE`]: no hand.
    pub hand_particle: u32,
    /// Position of the hand [m].
    pub hand_position: [f64; 3],
    /// Force of the cloth on the hand [N].
    pub force: [f64; 3],
    /// Cost, dimensionless: newton, stretch, bend, shear.
    pub cost: [f64; 4],
    /// Largest force out of balance [N].
    pub residual: f64,
    /// Time the step took [ms].
    pub solve_ms: f64,
    /// Deepest penetration [m].
    pub max_penetration: f64,
    /// Bound on the error of the force [N].
    pub force_error: f64,
    /// Ticks per second, measured [Hz].
    pub tick_hz: f64,
    /// Positions of the epoch's vertices [m].
    pub positions: Vec<[f32; 3]>,
    /// Poses of the obstacles in the order of the hello, world from obstacle: position [m] and unit quaternion x y z w.
    pub poses: Vec<[f32; 7]>,
}

impl Frame {
    /// First byte of the message.
    pub const OPCODE: u8 = 0x83;
    /// Size before the positions [bytes].
    pub const HEADER: usize = 96;
    /// Flag: the minimization converged.
    pub const CONVERGED: u8 = 1;
    /// Flag: the cloth is at rest.
    pub const RESTING: u8 = 2;
    /// Flag: there is a hand.
    pub const HAND: u8 = 4;
    /// Flag: a client holds it.
    pub const HELD: u8 = 8;
    /// Lattice index that says: no hand.
    pub const NO_PARTICLE: u32 = u32::MAX;

    fn size(positions: usize, poses: usize) -> usize {
        Self::HEADER + 12 * positions + 28 * poses
    }

    /// The message.
    pub fn encode(&self) -> Vec<u8> {
        let mut w = Writer::new(Self::OPCODE, Self::size(self.positions.len(), self.poses.len()));
        w.u8(self.flags);
        w.u16(0);
        w.u32(self.number);
        w.u64(self.server_us);
        w.u32(self.epoch);
        w.u32(self.positions.len() as u32);
        w.u32(self.active);
        w.u32(self.hand_particle);
        w.f32s(&self.hand_position);
        w.f32s(&self.force);
        w.f32s(&self.cost);
        for x in [self.residual, self.solve_ms, self.max_penetration, self.force_error, self.tick_hz] {
            w.f32(x);
        }
        w.u32(self.poses.len() as u32);
        let numbers = self.positions.iter().flatten().chain(self.poses.iter().flatten());
        numbers.for_each(|&x| w.f32(f64::from(x)));
        w.finish()
    }

    /// Reads a message of exactly the size its header says.
    pub fn decode(bytes: &[u8]) -> Result<Frame, Malformed> {
        let mut r = Reader::new(bytes, "frame", Self::OPCODE, Self::HEADER)?;
        let flags = r.u8();
        r.skip(2);
        let (number, server_us, epoch) = (r.u32(), r.u64(), r.u32());
        let v = r.u32() as usize;
        let mut frame = Frame {
            flags,
            number,
            server_us,
            epoch,
            active: r.u32(),
            hand_particle: r.u32(),
            hand_position: r.f32s(),
            force: r.f32s(),
            cost: r.f32s(),
            residual: r.f32(),
            solve_ms: r.f32(),
            max_penetration: r.f32(),
            force_error: r.f32(),
            tick_hz: r.f32(),
            ..Frame::default()
        };
        let poses = r.u32() as usize;
        let expected = Self::size(v, poses);
        if bytes.len() != expected {
            return Err(Malformed::Length { what: "frame", got: bytes.len(), expected });
        }
        frame.positions = (0..v).map(|_| r.f32s().map(|x: f64| x as f32)).collect();
        frame.poses = (0..poses).map(|_| r.f32s().map(|x: f64| x as f32)).collect();
        Ok(frame)
    }
}
