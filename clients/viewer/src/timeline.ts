// The timeline of a recording: the force over its whole length as a curve, a playhead, and marks. The user chooses a
// moment with a click or a drag.

import { clockText, type Recording } from "./journal";
import { part } from "./page";
import { quantity } from "./plot";

/** Space for the times beneath the curve, and for the playhead at both ends, pixels. */
const BOTTOM = 14;
const SIDE = 7;
/** Minimum distance of two times, pixels. */
const APART = 74;
/** A pointer that moves by more than this drags, pixels. */
const DRAG = 3;
/** Possible distances of marks, s. */
const MARKS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14_400];
/** If two moments of the curve are farther apart than usual by this factor, the tissue was at rest in between. */
const GAP = 3;

/** Called when a moment is being chosen, was chosen, or when choosing was cancelled. */
export interface Chosen {
  onScrub: (step: number) => void;
  onSeek: (step: number) => void;
  onCancel: () => void;
}

export class Timeline {
  readonly element = part("timeline", HTMLElement);
  private readonly canvas = part("curve", HTMLCanvasElement);
  private readonly played = part("played", HTMLElement);
  private readonly head = part("playhead", HTMLElement);
  private readonly hover = part("timeline-hover", HTMLElement);
  private recording: Recording | undefined;
  /** The force in each column of pixels. */
  private columns: number[] = [];
  private step = 0;
  private toldMs = -Infinity;
  private pressed: { pointer: number; x: number; isDrag: boolean } | undefined;

