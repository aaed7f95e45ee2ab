// Joins the parts: sockets to picture, plots and panel, once per animation frame.

import { ViewConnection } from "./connection";
import { Drag } from "./drag";
import { Hand } from "./hand";
import { Notices } from "./notices";
import { element, Panel } from "./panel";
import { Plots } from "./plots";
import type { ForceModel, Frame, ViewHello } from "./protocol";
import { recordingLink } from "./recording";
import { Rumble } from "./rumble";
import { Scene3d } from "./scene3d";
import "./style.css";

/** Frames asked for; the server has its own limit. */
const RATE_HZ = 60;

const page = document.documentElement.dataset; // also what the browser test reads
const stage = element("stage");
const canvas = element<HTMLCanvasElement>("canvas");
const notices = new Notices(element("toasts"), element("log"), element("log-count"));
const plots = new Plots({ force: element("force-plot"), cost: element("cost-plot"), solve: element("solve-plot") });
const rumble = new Rumble();

let hello: ViewHello | null = null;
let last: Frame | null = null;
let model: ForceModel | null = null;
let roundTripMs: number | null = null;
let drawn = 0;

const scene = openScene();
const panel = new Panel({
  resized: () => scene.setInsets(insets()),
  reset: () => scene.resetView(),
  mesh: (on) => (scene.showMesh = on),
});

const hand = new Hand({
  state(state) {
    panel.hand(state, last?.handHeld ?? false);
    if (state === "free") {
      model = roundTripMs = null;
      panel.feel(null, null);
      rumble.feel(null);
      drag.ended();
    }
  },
  granted: (position) => drag.granted(position),
  model: (newest, age) => ([model, roundTripMs] = [newest, age]),
  told: (level, text) => notices.tell(level, text),
});

const drag = new Drag(stage, canvas, {
  scene,
  hand,
  handParticle: () => (last?.handPresent && last.handParticle !== null ? place(last.handParticle) : null),
  letGo: () => panel.letGo,
});

const connection = new ViewConnection(
  {
    state: (state) => panel.connection(state),
    message(message) {
      switch (message.op) {
        case "hello":
          hello = message;
          panel.hello(message);
          scene.setScene(message);
          break;
        case "status":
          notices.tell(message.level, message.message);
          break;
        case "error":
          notices.tell("error", message.message);
          break;
      }
    },
    problem: (text) => notices.tell("error", text),
  },
  RATE_HZ,
);

addEventListener("keydown", (event) => {
  const typing = event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey;
  if (typing) return;
  if (event.key === "r" || event.key === "R") scene.resetView();
  if (event.key === "m" || event.key === "M") element("mesh").click();
});
for (const event of ["gamepadconnected", "gamepaddisconnected"]) addEventListener(event, () => panel.gamepads(Rumble.names()));
panel.gamepads(Rumble.names());
panel.hand("free", false);
recordingLink(element<HTMLAnchorElement>("recording"), (text) => notices.tell("warning", text));
requestAnimationFrame(animate);

function animate(nowMs: number): void {
  requestAnimationFrame(animate);
  const { topology, frame } = connection.take();
  if (topology) scene.setTopology(topology);
  if (frame && scene.setFrame(frame)) show(frame);
  hand.beat();
  drag.hover();
  scene.lead(hand.state === "held" ? hand.target : null);
  if (scene.draw(nowMs, hand.state === "held")) {
    const at = scene.screen(scene.handle.position);
    page["handPx"] = `${at.x.toFixed(1)} ${at.y.toFixed(1)}`;
  }
  if (frame) connection.acknowledge();
  plots.draw(nowMs);
}

function show(frame: Frame): void {
  last = frame;
  drawn += 1;
  plots.add(frame);
  panel.frame(frame);
  panel.hand(hand.state, frame.handHeld);
  panel.feel(model, roundTripMs);
  const force = Math.hypot(...frame.handForce);
  rumble.feel(hand.state === "held" ? force : null);
  page["frames"] = String(drawn);
  page["forceN"] = String(force);
  page["handM"] = frame.handPosition.join(" ");
}

/** Place on the lattice of a lattice index. */
function place(index: number): readonly [number, number] {
  const columns = hello?.scene.particles[1] ?? 1;
  return [Math.floor(index / columns), index % columns];
}

/** What the panel covers: the right side of a laptop, the bottom of a phone. */
function insets(): { right: number; bottom: number } {
  const box = element("panel").getBoundingClientRect();
  const phone = box.width > 0.8 * innerWidth;
  return phone ? { right: 0, bottom: innerHeight - box.top } : { right: innerWidth - box.left, bottom: 0 };
}

function openScene(): Scene3d {
  try {
    return new Scene3d(canvas, element("force-label"));
  } catch (error) {
    element("no-webgl").hidden = false;
    throw error;
  }
}
