// Frames: the surface as it changes, on credit, so that no queue grows between the server and the picture.

import { Encoding, type WatchFramesResponse } from "./gen/palpate/v1/view_pb";
import { keepOpen, PATIENCE_MS, views } from "./server";
import type { Surface } from "./surface";

/** Frames on their way: a round trip of 60 ms at 60 frames a second. */
const IN_FLIGHT = 4;

export interface FrameTold {
  step: bigint;
  timeS: number;
  isFull: boolean;
}

export class Frames {
  /** Frames taken in, and those that the server left out for this viewer. */
  taken = 0;
  skipped = 0n;
  newest: FrameTold | undefined;
  onFrame: (frame: FrameTold) => void = () => {};

  run(
    sessionId: string,
    refinement: number,
    surface: Surface,
    signal: AbortSignal,
    onFailure: (error: unknown, waitMs: number) => void,
  ): Promise<void> {
    return keepOpen(
      async (signal, alive) => {
        const request = { sessionId, refinement, encoding: Encoding.I16, maxFramesInFlight: IN_FLIGHT };
        const credit = new Credit(signal);
        let parts: WatchFramesResponse[] = [];
        const before = this.skipped;
        for await (const part of views.watchFrames(request, { signal })) {
          alive();
          parts.push(part);
          if (!part.last) continue;
          // Between the parts of a frame nothing is drawn.
          surface.apply(parts);
          this.taken += 1;
          this.skipped = before + part.skippedFrames;
          this.newest = { step: part.step, timeS: part.simulationTimeS, isFull: part.full };
          parts = [];
          credit.giveBack(part.viewerId, part.frameId);
          this.onFrame(this.newest);
        }
      },
      signal,
      onFailure,
    );
  }
}

/** Acknowledges frames, one message at a time, always the newest. */
class Credit {
  private due: [string, bigint] | undefined;
  private underWay = false;

  constructor(private readonly signal: AbortSignal) {}

  giveBack(viewerId: string, frameId: bigint): void {
    this.due = [viewerId, frameId];
    if (!this.underWay) void this.send();
  }

  private async send(): Promise<void> {
    this.underWay = true;
    while (this.due && !this.signal.aborted) {
      const [viewerId, frameId] = this.due;
      this.due = undefined;
      try {
        await views.acknowledgeFrames({ viewerId, frameId }, { signal: this.signal, timeoutMs: PATIENCE_MS });
      } catch {
        // The stream fails as well, and tells; or the next acknowledgement covers this one.
      }
    }
    this.underWay = false;
  }
}
