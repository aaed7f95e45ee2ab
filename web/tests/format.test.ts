// Numbers as the panel shows them.

import { expect, it } from "vitest";
import { meters, newtons, powerOfTen, scientific, significant } from "../src/format";

it("forces are always in newtons, with digits that stand still", () => {
  expect(newtons(0.15312)).toBe("0.153 N");
  expect(newtons(12.3456)).toBe("12.35 N");
  expect(newtons(Number.NaN)).toBe("–");
});

it("lengths choose their unit", () => {
  expect(meters(0)).toBe("0 m");
  expect(meters(1.5)).toBe("1.50 m");
  expect(meters(0.00012)).toBe("120 µm");
  expect(meters(0.0034)).toBe("3.40 mm");
});

it("powers of ten are written as people write them", () => {
  expect(scientific(3.14e-8)).toBe("3.1·10⁻⁸");
  expect(powerOfTen(-12)).toBe("10⁻¹²");
  expect(scientific(0)).toBe("0");
  expect(significant(0.98765, 2)).toBe("0.99");
});
