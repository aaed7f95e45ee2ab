// The messages of `kesi.view.v1` and `kesi.haptic.v1` as the browser sees them: types, binary decoders and the move encoder.
// Byte layouts are those of PROTOCOL.md and are tested against the golden files that Rust writes. No sockets here.
//
// Typed arrays are views on the message, not copies: every layout is aligned to 4 bytes, and all browsers are little-endian.

export const VIEW_PROTOCOL = "kesi.view.v1";
export const HAPTIC_PROTOCOL = "kesi.haptic.v1";

export type Vec3 = readonly [number, number, number];

export interface Obstacle {
  name: string;
  shape: "box" | "sphere" | "capsule" | "plane" | "mesh";
  half_m?: Vec3;
  radius_m?: number;
  /** Half the length of a capsule's segment. */
  half_length_m?: number;
  points_m?: Vec3[];
  triangles?: (readonly [number, number, number])[];
  position_m: Vec3;
  rotation_xyzw: readonly [number, number, number, number];
}

export interface ViewHello {
  op: "hello";
  protocol: string;
  server: string;
  session: string;
  scene: { name: string; particles: readonly [number, number]; size_m: readonly [number, number] };
  fabric: { name: string; kind: string };
  obstacles: Obstacle[];
  tick_hz: number;
  view_hz_max: number;
}

export type Level = "info" | "warning" | "error";
export interface StatusMessage { op: "status"; level: Level; code: string; message: string }
export interface ErrorMessage { op: "error"; code: string; message: string }
export type ViewMessage = ViewHello | StatusMessage | ErrorMessage;

export type GrabAt = { corner: "00" | "I0" | "0J" | "IJ" } | { particle: readonly [number, number] } | { nearest_m: Vec3 };

export type HapticMessage =
  | { op: "hello"; protocol: string; server: string; session: string; tick_hz: number; lease_ms: number }
  | { op: "granted"; particle: [number, number]; position_m: [number, number, number]; lease_ms: number }
  | { op: "denied"; code: string; message: string }
  | { op: "released"; code: "client" | "silent" | "session_ended" | "shutdown"; message: string }
  | { op: "pong"; t_us: number }
  | StatusMessage
  | ErrorMessage;

/** The active mesh, sent before the first frame of each epoch. */
export interface Topology {
  epoch: number;
  /** Particles of the finest lattice, I and J. */
  lattice: readonly [number, number];
  /** Lattice index i*J + j of each vertex. */
  vertices: Uint32Array;
  /** Three vertex indices for each triangle. */
  triangles: Uint32Array;
  levels: Uint8Array;
}

/** One state of the cloth. */
export interface Frame {
  converged: boolean;
  resting: boolean;
  handPresent: boolean;
  handHeld: boolean;
  frame: number;
  timeUs: number;
  epoch: number;
  particlesActive: number;
  /** Lattice index of the hand's particle, or null. */
  handParticle: number | null;
  handPosition: Vec3;
  /** Force that the cloth exerts on the hand [N]. */
  handForce: Vec3;
  cost: { newton: number; stretch: number; bend: number; shear: number };
  residual: number;
  solveMs: number;
  maxPenetration: number;
  forceErrorBound: number;
  tickHz: number;
  /** x, y, z of each vertex [m]. */
  positions: Float32Array;
  /** Seven numbers for each obstacle: position [m] and quaternion x, y, z, w. */
  poses: Float32Array;
}

/** What the hand feels near one state: F0 + G τ − K (p − p0 − v0 τ). */
export interface ForceModel {
  converged: boolean;
  resting: boolean;
  clamped: boolean;
  meshChanged: boolean;
  contactChanged: boolean;
  seq: number;
  timeUs: number;
  moveTimeUs: number;
  moveSeq: number;
  leaseMs: number;
  p0: Vec3;
  v0: Vec3;
  f0: Vec3;
  g: Vec3;
  /** xx xy xz yy yz zz [N/m]. */
  k: readonly [number, number, number, number, number, number];
  radius: number;
  horizonMs: number;
  forceErrorBound: number;
  particlesActive: number;
  solveMs: number;
}

/** A message that does not follow the protocol; the text says how. */
export class ProtocolError extends Error {}

const TOPOLOGY = 0x82;
const FRAME = 0x83;
const FORCE_MODEL = 0x81;
const MOVE = 0x01;
const NO_PARTICLE = 0xffffffff;

export function opcode(bytes: ArrayBuffer): number {
  if (bytes.byteLength === 0) throw new ProtocolError("empty binary message");
  return new Uint8Array(bytes, 0, 1)[0]!;
}

/** Decodes a binary message of the view socket. */
export function decodeView(bytes: ArrayBuffer): { topology: Topology } | { frame: Frame } {
  switch (opcode(bytes)) {
    case TOPOLOGY:
      return { topology: decodeTopology(bytes) };
    case FRAME:
      return { frame: decodeFrame(bytes) };
    default:
      throw new ProtocolError(`unknown view opcode 0x${opcode(bytes).toString(16)}`);
  }
}

