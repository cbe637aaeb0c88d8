// Mouse, fingers and keys on the tissue.

import { Vector3 } from "three";
import { OPEN } from "./grasper";
import type { Hand, Reach } from "./hand";
import type { Latency } from "./latency";
import type { Vec3 } from "palpate";
import type { Stage } from "./stage";
import type { Place, Surface } from "./surface";

/** What the user can touch. */
export interface Touched {
  hand: Hand;
  surface: Surface;
  reach: Reach;
}

/** Returns whether the tool moves to the places under the drag. */
function glides({ mode, grasper }: Hand): boolean {
  return mode === "stroke" || mode === "tip" || (mode === "grasper" && !grasper.grips);
}

/** Rotation of the view per key press, radians. */
const TURN = 0.08;
/** Opening of the jaws per pixel of the wheel, per event at most, and per key press. */
const WHEEL = { pixel: 0.0015, most: 0.15 };
const JAW_STEP = 0.15;

export class Input {
  /** If set, gets the next press on the tissue instead of a touch. */
  onPlace: ((place: Place) => void) | undefined;
  /** Called with the place under a pointer that does not touch, and without a place when it leaves. */
  onPoint: (place?: Place) => void = () => {};
  private dragging: number | undefined;
  private readonly fingers = new Map<number, [number, number]>();
  /** Distance of two fingers, and opening of the jaws, when the second finger came. */
  private pinch: { apart: number; opening: number } | undefined;
  /** Whether the right button is down beside the left one. */
  private isChord = false;
  /** Start of the drag: the place, and its position then. */
  private from: { place: Place; onSurfaceM: Vec3 } | undefined;
  private aim: Place | undefined;
  /** Where the pointer that drags is in the window. */
  private pointer: [number, number] | undefined;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly stage: Stage,
    private readonly latency: Latency,
    private readonly touched: () => Touched | undefined,
  ) {
    // Runs before the camera controls' handler, whose behaviour depends on whether the press is on the tissue.
    canvas.addEventListener("pointerdown", (event) => this.down(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => this.moved(event));
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"] as const) {
      canvas.addEventListener(end, (event) => this.up(event));
    }
    canvas.addEventListener("wheel", (event) => this.wheel(event), { capture: true, passive: false });
    canvas.addEventListener("pointerleave", () => this.onPoint());
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("keyup", (event) => {
      if (event.key === " ") this.touched()?.hand.lift();
    });
    canvas.addEventListener("blur", () => {
      this.aim = undefined;
      this.stage.setAim(undefined);
      if (this.dragging === undefined) this.touched()?.hand.lift();
    });
  }

  private down(event: PointerEvent): void {
    if (event.pointerType === "touch") this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const { hand } = this.touched() ?? {};
    // If nothing can be touched, any drag turns the view.
    if (!hand) return this.stage.turnByDrag(true);
    if (this.fingers.size === 2 && this.dragging !== undefined && hand.mode === "grasper") {
      event.stopImmediatePropagation();
      this.pinch = { apart: this.apart(), opening: hand.grasper.opening };
      return;
    }
    // A second finger turns the view instead.
    if (this.fingers.size > 1) return this.finish();
    if (event.button !== 0 || this.dragging !== undefined) return;
    const place = this.stage.pick(event.clientX, event.clientY);
    // Beside the tissue a drag turns the view.
    this.stage.turnByDrag(!place);
    if (!place) return;
    this.onPoint();
    if (this.onPlace) return this.onPlace(place);
    this.latency.pressed(event.timeStamp);
    this.canvas.setPointerCapture(event.pointerId);
    this.dragging = event.pointerId;
    this.pointer = [event.clientX, event.clientY];
    this.begin(hand, place);
  }

  private begin(hand: Hand, place: Place): void {
    const { surface } = this.touched() ?? {};
    if (!surface) return;
    // A grasp holds a mass point and begins at that point.
    const held = hand.mode === "pull" ? surface.nearest(place) : place;
    const moved = surface.displacementAt(held);
    const [x, y, z] = held.restM;
    this.from = { place: held, onSurfaceM: [x + moved.x, y + moved.y, z + moved.z] };
    void hand.press(held, this.from.onSurfaceM, this.stage.viewOf(held));
    if (hand.mode === "grasper") hand.onJaws();
  }

  /** Distance of the first two fingers, pixels. */
  private apart(): number {
    const [[ax, ay], [bx, by]] = [...this.fingers.values()] as [[number, number], [number, number]];
    return Math.max(Math.hypot(ax - bx, ay - by), 1);
  }

  /** Moves the jaws of a grasper to a fraction of their largest angle. */
  moveJaws(part: number): void {
    const { hand } = this.touched() ?? {};
    if (hand?.mode !== "grasper") return;
    const { grips } = hand.grasper;
    hand.openJaws(part);
    const { grips: gripsNow, endsM } = hand.grasper;
    if (gripsNow === grips || !this.from || !endsM) return;
    if (gripsNow) {
      // The drag counts from here.
      const onSurfaceM = (this.pointer && this.stage.onFacingPlane(...this.pointer, endsM)) ?? endsM;
      this.from = { place: this.aim ?? this.from.place, onSurfaceM };
    } else if (this.pointer) {
      const place = this.stage.pick(...this.pointer);
      if (place) hand.goOn(place);
    }
  }

  private wheel(event: WheelEvent): void {
    const { hand } = this.touched() ?? {};
    if (!hand || hand.mode !== "grasper" || !hand.touches) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    const by = Math.min(Math.max(-WHEEL.pixel * event.deltaY, -WHEEL.most), WHEEL.most);
    this.moveJaws(hand.grasper.opening + by);
  }

  private moved(event: PointerEvent): void {
    const { hand } = this.touched() ?? {};
    const isMouse = event.pointerType !== "touch";
    if (hand && isMouse && this.dragging === undefined) {
      this.onPoint(event.buttons === 0 ? this.stage.pick(event.clientX, event.clientY) : undefined);
    }
    if (this.fingers.has(event.pointerId)) this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.pinch && this.fingers.size > 1) this.moveJaws((this.pinch.opening * this.apart()) / this.pinch.apart);
    if (event.pointerId !== this.dragging || !hand) return;
    // While one button is down, others come and go as movements.
    if (isMouse && (event.buttons & 1) === 0) return this.finish();
    this.pointer = [event.clientX, event.clientY];
    const isChord = (event.buttons & 2) !== 0;
    if (isChord !== this.isChord) this.moveJaws(isChord ? 0 : OPEN);
    this.isChord = isChord;
    if (glides(hand)) {
      const place = this.stage.pick(event.clientX, event.clientY);
      if (place) hand.goOn(place);
      return;
    }
    if (!this.from) return;
    const at = this.stage.onFacingPlane(event.clientX, event.clientY, this.from.onSurfaceM);
    if (!at) return;
    const [x, y, z] = this.from.onSurfaceM;
    hand.lean([at[0] - x, at[1] - y, at[2] - z]);
  }

  private up(event: PointerEvent): void {
    this.fingers.delete(event.pointerId);
    if (this.fingers.size < 2) this.pinch = undefined;
    if (event.pointerId === this.dragging) this.finish();
  }

  private finish(): void {
    this.dragging = undefined;
    this.from = undefined;
    this.pinch = undefined;
    this.pointer = undefined;
    this.isChord = false;
    this.stage.turnByDrag(false);
    this.touched()?.hand.lift();
  }

  private key(event: KeyboardEvent): void {
    const touched = this.touched();
    if (!touched || event.ctrlKey || event.metaKey || event.altKey) return;
    const { hand, reach } = touched;
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
      const from = this.aim ?? this.first(touched);
      this.aim = touched.surface.beside(from, this.stage.across(from, way).multiplyScalar(reach.lengthM));
      if (hand.touches) this.lead(this.aim, touched);
      this.stage.setAim(this.aim);
    } else if (event.key === " ") {
      if (!event.repeat && !hand.touches) {
        this.aim ??= this.first(touched);
        this.latency.pressed(event.timeStamp);
        this.begin(hand, this.aim);
        // A pull by key lifts the point.
        if (hand.mode === "pull") hand.lean(this.lifted([0, 0, 0], this.aim, touched));
        this.stage.setAim(this.aim);
      }
    } else if (event.key === "c") {
      if (!event.repeat) this.moveJaws(hand.grasper.grips ? OPEN : 0);
    } else if (event.key === "PageUp" || event.key === "PageDown") {
      this.moveJaws(hand.grasper.opening + (event.key === "PageUp" ? JAW_STEP : -JAW_STEP));
    } else if (event.key === "Escape") {
      void hand.letGo();
    } else if (event.key === "Home") {
      this.stage.resetView();
    } else if (event.key === "+" || event.key === "-") {
      this.stage.turn(0, 0, event.key === "+" ? 1.1 : 1 / 1.1);
    } else {
      return;
    }
    event.preventDefault();
  }

  /** Returns the initial target of the keys: the middle of the visible part. */
  private first({ surface }: Touched): Place {
    return (surface.edge ? undefined : this.stage.pickMiddle()) ?? surface.middle();
  }

  /** Returns a displacement, plus the height of a pull in the direction out of the tissue. */
  private lifted([x, y, z]: Vec3, { outward: n }: Place, { hand, reach }: Touched): Vec3 {
    const up = hand.mode === "pull" ? reach.depthM * hand.strength : 0;
    return [x + up * n[0], y + up * n[1], z + up * n[2]];
  }

  /** Arrow keys while Space is down: a stroke or tip moves on, a push leans, a pull moves sideways. */
  private lead(aim: Place, touched: Touched): void {
    if (glides(touched.hand)) return touched.hand.goOn(aim);
    const from = this.from?.place ?? aim;
    const way = new Vector3(...aim.restM).sub(new Vector3(...from.restM));
    touched.hand.lean(this.lifted(way.toArray(), from, touched));
  }
}
