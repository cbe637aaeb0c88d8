// The status line: the actual state of the connection and the server.

import { received } from "./server";

/** The figures, in display order. An absent one is unknown. */
export interface Figures {
  roundTripMs?: number;
  networkMs?: number;
  frameAgeMs?: number;
  framesTaken: number;
  framesDrawn: number;
  framesSkipped: bigint;
  /** What is reduced in the picture. */
  picture: string;
  overruns: bigint;
  dilation: number;
  awakePoints?: number;
  isAsleep: boolean;
  /** The larger relative error of displacement and force in the newest audit; absent before the first. */
  auditedError?: number;
  tolerance?: number;
}

export class Status {
  private readonly values = new Map<string, HTMLElement>();
  private before = { ms: performance.now(), bytes: 0, taken: 0, drawn: 0 };

  constructor(
    private readonly line: HTMLElement,
    private readonly list: HTMLElement,
  ) {}

  /** Screen readers announce it, so only changes are written. */
  say(text: string): void {
    if (this.line.textContent !== text) this.line.textContent = text;
  }

  /** Updates the figures. Call about once a second. */
  show(figures: Figures): void {
    const ms = performance.now();
    const seconds = (ms - this.before.ms) / 1000;
    const bytes = (received.bytes - this.before.bytes) / seconds;
    const taken = (figures.framesTaken - this.before.taken) / seconds;
    const drawn = (figures.framesDrawn - this.before.drawn) / seconds;
    this.before = { ms, bytes: received.bytes, taken: figures.framesTaken, drawn: figures.framesDrawn };
    const inMs = (value: number | undefined) => (value === undefined ? "–" : `${value.toFixed(1)} ms`);
    this.set("round trip", inMs(figures.roundTripMs));
    this.set("commands, network only", inMs(figures.networkMs));
    this.set("frame age", figures.isAsleep ? "still" : inMs(figures.frameAgeMs));
    this.set("frames", `${taken.toFixed(0)}/s, drawn ${drawn.toFixed(0)}/s, skipped ${figures.framesSkipped}`);
    this.set("picture", figures.picture);
    this.set("received", bytes >= 1e6 ? `${(bytes / 1e6).toFixed(2)} MB/s` : `${(bytes / 1e3).toFixed(1)} kB/s`);
    this.set("overruns", String(figures.overruns));
    this.set("time", `${figures.dilation.toFixed(2)} × real`);
    this.set("tissue", figures.isAsleep ? "asleep" : `${figures.awakePoints ?? "–"} points awake`);
    if (figures.auditedError !== undefined) {
      const asked = figures.tolerance === undefined ? "" : ` (tolerance ${figures.tolerance.toExponential(0)})`;
      this.set("error", `${figures.auditedError.toExponential(0)}${asked}`);
    }
  }

  private set(name: string, text: string): void {
    let value = this.values.get(name);
    if (!value) {
      const row = document.createElement("div");
      const term = document.createElement("dt");
      value = document.createElement("dd");
      term.textContent = name;
      row.append(term, value);
      this.list.append(row);
      this.values.set(name, value);
    }
    if (value.textContent !== text) value.textContent = text;
  }
}
