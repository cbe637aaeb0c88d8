// The datagrams of a lease: poses and samples by WebTransport (datagram-worker.ts), where browser, server and network
// allow it. Nothing depends on it: everything else goes by calls, and poses and samples too if there are no
// datagrams.

import type { Counts, Heard, Led, Order, Word } from "./datagram-worker.js";
import type { DatagramOffer, Sample, ToolSample } from "./gen/palpate/v1/haptic_pb.js";
import { isUnimplemented, CALL_TIMEOUT_MS, reasonOf, type Server } from "./server.js";

/**
 * Poses that stopped for longer than this, until the page learns of it, may have let the server end the touch: it does
 * after 250 ms.
 */
const MAX_GAP_MS = 150;
/** Longest wait before a session is tried again: a network that blocks datagrams will probably continue to do so. */
const AVOID_MS = 60_000;
/**
 * First wait for another session after one that worked. A browser gives up a session in which it receives nothing for
 * some seconds.
 */
const AGAIN_MS = 1000;

/** Time at which a session may be tried again; never if the browser does not support them. */
let avoidedMs = typeof WebTransport === "undefined" ? Infinity : 0;
/** Wait after the next failure. */
let waitMs = AVOID_MS;

export class Datagrams {
  onSample: (sample: Sample) => void = () => {};
  onRejected: (reason: string, message: string) => void = () => {};
  /** Called when `carries` changes. */
  onChange: () => void = () => {};
  /** Called when the server may have ended the touch because no pose arrived for too long. */
  onGap: () => void = () => {};
  /** Called with what each sample says of a tool of the lease. */
  onTool: (sample: ToolSample) => void = () => {};
  networkMs: number | undefined;
  /** Whether datagrams get through. */
  carries = false;
  private worker: Worker | undefined;
  private leaseId = "";
  private again: ReturnType<typeof setTimeout> | undefined;
  /** Newest ownership revision that was seen for this session. */
  private revision = 0n;
  private now = none();
  private before = none();

  constructor(
    private readonly server: Server,
    private readonly sessionId: string,
    private readonly tools: readonly number[],
    private readonly sampleEverySteps: number,
  ) {}

  /** Totals over all leases. */
  get counts(): Counts {
    return sum(this.before, this.now);
  }

  /** Opens a session for a lease as soon as possible, and another one whenever it fails, until `close`. */
  open(leaseId: string): void {
    this.close();
    this.leaseId = leaseId;
    const dueMs = avoidedMs - performance.now();
    if (dueMs === Infinity) return;
    if (dueMs > 0) this.again = setTimeout(() => void this.ask(leaseId), dueMs);
    else void this.ask(leaseId);
  }

  private async ask(leaseId: string): Promise<void> {
    const { sessionId, sampleEverySteps } = this;
    try {
      const { offer } = await this.server.haptics.openDatagrams({ sessionId, leaseId, sampleEverySteps }, { timeoutMs: CALL_TIMEOUT_MS });
      if (offer && leaseId === this.leaseId) this.start(offer);
    } catch (error) {
      // The server has datagrams disabled, or is too old to know them. Any other refusal concerns this lease, or is
      // temporary.
      if (reasonOf(error) === "NOT_AVAILABLE" || isUnimplemented(error)) avoidedMs = performance.now() + AVOID_MS;
    }
  }

  /** Handles a session that ended by itself. */
  private failed(worked: boolean): void {
    if (worked) waitMs = AGAIN_MS;
    avoidedMs = performance.now() + waitMs;
    waitMs = Math.min(AVOID_MS, 2 * waitMs);
    this.open(this.leaseId);
    this.onChange();
  }

  private start(offer: DatagramOffer): void {
    const host = offer.host || new URL(this.server.urlOf(this.sessionId)).hostname;
    const ticket = [...offer.ticket].map((byte) => byte.toString(16).padStart(2, "0")).join("");
    const worker = new Worker(new URL("./datagram-worker.js", import.meta.url), { type: "module", name: "datagrams" });
    this.worker = worker;
    worker.onmessage = ({ data }: MessageEvent<Heard>) => {
      if (this.worker === worker) this.heard(data);
    };
    worker.onerror = () => this.worker === worker && this.failed(false);
    const url = `https://${host}:${offer.port}/touch/${ticket}`;
    worker.postMessage({ url, certificateSha256: offer.certificateSha256.slice(), tools: this.tools } satisfies Order);
  }

  private heard({ carries, counts, networkMs, sample, rejection, isOver, lastPoseMs }: Heard): void {
    this.now = counts;
    this.networkMs = networkMs;
    if (lastPoseMs && performance.timeOrigin + performance.now() - lastPoseMs > MAX_GAP_MS) this.onGap();
    if (isOver) return this.failed(counts.came > 0);
    if (sample) this.take(sample);
    if (rejection) this.onRejected(rejection.reason, rejection.message);
    if (carries === this.carries) return;
    this.carries = carries;
    this.onChange();
  }

  /** Accepts a sample, unless it is from a server that no longer owns the session. */
  private take(sample: Sample): void {
    if (sample.ownershipRevision < this.revision) return;
    this.revision = sample.ownershipRevision;
    for (const tool of sample.tools) if (this.tools.includes(tool.tool)) this.onTool(tool);
    this.onSample(sample);
  }

  /** Sends poses of the tips until `rest`. Their sequences increase from `from`. */
  lead(led: Led): void {
    this.worker?.postMessage(led);
  }

  rest(): void {
    this.say("rest");
  }

  /** Closes the datagram session. */
  close(): void {
    clearTimeout(this.again);
    this.leaseId = "";
    this.say("close");
    this.worker = undefined;
    this.carries = false;
    this.networkMs = undefined;
    [this.before, this.now] = [this.counts, none()];
  }

  private say(word: Word): void {
    this.worker?.postMessage(word);
  }
}

function none(): Counts {
  return { sent: 0, came: 0, poses: 0, samples: 0, fellBack: 0 };
}

function sum(a: Counts, b: Counts): Counts {
  return {
    sent: a.sent + b.sent,
    came: a.came + b.came,
    poses: a.poses + b.poses,
    samples: a.samples + b.samples,
    fellBack: a.fellBack + b.fellBack,
  };
}
