// How the hand follows the pointer: a short first-order lag and a speed limit turn the pointer's jumps (60 Hz, whole
// pixels) into a path that a real hand could take. The cloth feels the path, not only where it ends.

import type { Vec3 } from "./protocol";

/** Chosen: two pointer events long; shorter lets single events through as jerks. */
const LAG_S = 0.03;
/** Chosen: a fast arm movement [m/s]. */
const SPEED_LIMIT = 2.0;
/** Below this the hand has arrived [m]. */
const ARRIVED = 1e-6;

/** The pose `dt` seconds on from `pose` towards `target`; `pose` itself when it has arrived. */
export function paced(pose: Vec3, target: Vec3, dt: number): Vec3 {
  const gap: Vec3 = [target[0] - pose[0], target[1] - pose[1], target[2] - pose[2]];
  const distance = Math.hypot(...gap);
  if (distance === 0) return pose;
  if (distance < ARRIVED) return target;
  const step = Math.min(distance * (1 - Math.exp(-dt / LAG_S)), SPEED_LIMIT * dt);
  const part = step / distance;
  return [pose[0] + part * gap[0], pose[1] + part * gap[1], pose[2] + part * gap[2]];
}
