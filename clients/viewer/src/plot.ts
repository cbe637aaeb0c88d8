// Two small plots of the last seconds: one line for each quantity, axes with ticks and values, and the present
// values; and what other plots of the page are drawn with.

import { HISTORY_S, type Moment } from "./samples";

interface Line {
  name: string;
  /** A CSS variable. */
  colour: string;
  of: (moment: Moment) => number;
}

/** Returns the SI prefix for a magnitude: its factor and letters. */
export function prefixed(most: number): [number, string] {
  if (most >= 1) return [1, ""];
  if (most >= 1e-3 || most < 1e-9) return [1e3, "m"];
  return [1e6, "µ"];
}

/** Formats a number with its unit. */
export function quantity(value: number, unit: string): string {
  const [factor, prefix] = prefixed(Math.abs(value));
  return `${value === 0 ? "0" : (value * factor).toPrecision(3)} ${prefix}${unit}`;
}

/** Returns the distance of ticks, 1, 2 or 5 times a power of ten, so that at most four fit in a span. */
export function tickDistance(span: number): number {
  const least = span / 4;
  const power = 10 ** Math.floor(Math.log10(least));
  return power * ([1, 2, 5].find((times) => times * power >= least) ?? 10);
}

/** Space for the axis values, pixels. */
export const LEFT = 38;
export const TOP = 19;
export const BOTTOM = 15;
/** Time between two ticks, s. */
const TICK_S = 2;

/** An empty canvas: its pen, in pixels of the page, its size, and the page's colours. */
export interface Sketch {
  pen: CanvasRenderingContext2D;
  width: number;
  height: number;
  /** Returns the value of a CSS variable. */
  colour: (variable: string) => string;
}

/** Clears a canvas, as fine as the screen; undefined if it is not shown. */
export function sketch(canvas: HTMLCanvasElement): Sketch | undefined {
  const pen = canvas.getContext("2d");
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (!pen || width === 0) return undefined;
  const ratio = Math.min(devicePixelRatio, 2);
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "11px system-ui, sans-serif";
  const style = getComputedStyle(canvas);
  return { pen, width, height, colour: (variable) => style.getPropertyValue(variable) };
}

/** Returns a number in a unit with a prefix, as it stands at a tick. */
export function tickText(value: number, factor: number): string {
  return String(Number((value * factor).toPrecision(3))).replace("-", "−");
}

/** Draws the lines and the values of a vertical axis. Returns the height of a value, and the axis' tick and factor. */
export function drawLevels({ pen, width, height, colour }: Sketch, low: number, high: number, unit: string) {
  const bottom = height - BOTTOM;
  const tick = tickDistance(high - low);
  const [first, last] = [Math.ceil(low / tick - 1e-6), Math.ceil(high / tick - 1e-6)];
  const y = (v: number) => bottom - ((v - low) / (last * tick - low)) * (bottom - TOP);
  const [factor, prefix] = prefixed(Math.max(-low, last * tick));
  pen.lineWidth = 1;
  pen.fillStyle = colour("--faint");
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  for (let k = first; k <= last; k++) {
    const at = Math.round(y(k * tick)) + 0.5;
    pen.strokeStyle = colour(k === 0 ? "--faint" : "--line");
    pen.beginPath();
    pen.moveTo(LEFT, at);
    pen.lineTo(width, at);
    pen.stroke();
    if (k % 2 !== 0 && ((bottom - TOP) * tick) / (last * tick - low) < 13) continue;
    pen.fillText(tickText(k * tick, factor), LEFT - 5, at);
  }
  pen.textBaseline = "alphabetic";
  pen.textAlign = "left";
  pen.fillText(`${prefix}${unit}`, 0, 11);
  return { y, tick, factor };
}

class Plot {
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly unit: string,
    private readonly lines: Line[],
  ) {}

  /** `least` is the smallest span that is shown: smaller changes are noise. */
  draw(history: Moment[], nowS: number, least: number): void {
    const drawn = sketch(this.canvas);
    if (!drawn) return;
    const { pen, width, height, colour } = drawn;
    const bottom = height - BOTTOM;
    let [low, high] = [0, least];
    for (const moment of history) {
      for (const { of } of this.lines) {
        low = Math.min(low, of(moment));
        high = Math.max(high, of(moment));
      }
    }
    const { y, tick, factor } = drawLevels(drawn, low, high, this.unit);
    const x = (t: number) => LEFT + (width - LEFT - 1) * (1 - (nowS - t) / HISTORY_S);
    pen.strokeStyle = colour("--faint");
    for (let s = 0; s <= HISTORY_S; s += TICK_S) {
      const at = Math.round(x(nowS - s)) - 0.5;
      pen.beginPath();
      pen.moveTo(at, bottom);
      pen.lineTo(at, bottom + 3);
      pen.stroke();
      pen.textAlign = s === 0 ? "right" : s === HISTORY_S ? "left" : "center";
      pen.fillText(s === 0 ? "now" : `−${s} s`, at + (s === 0 ? 1 : 0), height - 2);
    }
    pen.textAlign = "left";
    let at = LEFT;
    const now = history.at(-1);
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, 0, width - LEFT, height);
    pen.clip();
    for (const { name, colour: variable, of } of this.lines) {
      pen.strokeStyle = pen.fillStyle = colour(variable);
      const value = now && nowS - now.timeS < 0.5 ? of(now) : 0;
      const digits = Math.max(0, Math.ceil(-Math.log10(tick * factor)) + 1);
      const text = `${name} ${(value * factor).toFixed(digits).replace(/^-(?=[0.]*$)/, "").replace("-", "−")}`;
      pen.fillText(text, at, 11);
      at += pen.measureText(text).width + 14;
      pen.lineWidth = 1.75;
      pen.lineJoin = "round";
      pen.beginPath();
      let before: Moment | undefined;
      for (const moment of history) {
        // A gap without samples, or a change to another tool, gets no line.
        if (moment.tool !== before?.tool || moment.timeS - before.timeS > 0.5) pen.moveTo(x(moment.timeS), y(of(moment)));
        else pen.lineTo(x(moment.timeS), y(of(moment)));
        before = moment;
      }
      pen.stroke();
    }
    pen.restore();
  }
}

export class Plots {
  private readonly depth: Plot;
  private readonly force: Plot;

  constructor(displacement: HTMLCanvasElement, force: HTMLCanvasElement) {
    this.depth = new Plot(displacement, "m", [
      { name: "deep", colour: "--depth", of: ({ deepM }) => deepM },
      { name: "sideways", colour: "--faint", of: ({ asideM }) => asideM },
    ]);
    this.force = new Plot(force, "N", [
      { name: "pushes back", colour: "--force", of: ({ outN }) => outN },
      { name: "sideways", colour: "--faint", of: ({ acrossN }) => acrossN },
    ]);
  }

  /** `leastM` and `leastN` are the smallest spans of the axes. */
  draw(history: Moment[], nowS: number, leastM: number, leastN: number): void {
    this.depth.draw(history, nowS, leastM);
    this.force.draw(history, nowS, leastN);
  }
}
