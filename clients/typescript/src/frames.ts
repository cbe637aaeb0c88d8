// Frames: the changing surface. A worker receives them (intake.ts), and this module applies the newest to a field.

import type { News, Order, Trouble } from "./intake.js";
import type { Field } from "./field.js";
import type { Failure, Server } from "./server.js";

export interface FrameTold {
  step: bigint;
  timeS: number;
  /** The version of what joins the points: if it is not that of a `Wound`, call `followWound`. */
  topologyVersion: number;
  /** The version of what is burnt: if it is not that of `Burns`, call `followBurns`. */
  burnVersion: number;
}

export class Frames {
  /** Number of frames that were received, and number of frames that the server skipped for this viewer. */
  taken = 0;
  skipped = 0n;
  newest: FrameTold | undefined;
  onFrame: (frame: FrameTold) => void = () => {};

  constructor(private readonly server: Server) {}

  /**
   * Receives the frames of a session into `field` until `signal` aborts; then the worker and its stream end. For a
   * mesh, the field needs the dimensions of its `MeshData`, with its `cutRows` more rows to receive the surface within
   * cuts as well; for a sheet, (m − 1)·n + m vertices along a side of m points at refinement n.
   */
  run(
    sessionId: string,
    refinement: number,
    field: Field,
    signal: AbortSignal,
    onFailure: (failure: Failure, waitMs: number) => void = () => {},
  ): void {
    const worker = new Worker(new URL("./intake.js", import.meta.url), { type: "module", name: "frames" });
    signal.addEventListener("abort", () => worker.terminate());
    const before = this.skipped;
    worker.onmessage = ({ data }: MessageEvent<News | Trouble>) => {
      if (signal.aborted) return;
      if ("failure" in data) return onFailure(data.failure, data.waitMs);
      field.copyFrom(data.values, data.changed);
      worker.postMessage(data.values, [data.values.buffer]);
      this.taken += data.taken;
      this.skipped = before + data.skipped;
      this.server.received.bytes += data.bytes;
      this.newest = { step: data.step, timeS: data.timeS, topologyVersion: data.topologyVersion, burnVersion: data.burnVersion };
      this.onFrame(this.newest);
    };
    worker.onerror = (event) => onFailure({ isGone: false, reason: "", text: event.message || "can't receive frames" }, 0);
    const vertices: [number, number, number] = [field.nx, field.ny, field.cutRows];
    const { url, token } = this.server;
    worker.postMessage({ url, token, sessionId, refinement, vertices } satisfies Order);
  }
}
