// What the user is told: short notices over the picture that go away, and a log in the panel that stays.

import type { Level } from "./protocol";

const SHOWN_MS = { info: 5000, warning: 8000, error: 12000 } as const;
const SHOWN_AT_MOST = 3;
const KEPT = 60;

export class Notices {
  #last = { text: "", atMs: 0, times: 1, entry: null as HTMLElement | null };

  constructor(private readonly toasts: HTMLElement, private readonly log: HTMLElement, private readonly count: HTMLElement) {}

  tell(level: Level, text: string): void {
    const now = performance.now();
    if (text === this.#last.text && now - this.#last.atMs < 10_000 && this.#last.entry) {
      // The same again: counted, not shown again.
      this.#last.atMs = now;
      this.#last.times += 1;
      this.#last.entry.dataset["times"] = `×${this.#last.times}`;
      return;
    }
    const entry = line("li", level, text);
    entry.prepend(Object.assign(document.createElement("time"), { textContent: new Date().toLocaleTimeString([], { hour12: false }) }));
    this.log.prepend(entry);
    while (this.log.childElementCount > KEPT) this.log.lastElementChild!.remove();
    this.count.textContent = String(this.log.childElementCount);
    this.#last = { text, atMs: now, times: 1, entry };

    const toast = line("div", level, text);
    toast.addEventListener("click", () => toast.remove());
    this.toasts.append(toast);
    while (this.toasts.childElementCount > SHOWN_AT_MOST) this.toasts.firstElementChild!.remove();
    setTimeout(() => toast.remove(), SHOWN_MS[level] ?? SHOWN_MS.info);
  }
}

function line(tag: "li" | "div", level: Level, text: string): HTMLElement {
  const element = document.createElement(tag);
  element.className = `notice ${level}`;
  element.append(Object.assign(document.createElement("span"), { textContent: text }));
  return element;
}
