// The decoder against bytes: golden files written by Rust, and messages that break the layout.

import { describe, expect, it } from "vitest";
import { decodeForceModel, decodeFrame, decodeTopology, decodeView, encodeMove, parseMessage, ProtocolError } from "../src/protocol";

/** A minimal topology: one triangle on a 2 × 2 lattice. */
function topologyBytes(): ArrayBuffer {
  const bytes = new ArrayBuffer(24 + 12 + 12 + 4);
  const at = new DataView(bytes);
  at.setUint8(0, 0x82);
  at.setUint32(4, 7, true);
  at.setUint32(8, 3, true);
  at.setUint32(12, 1, true);
  at.setUint16(16, 2, true);
  at.setUint16(18, 2, true);
  [0, 2, 1].forEach((lattice, v) => at.setUint32(24 + 4 * v, lattice, true));
  [0, 1, 2].forEach((vertex, n) => at.setUint32(36 + 4 * n, vertex, true));
  [0, 1, 2].forEach((level, n) => at.setUint8(48 + n, level));
  return bytes;
}

function frameBytes(vertices: number): ArrayBuffer {
  const bytes = new ArrayBuffer(96 + 12 * vertices);
  const at = new DataView(bytes);
  at.setUint8(0, 0x83);
  at.setUint8(1, 2 | 4);
  at.setUint32(4, 41, true);
  at.setBigUint64(8, 5_000_000_000n, true);
  at.setUint32(16, 7, true);
  at.setUint32(20, vertices, true);
  at.setUint32(24, vertices, true);
  at.setUint32(28, 0xffffffff, true);
  for (let n = 0; n < 15; n++) at.setFloat32(32 + 4 * n, 0.5 * n, true);
  for (let n = 0; n < 3 * vertices; n++) at.setFloat32(96 + 4 * n, n, true);
  return bytes;
}

describe("topology", () => {
  it("gives lattice indices, triangles and levels", () => {
    const topology = decodeTopology(topologyBytes());
    expect(topology.epoch).toBe(7);
    expect(topology.lattice).toEqual([2, 2]);
    expect([...topology.vertices]).toEqual([0, 2, 1]);
    expect([...topology.triangles]).toEqual([0, 1, 2]);
    expect([...topology.levels]).toEqual([0, 1, 2]);
  });

  it("is refused when a triangle names a vertex that is not there", () => {
    const bytes = topologyBytes();
    new DataView(bytes).setUint32(36, 3, true);
    expect(() => decodeTopology(bytes)).toThrow(/vertex 3 of 3/);
  });

  it("is refused when its length and its counts disagree", () => {
    expect(() => decodeTopology(topologyBytes().slice(0, 48))).toThrow(ProtocolError);
  });
});

describe("frame", () => {
  it("gives flags, numbers and positions from their offsets", () => {
    const frame = decodeFrame(frameBytes(2));
    expect(frame).toMatchObject({
      converged: false, resting: true, handPresent: true, handHeld: false,
      frame: 41, timeUs: 5_000_000_000, epoch: 7, particlesActive: 2, handParticle: null,
      handPosition: [0, 0.5, 1], handForce: [1.5, 2, 2.5],
      cost: { newton: 3, stretch: 3.5, bend: 4, shear: 4.5 },
      residual: 5, solveMs: 5.5, maxPenetration: 6, forceErrorBound: 6.5, tickHz: 7,
    });
    expect([...frame.positions]).toEqual([0, 1, 2, 3, 4, 5]);
  });

  it("is refused when it is cut short or padded", () => {
    expect(() => decodeFrame(frameBytes(2).slice(0, 100))).toThrow(/100 bytes, 120 expected/);
    expect(() => decodeFrame(frameBytes(0).slice(0, 40))).toThrow(/at least 96/);
  });
});

describe("messages", () => {
  it("are told apart by opcode, and unknown ones refused", () => {
    expect(decodeView(topologyBytes())).toHaveProperty("topology");
    expect(decodeView(frameBytes(1))).toHaveProperty("frame");
    expect(() => decodeView(new Uint8Array([0x7f]).buffer)).toThrow(/0x7f/);
    expect(() => decodeView(new ArrayBuffer(0))).toThrow(/empty/);
  });

  it("in JSON need an op", () => {
    expect(parseMessage('{"op":"pong","t_us":3}')).toEqual({ op: "pong", t_us: 3 });
    expect(() => parseMessage("{")).toThrow(ProtocolError);
    expect(() => parseMessage("[1]")).toThrow(ProtocolError);
    expect(() => parseMessage("null")).toThrow(ProtocolError);
  });
});

it("a force model of the wrong length is refused", () => {
  const bytes = new ArrayBuffer(132);
  new DataView(bytes).setUint8(0, 0x81);
  expect(() => decodeForceModel(bytes)).toThrow(/132 bytes, 128 expected/);
});

it("a move has its fields at the offsets of the protocol", () => {
  const at = new DataView(encodeMove(17, 2 ** 40 + 3, [0.1, -0.2, 0.3]));
  expect(at.byteLength).toBe(40);
  expect(at.getUint32(0, true)).toBe(0x01);
  expect(at.getUint32(4, true)).toBe(17);
  expect(at.getBigUint64(8, true)).toBe(2n ** 40n + 3n);
  expect([16, 24, 32].map((offset) => at.getFloat64(offset, true))).toEqual([0.1, -0.2, 0.3]);
});
