// The hand follows the pointer without jumps, and arrives.

import { expect, it } from "vitest";
import { paced } from "../src/pace";
import type { Vec3 } from "../src/protocol";

it("the hand arrives and then stays the same pose", () => {
  let pose: Vec3 = [0, 0, 0];
  const target: Vec3 = [0.03, 0.01, -0.02];
  for (let n = 0; n < 200; n++) pose = paced(pose, target, 0.008);
  expect(pose).toEqual(target);
  expect(paced(pose, target, 0.008)).toBe(pose);
});

it("no step is faster than two meters a second, however late the clock", () => {
  for (const dt of [0.001, 0.008, 0.1]) {
    const pose = paced([0, 0, 0], [1, 0, 0], dt);
    expect(pose[0]).toBeLessThanOrEqual(2 * dt + 1e-12);
    expect(pose[0]).toBeGreaterThan(0);
  }
});

it("a step never passes the target", () => {
  const pose = paced([0, 0, 0], [0, 0, 0.001], 5);
  expect(pose[2]).toBeLessThanOrEqual(0.001);
});
