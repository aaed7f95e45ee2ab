// The running plots: force on the hand, cost by term, tick time, over the last ten seconds.

import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { powerOfTen } from "./format";
import type { Frame } from "./protocol";

const WINDOW_S = 10;
/** Plots are redrawn so often; the eye reads them slower than it sees the cloth. */
const DRAW_EVERY_MS = 66;
/** The log scale shows so many decades below the largest cost at the most. */
const DECADES = 8;

export const SERIES = {
  force: [["|F|", "#ff8577"], ["x", "#5fb3d9"], ["y", "#8fd694"], ["z", "#b9a3ff"]],
  cost: [["newton", "#ffc066"], ["stretch", "#ff8577"], ["bend", "#5fb3d9"], ["shear", "#8fd694"]],
  solve: [["solve", "#8fb4ff"]],
} as const satisfies Record<string, readonly (readonly [string, string])[]>;

export type PlotName = keyof typeof SERIES;

export class Plots {
  #times: number[] = [];
  #values: Record<PlotName, (number | null)[][]> = { force: [[], [], [], []], cost: [[], [], [], []], solve: [[]] };
  #plots: Record<PlotName, uPlot>;
  #resting = false;
  #changedS = 0;
  #drawnMs = 0;

  constructor(hosts: Record<PlotName, HTMLElement>) {
    this.#plots = {
      force: plot(hosts.force, "force", false),
      cost: plot(hosts.cost, "cost", true),
      solve: plot(hosts.solve, "solve", false),
    };
  }

  add(frame: Frame): void {
    const now = performance.now() / 1000;
    const { newton, stretch, bend, shear } = frame.cost;
    const [x, y, z] = frame.handForce;
    const row: Record<PlotName, (number | null)[]> = {
      force: [Math.hypot(x, y, z), x, y, z],
      cost: [newton, stretch, bend, shear].map((cost) => (cost > 0 ? cost : null)), // zero has no logarithm
      solve: [frame.solveMs],
    };
    this.#times.push(now);
    for (const name of names) row[name].forEach((value, n) => this.#values[name][n]!.push(value));
    this.#resting = frame.resting;
    this.#changedS = now;
    const old = this.#times.findIndex((t) => t > now - WINDOW_S - 1);
    if (old > 60) {
      this.#times.splice(0, old);
      for (const name of names) for (const series of this.#values[name]) series.splice(0, old);
    }
  }

  /** Draws when it is time; a session at rest sends nothing: its last values go on as they are, but it has no ticks. */
  draw(nowMs: number): void {
    const now = nowMs / 1000;
    if (nowMs - this.#drawnMs < DRAW_EVERY_MS || this.#times.length === 0 || now - this.#changedS > WINDOW_S + 1) return;
    this.#drawnMs = nowMs;
    const ages = this.#times.map((t) => t - now);
    if (this.#resting) ages.push(0);
    for (const name of names) {
      const last = (values: (number | null)[]): number | null => (name === "solve" ? null : (values[values.length - 1] ?? null));
      const series = this.#values[name].map((values) => (this.#resting ? [...values, last(values)] : values));
      this.#plots[name].setData([ages, ...series], true);
    }
  }
}

const names = Object.keys(SERIES) as PlotName[];

function plot(host: HTMLElement, name: PlotName, log: boolean): uPlot {
  const axis = {
    stroke: "#8792a8",
    font: "11px system-ui, sans-serif",
    grid: { stroke: "rgba(140,160,200,0.10)", width: 1 },
    ticks: { show: false },
  } satisfies uPlot.Axis;
  const size = () => ({ width: Math.max(120, host.clientWidth), height: Math.max(60, host.clientHeight) });
  const chart = new uPlot(
    {
      ...size(),
      cursor: { show: false },
      legend: { show: false },
      padding: [6, 14, 0, 0],
      scales: {
        x: { time: false, range: [-WINDOW_S, 0] },
        y: log ? { distr: 3, range: decades } : { range: margin },
      },
      axes: [
        { ...axis, size: 22, gap: 4, splits: [-10, -8, -6, -4, -2, 0], values: (_, at) => at.map((s) => (s === 0 ? "now" : `−${-s} s`)) },
        { ...axis, size: 46, gap: 4, values: (_, at) => at.map((v) => tick(v, log)), ...(log ? { splits: decadeSplits, filter: (_: uPlot, at: number[]) => at } : { space: 26 }) },
      ],
      series: [{}, ...SERIES[name].map(([label, stroke], n) => ({ label, stroke, width: n === 0 ? 1.8 : 1.1, points: { show: false } }))],
    },
    [[], ...SERIES[name].map(() => [])],
    host,
  );
  new ResizeObserver(() => chart.setSize(size())).observe(host);
  return chart;
}

function tick(value: number, log: boolean): string {
  if (log) return powerOfTen(Math.round(Math.log10(value)));
  return Math.abs(value) < 1e-12 ? "0" : String(Number(value.toPrecision(3))).replace("-", "−");
}

/** Linear range with air above and below, zero always in it. */
function margin(_: uPlot, min: number | null, max: number | null): [number, number] {
  const low = Math.min(0, min ?? 0);
  const high = Math.max(0, max ?? 1);
  const air = 0.08 * (high - low || 1);
  return [low < 0 ? low - air : 0, high + air];
}

/** Whole decades, at least three of them. */
function decades(_: uPlot, min: number | null, max: number | null): [number, number] {
  const high = Math.ceil(Math.log10(max ?? 1) + 1e-9);
  const low = Math.max(high - DECADES, Math.min(high - 3, Math.floor(Math.log10(min ?? 1e-3))));
  return [10 ** low, 10 ** high];
}

function decadeSplits(_: uPlot, __: number, min: number, max: number): number[] {
  const low = Math.round(Math.log10(min));
  const high = Math.round(Math.log10(max));
  const step = Math.max(1, Math.ceil((high - low) / 4));
  return Array.from({ length: Math.floor((high - low) / step) + 1 }, (_unused, n) => 10 ** (low + n * step));
}
