// The panel beside the picture (a sheet at the bottom of a phone): names, numbers, switches. It shows what it is given.

import type { ConnectionState } from "./connection";
import { count, hertz, meters, milliseconds, newtons, scientific } from "./format";
import type { HandState } from "./hand_socket";
import { SERIES } from "./plots";
import type { PlotName } from "./plots";
import type { ForceModel, Frame, ViewHello } from "./protocol";

export function element<E extends HTMLElement = HTMLElement>(id: string): E {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no element #${id}`);
  return found as E;
}

const KINDS: Record<string, string> = {
  measured: "measured",
  digitised: "digitised",
  from_parameters: "from parameters",
};

/** Text that is set only when it changes, so that the browser has nothing to do. */
class Text {
  #shown = "";
  #element: HTMLElement;
  constructor(id: string) {
    this.#element = element(id);
  }
  set(text: string): void {
    if (text === this.#shown) return;
    this.#shown = text;
    this.#element.textContent = text;
  }
}

export class Panel {
  #texts = new Map<string, Text>();
  #sheet = element("panel");
  #letGo = element<HTMLInputElement>("let-go");

  constructor(on: { resized(): void; reset(): void; mesh(on: boolean): void }) {
    const toggle = element<HTMLButtonElement>("sheet-toggle");
    const open = (yes: boolean) => {
      this.#sheet.classList.toggle("open", yes);
      toggle.setAttribute("aria-expanded", String(yes));
      toggle.setAttribute("aria-label", yes ? "Hide details" : "Show details");
    };
    toggle.addEventListener("click", () => open(!this.#sheet.classList.contains("open")));
    swipe(element("sheet-head"), open);
    element("reset").addEventListener("click", () => on.reset());
    const mesh = element<HTMLButtonElement>("mesh");
    mesh.addEventListener("click", () => {
      const pressed = mesh.getAttribute("aria-pressed") !== "true";
      mesh.setAttribute("aria-pressed", String(pressed));
      on.mesh(pressed);
    });
    new ResizeObserver(() => on.resized()).observe(this.#sheet);
    for (const name of Object.keys(SERIES) as PlotName[]) legend(name);
  }

  /** Whether a release lets the particle fall. */
  get letGo(): boolean {
    return this.#letGo.checked;
  }

  connection({ phase, message }: ConnectionState): void {
    document.documentElement.dataset["state"] = phase;
    this.#set("connection", phase === "connected" ? "Live" : phase === "connecting" ? "Connecting" : "Offline");
    this.#set("outage-text", message);
    element("outage").hidden = phase === "connected" || phase === "connecting";
  }

  hello(hello: ViewHello): void {
    this.#set("fabric", hello.fabric.name);
    this.#set("fabric-kind", KINDS[hello.fabric.kind] ?? hello.fabric.kind);
    element("fabric-kind").dataset["kind"] = hello.fabric.kind;
    this.#set("scene", hello.scene.name);
    this.#set("session", hello.session);
    this.#set("lattice", hello.scene.particles.join(" × "));
    this.#set("size", `${hello.scene.size_m.map((m) => String(Number((100 * m).toPrecision(4)))).join(" × ")} cm`);
    this.#set("server", hello.server);
    document.title = `${hello.fabric.name} · ${hello.scene.name} · kesi`;
  }

  frame(frame: Frame): void {
    const [x, y, z] = frame.handForce;
    const force = Math.hypot(x, y, z);
    this.#set("force", frame.handPresent ? force.toFixed(force < 10 ? 3 : 2) : "–");
    this.#set("force-x", signed(x));
    this.#set("force-y", signed(y));
    this.#set("force-z", signed(z));
    this.#set("force-error", frame.handPresent ? `± ${scientific(frame.forceErrorBound)} N` : "no hand");
    this.#set("active", count(frame.particlesActive));
    this.#set("tick", frame.resting ? "–" : hertz(frame.tickHz)); // at rest there are no ticks
    this.#set("residual", `${scientific(frame.residual)} N`);
    this.#set("penetration", meters(Math.max(0, frame.maxPenetration)));
    this.#set("solve-value", frame.resting ? "–" : milliseconds(frame.solveMs));
    this.#set("force-value", newtons(force));
    const { newton, stretch, bend, shear } = frame.cost;
    this.#set("cost-value", scientific(newton + stretch + bend + shear));
    this.#set("motion", frame.resting ? "At rest" : frame.converged ? "Moving" : "Converging");
    document.documentElement.dataset["resting"] = String(frame.resting);
  }

  hand(state: HandState, heldByAnother: boolean): void {
    document.documentElement.dataset["grab"] = state;
    this.#set("holder", state === "held" ? "yours" : state === "asking" ? "asking …" : heldByAnother ? "another client" : "the scene");
  }

  /** Stiffness under the user's own hand, and the time from a pose to the force it made. */
  feel(model: ForceModel | null, roundTripMs: number | null): void {
    this.#set("stiffness", model ? `${((model.k[0] + model.k[3] + model.k[5]) / 3).toFixed(1)} N/m` : "–");
    this.#set("round-trip", roundTripMs === null ? "–" : milliseconds(roundTripMs));
  }

  gamepads(names: readonly string[]): void {
    this.#set("gamepad", names.join(", ") || "none");
  }

  #set(id: string, text: string): void {
    let shown = this.#texts.get(id);
    if (!shown) this.#texts.set(id, (shown = new Text(id)));
    shown.set(text);
  }
}

const signed = (force: number): string => (Number.isFinite(force) ? `${force < 0 ? "−" : "+"}${Math.abs(force).toFixed(3)}` : "–");

function legend(name: PlotName): void {
  const host = element(`${name}-legend`);
  for (const [label, color] of SERIES[name]) {
    const item = document.createElement("span");
    item.textContent = label;
    item.style.setProperty("--key", color);
    host.append(item);
  }
}

/** Swiping the sheet's head up or down opens or closes it. */
function swipe(head: HTMLElement, open: (yes: boolean) => void): void {
  let from: number | null = null;
  head.addEventListener("pointerdown", (event) => (from = event.clientY));
  addEventListener("pointerup", (event) => {
    if (from !== null && Math.abs(event.clientY - from) > 24) open(event.clientY < from);
    from = null;
  });
}
