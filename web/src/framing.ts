// How near a camera may stand for everything to lie in the picture.

import * as THREE from "three";

/** A camera that looks at a center from a direction, with its head up. */
export interface Look { center: THREE.Vector3; direction: THREE.Vector3; up: THREE.Vector3 }

/** Tangents of half the angles that it sees across and upright. */
export interface Field { across: number; upright: number }

/** Part of the canvas that panels cover [CSS px]; the cloth is centered in the rest. */
export interface Insets { right: number; bottom: number }

/** A canvas and what of it is covered [CSS px]. */
export interface Canvas extends Insets { width: number; height: number }

/** Tangents for a vertical field of view [degrees], where the picture is what panels leave of a canvas. */
export function fieldOfView(degrees: number, { width, height, right, bottom }: Canvas): Field {
  const vertical = Math.tan(THREE.MathUtils.degToRad(degrees) / 2);
  return { across: (vertical * (width - right)) / height, upright: (vertical * (height - bottom)) / height };
}

/** Least distance from the center at which points lie in the picture even where that reaches `margin` times less far, and `nearest` at least. */
export function distanceToFit(points: Iterable<THREE.Vector3>, look: Look, field: Field, margin: number, nearest: number): number {
  const aside = new THREE.Vector3().crossVectors(look.up, look.direction).normalize();
  const above = new THREE.Vector3().crossVectors(look.direction, aside);
  const off = new THREE.Vector3();
  let distance = nearest;
  for (const point of points) {
    off.subVectors(point, look.center);
    const out = Math.max(Math.abs(off.dot(aside)) / field.across, Math.abs(off.dot(above)) / field.upright);
    distance = Math.max(distance, off.dot(look.direction) + margin * out);
  }
  return distance;
}
