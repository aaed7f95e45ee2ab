// The picture gets plainer on a slow machine, never by chance and never finer again.

import { expect, it } from "vitest";
import { QualityLadder } from "../src/quality";

function run(ladder: QualityLadder, everyMs: number, drawings: number, fromMs = 0): number {
  let changes = 0;
  for (let n = 1; n <= drawings; n++) if (ladder.drew(fromMs + n * everyMs, n > 1)) changes += 1;
  return changes;
}

it("fast drawings keep full quality", () => {
  const ladder = new QualityLadder(2, false);
  expect(run(ladder, 17, 500)).toBe(0);
  expect(ladder.now).toEqual({ pixelRatio: 2, shadows: true });
});

it("slow drawings step down to the last step and stay there", () => {
  const ladder = new QualityLadder(2, false);
  expect(run(ladder, 120, 100)).toBe(2);
  expect(ladder.now).toEqual({ pixelRatio: 0.5, shadows: false });
});

it("a cloth that sends few frames is not a slow machine", () => {
  const ladder = new QualityLadder(1, false);
  for (let n = 1; n < 100; n++) expect(ladder.drew(200 * n, false)).toBe(false);
});

it("a fixed quality stays", () => {
  const ladder = new QualityLadder(2, true);
  expect(run(ladder, 500, 50)).toBe(0);
});
