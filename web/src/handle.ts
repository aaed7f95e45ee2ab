// The hand in the picture: a handle at the held particle, the force arrow, its number beside it, and where the user leads it.

import * as THREE from "three";
import type { Frame, Vec3 } from "./protocol";
import { newtons } from "./format";

const HANDLE = "#ffc066";
const FORCE = "#ff6f61";

/** Arrow length [m] per square root of a newton, for a cloth of 1 m: the root keeps 0.05 N and 5 N both in the picture. */
const LENGTH_PER_ROOT_NEWTON = 0.42;
/** Length that no arrow reaches: large forces would run off the page. */
const LONGEST = 0.8;

export class Handle {
  readonly group = new THREE.Group();
  #ball: THREE.Mesh<THREE.SphereGeometry, THREE.MeshStandardMaterial>;
  #halo: THREE.Mesh<THREE.RingGeometry, THREE.MeshBasicMaterial>;
  #lead: THREE.Mesh<THREE.RingGeometry, THREE.MeshBasicMaterial>;
  #arrow = new Arrow();
  #tip = new THREE.Vector3();
  #size = 0.3;

  constructor(private readonly label: HTMLElement) {
    const over = { transparent: true, depthTest: false, depthWrite: false, side: THREE.DoubleSide } as const;
    this.#ball = new THREE.Mesh(
      new THREE.SphereGeometry(1, 32, 20),
      new THREE.MeshStandardMaterial({ color: HANDLE, emissive: HANDLE, emissiveIntensity: 0.35, roughness: 0.35, transparent: true }),
    );
    this.#ball.renderOrder = 4; // over the arrow's faint part, which starts inside it
    this.#ball.castShadow = true;
    this.#halo = new THREE.Mesh(new THREE.RingGeometry(1.6, 1.74, 64), new THREE.MeshBasicMaterial({ color: HANDLE, opacity: 0.75, ...over }));
    this.#lead = new THREE.Mesh(new THREE.RingGeometry(0.75, 1, 40), new THREE.MeshBasicMaterial({ color: "#ffffff", opacity: 0.4, ...over }));
    this.#halo.renderOrder = this.#lead.renderOrder = 5;
    this.group.add(this.#ball, this.#halo, this.#lead, this.#arrow.group);
    this.group.visible = false;
    this.#lead.visible = false;
  }

  get position(): THREE.Vector3 {
    return this.#ball.position;
  }

  /** The larger side of the cloth [m]: scales handle and arrow. */
  set size(size: number) {
    this.#size = size;
    this.#ball.scale.setScalar(0.02 * size);
  }

  update(frame: Frame): void {
    this.group.visible = frame.handPresent;
    this.label.hidden = !frame.handPresent;
    if (!frame.handPresent) return;
    this.#ball.position.fromArray(frame.handPosition);
    const force = new THREE.Vector3().fromArray(frame.handForce);
    const magnitude = force.length();
    const wanted = LENGTH_PER_ROOT_NEWTON * Math.sqrt(magnitude);
    const length = (wanted / (1 + wanted / LONGEST)) * this.#size;
    this.#arrow.set(this.#ball.position, force.normalize(), length, this.#size);
    this.#tip.copy(this.#ball.position).addScaledVector(force, length);
    this.label.textContent = newtons(magnitude);
  }

  /** Marks the place to which the user leads the hand, or nothing. */
  lead(target: Vec3 | null): void {
    this.#lead.visible = target !== null && this.#ball.position.distanceTo(new THREE.Vector3(...target)) > 0.02 * this.#size;
    if (target) this.#lead.position.fromArray(target);
  }

  /** Turns rings to the camera and puts the number beside the arrow's tip. */
  face(camera: THREE.PerspectiveCamera, width: number, height: number, held: boolean): void {
    this.#halo.position.copy(this.#ball.position);
    this.#halo.quaternion.copy(camera.quaternion);
    this.#halo.scale.setScalar((held ? 0.026 : 0.02) * this.#size);
    this.#halo.material.opacity = held ? 0.95 : 0.5;
    this.#lead.quaternion.copy(camera.quaternion);
    this.#lead.scale.setScalar(0.016 * this.#size);
    const at = this.#tip.clone().project(camera);
    const x = Math.min(width - 90, Math.max(8, (0.5 + 0.5 * at.x) * width + 12));
    // Above the hints.
    const y = Math.min(height - 60, Math.max(30, (0.5 - 0.5 * at.y) * height));
    this.label.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px) translateY(-50%)`;
  }
}

/** An arrow that shines faintly through what is before it. */
class Arrow {
  readonly group = new THREE.Group();
  #parts: { shaft: THREE.Mesh; head: THREE.Mesh }[];

  constructor() {
    const along = (geometry: THREE.BufferGeometry) => geometry.rotateX(Math.PI / 2).translate(0, 0, 0.5);
    const shaft = along(new THREE.CylinderGeometry(1, 1, 1, 20));
    const head = along(new THREE.ConeGeometry(1, 1, 28));
    const solid = new THREE.MeshStandardMaterial({ color: FORCE, emissive: FORCE, emissiveIntensity: 0.45, roughness: 0.45 });
    const through = new THREE.MeshBasicMaterial({ color: FORCE, transparent: true, opacity: 0.4, depthFunc: THREE.GreaterDepth, depthWrite: false });
    this.#parts = [through, solid].map((material) => ({ shaft: new THREE.Mesh(shaft, material), head: new THREE.Mesh(head, material) }));
    for (const part of this.#parts) this.group.add(part.shaft, part.head);
  }

  set(from: THREE.Vector3, direction: THREE.Vector3, length: number, size: number): void {
    this.group.visible = length > 1e-3 * size;
    this.group.position.copy(from);
    this.group.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), direction);
    const width = 0.009 * size;
    const headLength = Math.min(0.08 * size, 0.5 * length);
    for (const { shaft, head } of this.#parts) {
      shaft.scale.set(width, width, Math.max(1e-6, length - headLength));
      head.scale.set(0.3 * headLength, 0.3 * headLength, headLength);
      head.position.z = length - headLength;
    }
  }
}
