// The grasper: an instrument of two jaws that a hand leads. Its jaws meet the tissue at the place under the pointer,
// and its shaft points out of the tissue and towards the user.
//
// Open jaws glide along the tissue at a depth, as a tip does. Jaws that close hold what is between them, and move with
// the drag, in a plane that faces the user. Their tips are discs, which lie on the tissue, so that friction could not lift
// it: discs at the ends of the jaws hold what they touch when the jaws begin to close.

import { cross, dot, Instrument, type InstrumentFelt, type InstrumentPose, InstrumentTool, norm, plus, rotationTo, unit, type Vec3, type Wanted } from "palpate";
import { InstrumentPart } from "palpate/v1";
import { server } from "./server";
import type { Reach } from "./hand";
import type { Felt } from "./samples";
import type { Place } from "./surface";

/** Radius of a tip, as a fraction of that of a finger. */
const TIP = 0.8;
/** Length of a jaw, and distance of the tips on it, in radii of a tip. */
export const JAW = { length: 4.8, spacing: 1.4 };
/** Radius of a drawn jaw, as a fraction of that of its discs: closed jaws are as wide as these. */
export const DRAWN_RADIUS = 0.5;
/** Angle between open jaws, and the largest, rad. */
const OPEN_RAD = 0.9;
const MAX_RAD = 1.3;
/** Opening of open jaws, as a fraction of the largest angle. */
export const OPEN = OPEN_RAD / MAX_RAD;
/** Jaws that grip let go if they open by this fraction. */
const LETS_GO = 0.04;
const JAW_RAD_PER_S = 2.5;
/** Speed of the grasper, fingers' lengths a second: the tissue that it holds comes along. */
const LENGTHS_PER_S = 40;
/** Directions of the shaft that are tried: out of the tissue, to the right and up, as seen. */
const SHAFTS: readonly Vec3[] = [[0.7, 0.45, -0.55], [0.7, -0.45, -0.55], [0.7, 0.45, 0.5], [1, 0.2, -0.2], [1, 0, 0]];
/** Smallest cosine of the angle between the shaft and the direction out of the tissue. */
const MIN_UPRIGHT = 0.45;

/** The user's view of a place: unit vectors along the tissue to the right and up, and whether a shaft has room. */
export interface View {
  right: Vec3;
  up: Vec3;
  hasRoom: (shaft: Vec3, lengthM: number) => boolean;
}

/** The grasper as drawn. */
export interface ShownGrasper {
  /** Number of its first tool. */
  tool: number;
  pose: InstrumentPose;
  /** Radius of its tips, m. */
  radiusM: number;
  /** Discs lie on the tissue: the drawn jaws are higher by this vector, m. */
  liftM: Vec3;
  forceN: Vec3;
  /** Magnitude of the force, as a fraction of the strongest push. */
  part: number;
}

export class Grasper {
  readonly tool: InstrumentTool;
  /** Angle to which the jaws go, rad. */
  private wantedRad = OPEN_RAD;
  private jawRad = OPEN_RAD;
  private isGripping = false;
  /** Smallest opening since the jaws grip. */
  private least = 0;
  /** Middle between the ends of the jaws, m; absent before the first pose of a touch. */
  endsM: Vec3 | undefined;
  /** Where it gripped; absent while the jaws are open. */
  private grippedM: Vec3 | undefined;
  /** Tips that hold the tissue, and those that felt it last, the strongest force first. */
  private readonly held = new Set<number>();
  /** Whether it held tissue before the touch began anew, and does not yet hold it again. */
  private hasLost = false;
  private feeling: number[] = [];
  private shaft: Vec3 = [0, 0, 1];
  private across: Vec3 = [1, 0, 0];
  private outward: Vec3 = [0, 0, 1];
  private posedMs = 0;
  private pose: InstrumentPose | undefined;
  private readonly radiusM: number;
  private readonly jawM: number;

  constructor(
    sessionId: string,
    name: string,
    private readonly reach: Reach,
    sampleEverySteps: number,
    firstTool: number,
  ) {
    this.radiusM = TIP * reach.lengthM;
    this.jawM = JAW.length * this.radiusM;
    this.tool = new InstrumentTool(server, sessionId, name, this.instrument(), sampleEverySteps, firstTool);
  }

  /** Returns jaws that end at the origin. */
  private instrument(): Instrument {
    const { radiusM } = this;
    const instrument = new Instrument([-this.jawM, 0, 0]);
    for (const [part, side] of [[InstrumentPart.UPPER_JAW, 1], [InstrumentPart.LOWER_JAW, -1]] as const) {
      for (let at = 0; at < this.reach.jawTips; at++) {
        // Closed jaws, as wide as drawn, touch each other.
        instrument.tips.push({ offsetM: [-at * JAW.spacing * radiusM, side * DRAWN_RADIUS * radiusM, 0], tip: { radiusM }, part });
      }
    }
    return instrument;
  }

  /** Whether the jaws hold what is between them: since they closed, until they open. */
  get grips(): boolean {
    return this.isGripping;
  }

  /** Angle to which the jaws go, as a fraction of the largest. */
  get opening(): number {
    return this.wantedRad / MAX_RAD;
  }

  set opening(part: number) {
    const to = Math.min(Math.max(part, 0), 1);
    if (to < this.opening) [this.isGripping, this.least] = [this.tool.touches, to];
    else if (to > this.least + LETS_GO) this.isGripping = false;
    this.wantedRad = to * MAX_RAD;
    this.tool.changed();
  }

