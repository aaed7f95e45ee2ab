// The haptic socket, held open while the user grabs. It sends poses on its own clock, keeps the lease, and decodes force
// models. It runs in a worker (hand.worker.ts), where a slow picture cannot make it miss the lease.

import { decodeForceModel, encodeMove, HAPTIC_PROTOCOL, parseMessage } from "./protocol";
import type { ForceModel, GrabAt, HapticMessage, Vec3 } from "./protocol";
import { paced } from "./pace";

export type HandState = "free" | "asking" | "held";

export interface HandEvents {
  state(state: HandState): void;
  granted(position: Vec3): void;
  /** A force model, and the time since the pose that it includes was sent. */
  model(model: ForceModel, roundTripMs: number | null): void;
  /** Something that the user should read. */
  told(level: "info" | "warning" | "error", text: string): void;
}

/** Poses are sent at 125 Hz while the hand moves. */
const SEND_EVERY_MS = 8;
/** The lease is 125 ms; two pings may be lost. */
const PING_AFTER_MS = 40;
/** An unused socket is closed, so that the server does not send force models to nobody. */
const CLOSE_AFTER_MS = 15_000;

export class HandSocket {
  #socket: WebSocket | null = null;
  #state: HandState = "free";
  #wanted: GrabAt | null = null;
  /** The grab that the server has not answered yet; at most one, so that each answer is told apart. */
  #asked: GrabAt | null = null;
  #seq = 0;
  #target: Vec3 = [0, 0, 0];
  #pose: Vec3 = [0, 0, 0];
  #posedMs = 0;
  #sentMs = 0;
  #timer: ReturnType<typeof setInterval> | undefined;
  #idle: ReturnType<typeof setTimeout> | undefined;

  constructor(private readonly url: string, private readonly events: HandEvents) {}

  /** Asks for a particle; the answer comes as `granted` or as something told. */
  grab(at: GrabAt): void {
    if (this.#state !== "free") return;
    clearTimeout(this.#idle);
    this.#wanted = at;
    this.#enter("asking");
    if (this.#socket === null) this.#open();
    else this.#ask();
  }

  /** Leads the hand to a position; poses on the way are sent at an even rate. */
  moveTo(position: Vec3): void {
    this.#target = position;
  }

  /** Gives the particle back: it stays where it is, or falls when it is let go. */
  release(letGo: boolean): void {
    if (this.#state === "held") {
      this.#send({ op: "release", let_go: letGo });
      this.#end();
    } else if (this.#state === "asking") {
      this.#wanted = null; // given back as soon as it is granted
      this.#enter("free");
      this.#rest();
    }
  }

  #open(): void {
    const socket = new WebSocket(this.url, HAPTIC_PROTOCOL);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    this.#seq = 0;
    socket.onopen = () => {
      this.#send({ op: "hello", client: "kesi viewer", device: { rate_hz: 1000 / SEND_EVERY_MS } });
      this.#ask();
    };
    socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
      try {
        if (typeof data === "string") this.#receive(parseMessage<HapticMessage>(data));
        else this.#feel(decodeForceModel(data));
      } catch (error) {
        this.events.told("error", `Hand: ${(error as Error).message}`);
      }
    };
    socket.onclose = (event) => {
      if (socket !== this.#socket) return;
      this.#socket = null;
      this.#asked = null;
      if (this.#state === "free") return;
      this.#end();
      this.events.told("warning", event.reason || "The hand lost its connection; the particle stays where it is.");
    };
  }

  /** Sends the wanted grab, unless the socket is still opening or an older grab waits for its answer. */
  #ask(): void {
    if (!this.#wanted || this.#asked || this.#socket?.readyState !== WebSocket.OPEN) return;
    this.#asked = this.#wanted;
    this.#send({ op: "grab", at: this.#asked });
  }

  /** Takes the answer to a grab; false when the user has given that grab up meanwhile. */
  #answered(): boolean {
    const current = this.#asked !== null && this.#asked === this.#wanted;
    this.#asked = null;
    return current;
  }

  #receive(message: HapticMessage): void {
    switch (message.op) {
      case "granted":
        this.#granted(message.particle, message.position_m);
        break;
      case "denied":
        if (!this.#answered()) {
          this.#ask();
          break;
        }
        this.#end();
        this.events.told("warning", message.code === "held_by_another" ? "Somebody else holds this particle." : message.message);
        break;
      case "released":
        if (message.code === "client") break;
        if (message.code === "silent" && this.#state === "held") {
          this.#retake();
          break;
        }
        if (this.#state !== "free") this.#end();
        this.events.told("warning", message.message);
        break;
      case "error":
        if (message.code === "not_holding") break; // poses on their way when the grab ended, which was told
        if (this.#state === "asking" && this.#answered()) this.#end();
        this.events.told("error", message.message);
        break;
      case "hello":
      case "pong":
      case "status": // the view socket tells it
        break;
    }
  }

  #feel(model: ForceModel): void {
    if (this.#state !== "held") return;
    this.events.model(model, model.moveTimeUs > 0 ? performance.now() - model.moveTimeUs / 1000 : null);
  }

  #granted(particle: readonly [number, number], position: Vec3): void {
    if (!this.#answered()) {
      this.#send({ op: "release", let_go: false });
      this.#ask();
      return;
    }
    this.#wanted = { particle };
    this.#pose = position;
    this.#posedMs = this.#sentMs = performance.now();
    this.#timer = setInterval(() => this.#beat(), SEND_EVERY_MS);
    if (this.#state === "held") return; // taken again: it goes on to where it is led
    this.#target = position;
    this.#enter("held");
    this.events.granted(position);
  }

  /** A machine too busy to send poses has lost the lease, but its user still holds: the same particle is asked for again. */
  #retake(): void {
    clearInterval(this.#timer);
    this.#ask();
    this.events.told("info", "This machine was too busy to hold on; the particle is taken again.");
  }

  /** One beat of the sending clock: a pose when the hand moves, a ping when it has been still. */
  #beat(): void {
    const now = performance.now();
    const next = paced(this.#pose, this.#target, (now - this.#posedMs) / 1000);
    this.#posedMs = now;
    const tUs = Math.round(now * 1000);
    if (next !== this.#pose) {
      this.#pose = next;
      this.#sentMs = now;
      this.#seq += 1;
      this.#socket?.send(encodeMove(this.#seq, tUs, next));
    } else if (now - this.#sentMs >= PING_AFTER_MS) {
      this.#sentMs = now;
      this.#send({ op: "ping", t_us: tUs });
    }
  }

  #send(message: object): void {
    this.#socket?.send(JSON.stringify(message));
  }

  #end(): void {
    clearInterval(this.#timer);
    this.#wanted = null;
    this.#enter("free");
    this.#rest();
  }

  #rest(): void {
    clearTimeout(this.#idle);
    this.#idle = setTimeout(() => {
      const socket = this.#socket;
      this.#socket = null;
      this.#asked = null;
      socket?.close();
    }, CLOSE_AFTER_MS);
  }

  #enter(state: HandState): void {
    this.#state = state;
    this.events.state(state);
  }
}