export function decodeTopology(bytes: ArrayBuffer): Topology {
  const at = header(bytes, "topology", TOPOLOGY, 24);
  const vertices = at.getUint32(8, true);
  const triangles = at.getUint32(12, true);
  const levelsAt = 24 + 4 * vertices + 12 * triangles;
  expectLength(bytes, "topology", levelsAt + 4 * Math.ceil(vertices / 4));
  const topology: Topology = {
    epoch: at.getUint32(4, true),
    lattice: [at.getUint16(16, true), at.getUint16(18, true)],
    vertices: new Uint32Array(bytes, 24, vertices),
    triangles: new Uint32Array(bytes, 24 + 4 * vertices, 3 * triangles),
    levels: new Uint8Array(bytes, levelsAt, vertices),
  };
  const outside = topology.triangles.find((v) => v >= vertices);
  if (outside !== undefined) throw new ProtocolError(`topology: a triangle names vertex ${outside} of ${vertices}`);
  return topology;
}

export function decodeFrame(bytes: ArrayBuffer): Frame {
  const at = header(bytes, "frame", FRAME, 96);
  const vertices = at.getUint32(20, true);
  const poses = at.getUint32(92, true);
  expectLength(bytes, "frame", 96 + 12 * vertices + 28 * poses);
  const flags = at.getUint8(1);
  const handParticle = at.getUint32(28, true);
  return {
    converged: (flags & 1) !== 0,
    resting: (flags & 2) !== 0,
    handPresent: (flags & 4) !== 0,
    handHeld: (flags & 8) !== 0,
    frame: at.getUint32(4, true),
    timeUs: Number(at.getBigUint64(8, true)),
    epoch: at.getUint32(16, true),
    particlesActive: at.getUint32(24, true),
    handParticle: handParticle === NO_PARTICLE ? null : handParticle,
    handPosition: vec3(at, 32),
    handForce: vec3(at, 44),
    cost: {
      newton: at.getFloat32(56, true),
      stretch: at.getFloat32(60, true),
      bend: at.getFloat32(64, true),
      shear: at.getFloat32(68, true),
    },
    residual: at.getFloat32(72, true),
    solveMs: at.getFloat32(76, true),
    maxPenetration: at.getFloat32(80, true),
    forceErrorBound: at.getFloat32(84, true),
    tickHz: at.getFloat32(88, true),
    positions: new Float32Array(bytes, 96, 3 * vertices),
    poses: new Float32Array(bytes, 96 + 12 * vertices, 7 * poses),
  };
}

export function decodeForceModel(bytes: ArrayBuffer): ForceModel {
  const at = header(bytes, "force model", FORCE_MODEL, 128);
  expectLength(bytes, "force model", 128);
  const flags = at.getUint8(1);
  const k = (n: number) => at.getFloat32(80 + 4 * n, true);
  return {
    converged: (flags & 1) !== 0,
    resting: (flags & 2) !== 0,
    clamped: (flags & 4) !== 0,
    meshChanged: (flags & 8) !== 0,
    contactChanged: (flags & 16) !== 0,
    seq: at.getUint32(4, true),
    timeUs: Number(at.getBigUint64(8, true)),
    moveTimeUs: Number(at.getBigUint64(16, true)),
    moveSeq: at.getUint32(24, true),
    leaseMs: at.getFloat32(28, true),
    p0: vec3(at, 32),
    v0: vec3(at, 44),
    f0: vec3(at, 56),
    g: vec3(at, 68),
    k: [k(0), k(1), k(2), k(3), k(4), k(5)],
    radius: at.getFloat32(104, true),
    horizonMs: at.getFloat32(108, true),
    forceErrorBound: at.getFloat32(112, true),
    particlesActive: at.getUint32(116, true),
    solveMs: at.getFloat32(120, true),
  };
}

export function encodeMove(seq: number, tUs: number, position: Vec3): ArrayBuffer {
  const bytes = new ArrayBuffer(40);
  const at = new DataView(bytes);
  at.setUint8(0, MOVE);
  at.setUint32(4, seq, true);
  at.setBigUint64(8, BigInt(tUs), true);
  position.forEach((x, n) => at.setFloat64(16 + 8 * n, x, true));
  return bytes;
}

/** Parses a JSON message; only `op` is checked, because the server of the same version wrote the rest. */
export function parseMessage<M extends { op: string }>(text: string): M {
  let message: unknown;
  try {
    message = JSON.parse(text);
  } catch {
    throw new ProtocolError("a text message is not JSON");
  }
  if (typeof message !== "object" || message === null || typeof (message as { op?: unknown }).op !== "string") {
    throw new ProtocolError('a JSON message has no "op"');
  }
  return message as M;
}

function header(bytes: ArrayBuffer, what: string, code: number, length: number): DataView {
  if (bytes.byteLength < length) throw new ProtocolError(`${what}: ${bytes.byteLength} bytes, at least ${length} expected`);
  if (opcode(bytes) !== code) throw new ProtocolError(`${what}: opcode 0x${opcode(bytes).toString(16)}, 0x${code.toString(16)} expected`);
  return new DataView(bytes);
}

function expectLength(bytes: ArrayBuffer, what: string, length: number): void {
  if (bytes.byteLength !== length) throw new ProtocolError(`${what}: ${bytes.byteLength} bytes, ${length} expected`);
}

function vec3(at: DataView, offset: number): Vec3 {
  return [at.getFloat32(offset, true), at.getFloat32(offset + 4, true), at.getFloat32(offset + 8, true)];
}
