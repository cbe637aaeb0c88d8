// The poses of a tool in a datagram: the newest, and by their differences those before it, which may have been lost.

import type { MessageInitShape } from "@bufbuild/protobuf";
import type { EarlierPoseSchema, PoseSchema, ToolPosesSchema } from "./gen/palpate/v1/haptic_pb.js";
import type { Vec3 } from "./vector.js";

/** Poses before the newest. */
const MAX_EARLIER = 8;
/** What is farther away has no place in the message, nm. */
const FAR_NM = 1e10;

/** Where the tip is led. */
export interface Lead {
  positionM: Vec3;
  radiusM: number;
}

/** One pose that was sent. */
interface Posed {
  sequence: bigint;
  timeNs: bigint;
  positionM: Vec3;
}

/** A pose as a message. */
export function poseOf({ positionM: [x, y, z], radiusM }: Lead): MessageInitShape<typeof PoseSchema> {
  return { positionM: { x, y, z }, tip: { radiusM } };
}

/** The newest poses of one tool, with one tip. */
export class Poses {
  /** Newest first. */
  private recent: Posed[] = [];

  /** The sequence of the next. */
  private sequence: bigint;

  constructor(
    private readonly tool: number,
    private readonly first: bigint,
  ) {
    this.sequence = first;
  }

  /** Whether a sequence is of one of these. */
  has(sequence: bigint): boolean {
    return sequence >= this.first && sequence < this.sequence;
  }

  /** Adds a pose at the client's time `timeNs`, which rises. */
  message(lead: Lead, timeNs: bigint): MessageInitShape<typeof ToolPosesSchema> {
    const newest = { sequence: this.sequence, timeNs, positionM: lead.positionM };
    const earlier = this.recent.flatMap((before) => earlierPose(newest, before));
    this.recent = [newest, ...this.recent].slice(0, MAX_EARLIER);
    this.sequence += 1n;
    return { tool: this.tool, sequence: newest.sequence, clientTimeNs: timeNs, pose: poseOf(lead), earlier };
  }
}

/** By how much `before` differs from the newest; nothing if it can't be told. */
function earlierPose(newest: Posed, before: Posed): MessageInitShape<typeof EarlierPoseSchema>[] {
  const awayNm = newest.positionM.map((v, i) => Math.round((v - before.positionM[i]!) * 1e9));
  if (!awayNm.every((nm) => Math.abs(nm) < FAR_NM)) return [];
  const [xNm, yNm, zNm] = awayNm.map(BigInt);
  const sequences = Number(newest.sequence - before.sequence);
  return [{ sequences, clientTimeNs: newest.timeNs - before.timeNs, xNm, yNm, zNm }];
}
