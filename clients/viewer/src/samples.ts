// What the tools feel: the newest sample, and those of the last seconds.

import type { GridPoint, Vector3 } from "./gen/palpate/v1/geometry_pb";
import type { Sample } from "./gen/palpate/v1/haptic_pb";
import { type Failure, haptics, keepOpen } from "./server";

export type Vec3 = [number, number, number];

export function vec(v: Vector3 | undefined): Vec3 {
  return v ? [v.x, v.y, v.z] : [0, 0, 0];
}

export function norm([x, y, z]: Vec3): number {
  return Math.hypot(x, y, z);
}

/** A tool at the end of a step. */
export interface Felt {
  tool: number;
  /** The control point, in the grid. */
  point: GridPoint | undefined;
  displacementM: Vec3;
  forceN: Vec3;
  appliedN: Vec3;
}

/** A moment of the plots. */
export interface Moment {
  timeS: number;
  displacementM: Vec3;
  forceN: Vec3;
}

/** Samples a second: more than a screen shows, fewer than matter to a network. */
const RATE_HZ = 100;

/** What plots show, s. */
export const HISTORY_S = 6;

/** A tool touches if there is more force, as a part of the strongest push. */
const FELT = 0.01;

export class Samples {
  newest: Sample | undefined;
  /** Those that touch. */
  tools: Felt[] = [];
  readonly history: Moment[] = [];
  onSample: (sample: Sample) => void = () => {};

  constructor(private readonly mostN: number) {}

  /** Reads until it is aborted. */
  run(
    sessionId: string,
    stepRateHz: number,
    signal: AbortSignal,
    onFailure: (failure: Failure, waitMs: number) => void,
  ): Promise<void> {
    const sampleEverySteps = Math.max(1, Math.round(stepRateHz / RATE_HZ));
    return keepOpen(
      async (signal, alive) => {
        for await (const { sample } of haptics.watchSamples({ sessionId, sampleEverySteps }, { signal })) {
          alive();
          if (sample) this.take(sample);
        }
      },
      signal,
      onFailure,
    );
  }

  private take(sample: Sample): void {
    this.newest = sample;
    const felt = sample.tools
      .filter((tool) => tool.point !== undefined)
      .map((tool) => ({
        tool: tool.tool,
        point: tool.point,
        displacementM: vec(tool.displacementM),
        forceN: vec(tool.forceOnToolN),
        appliedN: vec(tool.appliedForceN),
      }));
    // A tool that has let go is told of as long as its place still moves: the plots show how it comes to rest.
    const least = FELT * this.mostN;
    this.tools = felt.filter((tool) => norm(tool.appliedN) > least || norm(tool.forceN) > least);
    const timeS = sample.simulationTimeS;
    const first = this.tools[0] ?? felt[0];
    if (first) this.history.push({ timeS, displacementM: first.displacementM, forceN: first.forceN });
    // A gap of a second or more is seen as one, and the past goes.
    while (this.history.length > 0 && this.history[0]!.timeS < timeS - HISTORY_S) this.history.shift();
    this.onSample(sample);
  }
}
