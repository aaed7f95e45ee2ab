// Gamepad rumble: a change of |F| shakes, steady force does not (that is what motors without a position can tell).

/** A change of this size in one frame is full strength [N]. */
const FULL_CHANGE = 0.15;
/** Weaker changes are not worth a start of the motor. */
const THRESHOLD = 0.04;
const LENGTH_MS = 60;

export class Rumble {
  #last: number | null = null;

  /** Names of connected gamepads that can shake. */
  static names(): string[] {
    return gamepads().map((pad) => pad.id.replace(/\s*\(.*\)$/, ""));
  }

  /** Feels the force on the hand [N]; null when the hand is not ours. */
  feel(force: number | null): void {
    const change = force === null || this.#last === null ? 0 : Math.abs(force - this.#last);
    this.#last = force;
    const strength = Math.min(1, change / FULL_CHANGE);
    if (strength < THRESHOLD) return;
    for (const pad of gamepads()) {
      const effect = { duration: LENGTH_MS, strongMagnitude: strength, weakMagnitude: Math.sqrt(strength) };
      // A gamepad that is unplugged meanwhile refuses; the next look does not list it any more.
      pad.vibrationActuator.playEffect("dual-rumble", effect).catch(() => undefined);
    }
  }
}

function gamepads(): Gamepad[] {
  if (!("getGamepads" in navigator)) return [];
  return navigator.getGamepads().filter((pad): pad is Gamepad => Boolean(pad?.connected && pad.vibrationActuator));
}
