// A drag: what a pointer or the keys do with a hand, from where they began.

import { plus, type Vec3 } from "palpate";
import type { Hand } from "./hand";
import type { Stage } from "./stage";
import type { Place, Surface } from "./surface";

/** Returns whether the tool moves to the places under the drag. */
export function glides({ mode, grasper }: Hand): boolean {
  return mode === "stroke" || mode === "tip" || mode === "blade" || mode === "cautery" || (mode === "grasper" && !grasper.grips);
}

export class Drag {
  /** The pointer that leads, or the keys; undefined if the hand is left to itself. */
  leader: number | "keys" | undefined;
  /** Where the pointer is in the window. */
  pointer: [number, number] | undefined;
  /** Whether the right button is down beside the left one. */
  isChord = false;
  /** Start of the drag: the place, the position of the tissue there, and how far the hand leaned. */
  private from!: { place: Place; onSurfaceM: Vec3; leaningM: Vec3 };
  /** Whether the touch began with this drag. */
  private isAnew = true;

  constructor(
    readonly hand: Hand,
    private readonly stage: Stage,
    private readonly surface: () => Surface,
  ) {}

  /** Begins at a place: touches it, or moves on what the hand holds. */
  begin(place: Place, leader: number | "keys", pointer?: [number, number]): void {
    const hand = this.hand;
    const surface = this.surface();
    [this.leader, this.pointer, this.isChord] = [leader, pointer, false];
    this.isAnew = !hand.holdsTissue;
    if (!this.isAnew) return this.restart(place, hand.leaningM);
    const stays = hand.isParked;
    // A parked tool that holds nothing is taken to the other place.
    if (stays) hand.tool.rest();
    // A pull holds a mass point and begins at that point.
    const held = hand.mode === "pull" ? surface.nearest(place) : place;
    const moved = surface.displacementAt(held);
    const [x, y, z] = held.restM;
    this.from = { place, onSurfaceM: [x + moved.x, y + moved.y, z + moved.z], leaningM: [0, 0, 0] };
    void hand.press(held, this.from.onSurfaceM, this.stage.viewOf(held));
    if (stays) hand.isParked = true;
    if (hand.mode === "grasper") hand.onJaws();
  }

  /** Counts the drag from here. */
  private restart(place: Place, leaningM: Vec3): void {
    const { heldM } = this.hand;
    this.from = { place, onSurfaceM: (this.pointer && this.stage.onFacingPlane(...this.pointer, heldM)) ?? heldM, leaningM };
  }

  /** Follows the pointer. */
  moveTo(x: number, y: number): void {
    const { hand, stage } = this;
    this.pointer = [x, y];
    if (glides(hand)) {
      const place = stage.pick(x, y);
      if (place) hand.goOn(place);
      return;
    }
    const at = stage.onFacingPlane(x, y, this.from.onSurfaceM);
    if (at) hand.lean(plus(plus(this.from.leaningM, at), this.from.onSurfaceM, -1));
  }

  /** Follows the target of the keys. A touch that they began is higher by `liftM`. */
  aimAt(aim: Place, liftM: number): void {
    const { place, leaningM } = this.from;
    if (glides(this.hand)) return this.hand.goOn(aim);
    const way = plus(aim.restM, place.restM, -1);
    this.hand.lean(plus(plus(leaningM, way), place.outward, this.isAnew ? liftM : 0));
  }

  /** Opens the jaws to a fraction of their largest angle. `aim` is the target of the keys, if they lead. */
  moveJaws(part: number, aim?: Place): void {
    const { hand, stage } = this;
    const { grips } = hand.grasper;
    hand.openJaws(part);
    const { grips: gripsNow, endsM } = hand.grasper;
    if (gripsNow === grips || !endsM) return;
    if (gripsNow) return this.restart(aim ?? this.from.place, [0, 0, 0]);
    // Open jaws go to the tissue beneath them.
    const place = stage.pick(...(this.pointer ?? stage.inWindow(endsM)));
    if (place) hand.goOn(place);
  }
}
