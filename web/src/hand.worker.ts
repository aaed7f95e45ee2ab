// The worker around the haptic socket: page messages in, page messages out. At most one force model per animation frame
// goes to the page. A page that has stopped altogether loses its grab, as the lease intends.

import { HandSocket } from "./hand_socket";
import type { HandState } from "./hand_socket";
import type { ForceModel, GrabAt, Level, Vec3 } from "./protocol";

export type ToWorker =
  | { op: "start"; url: string }
  | { op: "grab"; grab: number; at: GrabAt }
  | { op: "move"; position: Vec3 }
  | { op: "release"; letGo: boolean }
  | { op: "beat" };

export type FromWorker =
  | { op: "state"; grab: number; state: HandState }
  | { op: "granted"; grab: number; position: Vec3 }
  | { op: "model"; grab: number; model: ForceModel; roundTripMs: number | null }
  | { op: "told"; level: Level; text: string };

/** A page silent for so long has stopped; a slow picture is far faster. */
const PAGE_LEASE_MS = 5000;

let socket: HandSocket | null = null;
let grab = 0;
let roomForModel = true;
let pageLease: ReturnType<typeof setTimeout> | undefined;

self.onmessage = ({ data }: MessageEvent<ToWorker>) => {
  switch (data.op) {
    case "start":
      socket = new HandSocket(data.url, {
        state(state) {
          if (state === "free") clearTimeout(pageLease);
          post({ op: "state", grab, state });
        },
        granted: (position) => post({ op: "granted", grab, position }),
        model(model, roundTripMs) {
          if (!roomForModel) return;
          roomForModel = false;
          post({ op: "model", grab, model, roundTripMs });
        },
        told: (level, text) => post({ op: "told", level, text }),
      });
      break;
    case "grab":
      grab = data.grab;
      renew();
      socket?.grab(data.at);
      break;
    case "move":
      socket?.moveTo(data.position);
      break;
    case "release":
      clearTimeout(pageLease);
      socket?.release(data.letGo);
      break;
    case "beat":
      roomForModel = true;
      renew();
      break;
  }
};

function renew(): void {
  clearTimeout(pageLease);
  pageLease = setTimeout(() => {
    socket?.release(false);
    post({ op: "told", level: "warning", text: "The page stood still for too long; the particle stays where it is." });
  }, PAGE_LEASE_MS);
}

function post(message: FromWorker): void {
  self.postMessage(message);
}
