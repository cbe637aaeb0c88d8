// Two small plots of the last seconds: one line per quantity, an axis, and the largest value.

import { HISTORY_S, type Moment, norm } from "./samples";

interface Line {
  name: string;
  /** A CSS variable. */
  colour: string;
  of: (moment: Moment) => number;
}

/** The SI prefix for a magnitude: its factor and letters. */
function prefixed(most: number): [number, string] {
  if (most >= 1) return [1, ""];
  if (most >= 1e-3) return [1e3, "m"];
  return [1e6, "µ"];
}

/** A number with its unit, for display. */
export function quantity(value: number, unit: string): string {
  const [factor, prefix] = prefixed(Math.abs(value));
  return `${(value * factor).toPrecision(3)} ${prefix}${unit}`;
}

class Plot {
  private readonly pen: CanvasRenderingContext2D | null;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly title: string,
    private readonly unit: string,
    private readonly lines: Line[],
  ) {
    this.pen = canvas.getContext("2d");
  }

  draw(history: Moment[], nowS: number): void {
    const { pen, canvas } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!pen || width === 0) return;
    const ratio = Math.min(devicePixelRatio, 2);
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const style = getComputedStyle(canvas);
    const [top, bottom] = [20, height - 4];
    let [low, high] = [0, 0];
    for (const moment of history) {
      for (const { of } of this.lines) {
        low = Math.min(low, of(moment));
        high = Math.max(high, of(moment));
      }
    }
    const span = high - low || 1e-6;
    const y = (v: number) => bottom - ((v - low) / span) * (bottom - top);
    const x = (t: number) => width * (1 - (nowS - t) / HISTORY_S);
    pen.strokeStyle = style.getPropertyValue("--line");
    pen.lineWidth = 1;
    pen.beginPath();
    for (let s = Math.ceil(nowS - HISTORY_S); s <= nowS; s++) {
      pen.moveTo(x(s), top);
      pen.lineTo(x(s), bottom);
    }
    pen.moveTo(0, y(0));
    pen.lineTo(width, y(0));
    pen.stroke();
    pen.font = "11px system-ui, sans-serif";
    pen.fillStyle = style.getPropertyValue("--faint");
    pen.textAlign = "right";
    if (high - low > 0) pen.fillText(`${quantity(low, this.unit)} … ${quantity(high, this.unit)}`, width, 11);
    pen.textAlign = "left";
    pen.fillText(this.title, 0, 11);
    let at = pen.measureText(this.title).width + 8;
    for (const { name, colour, of } of this.lines) {
      pen.strokeStyle = pen.fillStyle = style.getPropertyValue(colour);
      pen.fillText(name, at, 11);
      at += pen.measureText(name).width + 8;
      pen.lineWidth = 1.5;
      pen.beginPath();
      let before = -Infinity;
      for (const moment of history) {
        // A gap without samples gets no line.
        if (moment.timeS - before > 0.5) pen.moveTo(x(moment.timeS), y(of(moment)));
        else pen.lineTo(x(moment.timeS), y(of(moment)));
        before = moment.timeS;
      }
      pen.stroke();
    }
  }
}

export class Plots {
  private readonly plots: Plot[];

  constructor(displacement: HTMLCanvasElement, force: HTMLCanvasElement) {
    const up = (name: string, of: (moment: Moment) => number): Line => ({ name, colour: "--accent", of });
    const size = (name: string, of: (moment: Moment) => number): Line => ({ name, colour: "--second", of });
    this.plots = [
      new Plot(displacement, "Displacement", "m", [
        size("length", (moment) => norm(moment.displacementM)),
        up("up", (moment) => moment.displacementM[2]),
      ]),
      new Plot(force, "Reaction", "N", [
        size("length", (moment) => norm(moment.forceN)),
        up("up", (moment) => moment.forceN[2]),
      ]),
    ];
  }

  draw(history: Moment[], nowS: number): void {
    for (const plot of this.plots) plot.draw(history, nowS);
  }
}
