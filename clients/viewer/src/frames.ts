// Frames: the changing surface. A worker receives them (intake.ts), and this module applies the newest to the surface.

import type { News, Order, Trouble } from "./intake";
import { caller, type Failure, received } from "./server";
import type { Surface } from "./surface";

export interface FrameTold {
  step: bigint;
  timeS: number;
}

export class Frames {
  /** Frames received, and frames that the server skipped for this viewer. */
  taken = 0;
  skipped = 0n;
  newest: FrameTold | undefined;
  onFrame: (frame: FrameTold) => void = () => {};

  /** Runs until it is aborted. Then the worker ends, and its stream with it. */
  run(
    sessionId: string,
    refinement: number,
    surface: Surface,
    signal: AbortSignal,
    onFailure: (failure: Failure, waitMs: number) => void,
  ): void {
    const worker = new Worker(new URL("./intake.ts", import.meta.url), { type: "module", name: "frames" });
    signal.addEventListener("abort", () => worker.terminate());
    const before = this.skipped;
    worker.onmessage = ({ data }: MessageEvent<News | Trouble>) => {
      if (signal.aborted) return;
      if ("failure" in data) return onFailure(data.failure, data.waitMs);
      surface.field.copyFrom(data.values, data.changed);
      worker.postMessage(data.values, [data.values.buffer]);
      this.taken += data.taken;
      this.skipped = before + data.skipped;
      received.bytes += data.bytes;
      this.newest = { step: data.step, timeS: data.timeS };
      this.onFrame(this.newest);
    };
    worker.onerror = (event) => onFailure({ isGone: false, text: event.message || "can't receive frames" }, 0);
    const vertices: [number, number] = [surface.field.nx, surface.field.ny];
    worker.postMessage({ sessionId, token: caller.token, refinement, vertices } satisfies Order);
  }
}
