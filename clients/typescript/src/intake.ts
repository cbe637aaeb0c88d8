// A worker that receives frames and acknowledges them, however long the page takes to draw. The page gets the newest
// state in one buffer that is passed back and forth: while the page has it, changes accumulate here, and nothing
// queues.

import { Field, type Rectangle } from "./field.js";
import { Encoding, type WatchFramesResponse } from "./gen/palpate/v1/view_pb.js";
import { type Failure, keepOpen, CALL_TIMEOUT_MS, Server } from "./server.js";

/** Maximum number of unacknowledged frames: enough for a round trip of 60 ms at 60 frames a second. */
const IN_FLIGHT = 4;

/** Each part of a frame and each patch counts as this many values. A frame has at most `MAX_PARTS` parts and patches. */
const PART_VALUES = 64;
const MAX_PARTS = 1 << 16;

/** The page's first message: the stream to receive. Each later message returns the buffer. */
export interface Order {
  url: string;
  token: string;
  sessionId: string;
  refinement: number;
  /** Rows, vertices of a row, and how many of the rows are for the surface within cuts. */
  vertices: [number, number, number];
}

/** The newest frame, and the changes since the last message. */
export interface News {
  changed: Rectangle;
  /** Displacements of the changed rectangle, at the beginning of the buffer. */
  values: Float32Array<ArrayBuffer>;
  step: bigint;
  timeS: number;
  topologyVersion: number;
  burnVersion: number;
  /** Frames that were received, frames that the server skipped since this worker began, and bytes. */
  taken: number;
  skipped: bigint;
  bytes: number;
}

export interface Trouble {
  failure: Failure;
  waitMs: number;
}

// TypeScript can't load the type libraries for workers and for pages together.
const page = self as unknown as {
  onmessage: (event: MessageEvent<Order | Float32Array<ArrayBuffer>>) => void;
  postMessage: (message: News | Trouble, transfer?: Transferable[]) => void;
};

class Intake {
  private readonly field: Field;
  private buffer: Float32Array<ArrayBuffer> | undefined;
  private taken = 0;
  private last: WatchFramesResponse | undefined;
  /** Number of frames that the server skipped: in the earlier streams, and in total. */
  private skipped = { before: 0n, now: 0n };

  private readonly server: Server;

  constructor(private readonly order: Order) {
    this.server = new Server(order.url, order.token);
    this.field = new Field(...order.vertices);
    this.buffer = new Float32Array(this.field.displacementM.length);
    // The stream ends with the worker.
    const { signal } = new AbortController();
    void keepOpen(
      (signal, alive) => this.read(signal, alive),
      signal,
      (failure, waitMs) => page.postMessage({ failure, waitMs }),
    );
  }

  private async read(signal: AbortSignal, alive: () => void): Promise<void> {
    const { sessionId, refinement } = this.order;
    const cutSurface = this.field.cutRows > 0;
    const request = { sessionId, refinement, encoding: Encoding.I16, maxFramesInFlight: IN_FLIGHT, cutSurface };
    const credit = new Credit(this.server, signal);
    this.skipped.before = this.skipped.now;
    let parts: WatchFramesResponse[] = [];
    let values = 0;
    for await (const part of this.server.views.watchFrames(request, { signal })) {
      alive();
      parts.push(part);
      // A frame contains each vertex only once.
      values += PART_VALUES + part.patches.reduce((sum, patch) => sum + PART_VALUES + patch.displacement.byteLength / 2, 0);
      if (values > 2 * this.field.displacementM.length + MAX_PARTS * PART_VALUES) throw new RangeError("a frame has no end");
      if (!part.last) continue;
      // Apply all parts at once, so that half a frame is never visible.
      for (const each of parts) each.patches.forEach((patch) => this.field.write(each, patch));
      [parts, values] = [[], 0];
      credit.giveBack(part.viewerId, part.frameId);
      this.taken += 1;
      this.skipped.now = this.skipped.before + part.skippedFrames;
      this.last = part;
      this.tell();
    }
  }

  /** The page returns the buffer. */
  reuse(buffer: Float32Array<ArrayBuffer>): void {
    this.buffer = buffer;
    this.tell();
  }

  private tell(): void {
    const { buffer: values, last } = this;
    if (!values || !last || this.taken === 0) return;
    const changed = this.field.takeChanged() ?? { a0: 0, a1: -1, b0: 0, b1: -1 };
    this.field.copyTo(values, changed);
    const { step, simulationTimeS: timeS, topologyVersion, burnVersion } = last;
    const { received } = this.server;
    const news = { changed, values, step, timeS, topologyVersion, burnVersion, taken: this.taken, skipped: this.skipped.now, bytes: received.bytes };
    [this.buffer, this.taken, received.bytes] = [undefined, 0, 0];
    page.postMessage(news, [values.buffer]);
  }
}

/** Acknowledges frames, one call at a time, always the newest frame. */
class Credit {
  private due: [string, bigint] | undefined;
  private underWay = false;

  constructor(
    private readonly server: Server,
    private readonly signal: AbortSignal,
  ) {}

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
        await this.server.views.acknowledgeFrames({ viewerId, frameId }, { signal: this.signal, timeoutMs: CALL_TIMEOUT_MS });
      } catch {
        // If the connection failed, the stream reports it; otherwise, the next acknowledgement covers this one.
      }
    }
    this.underWay = false;
  }
}

let intake: Intake | undefined;
page.onmessage = ({ data }) => {
  if (data instanceof Float32Array) return intake?.reuse(data);
  intake = new Intake(data);
};
