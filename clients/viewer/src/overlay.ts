// The overlays on the picture: the scale bar, the depth and the force beside the tool, and a ring at the pointer that
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

export class Overlay {
  private readonly touch = part("touch", HTMLElement);
  private readonly depth = part("touch-depth", HTMLElement);
  private readonly force = part("touch-force", HTMLElement);
  private readonly jaws = part("touch-jaws", HTMLElement);
  private readonly bar = part("scale-bar", HTMLElement);
  private readonly length = part("scale-text", HTMLElement);
  private readonly ring = document.getElementById("pointer-ring") as unknown as SVGPathElement;
  /** The view in which the bar was measured. */
  private measured = -1;
  private pointed: { place: Place; radiusM: number } | undefined;

  constructor(private readonly stage: Stage) {}

  /** Shows what the first tool feels; nothing if there is none. */
  tell(felt: Told | undefined): void {
    if (this.touch.hidden === (felt === undefined)) return void (felt && this.write(felt));
    this.touch.hidden = felt === undefined;
    if (felt) {
      this.write(felt);
      this.place();
    }
  }

  private write(felt: Told): void {
    this.depth.textContent = depthText(felt);
    this.force.textContent = `${quantity(felt.allN, "N")} back`;
    this.jaws.textContent = jawsText(felt);
  }

  /** Shows what a press would move; nothing without a place. The picture itself need not be drawn again. */
  point(place?: Place, radiusM = 0): void {
    this.pointed = place && { place, radiusM };
    this.drawRing();
  }

  private drawRing(): void {
    const { pointed } = this;
    if (!pointed) return this.ring.removeAttribute("d");
    const { left, top } = this.touch.parentElement!.getBoundingClientRect();
    const corners = this.stage.ringInWindow(pointed.place, pointed.radiusM);
    this.ring.setAttribute("d", `M${corners.map(([x, y]) => `${(x - left).toFixed(1)} ${(y - top).toFixed(1)}`).join("L")}Z`);
  }

  /** Call after each picture. */
  drawn(): void {
    this.measure();
    if (this.pointed) this.drawRing();
    if (!this.touch.hidden) this.place();
  }

  private place(): void {
    const at = this.stage.tipInWindow();
    if (!at) return;
    const view = this.touch.parentElement!.getBoundingClientRect();
    const [width, height] = [this.touch.offsetWidth, this.touch.offsetHeight];
    const [x, y] = [at[0] - view.left, at[1] - view.top];
    // To the left of the tool, which comes from the right; if there is no room, to the right and below.
    const hasRoom = x - BESIDE - width > 8;
    const left = hasRoom ? x - BESIDE - width : Math.min(x + BESIDE, view.width - width - 8);
    const top = Math.min(Math.max(hasRoom ? y - height / 2 : y + BESIDE / 2, 8), view.height - height - 8);
    this.touch.style.transform = `translate(${Math.round(left)}px, ${Math.round(top)}px)`;
  }

  private measure(): void {
    if (this.stage.views === this.measured || !this.stage.began.isDrawn) return;
    const pixels = this.stage.pixelsPerMetre();
    if (!Number.isFinite(pixels) || pixels <= 0) return;
    this.measured = this.stage.views;
    this.length.parentElement!.hidden = false;
    const most = Math.min(LONGEST.pixels, LONGEST.part * this.touch.parentElement!.clientWidth) / pixels;
    const power = 10 ** Math.floor(Math.log10(most));
    const lengthM = power * ([5, 2].find((times) => times * power <= most) ?? 1);
    this.bar.style.width = `${(lengthM * pixels).toFixed(1)}px`;
    // Lengths of tissue are usually given in millimetres.
    this.length.textContent = `${Number((1000 * lengthM).toPrecision(3))} mm`;
  }
}
