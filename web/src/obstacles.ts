// The obstacles of the scene as solid shapes, and the ground under it all.

import * as THREE from "three";
import type { Obstacle } from "./protocol";

/** Half the width at which an endless plane is drawn [m]. */
const PLANE_HALF = 2;

/** A shape for each obstacle; planes face along their own +z. */
export function obstacleMeshes(obstacles: readonly Obstacle[]): THREE.Mesh[] {
  return obstacles.map((obstacle) => {
    const material = new THREE.MeshStandardMaterial({
      color: obstacle.shape === "plane" ? "#222b3b" : "#8e97a8",
      roughness: 0.7,
      // The cloth lies on the surface to within a fraction of a millimeter: the picture prefers the cloth.
      polygonOffset: true,
      polygonOffsetFactor: 2,
      polygonOffsetUnits: 8,
    });
    const geometry = shape(obstacle);
    const mesh = new THREE.Mesh(geometry, material);
    mesh.name = obstacle.name;
    mesh.position.fromArray(obstacle.position_m);
    mesh.quaternion.fromArray(obstacle.rotation_xyzw);
    mesh.castShadow = obstacle.shape !== "plane";
    mesh.receiveShadow = true;
    if (obstacle.shape === "box") {
      const edges = new THREE.LineSegments(
        new THREE.EdgesGeometry(geometry),
        new THREE.LineBasicMaterial({ color: "#c9d2e3", transparent: true, opacity: 0.28 }),
      );
      mesh.add(edges);
    }
    return mesh;
  });
}

function shape(obstacle: Obstacle): THREE.BufferGeometry {
  switch (obstacle.shape) {
    case "box": {
      const [x, y, z] = obstacle.half_m ?? [0.05, 0.05, 0.05];
      return new THREE.BoxGeometry(2 * x, 2 * y, 2 * z);
    }
    case "sphere":
      return new THREE.SphereGeometry(obstacle.radius_m ?? 0.05, 64, 40);
    case "capsule":
      // three.js lays capsules along y.
      return new THREE.CapsuleGeometry(obstacle.radius_m ?? 0.05, 2 * (obstacle.half_length_m ?? 0.05), 16, 40).rotateX(Math.PI / 2);
    case "plane":
      return new THREE.PlaneGeometry(2 * PLANE_HALF, 2 * PLANE_HALF);
    case "mesh": {
      const points = obstacle.points_m ?? [];
      const corners = (obstacle.triangles ?? []).flatMap((triangle) => triangle.flatMap((n) => [...(points[n] ?? [0, 0, 0])]));
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.Float32BufferAttribute(corners, 3));
      geometry.computeVertexNormals();
      return geometry;
    }
  }
}

/** The place for shadows, and a fading grid that shows height. Neither hides the cloth. */
export function ground(): THREE.Group {
  const shadow = new THREE.Mesh(new THREE.CircleGeometry(RADIUS, 64), new THREE.ShadowMaterial({ color: "#04060b", opacity: 0.55, depthWrite: false }));
  shadow.receiveShadow = true;
  const grid = new THREE.Mesh(
    new THREE.CircleGeometry(RADIUS, 64),
    new THREE.ShaderMaterial({ vertexShader: GRID_VERTEX, fragmentShader: GRID_FRAGMENT, transparent: true, depthWrite: false }),
  );
  grid.renderOrder = -2;
  shadow.renderOrder = -1;
  return new THREE.Group().add(grid, shadow);
}

const RADIUS = 1.3;

const GRID_VERTEX = /* glsl */ `
varying vec2 at;
void main() {
  at = position.xy;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;

/** Lines every 10 cm. */
const GRID_FRAGMENT = /* glsl */ `
varying vec2 at;
void main() {
  vec2 g = at / 0.1;
  vec2 pixel = max(fwidth(g), vec2(1e-6));
  vec2 line = 1.0 - smoothstep(vec2(0.0), 1.3 * pixel, abs(g - round(g)));
  float near = smoothstep(1.0, 0.1, length(at));
  float crowd = 1.0 - smoothstep(0.1, 0.5, max(pixel.x, pixel.y));
  gl_FragColor = vec4(0.55, 0.65, 0.85, near * (0.035 + 0.13 * crowd * max(line.x, line.y)));
}`;