  constructor(private readonly chosen: Chosen) {
    const { element } = this;
    element.addEventListener("pointerdown", (event) => this.down(event));
    element.addEventListener("pointermove", (event) => this.move(event));
    element.addEventListener("pointerup", (event) => this.up(event));
    element.addEventListener("pointercancel", () => this.cancel());
    element.addEventListener("pointerleave", () => (this.hover.hidden = true));
    new ResizeObserver(() => this.draw()).observe(element);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  show(recording: Recording): void {
    this.recording = recording;
    this.draw();
    this.moveTo(this.step, true);
  }

  /** Moves the playhead. `isSmooth`: this is a part of continuous playback. */
  moveTo(step: number, isSmooth: boolean): void {
    this.step = step;
    const { recording } = this;
    if (!recording) return;
    const x = this.x(step);
    this.head.style.transform = `translateX(${x.toFixed(1)}px)`;
    this.played.style.width = `${Math.max(0, x - SIDE).toFixed(1)}px`;
    // Screen readers read out each change.
    const now = performance.now();
    if (isSmooth && now - this.toldMs < 1000) return;
    if (isSmooth) this.toldMs = now;
    const at = recording.timeS(step);
    const force = quantity(this.columns[Math.round(x)] ?? 0, "N");
    const told = {
      "aria-valuemin": "0",
      "aria-valuemax": recording.lengthS.toFixed(1),
      "aria-valuenow": at.toFixed(1),
      "aria-valuetext": `${clockText(at)} of ${clockText(recording.lengthS)}, ${force}`,
    };
    for (const [name, text] of Object.entries(told)) {
      if (this.element.getAttribute(name) !== text) this.element.setAttribute(name, text);
    }
  }

  private get width(): number {
    return this.element.clientWidth;
  }

  private x(step: number): number {
    const { begin = 0, end = 0 } = this.recording ?? {};
    return SIDE + (this.width - 2 * SIDE) * (end > begin ? Math.min(Math.max((step - begin) / (end - begin), 0), 1) : 0);
  }

  private stepAt(clientX: number): number {
    const { recording } = this;
    if (!recording) return 0;
    const part = (clientX - this.element.getBoundingClientRect().left - SIDE) / Math.max(this.width - 2 * SIDE, 1);
    return recording.clamp(recording.begin + part * (recording.end - recording.begin));
  }

  private down(event: PointerEvent): void {
    if (event.button !== 0 || this.pressed || !this.recording) return;
    this.element.setPointerCapture(event.pointerId);
    this.pressed = { pointer: event.pointerId, x: event.clientX, isDrag: false };
  }

  private move(event: PointerEvent): void {
    this.point(event);
    const { pressed } = this;
    if (pressed?.pointer !== event.pointerId) return;
    pressed.isDrag ||= Math.abs(event.clientX - pressed.x) >= DRAG;
    if (pressed.isDrag) this.chosen.onScrub(this.stepAt(event.clientX));
  }

  private up(event: PointerEvent): void {
    if (this.pressed?.pointer !== event.pointerId) return;
    this.pressed = undefined;
    if (event.pointerType === "touch") this.hover.hidden = true;
    this.chosen.onSeek(this.stepAt(event.clientX));
  }

  private cancel(): void {
    if (this.pressed?.isDrag) this.chosen.onCancel();
    this.pressed = undefined;
    this.hover.hidden = true;
  }

  /** Shows the time and force under the pointer. */
  private point(event: PointerEvent): void {
    const { recording } = this;
    if (!recording) return;
    const step = this.stepAt(event.clientX);
    this.hover.hidden = false;
    const x = this.x(step);
    this.hover.textContent = `${clockText(recording.timeS(step))}  ${quantity(this.columns[Math.round(x)] ?? 0, "N")}`;
    const half = this.hover.offsetWidth / 2;
    this.hover.style.transform = `translateX(${Math.round(Math.min(Math.max(x, half), this.width - half) - half)}px)`;
  }

  /** Computes the largest force in each column of pixels. */
  private fill(width: number): void {
    this.columns = new Array<number>(width + 1).fill(0);
    const { forces } = this.recording ?? { forces: [] };
    const steps = forces.map(({ step }) => Number(step));
    const gaps = steps.map((step, i) => step - (steps[i - 1] ?? step - 1)).sort((a, b) => a - b);
    const usual = gaps[gaps.length >> 1] ?? 1;
    const put = (from: number, to: number, force: number) => {
      const last = Math.min(Math.ceil(this.x(to)), width);
      for (let x = Math.floor(this.x(from)); x <= last; x++) this.columns[x] = Math.max(this.columns[x]!, force);
    };
    let before = { step: this.recording?.begin ?? 0, force: 0 };
    for (let i = 0; i < steps.length; i++) {
      const [step, force] = [steps[i]!, forces[i]!.forceN];
      const isRest = step - before.step > GAP * usual;
      const from = isRest ? step - usual : before.step;
      // At rest nothing changes.
      if (isRest) put(before.step, from, before.force);
      put(from, step, force);
      before = { step, force };
    }
    put(before.step, this.recording?.end ?? before.step, before.force);
  }

  private draw(): void {
    const { canvas, recording } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const pen = canvas.getContext("2d");
    if (!pen || !recording || width === 0) return;
    this.fill(width);
    const ratio = Math.min(devicePixelRatio, 2);
    [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const style = getComputedStyle(canvas);
    const colour = (name: string) => style.getPropertyValue(name);
    const bottom = height - BOTTOM;
    // Marks for times, and for moments from which playback starts immediately.
    pen.font = "11px system-ui, sans-serif";
    pen.lineWidth = 1;
    const perSecond = (width - 2 * SIDE) / Math.max(recording.lengthS, 1e-3);
    const every = MARKS_S.find((seconds) => seconds * perSecond >= APART) ?? recording.lengthS;
    const line = (x: number, from: number, to: number) => {
      pen.beginPath();
      pen.moveTo(Math.round(x) + 0.5, from);
      pen.lineTo(Math.round(x) + 0.5, to);
      pen.stroke();
    };
    pen.textAlign = "center";
    for (let k = 0; k * every <= recording.lengthS; k++) {
      const x = SIDE + k * every * perSecond;
      pen.strokeStyle = colour("--line");
      line(x, 0, bottom);
      pen.fillStyle = colour("--faint");
      pen.textAlign = k === 0 ? "left" : x > width - 28 ? "right" : "center";
      const text = clockText(k * every);
      pen.fillText(every < 1 ? text : text.slice(0, -2), k === 0 ? 0 : Math.min(x, width), height - 2);
    }
    pen.strokeStyle = colour("--faint");
    // If they are dense they show nothing useful.
    if (recording.snapshots.length * 4 < width) for (const step of recording.snapshots) line(this.x(step), bottom, bottom + 3);
    const most = Math.max(...this.columns);
    const y = (force: number) => bottom - 0.5 - (most > 0 ? force / most : 0) * (bottom - 5);
    pen.beginPath();
    for (let x = SIDE; x <= width - SIDE; x++) pen.lineTo(x, y(this.columns[x]!));
    pen.strokeStyle = colour("--force");
    pen.lineWidth = 1.5;
    pen.lineJoin = "round";
    pen.stroke();
    pen.lineTo(width - SIDE, bottom);
    pen.lineTo(SIDE, bottom);
    pen.globalAlpha = 0.25;
    pen.fillStyle = colour("--force");
    pen.fill();
    pen.globalAlpha = 1;
    if (most === 0) return;
    pen.textAlign = "left";
    pen.fillStyle = colour("--faint");
    pen.fillText(quantity(most, "N"), SIDE + 3, 10);
  }
}
