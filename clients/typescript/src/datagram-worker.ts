// A worker that carries datagrams: a WebTransport session that belongs to a lease. It works however long the page
// takes to draw: it repeats the newest pose, sends keep-alive datagrams, and passes on what it receives.

import { create, fromBinary, toBinary } from "@bufbuild/protobuf";
import { DatagramHealth } from "./datagram-health.js";
import { PosesDatagramSchema, SampleDatagramSchema, TouchResponseSchema } from "./gen/palpate/v1/haptic_pb.js";
import type { Rejection, Sample } from "./gen/palpate/v1/haptic_pb.js";
import { type Lead, MAX_POSED, Poses } from "./poses.js";

/** Interval between poses of a tool at rest. The server holds a tool after 50 ms without a pose. */
const REPEAT_MS = 20;
/** Interval between checks for something to send. */
const TICK_MS = 10;
/**
 * The worker stops sending poses if the page has sent nothing for this time. It is the time to live of a command in a
 * call.
 */
const PAGE_MS = 2000;
/** A worker that was stopped for longer than this stops sending poses: the server ends a touch after 250 ms. */
const MAX_STOP_MS = 150;
/** Largest datagram, bytes. */
const MAX_BYTES = 1024;
/** Largest message of the stream, bytes. */
const MAX_MESSAGE = 1 << 20;
/** Datagrams that have waited longer than this are dropped as outdated. */
const OLD_MS = 50;

/** The page's first message: the session to open. */
export interface Order {
  url: string;
  certificateSha256: Uint8Array<ArrayBuffer>;
  tools: readonly number[];
}

/**
 * Further messages of the page: the target of each tool's tip. `from` is the sequence of the first pose since another action
 * was commanded.
 */
export interface Led {
  leads: readonly Lead[];
  from: bigint;
}

/** "rest" stops sending poses until another one is set; "close" ends the session. */
export type Word = "rest" | "close";

export interface Counts {
  /** Number of datagrams that were sent, and that arrived. */
  sent: number;
  came: number;
  /** Number of poses and samples in them. */
  poses: number;
  samples: number;
  fellBack: number;
}

/** Messages to the page. */
export interface Heard {
  carries: boolean;
  counts: Counts;
  /** Round trip time minus the time for which the server held a pose, ms. */
  networkMs?: number;
  sample?: Sample;
  rejection?: Pick<Rejection, "reason" | "message">;
  /** If poses have stopped, the time of the last one, ms since the Unix epoch. */
  lastPoseMs?: number;
  /** Whether the session has ended. */
  isOver?: boolean;
}

// TypeScript can't load the type libraries for workers and for pages together.
const page = self as unknown as {
  onmessage: (event: MessageEvent<Order | Led | Word>) => void;
  postMessage: (message: Heard) => void;
  close: () => void;
};

class DatagramWorker {
  private readonly session: WebTransport;
  private readonly health = new DatagramHealth();
  private readonly writer: WritableStreamDefaultWriter<Uint8Array>;
  private counted = { poses: 0, samples: 0 };
  private poses: Poses[] = [];
  private led: Led | undefined;
  private ledMs = 0;
  private posedMs = 0;
  private timeNs = 0n;
  private repeatMs = REPEAT_MS;
  private carries = false;
  private networkMs: number | undefined;

  constructor(private readonly order: Order) {
    this.session = new WebTransport(order.url, {
      serverCertificateHashes: [{ algorithm: "sha-256", value: order.certificateSha256 }],
      requireUnreliable: true,
    });
    this.session.datagrams.outgoingMaxAge = OLD_MS;
    this.writer = (this.session.datagrams.writable as WritableStream<Uint8Array>).getWriter();
    // `run` reports how the session ends.
    this.session.closed.catch(() => undefined);
    void this.run().catch(() => this.over());
  }

  private async run(): Promise<void> {
    await this.session.ready;
    const timer = setInterval(() => this.tick(), TICK_MS);
    void this.session.closed.catch(() => undefined).then(() => clearInterval(timer));
    await Promise.all([this.readDatagrams(), this.readStream(), this.session.closed]);
    this.over();
  }

  close(): void {
    // A session that is not open yet can't be closed.
    void this.session.ready.then(() => this.session.close(), () => undefined).finally(() => page.close());
  }

  private over(): void {
    this.carries = false;
    this.tell({ isOver: true });
    page.close();
  }

  lead(led: Led): void {
    this.ledMs = performance.now();
    if (!this.led) this.posedMs = this.ledMs;
    const { tools } = this.order;
    if (this.led?.from !== led.from) this.poses = tools.map((tool) => new Poses(tool, led.from, tools.length));
    this.led = led;
    this.pose(this.ledMs);
  }

  rest(): void {
    this.led = undefined;
  }

