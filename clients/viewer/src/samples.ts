// Samples of the tools: the newest, and those of the last seconds.

import type { GridPoint, Sample, ToolSample } from "palpate/v1";
import { norm, vec, type Vec3, watchSamples } from "palpate";
import { type Failure, server } from "./server";

/** The sample of a tool at the end of a step. */
export interface Felt {
  tool: number;
  /** The control point: its indices in the grid of a sheet, or its index in the file of a mesh. */
  point: GridPoint | undefined;
  vertex: number | undefined;
  displacementM: Vec3;
  forceN: Vec3;
  appliedN: Vec3;
  /** Torque that opens the jaws, if it is a grasper with its jaws closed, N·m. */
  openingNM?: number;
}

/** What a tool feels, relative to the direction out of the tissue at its place. */
export interface Told {
  /** Displacement of the control point: into the tissue, and sideways. */
  deepM: number;
  asideM: number;
  /** Force of the tissue on the tool: out of the tissue, sideways, and its magnitude. */
  outN: number;
  acrossN: number;
  allN: number;
  /** Torque of the tissue that opens closed jaws, N·m. */
  openingNM?: number;
}

/** One moment in the plots. */
export interface Moment extends Told {
  /** The tool that is told of. */
  tool: number;
  timeS: number;
  displacementM: Vec3;
}

/**
 * How to interpret samples of a tool: the direction out of the tissue at the tool, and the factor for displayed
 * forces.
 */
export interface Sense {
  outward: Vec3;
  share: number;
}

/** Samples per second: more than a screen shows, but few enough for any network. */
const RATE_HZ = 100;

/** Steps between two samples. */
export function sampleEvery(stepRateHz: number): number {
  return Math.max(1, Math.round(stepRateHz / RATE_HZ));
}

/** Length of the plots, s. */
export const HISTORY_S = 6;

/** Maximum number of moments in the plots, and of tools in a sample. */
const MAX_MOMENTS = 8 * HISTORY_S * RATE_HZ;
const MAX_TOOLS = 256;

/** A tool counts as touching above this fraction of the strongest push. */
const FELT = 0.01;

export class Samples {
  newest: Sample | undefined;
  /** The tools that touch. */
  tools: Felt[] = [];
  readonly history: Moment[] = [];
  onSample: (sample: Sample) => void = () => {};
  /** The newest sample of each tool, and its step: datagrams bring those of one hand's tools only. */
  private readonly latest = new Map<number, { step: bigint; sample: ToolSample }>();

  /** Forces of the tissue on a tool that are worth showing are at least about a hundredth of `pointN`. */
  constructor(
    private readonly pointN: number,
    private readonly sense: (tool: Felt) => Sense,
    /** Returns the tools to show, with those of an instrument as one. */
    private readonly joined: (tools: Felt[]) => Felt[],
  ) {}

  /** Converts a tool's sample to the directions of the place that it touches. */
  tell(tool: Felt): Told {
    const { outward: n, share } = this.sense(tool);
    const [u, f] = [tool.displacementM, tool.forceN];
    const along = (v: Vec3) => v[0] * n[0] + v[1] * n[1] + v[2] * n[2];
    const across = (v: Vec3) => norm([v[0] - along(v) * n[0], v[1] - along(v) * n[1], v[2] - along(v) * n[2]]);
    return { deepM: -along(u), asideM: across(u), outN: share * along(f), acrossN: share * across(f), allN: share * norm(f), openingNM: tool.openingNM };
  }

  /** Continues from the samples of another session, which had the same history until `timeS`. */
  follow({ tools, history }: Samples, timeS: number): void {
    this.tools = tools;
    this.history.push(...history.filter((moment) => moment.timeS <= timeS && moment.timeS > timeS - HISTORY_S));
  }

  /** Receives samples until `signal` aborts. */
  run(
    sessionId: string,
    stepRateHz: number,
    signal: AbortSignal,
    onFailure: (failure: Failure, waitMs: number) => void,
  ): Promise<void> {
    const take = (sample: Sample) => {
      const present = new Set(sample.tools.slice(0, MAX_TOOLS).map(({ tool }) => tool));
      for (const [tool, { step }] of this.latest) if (step <= sample.step && !present.has(tool)) this.latest.delete(tool);
      this.takeOwn(sample);
    };
    return watchSamples(server, sessionId, sampleEvery(stepRateHz), take, signal, onFailure);
  }

  /** Adds a sample that may lack tools, such as one of this page's own tools, which arrived by datagram. */
  takeOwn(sample: Sample): void {
    const { step, tools } = sample;
    for (const tool of tools.slice(0, MAX_TOOLS)) {
      const known = this.latest.get(tool.tool);
      if (known ? known.step <= step : this.latest.size < MAX_TOOLS) this.latest.set(tool.tool, { step, sample: tool });
    }
    this.take(sample);
  }

  /** The newest sample of each tool, in the order of their numbers. */
  get toolSamples(): ToolSample[] {
    return [...this.latest.values()].map(({ sample }) => sample).sort((a, b) => a.tool - b.tool);
  }

  /** Shows a sample, unless a newer one already arrived by the other transport. */
  private take(sample: Sample): void {
    if (!Number.isFinite(sample.simulationTimeS) || (this.newest && sample.step < this.newest.step)) return;
    this.newest = sample;
    const each = this.toolSamples
      .filter((tool) => tool.point !== undefined || tool.vertex !== undefined)
      .map((tool) => ({
        tool: tool.tool,
        point: tool.point,
        vertex: tool.vertex,
        displacementM: vec(tool.displacementM),
        forceN: vec(tool.forceOnToolN),
        appliedN: vec(tool.appliedForceN),
      }));
    const felt = this.joined(each);
    // The server reports a released tool while its point still moves, so the plots show it come to rest.
    const least = FELT * this.pointN;
    this.tools = felt.filter((tool) => norm(tool.appliedN) > least || norm(tool.forceN) > least);
    const timeS = sample.simulationTimeS;
    const first = this.tools[0] ?? felt[0];
    // The same step may arrive by both transports.
    if (this.history.at(-1)?.timeS === timeS) this.history.pop();
    if (first) this.history.push({ tool: first.tool, timeS, displacementM: first.displacementM, ...this.tell(first) });
    // A gap of a second or more stays visible. Older samples are dropped.
    const isOld = ({ timeS: thenS }: Moment) => !(thenS > timeS - HISTORY_S && thenS <= timeS);
    while (this.history.length > MAX_MOMENTS || (this.history[0] && isOld(this.history[0]))) this.history.shift();
    this.onSample(sample);
  }
}
