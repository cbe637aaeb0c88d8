// Mouse, fingers and keys on the tissue.

import type { Hand, Reach } from "./hand";
import type { Latency } from "./latency";
import type { Vec3 } from "./samples";
import type { Stage } from "./stage";
import type { Surface } from "./surface";

/** What the user can touch. */
export interface Touched {
  hand: Hand;
  surface: Surface;
  reach: Reach;
  extentM: [number, number];
}

/** Rotation of the view per key press, radians. */
const TURN = 0.08;

export class Input {
  private dragging: number | undefined;
  private fingers = new Set<number>();
  /** Where the drag began: in the rest plane, and on the surface. */
  private from: { placeM: [number, number]; onSurfaceM: Vec3 } | undefined;
  private aimM: [number, number] | undefined;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly stage: Stage,
    private readonly latency: Latency,
    private readonly touched: () => Touched | undefined,
  ) {
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.moved(event));
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"] as const) {
      canvas.addEventListener(end, (event) => this.up(event));
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("keyup", (event) => {
      if (event.key === " ") this.touched()?.hand.lift();
    });
    canvas.addEventListener("blur", () => {
      this.aimM = undefined;
      this.stage.setAim(undefined);
      if (this.dragging === undefined) this.touched()?.hand.lift();
    });
  }

  private down(event: PointerEvent): void {
    if (event.pointerType === "touch") this.fingers.add(event.pointerId);
    const { hand } = this.touched() ?? {};
    if (!hand) return;
    // A second finger turns the view instead.
    if (this.fingers.size > 1) return this.finish();
    if (event.button !== 0 || this.dragging !== undefined) return;
    const placeM = this.stage.pick(event.clientX, event.clientY);
    if (!placeM) return;
    this.latency.pressed(event.timeStamp);
    this.canvas.setPointerCapture(event.pointerId);
    this.dragging = event.pointerId;
    this.begin(hand, placeM);
  }

  private begin(hand: Hand, placeM: [number, number]): void {
    const { spacingM } = hand.reach;
    // A grasp holds a mass point and begins at that point.
    if (hand.mode === "pull") placeM = [spacingM * Math.round(placeM[0] / spacingM), spacingM * Math.round(placeM[1] / spacingM)];
    this.from = { placeM, onSurfaceM: this.onSurface(placeM) };
    void hand.press(placeM, this.from.onSurfaceM);
  }

  private onSurface([x, y]: [number, number]): Vec3 {
    const [dx, dy, dz] = this.touched()?.surface.displacementAtM(x, y) ?? [0, 0, 0];
    return [x + dx, y + dy, dz];
  }

  private moved(event: PointerEvent): void {
    const { hand } = this.touched() ?? {};
    if (event.pointerId !== this.dragging || !hand || !this.from) return;
    if (hand.mode === "stroke") {
      const placeM = this.stage.pick(event.clientX, event.clientY);
      if (placeM) hand.goOn(placeM);
      return;
    }
    const at = this.stage.onFacingPlane(event.clientX, event.clientY, this.from.onSurfaceM);
    if (!at) return;
    const [x, y, z] = this.from.onSurfaceM;
    hand.lean([at[0] - x, at[1] - y, at[2] - z]);
  }

  private up(event: PointerEvent): void {
    this.fingers.delete(event.pointerId);
    if (event.pointerId === this.dragging) this.finish();
  }

  private finish(): void {
    this.dragging = undefined;
    this.from = undefined;
    this.touched()?.hand.lift();
  }

  private key(event: KeyboardEvent): void {
    const touched = this.touched();
    if (!touched || event.ctrlKey || event.metaKey || event.altKey) return;
    const { hand, reach, extentM } = touched;
    const ways: Record<string, [number, number]> = {
      ArrowLeft: [-1, 0],
      ArrowRight: [1, 0],
      ArrowUp: [0, 1],
      ArrowDown: [0, -1],
    };
    const way = ways[event.key];
    if (way && event.shiftKey) {
      this.stage.turn(-way[0] * TURN, way[1] * TURN, 1);
    } else if (way) {
      // Right is the right side of the view.
      const [rx, ry] = this.stage.rightwards();
      const [x, y] = this.aimM ?? [extentM[0] / 2, extentM[1] / 2];
      const by: [number, number] = [way[0] * rx - way[1] * ry, way[0] * ry + way[1] * rx];
      const to = (v: number, along: number, most: number) => Math.min(Math.max(v + along * reach.spacingM, 0), most);
      this.aimM = [to(x, by[0], extentM[0]), to(y, by[1], extentM[1])];
      if (hand.touches) this.lead(this.aimM, touched);
      this.stage.setAim(this.aimM);
    } else if (event.key === " ") {
      if (!event.repeat && !hand.touches) {
        this.aimM ??= [extentM[0] / 2, extentM[1] / 2];
        this.latency.pressed(event.timeStamp);
        this.begin(hand, this.aimM);
        // A pull by key lifts the point.
        if (hand.mode === "pull") hand.lean([0, 0, reach.depthM * hand.strength]);
        this.stage.setAim(this.aimM);
      }
    } else if (event.key === "Escape") {
      void hand.letGo();
    } else if (event.key === "+" || event.key === "-") {
      this.stage.turn(0, 0, event.key === "+" ? 1.1 : 1 / 1.1);
    } else {
      return;
    }
    event.preventDefault();
  }

  /** Arrow keys while Space is down: a stroke moves on, a push leans, a pull moves sideways. */
  private lead(aimM: [number, number], { hand, reach }: Touched): void {
    if (hand.mode === "stroke") return hand.goOn(aimM);
    const from = this.from?.placeM ?? aimM;
    const up = hand.mode === "pull" ? reach.depthM * hand.strength : 0;
    hand.lean([aimM[0] - from[0], aimM[1] - from[1], up]);
  }
}