  private tick(): void {
    const now = performance.now();
    const carries = this.health.carries(now);
    const isLate = now - this.posedMs > MAX_STOP_MS;
    if (carries !== this.carries || (this.led && isLate)) {
      this.carries = carries;
      this.tell({});
    }
    // Meanwhile the page sends the poses by calls, and starts anew here later.
    if (!carries || isLate || now - this.ledMs > PAGE_MS) this.rest();
    if (this.led && now - this.posedMs >= this.repeatMs) this.pose(now);
    if (this.health.isSilent(now)) this.send([], now);
  }

  private pose(now: number): void {
    if (!this.led || !this.carries) return;
    const timeNs = BigInt(Math.round(now * 1e6));
    // The clock of a page is coarse, but each pose needs a different time.
    this.timeNs = timeNs > this.timeNs ? timeNs : this.timeNs + 1n;
    this.posedMs = now;
    this.counted.poses += 1;
    const { leads } = this.led;
    const messages = this.poses.map((poses, index) => poses.message(leads[index]!, this.timeNs));
    for (let from = 0; from < messages.length; from += MAX_POSED) this.send(messages.slice(from, from + MAX_POSED), now);
  }

  private send(tools: ReturnType<Poses["message"]>[], now: number): void {
    const sentNs = BigInt(Math.round(now * 1e6));
    const message = create(PosesDatagramSchema, { ...this.health.send(now), tools, sentNs });
    const bytes = toBinary(PosesDatagramSchema, message);
    if (bytes.length > Math.min(MAX_BYTES, this.session.datagrams.maxDatagramSize)) return;
    // The end of the session is reported by `closed`.
    this.writer.write(bytes).catch(() => undefined);
  }

  private async readDatagrams(): Promise<void> {
    const reader = (this.session.datagrams.readable as ReadableStream<Uint8Array>).getReader();
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      const now = performance.now();
      const { number, acknowledges, heartbeatS, sample } = fromBinary(SampleDatagramSchema, value);
      this.health.arrive(number, acknowledges, now);
      this.carries = this.health.carries(now);
      if (heartbeatS > 0) this.repeatMs = Math.min(REPEAT_MS, Math.max(10, 1000 * heartbeatS));
      if (sample) this.counted.samples += 1;
      this.passOn(sample, now);
    }
  }

  /**
   * Reads the stream, which carries messages that must not be lost or are too long for a datagram, each after its
   * length.
   */
  private async readStream(): Promise<void> {
    const streams = (this.session.incomingUnidirectionalStreams as ReadableStream<ReadableStream<Uint8Array>>).getReader();
    const { value: stream } = await streams.read();
    if (!stream) return;
    const reader = stream.getReader();
    let bytes = new Uint8Array();
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      bytes = joined(bytes, value);
      while (bytes.length >= 4) {
        const length = new DataView(bytes.buffer, bytes.byteOffset).getUint32(0, true);
        if (length > MAX_MESSAGE) return this.session.close();
        if (bytes.length < 4 + length) break;
        const { message } = fromBinary(TouchResponseSchema, bytes.subarray(4, 4 + length));
        bytes = bytes.slice(4 + length);
        if (message.case === "sample") this.passOn(message.value, performance.now());
        if (message.case === "rejection") {
          const { reason, message: text } = message.value;
          this.tell({ rejection: { reason, message: text } });
        }
      }
    }
  }

  private passOn(sample: Sample | undefined, now: number): void {
    if (!sample) return this.tell({});
    const tool = sample.tools.find(({ tool }) => tool === this.order.tools[0]);
    // Times of calls are from a different clock.
    if (tool && this.led && this.poses[0]?.has(tool.acknowledgedSequence)) {
      this.networkMs = Math.max(0, now - Number(tool.clientTimeNs + tool.serverHoldNs) / 1e6);
    } else {
      this.networkMs = undefined;
    }
    this.tell({ sample });
  }

  private tell(heard: Partial<Heard>): void {
    const { sent, came, fellBack } = this.health;
    const counts = { ...this.counted, sent: Number(sent), came: Number(came), fellBack };
    const hasStopped = this.led && (!this.carries || performance.now() - this.posedMs > MAX_STOP_MS);
    const lastPoseMs = hasStopped ? performance.timeOrigin + this.posedMs : undefined;
    page.postMessage({ carries: this.carries, counts, lastPoseMs, networkMs: this.networkMs, ...heard });
  }
}

function joined(a: Uint8Array<ArrayBuffer>, b: Uint8Array): Uint8Array<ArrayBuffer> {
  const both = new Uint8Array(a.length + b.length);
  both.set(a);
  both.set(b, a.length);
  return both;
}

let worker: DatagramWorker | undefined;
page.onmessage = ({ data }) => {
  if (data === "close") return worker ? worker.close() : page.close();
  if (data === "rest") return worker?.rest();
  if ("leads" in data) return worker?.lead(data);
  worker = new DatagramWorker(data);
};
