// Numbers as people read them: units chosen by size, digits that do not jump about. "–" stands for what is not a number.

function scaled(value: number, steps: readonly (readonly [number, string])[], digits: number): string {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return `0 ${steps[0]![1]}`;
  const [factor, unit] = steps.find(([f]) => Math.abs(value) >= f) ?? steps[steps.length - 1]!;
  return `${significant(value / factor, digits)} ${unit}`;
}

/** Fixed significant digits without exponents; meant for 0.001 … 9999. */
export function significant(value: number, digits: number): string {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const whole = Math.floor(Math.log10(Math.abs(value))) + 1;
  return value.toFixed(Math.min(6, Math.max(0, digits - whole)));
}

/** Always newtons, so that the number can be watched while it changes. */
export const newtons = (force: number): string => (Number.isFinite(force) ? `${force.toFixed(Math.abs(force) < 10 ? 3 : 2)} N` : "–");
export const meters = (length: number): string => scaled(length, [[1, "m"], [1e-3, "mm"], [1e-6, "µm"]], 3);
export const milliseconds = (ms: number): string => (Number.isFinite(ms) ? `${significant(ms, ms < 1 ? 2 : 3)} ms` : "–");
export const hertz = (hz: number): string => (Number.isFinite(hz) ? `${Math.round(hz)} Hz` : "–");

/** A power of ten with a typographic exponent: 3.1·10⁻⁸. */
export function scientific(value: number): string {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const [mantissa, exponent] = value.toExponential(1).split("e");
  return `${mantissa}·${powerOfTen(Number(exponent))}`;
}

export function powerOfTen(exponent: number): string {
  return `10${String(exponent).replace(/./g, (c) => (c === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[Number(c)]!))}`;
}

const COUNT = new Intl.NumberFormat("en", { useGrouping: true });
export const count = (n: number): string => (Number.isFinite(n) ? COUNT.format(n) : "–");
