// Mouse, fingers and keys on the tissue.

import { Drag } from "./drag";
import { OPEN } from "./grasper";
import type { Hand, Reach } from "./hand";
import type { Hands } from "./hands";
import type { Latency } from "./latency";
import type { Stage } from "./stage";
import { sews, type Sewing } from "./sewing";
import type { Place, Surface } from "./surface";

/** What the user can touch. */
export interface Touched {
  hands: Hands;
  surface: Surface;
  reach: Reach;
}

/** Rotation of the view per key press, radians. */
const TURN = 0.08;
/** Opening of the jaws per pixel of the wheel, per event at most, and per key press. */
const WHEEL = { pixel: 0.0015, most: 0.15 };
const JAW_STEP = 0.15;
/** A press that moves by less is a tap, pixels. */
const TAP_PX = 8;

export class Input {
  /** If set, gets the next press on the tissue instead of a touch. */
  onPlace: ((place: Place) => void) | undefined;
  /** Gets what picks the places of a thread or clip, instead of a touch. */
  sewing: Sewing | undefined;
  /** A press that picks a place when it ends where it began: a drag turns the view. */
  private tap: { pointer: number; at: [number, number]; place: Place } | undefined;
  /** Called with the place under a pointer that does not touch, and without a place when it leaves. */
  onPoint: (place?: Place) => void = () => {};
  /** The newest drag of each hand; also of a parked one, which nothing leads. */
  private readonly drags = new Map<Hand, Drag>();
  private readonly fingers = new Map<number, [number, number]>();
  /** A finger that moves the jaws: its drag, and its distance and the opening of the jaws when it came. */
  private pinch: { finger: number; drag: Drag; apart: number; opening: number } | undefined;
  private aim: Place | undefined;

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
      if (event.key === " ") this.end(this.ledBy("keys"));
    });
    canvas.addEventListener("blur", () => {
      this.aim = undefined;
      this.stage.setAim(undefined);
      this.end(this.ledBy("keys"));
    });
  }

  private ledBy(leader: number | "keys"): Drag | undefined {
    return [...this.drags.values()].find((drag) => drag.leader === leader);
  }

  /** The drags of pointers. */
  private get dragging(): Drag[] {
    return [...this.drags.values()].filter(({ leader }) => typeof leader === "number");
  }

  private down(event: PointerEvent): void {
    const isFinger = event.pointerType === "touch";
    if (isFinger) this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const { hands } = this.touched() ?? {};
    // If nothing can be touched, any drag turns the view.
    if (!hands) return this.stage.turnByDrag(true);
    const [leading] = this.dragging;
    if (leading && (hands.isTwo || (this.fingers.size === 2 && leading.hand.mode === "grasper"))) {
      event.stopImmediatePropagation();
      if (!hands.isTwo || !this.beginBeside(hands, event)) this.beginPinch(leading, event);
      return;
    }
    this.tap = undefined;
    // A second finger turns the view instead.
    if (this.fingers.size > 1) return this.finish();
    if (event.button !== 0 || leading) return;
    const place = this.stage.pick(event.clientX, event.clientY);
    // Beside the tissue a drag turns the view.
    const isTap = place !== undefined && !this.onPlace && sews(hands.chosen.mode);
    this.stage.turnByDrag(!place || isTap);
    if (!place) return;
    this.onPoint();
    if (isTap) {
      this.tap = { pointer: event.pointerId, at: [event.clientX, event.clientY], place };
      return;
    }
    if (this.onPlace) return this.onPlace(place);
    this.latency.pressed(event.timeStamp);
    this.lead(hands.chosen, place, event);
  }

  /** While a pointer leads one hand, another one leads the other. Returns false if it is beside the tissue, or neither is free. */
  private beginBeside(hands: Hands, event: PointerEvent): boolean {
    const free = [hands.chosen, hands.other].find((hand) => typeof this.drags.get(hand)?.leader !== "number");
    const place = free && event.button === 0 ? this.stage.pick(event.clientX, event.clientY) : undefined;
    if (place && free) this.lead(free, place, event);
    return place !== undefined;
  }

  private lead(hand: Hand, place: Place, { pointerId, clientX, clientY }: PointerEvent): void {
    this.canvas.setPointerCapture(pointerId);
    this.begin(hand, place, pointerId, [clientX, clientY]);
  }

  private begin(hand: Hand, place: Place, leader: number | "keys", pointer?: [number, number]): void {
    const { surface, hands } = this.touched() ?? {};
    if (!surface || !hands) return;
    // Hands of a session that is left.
    for (const old of this.drags.keys()) if (!hands.both.includes(old)) this.drags.delete(old);
    const drag = this.drags.get(hand) ?? new Drag(hand, this.stage, () => this.touched()?.surface ?? surface);
    this.drags.set(hand, drag);
    drag.begin(place, leader, pointer);
  }

  /** Another finger moves the jaws of the grasper that a finger leads. */
  private beginPinch(drag: Drag, { pointerId, pointerType }: PointerEvent): void {
    if (pointerType !== "touch" || drag.hand.mode !== "grasper" || this.pinch) return;
    this.pinch = { finger: pointerId, drag, apart: this.apart(pointerId, drag), opening: drag.hand.grasper.opening };
  }

  /** Distance of a finger from the pointer of a drag, pixels. */
  private apart(finger: number, { pointer }: Drag): number {
    const [[ax, ay], [bx, by]] = [this.fingers.get(finger) ?? [0, 0], pointer ?? [0, 0]];
    return Math.max(Math.hypot(ax - bx, ay - by), 1);
  }

  /** Moves the jaws of the chosen hand's grasper to a fraction of their largest angle. */
  moveJaws(part: number): void {
    const { hands } = this.touched() ?? {};
    if (hands?.chosen.mode !== "grasper") return;
    const drag = this.drags.get(hands.chosen);
    if (drag) drag.moveJaws(part, this.aim);
    else hands.chosen.openJaws(part);
  }

  /** Closes the jaws of the chosen hand's grasper, or opens closed ones. */
  turnJaws(): void {
    const { hands } = this.touched() ?? {};
    if (hands) this.moveJaws(hands.chosen.grasper.grips ? OPEN : 0);
  }

  /** Parks the chosen hand's tool, and chooses the other hand; or ends the stay of a parked one. */
  park(): void {
    const { hands } = this.touched() ?? {};
    if (!hands) return;
    const drag = this.drags.get(hands.chosen);
    hands.park();
    // A pointer that is still down leads it no longer.
    if (drag?.hand.isParked) this.leave(drag);
  }

  /** The pointer or the keys no longer lead a hand. */
  private leave(drag: Drag): void {
    [drag.leader, drag.pointer, drag.isChord] = [undefined, undefined, false];
    if (this.pinch?.drag === drag) this.pinch = undefined;
  }

  private wheel(event: WheelEvent): void {
    const drag = this.dragging[0] ?? this.ledBy("keys");
    if (drag?.hand.mode !== "grasper" || !drag.hand.touches) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    const by = Math.min(Math.max(-WHEEL.pixel * event.deltaY, -WHEEL.most), WHEEL.most);
    drag.moveJaws(drag.hand.grasper.opening + by);
  }

  private moved(event: PointerEvent): void {
    const { pointerId, clientX, clientY, buttons } = event;
    const isMouse = event.pointerType !== "touch";
    if (isMouse && this.touched() && this.dragging.length === 0) {
      this.onPoint(buttons === 0 ? this.stage.pick(clientX, clientY) : undefined);
    }
    if (this.fingers.has(pointerId)) this.fingers.set(pointerId, [clientX, clientY]);
    const { pinch } = this;
    if (pinch && [pinch.finger, pinch.drag.leader].includes(pointerId)) {
      if (pointerId === pinch.drag.leader) pinch.drag.pointer = [clientX, clientY];
      pinch.drag.moveJaws((pinch.opening * this.apart(pinch.finger, pinch.drag)) / pinch.apart);
    }
    const drag = this.ledBy(pointerId);
    if (!drag || !this.touched()) return;
    // While one button is down, others come and go as movements.
    if (isMouse && (buttons & 1) === 0) return this.end(drag);
    if (isMouse && (buttons & 4) !== 0 && drag.hand === this.touched()?.hands.chosen) return this.park();
    drag.pointer = [clientX, clientY];
    const isChord = (buttons & 2) !== 0;
    if (isChord !== drag.isChord && drag.hand.mode === "grasper") drag.moveJaws(isChord ? 0 : OPEN);
    drag.isChord = isChord;
    drag.moveTo(clientX, clientY);
  }

  private up({ pointerId, type, clientX, clientY }: PointerEvent): void {
    const { tap } = this;
    if (tap?.pointer === pointerId) {
      this.tap = undefined;
      this.stage.turnByDrag(false);
      const isStill = Math.hypot(clientX - tap.at[0], clientY - tap.at[1]) < TAP_PX;
      if (type === "pointerup" && isStill) this.sewing?.pick(tap.place);
    }
    this.fingers.delete(pointerId);
    if (this.pinch?.finger === pointerId) this.pinch = undefined;
    this.end(this.ledBy(pointerId));
  }

  /** Ends a drag: lifts the hand, unless its tool is parked. */
  private end(drag: Drag | undefined): void {
    if (!drag) return;
    const isPointer = typeof drag.leader === "number";
    this.leave(drag);
    if (isPointer) this.stage.turnByDrag(false);
    drag.hand.lift();
    if (!drag.hand.touches) this.drags.delete(drag.hand);
  }

  /** Ends the drags of all pointers. */
  private finish(): void {
    this.pinch = undefined;
    this.stage.turnByDrag(false);
    for (const drag of this.dragging) this.end(drag);
  }

  private key(event: KeyboardEvent): void {
    const touched = this.touched();
    if (!touched || event.ctrlKey || event.metaKey || event.altKey) return;
    const { hands, reach } = touched;
    const byKeys = this.ledBy("keys");
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
      byKeys?.aimAt(this.aim, this.liftM(touched));
      this.stage.setAim(this.aim);
    } else if (event.key === " ") {
      const hand = hands.chosen;
      if (sews(hand.mode)) {
        this.aim ??= this.first(touched);
        this.stage.setAim(this.aim);
        if (!event.repeat) this.sewing?.pick(this.aim);
      } else if (!event.repeat && !byKeys && (!hand.touches || hand.isParked)) {
        this.aim ??= this.first(touched);
        this.latency.pressed(event.timeStamp);
        this.begin(hand, this.aim, "keys");
        this.ledBy("keys")?.aimAt(this.aim, this.liftM(touched));
        this.stage.setAim(this.aim);
      }
    } else if (event.key === "c") {
      if (!event.repeat) this.turnJaws();
    } else if (event.key === "p") {
      if (!event.repeat) this.park();
    } else if (event.key === "1" || event.key === "2") {
      hands.choose(event.key === "1" ? 0 : 1);
    } else if (event.key === "PageUp" || event.key === "PageDown") {
      this.moveJaws(hands.chosen.grasper.opening + (event.key === "PageUp" ? JAW_STEP : -JAW_STEP));
    } else if (event.key === "Enter" && sews(hands.chosen.mode)) {
      if (!event.repeat) void this.sewing?.lay();
    } else if (event.key === "Backspace" && sews(hands.chosen.mode)) {
      this.sewing?.unpick();
    } else if (event.key === "Escape") {
      if (!this.sewing?.drop()) void hands.chosen.letGo();
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

  /** Returns the height of a pull by keys, m. */
  private liftM({ hands: { chosen }, reach }: Touched): number {
    return chosen.mode === "pull" ? reach.depthM * chosen.strength : 0;
  }
}
