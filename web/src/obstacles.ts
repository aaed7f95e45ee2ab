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
    case "plane":
      return new THREE.PlaneGeometry(2 * PLANE_HALF, 2 * PLANE_HALF);
  }
}

/** A fading disc with a grid, which shows height and takes shadows; it never hides the cloth. */
export function ground(): THREE.Mesh<THREE.BufferGeometry, THREE.MeshStandardMaterial> {
  const material = new THREE.MeshStandardMaterial({ color: "#1b2332", roughness: 1, transparent: true, depthWrite: false });
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", "#include <common>\nvarying vec2 vGround;")
      .replace("#include <begin_vertex>", "#include <begin_vertex>\nvGround = (modelMatrix * vec4(position, 1.0)).xy;");
    shader.fragmentShader = shader.fragmentShader
      .replace("#include <common>", "#include <common>\nvarying vec2 vGround;")
      .replace("#include <color_fragment>", /* glsl */ `#include <color_fragment>
        vec2 g = vGround / 0.1;
        vec2 w = max(fwidth(g), vec2(1e-6));
        vec2 l = 1.0 - smoothstep(vec2(0.0), 1.3 * w, abs(g - round(g)));
        float far = smoothstep(0.75, 0.1, length(vGround) / 1.3);
        diffuseColor.rgb += 0.028 * max(l.x, l.y) * (1.0 - smoothstep(0.1, 0.5, max(w.x, w.y)));
        diffuseColor.a *= far;`);
  };
  const mesh = new THREE.Mesh(new THREE.CircleGeometry(1.3, 96), material);
  mesh.receiveShadow = true;
  mesh.renderOrder = -1;
  return mesh;
}
