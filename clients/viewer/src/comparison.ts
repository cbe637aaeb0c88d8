// Measured curves beside those of this tissue: the server presses into a copy of it as a machine pressed into a phantom, and the page
// draws both forces.
//
// Points are measured, the line is computed: nobody needs to tell colours apart. A table says the same in numbers.

import { TipShape, type CompareCurvesResponse, type ComparedCurve } from "palpate/v1";
import { part, table } from "./page";
import { BOTTOM, drawLevels, LEFT, prefixed, quantity, sketch, tickDistance, tickText, TOP } from "./plot";
import { describe, sessions } from "./server";
import { excerpt } from "./text";

/** Maximum size of a table, bytes: a request has at most 1 MiB. */
const MAX_BYTES = 1_000_000;
/** Timeout of a comparison: the server gives up before. */
const PRESSING_MS = 120_000;
/** Maximum number of curves, and of samples of each, that are shown. */
const MAX_CURVES = 256;
const MAX_SAMPLES = 20_000;
/** Points of a plot, and rows of the table, at most; the others are left out evenly. */
const MAX_POINTS = 400;
const MAX_ROWS = 40;

/** Returns whether a file is a table of curves, by its name. */
export function isTable({ name }: File): boolean {
  return /[.](csv|tsv|txt)$/i.test(name);
}

/** The samples of a curve: equally long lists. */
interface Samples {
  timeS: number[];
  depthM: number[];
  measuredN: number[];
  computedN: number[];
}

/** Returns the samples of a curve whose numbers are finite, at most so many of them, evenly. */
function samplesOf({ timeS, depthM, measuredN, computedN }: ComparedCurve, most: number): Samples {
  const count = Math.min(timeS.length, depthM.length, measuredN.length, computedN.length, MAX_SAMPLES);
  const lists = [timeS, depthM, measuredN, computedN];
  const finite = Array.from({ length: count }, (_, k) => k).filter((k) => lists.every((list) => Number.isFinite(list[k])));
  const every = Math.max(1, Math.ceil(finite.length / most));
  const shown = finite.filter((_, n) => n % every === 0 || n === finite.length - 1);
  const [time = [], depth = [], measured = [], computed = []] = lists.map((list) => shown.map((k) => list[k] ?? 0));
  return { timeS: time, depthM: depth, measuredN: measured, computedN: computed };
}

/** Values along x with their unit, measured points, and a line. */
interface Diagram {
  x: number[];
  unit: string;
  points: number[];
  line: number[];
}

/** Draws points and a line over the same values along x. */
function draw(canvas: HTMLCanvasElement, { x, unit, points, line }: Diagram): void {
  const drawn = sketch(canvas);
  if (!drawn || x.length === 0) return;
  const { pen, width, height, colour } = drawn;
  const span = (values: number[]): [number, number] => [Math.min(0, ...values), Math.max(0, ...values)];
  const [low, high] = span([...points, ...line]);
  const { y } = drawLevels(drawn, low, high > low ? high : low + 1e-3, "N");
  const [begin, end] = span(x);
  const right = width - 6;
  const at = (value: number) => LEFT + ((right - LEFT) * (value - begin)) / (end > begin ? end - begin : 1);
  const bottom = height - BOTTOM;
  const [factor, prefix] = prefixed(Math.max(-begin, end));
  const tick = tickDistance(end > begin ? end - begin : 1);
  pen.strokeStyle = pen.fillStyle = colour("--faint");
  for (let k = Math.ceil(begin / tick - 1e-6); k * tick <= end + 1e-6 * tick; k++) {
    const place = Math.round(at(k * tick)) + 0.5;
    pen.beginPath();
    pen.moveTo(place, bottom);
    pen.lineTo(place, bottom + 3);
    pen.stroke();
    pen.textAlign = place > right - 20 ? "right" : place < LEFT + 10 ? "left" : "center";
    pen.fillText(`${tickText(k * tick, factor)} ${prefix}${unit}`, place > right - 20 ? width - 1 : place, height - 2);
  }
  pen.save();
  pen.beginPath();
  pen.rect(LEFT - 2, TOP - 4, width - LEFT + 2, bottom - TOP + 8);
  pen.clip();
  pen.fillStyle = colour("--depth");
  for (const [k, value] of points.entries()) {
    pen.beginPath();
    pen.arc(at(x[k] ?? 0), y(value), 2, 0, 2 * Math.PI);
    pen.fill();
  }
  pen.strokeStyle = colour("--force");
  pen.lineWidth = 1.75;
  pen.lineJoin = "round";
  pen.beginPath();
  for (const [k, value] of line.entries()) pen.lineTo(at(x[k] ?? 0), y(value));
  pen.stroke();
  pen.restore();
}

/** Returns the name of a tip, with its size. */
function tipText({ tip }: ComparedCurve): string {
  const shapes: Partial<Record<TipShape, string>> = { [TipShape.RIGID_DISC]: "a rigid disc", [TipShape.SPHERE]: "a sphere" };
  const shape = shapes[tip?.shape ?? TipShape.DISC] ?? "a disc of even pressure";
  return `${shape} of ${quantity(tip?.radiusM ?? 0, "m")} radius`;
}

export class Comparison {
  private readonly dialog = part("comparison", HTMLDialogElement);
  private readonly said = part("comparison-said", HTMLElement);
  private readonly shown = part("comparison-shown", HTMLElement);
  private readonly choice = part("comparison-curve", HTMLSelectElement);
  private file: File | undefined;
  private result: CompareCurvesResponse | undefined;
  /** Ends the call of the last comparison. */
  private ending = new AbortController();

