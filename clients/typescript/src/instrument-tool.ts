// An instrument that is led: its tips are tools of one lease, with consecutive numbers.

import type { Instrument, InstrumentPose, Wrench } from "./instrument.js";
import type { Server } from "./server.js";
import { Tool } from "./tool.js";
import type { Vec3 } from "./vector.js";

/** What an instrument feels: also the torque that opens its jaws. */
export interface InstrumentFelt extends Wrench {
  openingNM: number;
}

export class InstrumentTool extends Tool {
  /** Makes a tool of each tip of `instrument`, numbered from `firstTool` on. They are not taken yet. */
  constructor(
    server: Server,
    sessionId: string,
    holder: string,
    readonly instrument: Instrument,
    sampleEverySteps = 10,
    firstTool = 0,
  ) {
    super(server, sessionId, holder, sampleEverySteps, firstTool, instrument.tips.length);
  }

  /** Moves the instrument to a pose, where it stays until the next call of `leadTo` or `rest`. */
  leadTo(pose: InstrumentPose): Promise<boolean> {
    return this.touch(() => ({ leads: this.instrument.leads(pose) }));
  }

  /** Returns what the instrument feels at a pose, by the forces on its tools, N, by their numbers. */
  felt(pose: InstrumentPose, forces: Iterable<readonly [tool: number, forceN: Vec3]>): InstrumentFelt {
    const forcesN: (Vec3 | undefined)[] = this.tools.map(() => undefined);
    for (const [tool, forceN] of forces) if (this.has(tool)) forcesN[tool - this.tool] = forceN;
    const { instrument } = this;
    return { ...instrument.wrench(pose, forcesN), openingNM: instrument.openingNM(pose, forcesN) };
  }
}
