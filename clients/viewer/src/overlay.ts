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

  /** Places each label beside its tool, and below one before it that it would cover. */
  private place(): void {
    const view = this.view.getBoundingClientRect();
    const taken: { left: number; right: number; top: number; bottom: number }[] = [];
    for (const { element, tool } of this.labels) {
      const at = element.hidden ? undefined : this.stage.tipInWindow(tool);
      if (!at) continue;
      const [width, height] = [element.offsetWidth, element.offsetHeight];
      const [x, y] = [at[0] - view.left, at[1] - view.top];
      // To the left of the tool, which comes from the right; if there is no room, to the right and below.
      const hasRoom = x - BESIDE - width > 8;
      const left = hasRoom ? x - BESIDE - width : Math.min(x + BESIDE, view.width - width - 8);
      const within = (top: number) => Math.min(Math.max(top, 8), view.height - height - 8);
      let top = within(hasRoom ? y - height / 2 : y + BESIDE / 2);
      const covered = taken.find((other) => left < other.right && left + width > other.left && top < other.bottom && top + height > other.top);
      if (covered) top = within(covered.bottom + height + 8 < view.height ? covered.bottom + 4 : covered.top - height - 4);
      taken.push({ left, right: left + width, top, bottom: top + height });
      element.style.transform = `translate(${Math.round(left)}px, ${Math.round(top)}px)`;
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
