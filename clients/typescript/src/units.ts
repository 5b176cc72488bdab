/** Conversion of units at the edges: all values inside are in SI (metres, seconds, volts, amperes, radians …). */

import { InvalidValue } from "./errors.js";

interface Unit {
  readonly base: string;
  /** Of ten: kept apart from `factor`, as a division by a power of ten rounds less than a product with its inverse. */
  readonly power: number;
  readonly factor: number;
}

const PREFIXES: Readonly<Record<string, number>> = { "": 0, k: 3, M: 6, m: -3, u: -6, µ: -6, μ: -6, n: -9, p: -12, f: -15 };
const BASES = ["Hz", "rad", "m", "s", "V", "A", "N", "W", "K"];
const ANGSTROM: Unit = { base: "m", power: -10, factor: 1 };
const DEGREE: Unit = { base: "rad", power: 0, factor: Math.PI / 180 };
const NUMBER: Unit = { base: "", power: 0, factor: 1 };
const SPECIAL: ReadonlyMap<string, Unit> = new Map([
  ["", NUMBER], ["1", NUMBER], ["%", { base: "", power: -2, factor: 1 }], ["px", { base: "px", power: 0, factor: 1 }],
  ["Å", ANGSTROM], ["\u212b", ANGSTROM], ["angstrom", ANGSTROM],
  ["deg", DEGREE], ["°", DEGREE], ["degree", DEGREE], ["degrees", DEGREE],
  ["min", { base: "s", power: 0, factor: 60 }], ["h", { base: "s", power: 0, factor: 3600 }],
]);

/** The SI units of the base parameters, where they do not depend on the operating mode of the microscope. */
export const PARAMETER_UNITS: ReadonlyMap<string, string> = new Map([
  ["scan-top-left-x", "m"], ["scan-top-left-y", "m"], ["scan-size-x", "m"], ["scan-size-y", "m"], ["scan-angle", "rad"],
  ["scan-resolution-x", "px"], ["scan-resolution-y", "px"], ["zctrl-pgain", ""], ["zctrl-igain", ""],
  ["sample-slope-x", ""], ["sample-slope-y", ""], ["scan-speed", "m/s"], ["move-speed", "m/s"],
  ["probe-pos-x", "m"], ["probe-pos-y", "m"], ["tip-bias-voltage", "V"],
]);

/** Return `value` of the unit `from` in the unit `to`, such as `convert(2, "um/s", "m/s")`. Throws InvalidValue. */
export function convert(value: number, from: string, to: string): number {
  if (from === to) return value;
  const given = parse(from);
  const wanted = parse(to);
  if (given.base !== wanted.base) throw new InvalidValue(`${JSON.stringify(from)} can't be converted to ${JSON.stringify(to)}`);
  const power = given.power - wanted.power;
  const scaled = value * (given.factor / wanted.factor);
  return power < 0 ? scaled / 10 ** -power : scaled * 10 ** power;
}

function parse(unit: string): Unit {
  const [over = "", under, ...more] = unit.trim().split("/");
  if (under === undefined) return single(over);
  if (more.length) throw new InvalidValue(`the unit ${unit} is not known`);
  const [a, b] = [single(over), single(under)];
  return { base: `${a.base}/${b.base}`, power: a.power - b.power, factor: a.factor / b.factor };
}

function single(unit: string): Unit {
  const special = SPECIAL.get(unit);
  if (special) return special;
  for (const base of BASES) {
    const power = unit.endsWith(base) ? PREFIXES[unit.slice(0, unit.length - base.length)] : undefined;
    if (power !== undefined) return { base, power, factor: 1 };
  }
  throw new InvalidValue(`the unit ${unit} is not known`);
}