  /** `present` returns the id of the session that the page shows. */
  constructor(private readonly present: () => string | undefined) {
    const chosen = part("compare-file", HTMLInputElement);
    part("compare", HTMLButtonElement).addEventListener("click", () => chosen.click());
    chosen.addEventListener("change", () => {
      const file = chosen.files?.[0];
      // Lets the user choose the same file again.
      chosen.value = "";
      if (file) void this.take(file);
    });
    part("comparison-tip", HTMLFormElement).addEventListener("submit", (event) => {
      event.preventDefault();
      if (this.file) void this.take(this.file);
    });
    part("comparison-close", HTMLButtonElement).addEventListener("click", () => this.dialog.close());
    this.dialog.addEventListener("close", () => this.ending.abort());
    this.choice.addEventListener("change", () => this.tell());
    new ResizeObserver(() => this.draw()).observe(this.shown);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  /** What is shown, for tests. */
  get state() {
    const { curves = [], relativeRms = NaN } = this.result ?? {};
    return { isOpen: this.dialog.open, curves: curves.length, relativeRms };
  }

  /** Compares the curves of a file with the tissue. */
  async take(file: File): Promise<void> {
    this.ending.abort();
    const { signal } = (this.ending = new AbortController());
    this.file = file;
    this.result = undefined;
    part("comparison-name", HTMLElement).textContent = excerpt(file.name);
    this.wait("Pressing as the curves say …", true);
    if (!this.dialog.open) this.dialog.showModal();
    try {
      const result = await this.ask(file, signal);
      if (signal.aborted) return;
      this.result = result;
      this.wait("", false);
      this.offer(result);
    } catch (error) {
      if (!signal.aborted) this.wait(`This does not work: ${excerpt(describe(error)).replace(/[.]$/, "")}.`, false);
    }
  }

  private async ask(file: File, signal: AbortSignal): Promise<CompareCurvesResponse> {
    const sessionId = this.present();
    if (sessionId === undefined) throw new Error("there is no tissue yet");
    if (file.size > MAX_BYTES) throw new Error("the table has more than 1 MB; leave some of its rows out");
    const radiusM = Number(part("comparison-radius", HTMLInputElement).value) / 1000;
    const tip = { shape: Number(part("comparison-shape", HTMLSelectElement).value), radiusM };
    const request = { sessionId, fileName: file.name, table: await file.text(), tip };
    return await sessions.compareCurves(request, { signal, timeoutMs: PRESSING_MS });
  }

  /** Says how far it is, without a result. */
  private wait(text: string, isPressing: boolean): void {
    this.said.textContent = text;
    part("comparison-progress", HTMLProgressElement).hidden = !isPressing;
    this.shown.hidden = true;
  }

  /** Shows a result: its first curve. */
  private offer({ curves }: CompareCurvesResponse): void {
    const names = curves.slice(0, MAX_CURVES).map(({ name }, k) => new Option(excerpt(name) || `Curve ${k + 1}`, String(k)));
    this.choice.replaceChildren(...names);
    part("comparison-choice", HTMLElement).hidden = curves.length < 2;
    this.shown.hidden = false;
    this.tell();
  }

  private get curve(): ComparedCurve | undefined {
    return this.result?.curves[Number(this.choice.value)];
  }

  /** Tells the chosen curve in words and numbers, and draws it. */
  private tell(): void {
    const { result, curve } = this;
    if (!result || !curve) return;
    const percent = (100 * result.relativeRms).toFixed(2);
    const all = `Between them ${quantity(result.rmsN, "N")} (root of the mean square), ${percent} % of the largest force; R² ${result.rSquared.toFixed(4)}.`;
    const own = result.curves.length > 1 ? ` In this curve ${quantity(curve.rmsN, "N")}.` : "";
    this.said.textContent = `${all}${own} Pressed by ${tipText(curve)}.`;
    const { timeS, depthM, measuredN, computedN } = samplesOf(curve, MAX_ROWS);
    const largest = (values: number[]) => quantity(Math.max(0, ...values), "N");
    const reach = `measured up to ${largest(measuredN)}, this tissue up to ${largest(computedN)}`;
    const label = (id: string, text: string) => part(id, HTMLCanvasElement).setAttribute("aria-label", text);
    label("comparison-depth", `Force over depth: ${reach}, at depths up to ${quantity(Math.max(0, ...depthM), "m")}. The table below has the numbers.`);
    label("comparison-time", `Force over time: ${reach}. The table below has the numbers.`);
    label("comparison-residual", `This tissue minus measured, over time: ${quantity(curve.rmsN, "N")} in the mean square. The table below has the numbers.`);
    const row = (k: number) => {
      const [time = 0, depth = 0, measured = 0, computed = 0] = [timeS[k], depthM[k], measuredN[k], computedN[k]];
      return [quantity(time, "s"), quantity(depth, "m"), quantity(measured, "N"), quantity(computed, "N"), quantity(computed - measured, "N")];
    };
    const heading = ["Time", "Depth", "Measured", "This tissue", "Difference"];
    part("comparison-table", HTMLElement).replaceChildren(table(heading, timeS.map((_, k) => row(k))));
    this.draw();
  }

  private draw(): void {
    if (this.shown.hidden || !this.curve) return;
    const { timeS, depthM, measuredN, computedN } = samplesOf(this.curve, MAX_POINTS);
    const canvas = (id: string) => part(id, HTMLCanvasElement);
    draw(canvas("comparison-depth"), { x: depthM, unit: "m", points: measuredN, line: computedN });
    const fromS = timeS.map((time) => time - (timeS[0] ?? 0));
    draw(canvas("comparison-time"), { x: fromS, unit: "s", points: measuredN, line: computedN });
    const residual = computedN.map((force, k) => force - (measuredN[k] ?? 0));
    draw(canvas("comparison-residual"), { x: fromS, unit: "s", points: [], line: residual });
  }
}
