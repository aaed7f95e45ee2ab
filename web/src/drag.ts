// Pointer and keys: what takes hold of the cloth, how a drag moves it, and what is left to the orbit controls.
// A drag moves in the camera's plane; Shift, the wheel, or a second finger move in depth.

import * as THREE from "three";
import type { Hand } from "./hand";
import type { GrabAt, Vec3 } from "./protocol";
import type { Scene3d } from "./scene3d";

/** Pixels around the handle that still take it. */
const REACH = { mouse: 24, pen: 28, touch: 42 } as const;
/** One press of an arrow key moves the hand so far [m]. */
const KEY_STEP = 0.004;
/** The hand is kept within so many meters of where it was taken. */
const LEASH = 1.0;

export interface DragOptions {
  scene: Scene3d;
  hand: Hand;
  /** Lattice place of the scene's own hand, when it has one. */
  handParticle(): readonly [number, number] | null;
  letGo(): boolean;
}

export class Drag {
  #pointer: number | null = null;
  #second: number | null = null;
  #last = new THREE.Vector2();
  #secondY = 0;
  #target = new THREE.Vector3();
  #origin = new THREE.Vector3();
  #hoverAt: PointerEvent | null = null;

  constructor(stage: HTMLElement, private readonly canvas: HTMLCanvasElement, private readonly with_: DragOptions) {
    // On the way down, so that a grab is decided before the orbit controls see the event.
    const down = { capture: true } as const;
    stage.addEventListener("pointerdown", (event) => this.#down(event), down);
    stage.addEventListener("pointermove", (event) => this.#move(event), down);
    stage.addEventListener("pointerup", (event) => this.#up(event), down);
    stage.addEventListener("pointercancel", (event) => this.#up(event), down);
    stage.addEventListener("pointerleave", () => this.#unhover());
    stage.addEventListener("wheel", (event) => this.#wheel(event), { capture: true, passive: false });
    canvas.addEventListener("keydown", (event) => this.#key(event));
    canvas.addEventListener("blur", () => {
      if (this.#pointer === null) this.#release();
    });
    document.addEventListener("visibilitychange", () => {
      if (document.hidden) this.#release();
    });
  }

  /** The server has given the particle: the drag goes on from where it really is. */
  granted(position: Vec3): void {
    const led = this.#target.clone().sub(this.#origin); // movement since the press
    this.#origin.fromArray(position);
    this.#lead(this.#origin.clone().add(led));
  }

  /** The hand is free again, for whatever reason. */
  ended(): void {
    this.#pointer = this.#second = null;
    this.with_.scene.controls.enabled = true;
    this.canvas.classList.remove("grabbing");
  }

  /** Looks under a resting pointer; called once per animation frame. */
  hover(): void {
    const event = this.#hoverAt;
    this.#hoverAt = null;
    if (!event || this.with_.hand.state !== "free") return;
    const hit = this.with_.scene.pick(event.clientX, event.clientY, REACH.mouse);
    this.canvas.classList.toggle("grab", hit !== null);
    this.with_.scene.hover(hit && !hit.onHandle ? hit.position : null);
  }

  #down(event: PointerEvent): void {
    if (event.target !== this.canvas) return;
    if (this.#pointer !== null) {
      // A second finger moves in depth and is kept from the orbit controls.
      event.stopPropagation();
      this.#second ??= event.pointerId;
      this.#secondY = event.clientY;
      return;
    }
    if (event.button !== 0 || this.with_.hand.state !== "free") return;
    const reach = REACH[event.pointerType as keyof typeof REACH] ?? REACH.mouse;
    const hit = this.with_.scene.pick(event.clientX, event.clientY, reach);
    if (!hit) return;
    event.stopPropagation();
    this.#pointer = event.pointerId;
    this.canvas.setPointerCapture(event.pointerId);
    this.#last.set(event.clientX, event.clientY);
    this.#take(hit.position, hit.onHandle ? this.#ownParticle() : { nearest_m: vec3(hit.position) });
  }

  #move(event: PointerEvent): void {
    if (event.pointerId === this.#second) {
      event.stopPropagation();
      this.#shift(0, 0, this.#secondY - event.clientY);
      this.#secondY = event.clientY;
    } else if (event.pointerId === this.#pointer) {
      event.stopPropagation();
      const dx = event.clientX - this.#last.x;
      const dy = event.clientY - this.#last.y;
      this.#last.set(event.clientX, event.clientY);
      if (event.shiftKey) this.#shift(dx, 0, -dy);
      else this.#shift(dx, dy, 0);
    } else if (event.pointerType !== "touch" && event.buttons === 0) {
      this.#hoverAt = event.target === this.canvas ? event : null;
      if (!this.#hoverAt) this.#unhover();
    }
  }

  #up(event: PointerEvent): void {
    if (event.pointerId === this.#second) {
      event.stopPropagation();
      this.#second = null;
    } else if (event.pointerId === this.#pointer) {
      this.#release();
    }
  }

  #wheel(event: WheelEvent): void {
    if (this.with_.hand.state === "free") return;
    event.preventDefault();
    event.stopPropagation();
    this.#shift(0, 0, -0.3 * event.deltaY);
  }

  #key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { hand, scene } = this.with_;
    const { right, up, forward } = scene.dragFrame(this.#target);
    const steps: Record<string, THREE.Vector3> = event.shiftKey
      ? { ArrowUp: forward, ArrowDown: forward.clone().negate(), ArrowRight: right, ArrowLeft: right.clone().negate() }
      : { ArrowUp: up, ArrowDown: up.clone().negate(), ArrowRight: right, ArrowLeft: right.clone().negate() };
    const step = steps[event.key];
    if (step) {
      if (hand.state === "free") this.#take(scene.handle.position.clone(), this.#ownParticle());
      this.#lead(this.#target.clone().addScaledVector(step, KEY_STEP));
    } else if (event.key === "Enter" || event.key === " ") {
      if (hand.state === "free") this.#take(scene.handle.position.clone(), this.#ownParticle());
      else this.#release();
    } else if (event.key === "Escape") {
      this.#release();
    } else {
      return;
    }
    event.preventDefault();
  }

  #take(position: THREE.Vector3, at: GrabAt): void {
    this.#unhover();
    this.#origin.copy(position);
    this.#target.copy(position);
    this.with_.scene.controls.enabled = false;
    this.canvas.classList.add("grabbing");
    this.with_.hand.grab(at);
  }

  #ownParticle(): GrabAt {
    const particle = this.with_.handParticle();
    return particle ? { particle } : { corner: "00" };
  }

  #shift(dx: number, dy: number, depth: number): void {
    const { right, up, forward, metersPerPixel } = this.with_.scene.dragFrame(this.#target);
    this.#lead(
      this.#target.clone()
        .addScaledVector(right, dx * metersPerPixel)
        .addScaledVector(up, -dy * metersPerPixel)
        .addScaledVector(forward, depth * metersPerPixel),
    );
  }

  #lead(target: THREE.Vector3): void {
    this.#target.copy(target.sub(this.#origin).clampLength(0, LEASH).add(this.#origin));
    if (this.with_.hand.state === "held") this.with_.hand.moveTo(vec3(this.#target));
    this.with_.scene.touch();
  }

  #release(): void {
    if (this.with_.hand.state !== "free") this.with_.hand.release(this.with_.letGo());
  }

  #unhover(): void {
    this.#hoverAt = null;
    this.canvas.classList.remove("grab");
    this.with_.scene.hover(null);
  }
}

function vec3(v: THREE.Vector3): Vec3 {
  return [v.x, v.y, v.z];
}
