// Instruments: rigid sets of tips that one pose moves, some of them on two jaws.
//
// Frame. An instrument has a frame of its own, whose origin is the place of its pose. It points along x: the shaft runs
// along −x, and jaws run from their hinge along x. They turn about the axis along z through the hinge, each by half of
// the angle between them: the upper jaw towards y, the lower one towards −y. The server has the same frame
// (docs/touching.md, "Instruments").
//
// Forces. The force of a tip acts at the tip's place.

import { InstrumentPart, TipShape } from "./gen/palpate/v1/haptic_pb.js";
import type { Lead, Tip } from "./poses.js";
import { cross, dot, norm, plus, rotated, type Rotation, type Vec3 } from "./vector.js";

/** Largest number of tips of an instrument. */
export const MAX_TIPS = 64;

/** A tip of an instrument. */
export interface InstrumentTip {
  /** Place in the instrument's frame, m; on a jaw, that while the jaws are closed. */
  offsetM: Vec3;
  tip: Tip;
  part: InstrumentPart;
}

/** Where an instrument is. */
export interface InstrumentPose {
  /** Place of the instrument's origin, m. */
  positionM: Vec3;
  /** Turns vectors of the instrument's frame into the tissue's. */
  orientation: Rotation;
  /** Angle between the jaws, rad, 0 while they are closed. */
  jawRad: number;
}

/** A force on an instrument, and its torque about the place of the pose. */
export interface Wrench {
  forceN: Vec3;
  torqueNM: Vec3;
}

/** Forces on the tips of an instrument, N, by the numbers of the tips; absent ones are 0. */
export type TipForces = readonly (Vec3 | undefined)[];

/** A row of equal tips. */
export interface Row extends Tip {
  lengthM: number;
  /** Largest distance of neighbours, m; a radius if absent. */
  spacingM?: number;
}

export class Instrument {
  readonly tips: InstrumentTip[] = [];

  /** `hingeM`: the hinge of the jaws in the instrument's frame. */
  constructor(readonly hingeM: Vec3 = [0, 0, 0]) {}

  /** Adds a row of equal tips between two places of the instrument's frame: a capsule, if they are a radius apart. */
  addRow(fromM: Vec3, toM: Vec3, tip: Tip, part: InstrumentPart, spacingM = tip.radiusM): this {
    const way = plus(toM, fromM, -1);
    const gaps = Math.min(Math.ceil(norm(way) / spacingM), MAX_TIPS);
    for (let at = 0; at <= gaps; at++) this.tips.push({ offsetM: plus(fromM, way, at / Math.max(gaps, 1)), tip, part });
    return this;
  }

  /** Returns the place of a tip by its number. */
  tipM(number: number, { positionM, orientation, jawRad }: InstrumentPose): Vec3 {
    const { offsetM, part } = this.tips[number]!;
    const turn = jawTurn(part, { jawRad });
    const inFrameM = turn.z === 0 ? offsetM : plus(this.hingeM, rotated(turn, plus(offsetM, this.hingeM, -1)));
    return plus(positionM, rotated(orientation, inFrameM));
  }

  /** Returns the target of each tip at a pose. */
  leads(pose: InstrumentPose): Lead[] {
    return this.tips.map(({ tip, part }, number) => {
      const edgeM = tip.edgeM && rotated(pose.orientation, rotated(jawTurn(part, pose), tip.edgeM));
      return { ...tip, ...(edgeM && { edgeM }), positionM: this.tipM(number, pose) };
    });
  }

  /** Returns the sum of forces on the tips and of their torques. */
  wrench(pose: InstrumentPose, forcesN: TipForces): Wrench {
    return forcesN.reduce<Wrench>(
      ({ forceN, torqueNM }, force, number) => {
        if (!force) return { forceN, torqueNM };
        const armM = plus(this.tipM(number, pose), pose.positionM, -1);
        return { forceN: plus(forceN, force), torqueNM: plus(torqueNM, cross(armM, force)) };
      },
      { forceN: [0, 0, 0], torqueNM: [0, 0, 0] },
    );
  }

  /**
   * Returns the torque with which forces on the tips open the jaws, N·m: half the difference of the torques on both jaws
   * about their hinge, so that its product with the angle's velocity is their power.
   */
  openingNM(pose: InstrumentPose, forcesN: TipForces): number {
    const axis = rotated(pose.orientation, [0, 0, 1]);
    const hingeM = plus(pose.positionM, rotated(pose.orientation, this.hingeM));
    return forcesN.reduce<number>((sum, force, number) => {
      if (!force) return sum;
      return sum + turnOf(this.tips[number]!.part) * dot(cross(plus(this.tipM(number, pose), hingeM, -1), force), axis);
    }, 0);
  }
}

/**
 * Returns a grasper as `[[instrument]]` of a script has it: the jaws end at the origin, and the shaft runs from their
 * hinge along −x. Spheres of closed jaws touch each other; discs, which lie on the surface, meet in the middle.
 */
export function grasper(jaws: Row, shaft?: Row): Instrument {
  const instrument = new Instrument([-jaws.lengthM, 0, 0]);
  const beginM = Math.min(2 * jaws.radiusM, jaws.lengthM) - jaws.lengthM;
  for (const [part, side] of [[InstrumentPart.UPPER_JAW, 1], [InstrumentPart.LOWER_JAW, -1]] as const) {
    const besideM = jaws.shape === TipShape.SPHERE ? side * jaws.radiusM : 0;
    instrument.addRow([beginM, besideM, 0], [0, besideM, 0], tipOf(jaws), part, jaws.spacingM);
  }
  if (shaft) {
    const toM: Vec3 = [-jaws.lengthM - shaft.lengthM, 0, 0];
    instrument.addRow(instrument.hingeM, toM, tipOf(shaft), InstrumentPart.BODY, shaft.spacingM);
  }
  return instrument;
}

/** Returns a blade whose edge runs from its tip, at the origin, along −x. `radiusM` is how far around the edge the surface is felt. */
export function knife(lengthM: number, radiusM = 0.001): Instrument {
  const instrument = new Instrument();
  instrument.tips.push({ offsetM: [0, 0, 0], tip: { radiusM, shape: TipShape.BLADE, edgeM: [-lengthM, 0, 0] }, part: InstrumentPart.BODY });
  return instrument;
}

function tipOf({ radiusM, friction, shape, grasps }: Tip): Tip {
  return { radiusM, friction, shape, grasps };
}

/** Returns how a part is turned about the axis of the jaws. */
function jawTurn(part: InstrumentPart, { jawRad }: Pick<InstrumentPose, "jawRad">): Rotation {
  const half = (turnOf(part) * jawRad) / 2;
  return { w: Math.cos(half), x: 0, y: 0, z: Math.sin(half) };
}

/** Returns how far a part turns about the hinge for each radian between the jaws. */
function turnOf(part: InstrumentPart): number {
  if (part === InstrumentPart.UPPER_JAW) return 0.5;
  return part === InstrumentPart.LOWER_JAW ? -0.5 : 0;
}
