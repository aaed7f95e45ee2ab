// All that must be seen lies in the picture, and the camera stands no farther than that takes.

import * as THREE from "three";
import { expect, it } from "vitest";
import { distanceToFit, fieldOfView, type Canvas } from "../src/framing";

const up = new THREE.Vector3(0, 0, 1);
const direction = new THREE.Vector3(-0.62, -1, 0.62).normalize();
const center = new THREE.Vector3(0.15, 0.12, -0.2);

/** Corners of a sheet that hangs below the center, and of one that lies there. */
const sheets = [
  [[0, 0.1, 0], [0.3, 0.1, 0], [0, 0.14, -0.4], [0.3, 0.14, -0.4]],
  [[0, 0, -0.2], [0.3, 0, -0.2], [0, 0.3, -0.2], [0.3, 0.3, -0.2]],
].map((points) => points.map(([x, y, z]) => new THREE.Vector3(x, y, z)));

/** How far out of the picture's center points are, over half of it: 1 on its rim. */
function farthestOut(points: THREE.Vector3[], distance: number, { width, height, right, bottom }: Canvas): number {
  const camera = new THREE.PerspectiveCamera(32, width / height, 0.01, 30);
  camera.setViewOffset(width, height, right / 2, bottom / 2, width, height);
  camera.up.copy(up);
  camera.position.copy(center).addScaledVector(direction, distance);
  camera.lookAt(center);
  camera.updateMatrixWorld();
  const out = points.map((point) => {
    const { x, y } = point.clone().project(camera);
    const [px, py] = [((1 + x) * width) / 2, ((1 - y) * height) / 2];
    return Math.max(Math.abs((2 * px) / (width - right) - 1), Math.abs((2 * py) / (height - bottom) - 1));
  });
  return Math.max(...out);
}

const canvases = [
  { width: 1280, height: 800, right: 0, bottom: 0 },
  { width: 1280, height: 800, right: 340, bottom: 0 },
  { width: 390, height: 844, right: 0, bottom: 420 },
];

it.each(canvases)("sheets just touch the rim of %o without a margin, and stay within it with one", (canvas) => {
  const field = fieldOfView(32, canvas);
  for (const points of sheets) {
    const distance = (margin: number) => distanceToFit(points, { center, direction, up }, field, margin, 0.05);
    expect(farthestOut(points, distance(1), canvas)).toBeCloseTo(1, 9);
    expect(farthestOut(points, distance(1.3), canvas)).toBeLessThan(1);
  }
});

it("a point in the center leaves the camera at its nearest", () => {
  expect(distanceToFit([center], { center, direction, up }, { across: 0.3, upright: 0.3 }, 1.3, 0.05)).toBe(0.05);
});
