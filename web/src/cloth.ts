// The cloth's mesh in the picture: geometry from topology and frames, normals, and a material with a side each.
// The weave, the grid and the stitched border are drawn in the shader in lattice coordinates, so they show the strain.

import * as THREE from "three";
import type { Frame, Topology } from "./protocol";

const FRONT = new THREE.Color("#5876ae");
const BACK = new THREE.Color("#d9d1c1");
const THREAD = new THREE.Color("#f2a65a");

export class Cloth {
  readonly group = new THREE.Group();
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.MeshStandardMaterial>;
  #wire: THREE.Mesh;
  #topology: Topology | null = null;
  #size = { value: new THREE.Vector2(0.3, 0.3) };

  constructor() {
    const material = new THREE.MeshStandardMaterial({ side: THREE.DoubleSide, roughness: 0.92, metalness: 0 });
    material.onBeforeCompile = (shader) => this.#weave(shader);
    this.mesh = new THREE.Mesh(new THREE.BufferGeometry(), material);
    this.mesh.castShadow = this.mesh.receiveShadow = true;
    this.mesh.frustumCulled = false;
    this.#wire = new THREE.Mesh(
      this.mesh.geometry,
      new THREE.MeshBasicMaterial({ wireframe: true, vertexColors: true, transparent: true, opacity: 0.55, depthWrite: false }),
    );
    this.#wire.frustumCulled = false;
    this.#wire.visible = false;
    this.group.add(this.mesh, this.#wire);
  }

  get topology(): Topology | null {
    return this.#topology;
  }

  /** Shows or hides the edges of the active mesh, tinted by level. */
  set showMesh(on: boolean) {
    this.#wire.visible = on;
  }

  /** Rest size along I and J [m]: scales the weave. */
  setSize(size: readonly [number, number]): void {
    this.#size.value.set(size[0], size[1]);
  }

  setTopology(topology: Topology): void {
    this.#topology = topology;
    const [rows, columns] = topology.lattice;
    const count = topology.vertices.length;
    const uv = new Float32Array(2 * count);
    const tint = new Float32Array(3 * count);
    const color = new THREE.Color();
    topology.vertices.forEach((index, v) => {
      uv[2 * v] = Math.floor(index / columns) / Math.max(1, rows - 1);
      uv[2 * v + 1] = (index % columns) / Math.max(1, columns - 1);
      color.setHSL(0.5 - 0.14 * (topology.levels[v] ?? 0), 0.9, 0.7).toArray(tint, 3 * v);
    });
    const geometry = new THREE.BufferGeometry();
    geometry.setIndex(new THREE.BufferAttribute(topology.triangles, 1));
    geometry.setAttribute("uv", new THREE.BufferAttribute(uv, 2));
    geometry.setAttribute("color", new THREE.BufferAttribute(tint, 3));
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * count), 3).setUsage(THREE.DynamicDrawUsage));
    geometry.setAttribute("normal", new THREE.BufferAttribute(new Float32Array(3 * count), 3).setUsage(THREE.DynamicDrawUsage));
    geometry.boundingSphere = new THREE.Sphere();
    this.mesh.geometry.dispose();
    this.mesh.geometry = this.#wire.geometry = geometry;
  }

  /** Takes the frame's positions; false when they belong to another epoch. */
  setFrame(frame: Frame): boolean {
    if (this.#topology?.epoch !== frame.epoch || frame.positions.length !== 3 * this.#topology.vertices.length) return false;
    const geometry = this.mesh.geometry;
    const position = geometry.getAttribute("position") as THREE.BufferAttribute;
    const normal = geometry.getAttribute("normal") as THREE.BufferAttribute;
    (position.array as Float32Array).set(frame.positions);
    vertexNormals(this.#topology.triangles, frame.positions, normal.array as Float32Array);
    position.needsUpdate = normal.needsUpdate = true;
    boundingSphere(frame.positions, geometry.boundingSphere!);
    return true;
  }

  #weave(shader: THREE.WebGLProgramParametersWithUniforms): void {
    Object.assign(shader.uniforms, {
      uFront: { value: FRONT }, uBack: { value: BACK }, uThread: { value: THREAD }, uSize: this.#size,
    });
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", "#include <common>\nvarying vec2 vLattice;")
      .replace("#include <begin_vertex>", "#include <begin_vertex>\nvLattice = uv;");
    shader.fragmentShader = shader.fragmentShader
      .replace("#include <common>", `#include <common>\n${WEAVE_FUNCTIONS}`)
      .replace("#include <color_fragment>", "#include <color_fragment>\ndiffuseColor.rgb = weave();")
      .replace("#include <opaque_fragment>", `${FUZZ}\n#include <opaque_fragment>`);
  }
}

