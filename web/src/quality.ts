// Fits the picture to the machine: when drawings come too slowly it draws fewer pixels, then no shadows. It never goes
// back up by itself, because a picture that switches to and fro is worse than a plain one. `?quality=full` turns it off.

export interface Quality { pixelRatio: number; shadows: boolean }

/** A drawing that comes this long after the one before is slow; 20 a second still feel live. */
const SLOW_MS = 50;
/** So many slow drawings in a row are not chance. */
const PATIENCE = 10;

export class QualityLadder {
  #steps: Quality[];
  #step = 0;
  #slow = 0;
  #lastMs = 0;

  constructor(devicePixelRatio: number, private readonly fixed: boolean) {
    const best = Math.min(2, devicePixelRatio);
    const ratios = [best, Math.min(1, 0.6 * best), 0.5].filter((ratio, n, all) => n === 0 || ratio < all[n - 1]!);
    this.#steps = ratios.map((pixelRatio, n) => ({ pixelRatio, shadows: n < 2 }));
  }

  get now(): Quality {
    return this.#steps[this.#step]!;
  }

  /** Notes a drawing that followed another at once; true when the quality has changed. */
  drew(nowMs: number, followed: boolean): boolean {
    const slow = followed && nowMs - this.#lastMs > SLOW_MS;
    this.#lastMs = nowMs;
    this.#slow = slow ? this.#slow + 1 : 0;
    if (this.fixed || this.#slow < PATIENCE || this.#step + 1 >= this.#steps.length) return false;
    this.#slow = 0;
    this.#step += 1;
    return true;
  }
}
