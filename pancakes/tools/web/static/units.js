// Rounds numbers for people, and writes the units that the names of quantities end with.

const UNITS = {
  per_m: "1/m", per_s: "1/s", j_per_m: "J/m", radps: "rad/s", mps: "m/s", mib: "MiB", rad: "rad", deg: "°", mah: "mAh",
  hz: "Hz", ms: "ms", mm: "mm", percent: "%", m: "m", s: "s", v: "V", w: "W", j: "J",
};
// Longer endings come first, so that `speed_mps` is not taken for one in seconds.
const ENDINGS = Object.keys(UNITS).sort((a, b) => b.length - a.length);
const DIGITS = 4;
const NUMBER = "-?\\d+(?:\\.\\d+)?(?:e[-+]?\\d+)?";
const MEASURED = new RegExp(`\\b([A-Za-z]\\w*?)_(${ENDINGS.join("|")}) (${NUMBER})(?![\\w.])`, "g");
const LONG_NUMBER = new RegExp(`(?<![\\w.])-?\\d+\\.\\d{${DIGITS - 1},}(?:e[-+]?\\d+)?(?![\\w.])`, "g");

/** Returns a number with at most four digits that count. */
export function rounded(value, digits = DIGITS) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (Number.isInteger(value) && Math.abs(value) < 1e6) return String(value);
  const short = Number(value.toPrecision(digits));
  return Math.abs(short) >= 1e6 || (short !== 0 && Math.abs(short) < 1e-4) ? short.toExponential() : String(short);
}

/** Returns a quantity's name without its unit, and the unit; `voltage_v` is a voltage in V. */
export function quantity(name) {
  for (const ending of ENDINGS) {
    if (name.endsWith(`_${ending}`)) return [words(name.slice(0, -ending.length - 1)), UNITS[ending]];
  }
  return [words(name), ""];
}

function words(name) {
  return name.replaceAll("_", " ");
}

/** Returns a number with its unit. */
export function measured(value, unit) {
  const text = rounded(value);
  return unit && text !== "–" ? `${text} ${unit}` : text;
}

/** Rounds the numbers in a text, and puts units behind them: `radius_m 0.60512` becomes `radius 0.6051 m`. */
export function tidy(text) {
  const short = text.replace(LONG_NUMBER, (number) => rounded(Number(number)));
  return short.replace(MEASURED, (_, name, ending, number) => `${words(name)} ${number} ${UNITS[ending]}`);
}
