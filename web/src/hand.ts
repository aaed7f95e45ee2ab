// The hand as the page knows it: a thin front of the worker that owns the haptic socket. Its state changes at once when
// the user acts; what the worker still says about an earlier grab is dropped.

import type { HandEvents, HandState } from "./hand_socket";
import type { FromWorker, ToWorker } from "./hand.worker";
import type { GrabAt, Vec3 } from "./protocol";
import { socketUrl } from "./session";

/** A page that cannot draw for a while is alive all the same. */
const BEAT_EVERY_MS = 500;

export class Hand {
  #worker = new Worker(new URL("./hand.worker.ts", import.meta.url), { type: "module" });
  #state: HandState = "free";
  #grab = 0;
  #target: Vec3 = [0, 0, 0];

  constructor(private readonly events: HandEvents) {
    this.#post({ op: "start", url: socketUrl("haptic").href });
    this.#worker.onmessage = ({ data }: MessageEvent<FromWorker>) => this.#receive(data);
    setInterval(() => this.beat(), BEAT_EVERY_MS);
    this.#worker.onerror = (event) => events.told("error", `Hand: ${event.message || "the worker did not start"}`);
  }

  get state(): HandState {
    return this.#state;
  }

  /** Where the hand is led. */
  get target(): Vec3 {
    return this.#target;
  }

  /** Asks for a particle; the answer comes as `granted` or as something told. */
  grab(at: GrabAt): void {
    if (this.#state !== "free") return;
    this.#grab += 1;
    this.#post({ op: "grab", grab: this.#grab, at });
    this.#enter("asking");
  }

  /** Leads the hand to a position; poses on the way are sent at an even rate. */
  moveTo(position: Vec3): void {
    this.#target = position;
    this.#post({ op: "move", position });
  }

  /** Gives the particle back: it stays where it is, or falls when it is let go. */
  release(letGo: boolean): void {
    if (this.#state === "free") return;
    this.#post({ op: "release", letGo });
    this.#enter("free");
  }

  /** Tells the worker, at each animation frame, that the page is alive and has room for the newest force model. */
  beat(): void {
    if (this.#state !== "free") this.#post({ op: "beat" });
  }

  #receive(message: FromWorker): void {
    if (message.op === "told") {
      this.events.told(message.level, message.text);
    } else if (message.grab === this.#grab && this.#state !== "free") {
      if (message.op === "state") this.#enter(message.state);
      else if (message.op === "granted") {
        this.#target = message.position;
        this.events.granted(message.position);
      } else this.events.model(message.model, message.roundTripMs);
    }
  }

  #enter(state: HandState): void {
    if (state === this.#state) return;
    this.#state = state;
    this.events.state(state);
  }

  #post(message: ToWorker): void {
    this.#worker.postMessage(message);
  }
}
