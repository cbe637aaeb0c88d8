// The poses of a tool in a datagram: the newest, and the differences to those before it, which may have been lost.

import type { MessageInitShape } from "@bufbuild/protobuf";
import type { EarlierPoseSchema, PoseSchema, TipShape, ToolPosesSchema } from "./gen/palpate/v1/haptic_pb.js";
import type { Vec3 } from "./vector.js";

/** Maximum number of poses before the newest: of a tool, and of all tools in a datagram, which has room for so many. */
const MAX_EARLIER = 8;
const MAX_EARLIER_OF_ALL = 24;
/** Maximum number of tools in a datagram. */
export const MAX_POSED = 6;
/** Largest difference that fits into the message, nm. */
const FAR_NM = 1e10;

/** The tip of a tool. */
export interface Tip {
  radiusM: number;
  /** μ of Coulomb's friction; 0.2 if absent. */
  friction?: number;
  /** A disc of even pressure if absent. Rigid tips touch solids alone; a blade cuts sheets and surfaces. */
  shape?: TipShape;
  /** The edge of a blade from the tip, which is the tool's place, to its heel, m: in the frame of the tissue, or of the instrument. */
  edgeM?: Vec3;
  /** The time of contact after which a tip that is no blade severs what lies under it, s (cautery). It does not burn if absent. */
  burnS?: number;
  /** Whether it holds the tissue, and pulls as well as pushes; else it touches. Discs only. */
  grasps?: boolean;
}

/** Target of a tip. */
export interface Lead extends Tip {
  positionM: Vec3;
}

/** A pose that was sent. */
interface Posed {
  sequence: bigint;
  timeNs: bigint;
  positionM: Vec3;
}

/** Converts a pose to a message. */
export function poseOf({ positionM: [x, y, z], radiusM, friction, shape, grasps, edgeM, burnS }: Lead): MessageInitShape<typeof PoseSchema> {
  const edge = edgeM && { x: edgeM[0], y: edgeM[1], z: edgeM[2] };
  return { positionM: { x, y, z }, tip: { radiusM, friction, shape, grasps, edgeM: edge, burnS } };
}

/** The newest poses of a tool with a single tip. */
export class Poses {
  /** Newest first. */
  private recent: Posed[] = [];
  private readonly maxEarlier: number;
  /** Whether those grasp, the edge of their blade, and whether they burn: earlier poses have the same tip. */
  private grasps = false;
  private edgeM = "";
  private burnS = 0;

  /** Sequence of the next pose. */
  private sequence: bigint;

  /** `ofAll`: the number of tools whose poses go together. */
  constructor(
    private readonly tool: number,
    private readonly first: bigint,
    ofAll = 1,
  ) {
    this.sequence = first;
    this.maxEarlier = Math.min(MAX_EARLIER, Math.floor(MAX_EARLIER_OF_ALL / Math.min(ofAll, MAX_POSED)));
  }

  /** Returns whether a sequence belongs to one of these poses. */
  has(sequence: bigint): boolean {
    return sequence >= this.first && sequence < this.sequence;
  }

  /** Adds a pose at the client's time `timeNs`, which must increase. Returns the message. */
  message(lead: Lead, timeNs: bigint): MessageInitShape<typeof ToolPosesSchema> {
    const grasps = lead.grasps ?? false;
    const edgeM = String(lead.edgeM);
    const burnS = lead.burnS ?? 0;
    if (grasps !== this.grasps || edgeM !== this.edgeM || burnS !== this.burnS) {
      [this.grasps, this.edgeM, this.burnS, this.recent] = [grasps, edgeM, burnS, []];
    }
    const newest = { sequence: this.sequence, timeNs, positionM: lead.positionM };
    const earlier = this.recent.flatMap((before) => earlierPose(newest, before));
    this.recent = [newest, ...this.recent].slice(0, this.maxEarlier);
    this.sequence += 1n;
    return { tool: this.tool, sequence: newest.sequence, clientTimeNs: timeNs, pose: poseOf(lead), earlier };
  }
}

/** Returns how `before` differs from the newest pose; empty if the difference can't be encoded. */
function earlierPose(newest: Posed, before: Posed): MessageInitShape<typeof EarlierPoseSchema>[] {
  const awayNm = newest.positionM.map((v, i) => Math.round((v - before.positionM[i]!) * 1e9));
  if (!awayNm.every((nm) => Math.abs(nm) < FAR_NM)) return [];
  const [xNm, yNm, zNm] = awayNm.map(BigInt);
  const sequences = Number(newest.sequence - before.sequence);
  return [{ sequences, clientTimeNs: newest.timeNs - before.timeNs, xNm, yNm, zNm }];
}