const WEAVE_FUNCTIONS = /* glsl */ `
varying vec2 vLattice;
uniform vec3 uFront, uBack, uThread;
uniform vec2 uSize;

// A line at x = 0, at least a pixel wide; pixel is the size of a pixel in units of x.
float hairline(float x, float width, float pixel) {
  return 1.0 - smoothstep(0.5 * width, 0.5 * width + 1.2 * max(pixel, 1e-7), abs(x));
}

vec3 weave() {
  vec2 at = vLattice * uSize;                       // [m] on the flat cloth
  vec3 tint = gl_FrontFacing ? uFront : uBack;

  // A 2/1 twill, 0.9 mm: seen from near only, before it would alias.
  vec2 t = at / 0.0009;
  float seen = 1.0 - smoothstep(0.25, 0.75, max(fwidth(t.x), fwidth(t.y)));
  float rib = sin(6.2831853 * (gl_FrontFacing ? t.x + t.y : t.x - t.y) / 3.0);
  float threads = sin(6.2831853 * t.x) * sin(6.2831853 * t.y);
  tint *= 1.0 + seen * (0.10 * rib + 0.07 * threads);

  // A line every 3 cm shows how the cloth is strained and sheared.
  vec2 g = at / 0.03;
  vec2 pixel = fwidth(g);
  vec2 line = vec2(hairline(g.x - round(g.x), 0.012, pixel.x), hairline(g.y - round(g.y), 0.012, pixel.y));
  float crowd = 1.0 - smoothstep(0.08, 0.35, max(pixel.x, pixel.y));
  tint = mix(tint, gl_FrontFacing ? vec3(1.0) : vec3(0.25), 0.15 * crowd * max(line.x, line.y));

  // Stitches along the border.
  vec2 inset = min(at, uSize - at);
  float edge = min(inset.x, inset.y);
  float along = inset.x < inset.y ? at.y : at.x;
  float dash = smoothstep(-0.15, 0.15, sin(6.2831853 * along / 0.006) + 0.35);
  float fine = 0.03 * max(pixel.x, pixel.y);
  float stitch = max(hairline(edge - 0.004, 0.0006, fine), hairline(edge - 0.0062, 0.0006, fine));
  float close = 1.0 - smoothstep(0.0012, 0.004, fine);
  tint = mix(tint, uThread, 0.8 * stitch * dash * close);
  return tint;
}
`;

/** Loose fibers catch the light where the cloth is seen edge on. */
const FUZZ = /* glsl */ `
float grazing = pow(1.0 - abs(dot(normalize(normal), normalize(vViewPosition))), 3.0);
outgoingLight += 0.22 * grazing * mix(diffuseColor.rgb, vec3(0.75), 0.35);
`;

/** Area-weighted vertex normals. */
export function vertexNormals(triangles: Uint32Array, positions: Float32Array, normals: Float32Array): void {
  normals.fill(0);
  for (let t = 0; t < triangles.length; t += 3) {
    const a = 3 * triangles[t]!, b = 3 * triangles[t + 1]!, c = 3 * triangles[t + 2]!;
    const ax = positions[a]!, ay = positions[a + 1]!, az = positions[a + 2]!;
    const ux = positions[b]! - ax, uy = positions[b + 1]! - ay, uz = positions[b + 2]! - az;
    const vx = positions[c]! - ax, vy = positions[c + 1]! - ay, vz = positions[c + 2]! - az;
    const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
    for (const v of [a, b, c]) {
      normals[v]! += nx;
      normals[v + 1]! += ny;
      normals[v + 2]! += nz;
    }
  }
  for (let v = 0; v < normals.length; v += 3) {
    const length = Math.hypot(normals[v]!, normals[v + 1]!, normals[v + 2]!) || 1;
    normals[v]! /= length;
    normals[v + 1]! /= length;
    normals[v + 2]! /= length;
  }
}

/** A sphere around the box of all positions. */
function boundingSphere(positions: Float32Array, sphere: THREE.Sphere): void {
  const box = new THREE.Box3().setFromArray(positions);
  box.getBoundingSphere(sphere);
}
