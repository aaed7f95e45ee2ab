// The view socket: connects, reconnects with backoff, and keeps the newest topology and frame until the page draws.
// It never draws and never queues: a page that is slow or hidden sees the newest state when it is back.

import { decodeView, parseMessage, VIEW_PROTOCOL } from "./protocol";
import type { Frame, Topology, ViewMessage } from "./protocol";
import { socketUrl, whyUnreachable } from "./session";

export type Phase = "connecting" | "connected" | "waiting" | "refused";
export interface ConnectionState { phase: Phase; message: string }

export interface ConnectionEvents {
  state(state: ConnectionState): void;
  message(message: ViewMessage): void;
  problem(text: string): void;
}

/** Close code of a server that speaks another version of the protocol. */
const PROTOCOL_MISMATCH = 1002;
const BACKOFF_FIRST_MS = 400;
const BACKOFF_LAST_MS = 8000;

export class ViewConnection {
  #socket: WebSocket | null = null;
  #topology: Topology | null = null;
  #frame: Frame | null = null;
  /** Frames that came since the last drawing; all are acknowledged when the newest is drawn. */
  #unacknowledged: number[] = [];
  #backoffMs = BACKOFF_FIRST_MS;
  #retry: ReturnType<typeof setTimeout> | undefined;

  constructor(private readonly events: ConnectionEvents, private readonly rateHz: number) {
    addEventListener("online", () => this.#hurry());
    document.addEventListener("visibilitychange", () => {
      if (!document.hidden) this.#hurry();
    });
    this.#connect();
  }

  /** Takes what came since the last call: the newest frame, and the topology when it is new. */
  take(): { topology: Topology | null; frame: Frame | null } {
    const taken = { topology: this.#topology, frame: this.#frame };
    this.#topology = null;
    this.#frame = null;
    return taken;
  }

  /** Tells the server that everything taken has been drawn. */
  acknowledge(): void {
    for (const frame of this.#unacknowledged) this.#socket?.send(JSON.stringify({ op: "ack", frame }));
    this.#unacknowledged = [];
  }

  #connect(): void {
    this.events.state({ phase: "connecting", message: "Connecting …" });
    const socket = new WebSocket(socketUrl("view"), VIEW_PROTOCOL);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    this.#topology = this.#frame = null;
    this.#unacknowledged = [];
    socket.onopen = () => socket.send(JSON.stringify({ op: "hello", rate_hz: this.rateHz }));
    socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
      try {
        this.#receive(data);
      } catch (error) {
        this.events.problem(`View: ${(error as Error).message}`);
      }
    };
    // An error is always followed by a close, which says more.
    socket.onclose = (event) => void this.#closed(socket, event);
  }

  #receive(data: string | ArrayBuffer): void {
    if (typeof data === "string") {
      const message = parseMessage<ViewMessage>(data);
      if (message.op === "hello") {
        this.#backoffMs = BACKOFF_FIRST_MS;
        this.events.state({ phase: "connected", message: "Live" });
      }
      this.events.message(message);
      return;
    }
    const decoded = decodeView(data);
    if ("topology" in decoded) {
      this.#topology = decoded.topology;
      this.#frame = null; // of an older epoch; its acknowledgement is still owed
    } else {
      this.#frame = decoded.frame;
      this.#unacknowledged.push(decoded.frame.frame);
    }
  }

  async #closed(socket: WebSocket, event: CloseEvent): Promise<void> {
    if (socket !== this.#socket) return;
    this.#socket = null;
    if (event.code === PROTOCOL_MISMATCH) {
      this.events.state({ phase: "refused", message: event.reason || "The server speaks another version of the view protocol. Reload the page." });
      return;
    }
    const waitMs = this.#backoffMs * (0.8 + 0.4 * Math.random());
    this.#backoffMs = Math.min(BACKOFF_LAST_MS, this.#backoffMs * 1.7);
    this.#retry = setTimeout(() => this.#hurry(), waitMs);
    const again = `Trying again in ${Math.max(1, Math.round(waitMs / 1000))} s.`;
    this.events.state({ phase: "waiting", message: `${event.reason || "The connection is lost."} ${again}` });
    const reason = await whyUnreachable();
    if (reason && !this.#socket) this.events.state({ phase: "waiting", message: `${reason} ${again}` });
  }

  /** Connects now if a retry is waiting. */
  #hurry(): void {
    if (this.#retry === undefined) return;
    clearTimeout(this.#retry);
    this.#retry = undefined;
    this.#connect();
  }
}
