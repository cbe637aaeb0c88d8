// The status line: a light (good, slow, lost), a message about the session, and on demand the figures behind it.

import { received } from "./server";
import { excerpt } from "./text";

/** The figures, in display order. A missing figure is unknown. */
export interface Figures {
  roundTripMs?: number;
  networkMs?: number;
  /** Transport of touches between page and server. */
  way: string;
  frameAgeMs?: number;
  /** Whether nothing moves, so that no frame is due. */
  isStill: boolean;
  /** Time since the server last answered. */
  silentMs: number;
  framesTaken: number;
  framesDrawn: number;
  framesSkipped: bigint;
  /** What is reduced in the picture. */
  picture: string;
  /** Playback speed of a recording; 1 otherwise. */
  speed: number;
  overruns: bigint;
  dilation: number;
  awakePoints?: number;
  isAsleep: boolean;
  /** The larger of the relative errors of displacement and force in the newest audit; missing before the first. */
  auditedError?: number;
  tolerance?: number;
  /** How much stiffer than infinitely small ones the cells of a solid are under a finger; missing if unknown. */
  cellsError?: number;
  /** What blades have cut; missing while it is whole. */
  cut?: string;
}

/** Limits beyond which the light is slow or lost. */
const SLOW = { roundTripMs: 300, dilation: 0.8, frameAgeMs: 600, drawn: 6, taken: 12 };
const LOST_MS = 4000;

type Light = "wait" | "good" | "slow" | "lost" | "ended" | "barred";
const WORDS: Record<Light, string> = {
  wait: "Connecting",
  good: "Good",
  slow: "Slow",
  lost: "Lost",
  ended: "Ended",
  barred: "No access",
};

export class Status {
  /** Whether a stream failed and nothing arrived since, or nothing will arrive. */
  private isLost = false;
  /** Time of the next request to the server. */
  private againMs = 0;
  /** Number of consecutive seconds in which something was slow. */
  private slowTimes = 0;
  private readonly word: HTMLElement;
  private readonly values = new Map<string, HTMLElement>();
  private before = { ms: performance.now(), bytes: 0, taken: 0, drawn: 0 };

  constructor(
    private readonly light: HTMLElement,
    private readonly line: HTMLElement,
    private readonly list: HTMLElement,
    button: HTMLButtonElement,
    private readonly again: HTMLButtonElement,
  ) {
    this.word = light.firstElementChild as HTMLElement;
    button.addEventListener("click", () => {
      list.hidden = !list.hidden;
      button.setAttribute("aria-expanded", String(!list.hidden));
    });
  }

  /** The server is lost until it answers. The next request is in `waitMs`. */
  lose(waitMs: number): void {
    this.isLost = true;
    this.againMs = performance.now() + waitMs;
    this.shine("lost");
    this.again.hidden = false;
    this.count();
  }

  /** Nothing will arrive any more; `text` says why. */
  end(light: "ended" | "barred", text: string): void {
    this.isLost = true;
    this.againMs = 0;
    this.again.hidden = true;
    this.shine(light);
    this.say(text);
  }

  /** The server answers. */
  found(text: string): void {
    if (!["good", "slow"].includes(this.light.dataset.light ?? "")) this.shine("good");
    this.isLost = false;
    this.againMs = 0;
    this.again.hidden = true;
    this.say(text);
  }

  /** Shows when the server is asked again. Call this about once a second. */
  count(): void {
    if (this.againMs === 0) return;
    const seconds = Math.ceil((this.againMs - performance.now()) / 1000);
    this.say(seconds > 0 ? `The connection is lost. Trying again in ${seconds} s.` : "The connection is lost. Trying again …");
  }

  /** Shows the light, with the reason if it is not good. Outdated values are drawn without colour. */
  private shine(light: Light, why = ""): void {
    const text = WORDS[light] + (why && `: ${why}`);
    if (this.light.dataset.light !== light) this.light.dataset.light = light;
    if (this.word.textContent !== text) this.word.textContent = text;
    document.body.dataset.light = light;
  }

  /** Evaluates the figures. A single slow second does not count. */
  private judge(figures: Figures, taken: number, drawn: number): void {
    const { roundTripMs = 0, dilation, silentMs, frameAgeMs = 0, isStill } = figures;
    if (this.isLost) return;
    if (silentMs > LOST_MS) {
      this.say("The server does not answer.");
      return this.shine("lost");
    }
    const reasons = [
      roundTripMs > SLOW.roundTripMs ? `answers take ${(roundTripMs / 1000).toFixed(1)} s` : "",
      dilation < SLOW.dilation ? `the tissue's time runs at ${Math.round(100 * dilation)} %` : "",
      !isStill && frameAgeMs > SLOW.frameAgeMs ? `the picture is ${(frameAgeMs / 1000).toFixed(1)} s old` : "",
      taken >= SLOW.taken && drawn < SLOW.drawn ? `this machine draws ${drawn.toFixed(0)} pictures a second` : "",
    ].filter((reason) => reason !== "");
    this.slowTimes = reasons.length > 0 ? this.slowTimes + 1 : 0;
    if (this.slowTimes === 1 && this.light.dataset.light === "good") return;
    if (reasons.length > 0) this.shine("slow", reasons[0]);
    else this.shine("good");
  }

  /** Shows a message. Screen readers announce it, so only changes are written. */
  say(text: string): void {
    const said = excerpt(text);
    if (this.line.textContent !== said) this.line.textContent = said;
  }

  /** Updates the figures. Call this about once a second. */
  show(figures: Figures): void {
    const ms = performance.now();
    const seconds = (ms - this.before.ms) / 1000;
    const bytes = (received.bytes - this.before.bytes) / seconds;
    const taken = (figures.framesTaken - this.before.taken) / seconds;
    const drawn = (figures.framesDrawn - this.before.drawn) / seconds;
    this.before = { ms, bytes: received.bytes, taken: figures.framesTaken, drawn: figures.framesDrawn };
    this.judge(figures, taken, drawn);
    const inMs = (value: number | undefined) => (value === undefined ? "–" : `${value.toFixed(1)} ms`);
    this.set("round trip", inMs(figures.roundTripMs));
    this.set("commands, network only", inMs(figures.networkMs));
    this.set("touch goes by", figures.way);
    this.set("frame age", figures.isStill ? "still" : inMs(figures.frameAgeMs));
    this.set("frames", `${taken.toFixed(0)}/s, drawn ${drawn.toFixed(0)}/s, skipped ${figures.framesSkipped}`);
    this.set("picture", figures.picture);
    this.set("received", bytes >= 1e6 ? `${(bytes / 1e6).toFixed(2)} MB/s` : `${(bytes / 1e3).toFixed(1)} kB/s`);
    this.set("overruns", String(figures.overruns));
    this.set("time", `${(figures.speed * figures.dilation).toFixed(2)} × real`);
    this.set("tissue", figures.isAsleep ? "asleep" : `${figures.awakePoints ?? "–"} points awake`);
    if (figures.auditedError !== undefined) {
      const asked = figures.tolerance === undefined ? "" : ` (tolerance ${figures.tolerance.toExponential(0)})`;
      this.set("error", `${figures.auditedError.toExponential(0)}${asked}`);
    }
    if (figures.cut !== undefined || this.values.has("cut")) this.set("cut", figures.cut ?? "nothing");
    if (figures.cellsError !== undefined) {
      const percent = 100 * figures.cellsError;
      this.set("error of the cells", `${percent >= 0 ? "+" : "−"}${Math.abs(percent).toFixed(0)} % of the stiffness`);
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