  /** Describes this angle. */
  get openingText(): string {
    return `${Math.round((this.wantedRad * 180) / Math.PI)}°`;
  }

  /** Begins to touch a place: turns the shaft to where there is room. */
  begin({ outward }: Place, { right, up, hasRoom }: View): void {
    const shafts = SHAFTS.map(([x, y, z]) => unit(plus(plus(plus([0, 0, 0], outward, x), right, y), up, z)));
    this.shaft = shafts.find((shaft) => hasRoom(shaft, 4 * this.jawM)) ?? outward;
    const across = cross(outward, this.shaft);
    this.across = norm(across) > 1e-3 ? unit(across) : right;
    [this.endsM, this.grippedM, this.pose] = [undefined, undefined, undefined];
    this.held.clear();
    this.hasLost = false;
    this.feeling = [];
    // Jaws that were left closed open.
    if (this.isGripping) this.wantedRad = OPEN_RAD;
    this.isGripping = false;
    this.jawRad = this.wantedRad;
  }

  /**
   * Returns what it does at a time, on its way to a place. `outM` is the height of the jaws' underside above the place at
   * rest, and `hasSunk` whether they are at their depth; `leanM` is the drag since it gripped.
   */
  wanted(place: Place, outM: number, hasSunk: boolean, leanM: Vec3, now: number): Wanted {
    const { restM, outward } = place;
    const passedS = Math.min(Math.max(now - this.posedMs, 0), 50) / 1000;
    this.posedMs = now;
    this.outward = outward;
    // A touch that begins anew grips anew, in the tissue, and moves on once it holds it.
    this.grippedM = this.grips && hasSunk ? (this.grippedM ?? this.endsM) : undefined;
    const restingM = plus(restM, outward, outM);
    const targetM = this.grippedM ? plus(this.grippedM, leanM, this.hasLost ? 0 : 1) : restingM;
    const way = plus(targetM, this.endsM ?? targetM, -1);
    const part = this.endsM ? Math.min(1, (LENGTHS_PER_S * this.reach.lengthM * passedS) / (norm(way) || 1)) : 1;
    const endsM = (this.endsM = plus(targetM, way, part - 1));
    const turn = this.wantedRad - this.jawRad;
    this.jawRad += Math.sign(turn) * Math.min(Math.abs(turn), JAW_RAD_PER_S * passedS);
    this.pose = this.posed(endsM);
    this.hold();
    const leads = this.tool.instrument.leads(this.pose).map((lead, tip) => {
      if (this.held.has(tip)) return { ...lead, grasps: true };
      // The fold between the jaws is higher than other discs, which would press it down.
      const keepsOff = this.held.size === this.mostHeld || (this.held.size > 0 && !this.isEnd(tip));
      return keepsOff ? { ...lead, positionM: plus(lead.positionM, outward, 2 * this.jawM) } : lead;
    });
    return { leads, isMoving: part < 1 || this.jawRad !== this.wantedRad };
  }

  /** Lets the discs at the ends hold what they touch, from when the jaws begin to close. */
  private hold(): void {
    if (!this.grips) this.hasLost = false;
    else if (this.held.size > 0) this.hasLost = !this.grippedM;
    if (!this.grippedM) this.held.clear();
    else for (const tip of this.feeling) if (this.isEnd(tip) && this.held.size < this.mostHeld) this.held.add(tip);
  }

  /**
   * Largest number of discs that hold: one on each jaw. Two on a mesh would meet as the jaws close, and draw the few points
   * between them out to a spike.
   */
  private get mostHeld(): number {
    return this.reach.jawTips > 1 ? 2 : 1;
  }

  private isEnd(tip: number): boolean {
    return this.tool.instrument.tips[tip]!.offsetM[0] === 0;
  }

  /** Returns the pose with the ends of the jaws at a place. */
  private posed(endsM: Vec3): InstrumentPose {
    // On another side of an organ the shaft turns, so that it stays outside.
    const upright = dot(this.shaft, this.outward);
    const shaft = upright < MIN_UPRIGHT ? unit(plus(this.shaft, this.outward, MIN_UPRIGHT - upright)) : this.shaft;
    const x = plus([0, 0, 0], shaft, -1);
    const y = unit(plus(this.across, x, -dot(this.across, x)));
    // Open jaws are shorter than closed ones.
    const shorterM = this.jawM * (1 - Math.cos(this.jawRad / 2));
    return { positionM: plus(endsM, x, shorterM), orientation: rotationTo(x, y, cross(x, y)), jawRad: this.jawRad };
  }

  /** Returns what it feels, by the samples of its tips. */
  felt(tools: readonly Felt[]): InstrumentFelt | undefined {
    const feeling = tools.filter(({ forceN }) => norm(forceN) > 0).sort((a, b) => norm(b.forceN) - norm(a.forceN));
    this.feeling = feeling.map(({ tool }) => tool - this.tool.tool);
    return this.pose && this.tool.felt(this.pose, tools.map(({ tool, forceN }) => [tool, forceN] as const));
  }

  /** Returns how it is drawn with a force on it; undefined while it does not touch. */
  shown(forceN: Vec3, part: number): ShownGrasper | undefined {
    if (!this.pose || !this.tool.touches) return undefined;
    const { pose, radiusM } = this;
    const liftM = plus([0, 0, 0], this.outward, DRAWN_RADIUS * radiusM);
    return { tool: this.tool.tool, pose, radiusM, liftM, forceN, part };
  }
}
