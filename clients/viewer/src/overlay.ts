// The overlays on the picture: the scale bar, the depth and the force beside each tool, and a ring at the pointer that
// shows how far a press would move the tissue.

import { part } from "./page";
import { quantity } from "./plot";
import type { Told } from "./samples";
import type { Stage } from "./stage";
import type { Place } from "./surface";

/** Maximum length of the scale bar, in pixels and as a fraction of the picture's width. */
const LONGEST = { pixels: 150, part: 0.28 };
/** Distance of the text from the tip, pixels. */
const BESIDE = 46;
/** Distance that a text keeps from the tip of another tool, pixels. */
const NEAR = 12;

/** Describes a depth or height. */
export function depthText({ deepM }: Told): string {
  return deepM < 0 ? `${quantity(-deepM, "m")} lifted` : `${quantity(deepM, "m")} deep`;
}

/** Describes the torque on jaws that grip; empty if there are none. */
export function jawsText({ openingNM }: Told): string {
  return openingNM === undefined ? "" : `jaws ${quantity(openingNM, "N·m").replace("-", "−")}`;
}

/** What a tool feels, as shown beside it. */
export interface ToolLabel {
  /** Number of the tool. */
  tool: number;
  told: Told;
  /** Which hand's it is, if there are two. */
  title: string;
}

/** The text beside a tool. */
class Label {
  /** The tool that it is beside. */
  tool = 0;
  private readonly title: HTMLElement;
  private readonly depth: HTMLElement;
  private readonly force: HTMLElement;
  private readonly jaws: HTMLElement;

  constructor(readonly element: HTMLElement) {
    const line = (name: string) => {
      const made = document.createElement("span");
      made.className = name;
      element.append(made);
      return made;
    };
    [this.title, this.depth, this.force, this.jaws] = ["title", "depth", "force", "jaws"].map(line) as [HTMLElement, HTMLElement, HTMLElement, HTMLElement];
  }

  write({ tool, told, title }: ToolLabel): void {
    this.tool = tool;
    this.title.textContent = title;
    this.depth.textContent = depthText(told);
    this.force.textContent = `${quantity(told.allN, "N")} back`;
    this.jaws.textContent = jawsText(told);
  }
}

export class Overlay {
  private readonly labels = ["touch", "touch-other"].map((id) => new Label(part(id, HTMLElement)));
  private readonly view = part("view", HTMLElement);
  private readonly bar = part("scale-bar", HTMLElement);
  private readonly length = part("scale-text", HTMLElement);
  private readonly ring = document.getElementById("pointer-ring") as unknown as SVGPathElement;
  /** The view in which the bar was measured. */
  private measured = -1;
  private pointed: { place: Place; radiusM: number } | undefined;

  constructor(private readonly stage: Stage) {}

  /** Shows what tools feel: two at most. */
  tell(tools: readonly ToolLabel[]): void {
    this.labels.forEach((label, index) => {
      const tool = tools[index];
      label.element.hidden = tool === undefined;
      if (tool) label.write(tool);
    });
    this.place();
  }

  /** Shows what a press would move; nothing without a place. The picture itself need not be drawn again. */
  point(place?: Place, radiusM = 0): void {
    this.pointed = place && { place, radiusM };
    this.drawRing();
  }

  private drawRing(): void {
    const { pointed } = this;
    if (!pointed) return this.ring.removeAttribute("d");
    const { left, top } = this.view.getBoundingClientRect();
    const corners = this.stage.ringInWindow(pointed.place, pointed.radiusM);
    this.ring.setAttribute("d", `M${corners.map(([x, y]) => `${(x - left).toFixed(1)} ${(y - top).toFixed(1)}`).join("L")}Z`);
  }

  /** Call after each picture. */
  drawn(): void {
    this.measure();
    if (this.pointed) this.drawRing();
    this.place();
  }

  /** Places each label beside its tool, where it covers neither the other tool nor its label, if there is room. */
  private place(): void {
    const view = this.view.getBoundingClientRect();
    const shown = this.labels.flatMap((label) => {
      const at = label.element.hidden ? undefined : this.stage.tipInWindow(label.tool);
      return at ? [{ element: label.element, tool: label.tool, x: at[0] - view.left, y: at[1] - view.top }] : [];
    });
    const taken: { left: number; top: number; width: number; height: number }[] = [];
    for (const { element, tool, x, y } of shown) {
      const [width, height] = [element.offsetWidth, element.offsetHeight];
      const within = (v: number, most: number) => Math.min(Math.max(v, 8), most - 8);
      const spot = (left: number, top: number) => ({ left: within(left, view.width - width), top: within(top, view.height - height), width, height });
      // To the left of the tool, which comes from the right; if there is no room, to the right and below, or above,
      // or below the other text.
      const lefts = x - BESIDE - width > 8 ? [spot(x - BESIDE - width, y - height / 2), spot(x - BESIDE - width, y - height - BESIDE / 2)] : [];
      const below = taken.map((other) => spot(x + BESIDE, other.top + other.height + 4));
      const spots = [...lefts, spot(x + BESIDE, y + BESIDE / 2), spot(x + BESIDE, y - height - BESIDE / 2), ...below] as const;
      const isFree = ({ left, top }: { left: number; top: number }) =>
        shown.every((other) => other.tool === tool || !(other.x > left - NEAR && other.x < left + width + NEAR && other.y > top - NEAR && other.y < top + height + NEAR)) &&
        taken.every((other) => left >= other.left + other.width || left + width <= other.left || top >= other.top + other.height || top + height <= other.top);
      const free = spots.find(isFree) ?? spots[0]!;
      taken.push(free);
      element.style.transform = `translate(${Math.round(free.left)}px, ${Math.round(free.top)}px)`;
    }
  }

  private measure(): void {
    if (this.stage.views === this.measured || !this.stage.began.isDrawn) return;
    const pixels = this.stage.pixelsPerMetre();
    if (!Number.isFinite(pixels) || pixels <= 0) return;
    this.measured = this.stage.views;
    this.length.parentElement!.hidden = false;
    const most = Math.min(LONGEST.pixels, LONGEST.part * this.view.clientWidth) / pixels;
    const power = 10 ** Math.floor(Math.log10(most));
    const lengthM = power * ([5, 2].find((times) => times * power <= most) ?? 1);
    this.bar.style.width = `${(lengthM * pixels).toFixed(1)}px`;
    // Lengths of tissue are usually given in millimetres.
    this.length.textContent = `${Number((1000 * lengthM).toPrecision(3))} mm`;
  }
}
