// The files that Rust writes, decoded: both sides read the same bytes as the same values.

import { readFileSync } from "node:fs";
import { join } from "node:path";
import { expect, it } from "vitest";
import { decodeForceModel, decodeFrame, decodeTopology, encodeMove } from "../src/protocol";
import type { Vec3 } from "../src/protocol";

const folder = join(import.meta.dirname, "../../tests/golden");
const fields = JSON.parse(readFileSync(join(folder, "fields.json"), "utf8"));

function golden(name: string): { bytes: ArrayBuffer; says: Record<string, any> } {
  return { bytes: new Uint8Array(readFileSync(join(folder, name))).buffer, says: fields[name] };
}

/** Flags as a number again, from the names that the decoder gives them. */
function flags(...bits: boolean[]): number {
  return bits.reduce((sum, bit, n) => sum + (bit ? 2 ** n : 0), 0);
}

it("move.bin is what the encoder writes", () => {
  const { bytes, says } = golden("move.bin");
  expect(new Uint8Array(encodeMove(says["seq"], says["t_us"], says["position_m"] as Vec3))).toEqual(new Uint8Array(bytes));
});

it("force_model.bin is decoded field by field", () => {
  const { bytes, says } = golden("force_model.bin");
  const model = decodeForceModel(bytes);
  expect({
    flags: flags(model.converged, model.resting, model.clamped, model.meshChanged, model.contactChanged),
    seq: model.seq, server_us: model.timeUs, move_us: model.moveTimeUs, move_seq: model.moveSeq, lease_ms: model.leaseMs,
    p0_m: model.p0, v0_m_per_s: model.v0, f0_n: model.f0, g_n_per_s: model.g, k_n_per_m: model.k,
    radius_m: model.radius, horizon_ms: model.horizonMs, force_error_n: model.forceErrorBound,
    particles_active: model.particlesActive, solve_ms: model.solveMs,
  }).toEqual(says);
});

it("topology.bin is decoded field by field", () => {
  const { bytes, says } = golden("topology.bin");
  const topology = decodeTopology(bytes);
  expect({
    epoch: topology.epoch, particles: topology.lattice, vertices: [...topology.vertices],
    triangles: threes(topology.triangles), levels: [...topology.levels],
  }).toEqual(says);
});

it("frame.bin is decoded field by field", () => {
  const { bytes, says } = golden("frame.bin");
  const frame = decodeFrame(bytes);
  const { newton, stretch, bend, shear } = frame.cost;
  expect({
    flags: flags(frame.converged, frame.resting, frame.handPresent, frame.handHeld),
    frame: frame.frame, server_us: frame.timeUs, epoch: frame.epoch, particles_active: frame.particlesActive,
    hand_particle: frame.handParticle, hand_position_m: frame.handPosition, force_n: frame.handForce,
    cost: [newton, stretch, bend, shear], residual_n: frame.residual, solve_ms: frame.solveMs,
    max_penetration_m: frame.maxPenetration, force_error_n: frame.forceErrorBound, tick_hz: frame.tickHz,
    positions_m: threes(frame.positions), poses: [[...frame.poses]],
  }).toEqual(says);
});

function threes(values: ArrayLike<number>): number[][] {
  return Array.from({ length: values.length / 3 }, (_, n) => [values[3 * n]!, values[3 * n + 1]!, values[3 * n + 2]!]);
}
