// The picture: renderer, camera, lights, and everything in them. Draws only when something has changed.
// z is up, lengths are meters. It also answers what is under a pointer.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { Cloth } from "./cloth";
import { distanceToFit, fieldOfView, type Canvas, type Insets } from "./framing";
import { Handle } from "./handle";
import { ground, obstacleMeshes } from "./obstacles";
import { QualityLadder } from "./quality";
import type { Frame, Topology, Vec3, ViewHello } from "./protocol";

/** What a pointer can take hold of. */
export interface Hit { position: THREE.Vector3; onHandle: boolean }

const FIELD_OF_VIEW = 32;
/** Towards the corner "00", from above. */
const VIEW_DIRECTION = new THREE.Vector3(-0.62, -1, 0.62).normalize();
/** How much farther the picture reaches than what must be seen: the arrow, and what the cloth does next. */
const MARGIN = 1.3;
/** From the left of that view, so that folds have a light and a dark side. */
const SUN_DIRECTION = new THREE.Vector3(-0.75, -0.05, 1).normalize();

export class Scene3d {
  readonly controls: OrbitControls;
  readonly camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 30);
  readonly handle: Handle;
  #renderer: THREE.WebGLRenderer;
  #scene = new THREE.Scene();
  #cloth = new Cloth();
  #ground = ground();
  #sun = new THREE.DirectionalLight("#fff1dc", 2.3);
  #obstacles: THREE.Mesh[] = [];
  #hover: THREE.Mesh;
  #insets: Insets = { right: 0, bottom: 0 };
  #framed = false;
  /** The user has turned the view, which resizing then leaves alone. */
  #turned = false;
  #stale = true;
  #drewLast = false;
  #quality = new QualityLadder(devicePixelRatio, new URLSearchParams(location.search).get("quality") === "full");
  #raycaster = new THREE.Raycaster();

  constructor(private readonly canvas: HTMLCanvasElement, label: HTMLElement) {
    this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, powerPreference: "high-performance" });
    this.#renderer.toneMapping = THREE.NeutralToneMapping;
    this.#renderer.shadowMap.enabled = true;
    this.#renderer.shadowMap.type = THREE.PCFShadowMap;
    this.#renderer.shadowMap.autoUpdate = false;
    this.#applyQuality();
    this.handle = new Handle(label);

    const sky = new THREE.HemisphereLight("#d6e0ff", "#4a4238", 1.75);
    sky.position.set(0, 0, 1);
    const rim = new THREE.DirectionalLight("#9fc0ff", 0.8);
    rim.position.set(1, 0.7, 0.3);
    this.#sun.shadow.mapSize.set(2048, 2048);
    this.#sun.shadow.bias = -0.0004;
    this.#sun.shadow.normalBias = 0.0025;
    this.#sun.shadow.radius = 5;
    this.#sun.shadow.intensity = 0.8;

    this.#hover = new THREE.Mesh(
      new THREE.RingGeometry(0.6, 1, 32),
      new THREE.MeshBasicMaterial({ color: "#ffffff", transparent: true, opacity: 0.8, depthTest: false }),
    );
    this.#hover.visible = false;
    this.#hover.renderOrder = 6;
    this.#scene.add(sky, rim, this.#sun, this.#sun.target, this.#ground, this.#cloth.group, this.handle.group, this.#hover);

    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.12;
    this.controls.minDistance = 0.05;
    this.controls.maxDistance = 6;
    this.controls.addEventListener("change", () => this.touch());
    this.controls.addEventListener("start", () => (this.#turned = true));
    new ResizeObserver(() => this.#resize()).observe(canvas);
  }

  /** Asks for a drawing at the next animation frame. */
  touch(): void {
    this.#stale = true;
  }

  set showMesh(on: boolean) {
    this.#cloth.showMesh = on;
    this.touch();
  }

  setInsets(insets: Insets): void {
    if (insets.right === this.#insets.right && insets.bottom === this.#insets.bottom) return;
    this.#insets = insets;
    this.#resize();
  }

  /** Takes the scene of a session. */
  setScene(hello: ViewHello): void {
    for (const mesh of this.#obstacles) {
      mesh.removeFromParent();
      mesh.geometry.dispose();
    }
    this.#obstacles = obstacleMeshes(hello.obstacles);
    if (this.#obstacles.length > 0) this.#scene.add(...this.#obstacles);
    this.#cloth.setSize(hello.scene.size_m);
    this.handle.size = Math.max(...hello.scene.size_m);
    this.#framed = false;
    this.touch();
  }

  setTopology(topology: Topology): void {
    this.#cloth.setTopology(topology);
  }

  setFrame(frame: Frame): boolean {
    if (!this.#cloth.setFrame(frame)) return false;
    this.handle.update(frame);
    this.#obstacles.forEach((mesh, n) => {
      if (frame.poses.length < 7 * (n + 1)) return;
      mesh.position.fromArray(frame.poses, 7 * n);
      mesh.quaternion.fromArray(frame.poses, 7 * n + 3);
    });
    if (!this.#framed) this.#frameScene();
    this.#renderer.shadowMap.needsUpdate = true;
    this.touch();
    return true;
  }

  /** Looks at the whole scene from the side of the corner "00". */
  resetView(): void {
    const center = this.#subject().getCenter(new THREE.Vector3());
    const look = { center, direction: VIEW_DIRECTION, up: this.camera.up };
    const field = fieldOfView(FIELD_OF_VIEW, this.#visible());
    const distance = distanceToFit(this.#outline(), look, field, MARGIN, this.controls.minDistance);
    this.controls.target.copy(center);
    this.camera.position.copy(center).addScaledVector(VIEW_DIRECTION, distance);
    this.controls.update();
    this.#turned = false;
    this.touch();
  }

  /** What a pointer at these client coordinates would take: the handle within `reach` pixels, else the cloth under it. */
  pick(clientX: number, clientY: number, reach: number): Hit | null {
    const box = this.canvas.getBoundingClientRect();
    const pointer = new THREE.Vector2(clientX - box.left, clientY - box.top);
    if (this.handle.group.visible && this.screen(this.handle.position).distanceTo(pointer) <= reach) {
      return { position: this.handle.position.clone(), onHandle: true };
    }
    const device = new THREE.Vector2((2 * pointer.x) / box.width - 1, 1 - (2 * pointer.y) / box.height);
    this.#raycaster.setFromCamera(device, this.camera);
    const [first] = this.#raycaster.intersectObjects([this.#cloth.mesh, ...this.#obstacles], false);
    if (!first || (first.object !== this.#cloth.mesh && !this.#clothJustBehind(first))) return null;
    return { position: first.point, onHandle: false };
  }

  /** The cloth lies on an obstacle to within this depth [m]: the pointer means the cloth. */
  #clothJustBehind(first: THREE.Intersection): boolean {
    const [cloth] = this.#raycaster.intersectObject(this.#cloth.mesh, false);
    return cloth !== undefined && cloth.distance - first.distance < 0.003;
  }

  /** Pixel of the canvas at which a point is seen. */
  screen(point: THREE.Vector3): THREE.Vector2 {
    const at = point.clone().project(this.camera);
    return new THREE.Vector2((0.5 + 0.5 * at.x) * this.canvas.clientWidth, (0.5 - 0.5 * at.y) * this.canvas.clientHeight);
  }

  /** Camera axes, and the length of one pixel at the depth of a point [m]. */
  dragFrame(at: THREE.Vector3): { right: THREE.Vector3; up: THREE.Vector3; forward: THREE.Vector3; metersPerPixel: number } {
    const right = new THREE.Vector3(), up = new THREE.Vector3(), back = new THREE.Vector3();
    this.camera.matrixWorld.extractBasis(right, up, back);
    const depth = Math.abs(at.clone().sub(this.camera.position).dot(back));
    const metersPerPixel = (2 * depth * Math.tan(THREE.MathUtils.degToRad(FIELD_OF_VIEW) / 2)) / this.canvas.clientHeight;
    return { right, up, forward: back.negate(), metersPerPixel };
  }

  /** Shows a ring where a press would take hold, or none. */
  hover(position: THREE.Vector3 | null): void {
    if (!position && !this.#hover.visible) return;
    this.#hover.visible = position !== null;
    if (position) this.#hover.position.copy(position);
    this.touch();
  }

  lead(target: Vec3 | null): void {
    this.handle.lead(target);
  }

  /** Draws if something has changed since the last time; true when it did. */
  draw(nowMs: number, held: boolean): boolean {
    this.controls.update();
    const stale = this.#stale;
    if (stale) {
      this.#stale = false;
      this.#render(held);
      if (this.#quality.drew(nowMs, this.#drewLast)) this.#applyQuality();
    }
    this.#drewLast = stale;
    return stale;
  }

  #render(held: boolean): void {
    this.handle.face(this.camera, this.canvas.clientWidth, this.canvas.clientHeight, held);
    this.#hover.quaternion.copy(this.camera.quaternion);
    this.#hover.scale.setScalar(5 * this.dragFrame(this.#hover.position).metersPerPixel);
    this.#renderer.render(this.#scene, this.camera);
  }

  #applyQuality(): void {
    const { pixelRatio, shadows } = this.#quality.now;
    this.#renderer.setPixelRatio(pixelRatio);
    this.#sun.castShadow = shadows;
    this.#renderer.shadowMap.needsUpdate = true;
    this.touch();
  }

  /** Everything worth seeing: the cloth and the obstacles that end somewhere. */
  #subject(): THREE.Box3 {
    const box = new THREE.Box3();
    const position = this.#cloth.mesh.geometry.getAttribute("position");
    if (position) box.setFromBufferAttribute(position as THREE.BufferAttribute);
    for (const mesh of this.#obstacles) if (!(mesh.geometry instanceof THREE.PlaneGeometry)) box.expandByObject(mesh);
    if (box.isEmpty()) box.setFromCenterAndSize(new THREE.Vector3(), new THREE.Vector3(0.3, 0.3, 0.3));
    return box;
  }

  /** Points between which all of that lies, each given in the same vector: the cloth's, and the corners of boxes around obstacles. */
  *#outline(): Generator<THREE.Vector3> {
    const point = new THREE.Vector3();
    const position = this.#cloth.mesh.geometry.getAttribute("position");
    for (let n = 0; position && n < position.count; n++) yield point.fromBufferAttribute(position, n);
    for (const mesh of this.#obstacles) {
      if (mesh.geometry instanceof THREE.PlaneGeometry) continue;
      const { min, max } = new THREE.Box3().setFromObject(mesh);
      for (const x of [min.x, max.x]) for (const y of [min.y, max.y]) for (const z of [min.z, max.z]) yield point.set(x, y, z);
    }
  }

  /** Sets ground, sun and camera once per scene, from the first frame. */
  #frameScene(): void {
    this.#framed = true;
    const box = this.#subject();
    const { center, radius } = box.getBoundingSphere(new THREE.Sphere());
    const solid = this.#obstacles.length > 0;
    this.#ground.visible = !this.#obstacles.some((mesh) => mesh.geometry instanceof THREE.PlaneGeometry);
    this.#ground.position.set(0, 0, solid ? box.min.z : box.min.z - radius);
    this.#sun.target.position.copy(center);
    this.#sun.position.copy(center).addScaledVector(SUN_DIRECTION, 4 * radius);
    const camera = this.#sun.shadow.camera;
    camera.left = camera.bottom = -2.2 * radius;
    camera.right = camera.top = 2.2 * radius;
    camera.near = 0.1 * radius;
    camera.far = 8 * radius;
    camera.updateProjectionMatrix();
    this.resetView();
  }

  #visible(): Canvas {
    return { width: Math.max(1, this.canvas.clientWidth), height: Math.max(1, this.canvas.clientHeight), ...this.#insets };
  }

  #resize(): void {
    const { width, height, right, bottom } = this.#visible();
    this.#renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // Shifts the center of the picture into the part that no panel covers.
    this.camera.setViewOffset(width, height, right / 2, bottom / 2, width, height);
    this.camera.updateProjectionMatrix();
    this.touch();
    if (this.#framed && !this.#turned) this.resetView();
  }
}
