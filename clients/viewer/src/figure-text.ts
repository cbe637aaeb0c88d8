// Figures of an exercise as people read them.

import type { Figure } from "palpate/v1";
import { element } from "./page";
import { quantity } from "./plot";
import { excerpt } from "./text";

/** Units as measures have them at the ends of their names. */
const UNIT = /_(n_s|n_per_s|m_per_s|n_m|m2|pa|n|m|s|j|hz|percent)$/;
/** Units with prefixes; others are written as they are. */
const PREFIXED = ["N", "m", "s", "J", "Pa", "N·s", "N·m", "m/s", "N/s", "Hz"];

/** Returns the name of a measure without its unit: `peak_force_n` is "Peak force". */
export function measureTitle(measure: string): string {
  const words = excerpt(measure).replace(UNIT, "").replaceAll("_", " ");
  return words.charAt(0).toUpperCase() + words.slice(1);
}

/** Returns a value with its unit. Shares, of measures whose names end with `share`, are in percent. */
export function valueText(measure: string, value: number, unit: string): string {
  if (measure.endsWith("_share")) return `${Math.round(100 * value)} %`;
  if (unit === "m²") return `${(1e4 * value).toPrecision(3)} cm²`;
  if (PREFIXED.includes(unit)) return Math.abs(value) < 1e4 ? quantity(value, unit) : quantity(value / 1000, `k${unit}`);
  const rounded = Number.isInteger(value) ? String(value) : value.toPrecision(3);
  return unit === "" || unit === "1" ? rounded : `${rounded} ${excerpt(unit)}`;
}

/** Returns a row with the title and the value of a figure. */
export function figureRow({ measure, value, unit, tool }: Figure): [string, string] {
  return [measureTitle(measure) + (tool === undefined ? "" : `, tool ${tool}`), valueText(measure, value, unit)];
}

/** Returns rows of titles and values as the terms of a list. */
export function listed(rows: readonly (readonly [string, string])[]): HTMLElement[] {
  return rows.flatMap(([title, value]) => [element("dt", { textContent: title }), element("dd", { textContent: value })]);
}

/** Returns a time as minutes and seconds. */
export function timeText(timeS: number): string {
  const seconds = Math.floor(timeS);
  return `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}`;
}
