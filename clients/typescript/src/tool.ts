// A tool of a session, or several that move together, held by a lease.
//
// Commands are sent by calls. Poses of a tip are sent by datagram while datagrams get through (datagrams.ts). These
// have times, by which the server plays them. Poses in calls have no times and take effect on arrival, because a page
// can't guarantee one every 50 ms.

import type { MessageInitShape } from "@bufbuild/protobuf";
import { Datagrams } from "./datagrams.js";
import type { ClipSchema, CommandSchema, MarkSchema, Sample, ThreadSchema, TieSchema, ToolSample } from "./gen/palpate/v1/haptic_pb.js";
import { type Lead, poseOf } from "./poses.js";
import { backoffMs, describe, isGone, isUnreached, CALL_TIMEOUT_MS, reasonOf, type Server } from "./server.js";

type Command = MessageInitShape<typeof CommandSchema>;

/** Action of a tool: a force or a position, as in the protocol. */
export type Action = NonNullable<Command["action"]>;

/**
 * What a tool should do now: move its tip, of several tools that of each; or another action, which only a single tool
 * can do. `isMoving`: this changes with time, without a call of `changed`. `stays`: tips stay where they are for long, so that
 * they are commanded by calls, which need not be as frequent as datagrams: a browser that stands still for a second does not
 * end the touch.
 */
export type Wanted = ({ leads: readonly Lead[] } | { action: Action }) & { isMoving?: boolean; stays?: boolean };

/** In the tissue's time, without a newer command: a page that vanishes does not keep pressing. */
const TIME_TO_LIVE_S = 2;
/** A touch whose last call is longer ago than this may have ended at the server, and begins anew. */
const MAX_SILENCE_MS = 1500;
/** Interval between identical commands, well below the time to live. */
const REPEAT_MS = 100;
/** Interval between checks for something to send. */
const TICK_MS = 15;
const LEASE_S = 4;
/** A tool at rest is released after this time. */
const IDLE_MS = 5000;
/** Gap between the sequences of calls and of datagrams: datagrams count on from their own. */
const APART = 1n << 32n;
/**
 * Maximum number of batches in flight. So a round trip does not slow the hand down, and connections stay free for
 * other calls.
 */
const IN_FLIGHT = 2;

export class Tool {
  /** Called when the tool was taken or lost. */
  onChange: () => void = () => {};
  onRefused: (message: string, reason: string) => void = () => {};
  /** Poses and samples that are sent by datagram. */
  readonly datagrams: Datagrams;
  /** The numbers of the lease's tools. */
  readonly tools: readonly number[];
  /** Round trip time of the last batch minus the time for which the server held it, ms. */
  private callMs: number | undefined;
  private leaseId: string | undefined;
  private taking: Promise<boolean> | undefined;
  /** The release of the last lease, while the server has not answered it: until then the tool is still taken. */
  private leaving: Promise<void> | undefined;
  private sequence = 0n;
  /** Sequence of the first command of this touch. */
  private first: bigint | undefined;
  /** Tools on which the server acts in this touch. */
  private readonly acting = new Set<number>();
  /** Whether a release is on its way, after which the touch begins anew. */
  private beginsAnew = false;
  /** The sequence from which datagrams count, while poses are sent by datagram. */
  private from: bigint | undefined;
  private wanted: ((nowMs: number) => Wanted) | undefined;
  private released = true;
  private fresh = false;
  private underWay = 0;
  private sentMs = 0;
  private touchedMs = 0;
  /** Number of consecutive batches that reached no server, and the time until which none is sent because of that. */
  private unreached = 0;
  private waitsUntilMs = 0;
  private timer: ReturnType<typeof setInterval> | undefined;

  /**
   * Creates tool number `tool` of a session, or `count` tools from this number on; others see `holder` as its name. It
   * is not taken yet.
   */
  constructor(
    private readonly server: Server,
    readonly sessionId: string,
    private readonly holder: string,
    sampleEverySteps = 10,
    readonly tool = 0,
    count = 1,
  ) {
    this.tools = Array.from({ length: count }, (_, index) => tool + index);
    this.datagrams = new Datagrams(server, sessionId, this.tools, sampleEverySteps);
    this.datagrams.onChange = () => this.changed();
    this.datagrams.onGap = () => this.beginAnew();
    this.datagrams.onTool = (sample) => this.note(sample);
    this.datagrams.onRejected = (reason, message) => {
      if (!["STALE_SEQUENCE", "NOT_HOLDER"].includes(reason)) this.onRefused(message, reason);
    };
  }

  /** Round trip time of commands minus the time for which the server held them, ms. */
  get networkMs(): number | undefined {
    return this.datagrams.networkMs ?? this.callMs;
  }

  get holds(): boolean {
    return this.leaseId !== undefined;
  }

  get touches(): boolean {
    return this.wanted !== undefined;
  }

  /**
   * Whether the server acts on this touch. It ends a touch whose commands do not arrive; then the touch begins anew.
   * Until this is true, a tip belongs beside the tissue: where it begins tells its side of an open surface.
   */
  get isActing(): boolean {
    return this.acting.size === this.tools.length;
  }

  /** Returns whether a tool is one of these. */
  has(tool: number): boolean {
    return this.tools.includes(tool);
  }

  /** Takes the tool if it is free. */
  take(): Promise<boolean> {
    if (this.leaseId) return Promise.resolve(true);
    this.taking ??= this.acquire().finally(() => (this.taking = undefined));
    return this.taking;
  }

  private async acquire(): Promise<boolean> {
    const { sessionId, holder } = this;
    const [tool, ...moreTools] = this.tools;
    try {
      const call = { timeoutMs: CALL_TIMEOUT_MS };
      await this.leaving;
      const request = { sessionId, tool, moreTools, leaseS: LEASE_S, holder };
      const { leaseId } = await this.server.haptics.acquireTool(request, call);
      this.leaseId = leaseId;
      this.sequence = 0n;
      this.from = undefined;
      this.datagrams.open(leaseId);
      this.touchedMs = performance.now();
      this.timer ??= setInterval(() => this.tick(), TICK_MS);
      this.onChange();
      return true;
    } catch (error) {
      this.wanted = undefined;
      this.onRefused(describe(error), reasonOf(error));
      this.onChange();
      return false;
    }
  }

  /** Waits with taking the tool until something has ended: another lease of it. */
  takeAfter(ended: Promise<void>): void {
    this.leaving = ended;
  }

  /** Begins to touch: takes the tool if needed, and calls `wanted` regularly to learn what the tool should do. */
  async touch(wanted: (nowMs: number) => Wanted): Promise<boolean> {
    this.wanted = wanted;
    this.first = undefined;
    this.acting.clear();
    this.released = false;
    this.touchedMs = performance.now();
    this.fresh = true;
    const holds = await this.take();
    if (holds) this.tick();
    return holds;
  }

  /** Moves the tip of the tool to a position, where it stays until the next call of `lead` or `rest`. */
  lead(lead: Lead): Promise<boolean> {
    return this.touch(() => ({ leads: [lead] }));
  }

  /** To be called when the result of `wanted` changes. */
  changed(): void {
    if (this.wanted) this.touchedMs = performance.now();
    this.fresh = true;
    this.tick();
  }

  /** Ends the touch; the tool is kept for a while. */
  rest(): void {
    if (!this.wanted) return;
    this.wanted = undefined;
    this.datagrams.rest();
    this.touchedMs = performance.now();
    this.fresh = true;
    this.tick();
  }

  /**
   * Lays thread `number` of the session, or changes its length, friction or strength if it has these bites already; takes the tool if
   * needed. What the tool does goes on, and the thread stays when the tool is released. Returns whether the server accepts it;
   * `onRefused` gets the reason.
   */
  thread(number: number, thread: MessageInitShape<typeof ThreadSchema>): Promise<boolean> {
    return this.tie({ number, kind: { case: "thread", value: thread } });
  }

  /** Closes clip `number` on two places, otherwise as `thread`. Threads and clips share their numbers. */
  clip(number: number, clip: MessageInitShape<typeof ClipSchema>): Promise<boolean> {
    return this.tie({ number, kind: { case: "clip", value: clip } });
  }

  /** Cuts a thread or clip, and takes it out. */
  untie(number: number): Promise<boolean> {
    return this.tie({ number, kind: { case: "cut", value: {} } });
  }

  /** Marks a place of the surface, as an answer in an exercise; otherwise as `thread`. What the tool does goes on. */
  mark(mark: MessageInitShape<typeof MarkSchema>): Promise<boolean> {
    return this.act({ case: "mark", value: mark });
  }

  private tie(value: MessageInitShape<typeof TieSchema>): Promise<boolean> {
    return this.act({ case: "tie", value });
  }

  /** Does what changes nothing about what the tool does. Returns whether the server accepts it. */
  private async act(action: Action, isAgain = false): Promise<boolean> {
    if (!(await this.take())) return false;
    const { leaseId, sessionId, tool } = this;
    if (!leaseId) return false;
    this.touchedMs = performance.now();
    const command = { tool, sequence: this.next(), action };
    try {
      await this.server.haptics.sendCommands({ sessionId, leaseId, commands: [command] }, { timeoutMs: CALL_TIMEOUT_MS });
      return true;
    } catch (error) {
      if (this.leaseId === leaseId) this.failed(error);
      // The lease had ended, because this page came too late: the tool is taken again.
      return reasonOf(error) === "NOT_HOLDER" && !isAgain ? this.act(action, true) : false;
    }
  }

  /** Releases the tool. */
  async letGo(): Promise<void> {
    const { leaseId, sessionId } = this;
    this.wanted = undefined;
    this.lost();
    if (!leaseId) return;
    // If that fails, the lease expires by itself, which ends the tool's action.
    const released = this.server.haptics.releaseTool({ sessionId, leaseId }, { timeoutMs: CALL_TIMEOUT_MS });
    this.leaving = released.then(
      () => {},
      () => {},
    );
    await this.leaving;
  }

  private lost(): void {
    this.leaseId = undefined;
    this.datagrams.close();
    clearInterval(this.timer);
    this.timer = undefined;
    this.onChange();
  }

  /** Learns from the server's sample whether it acts on this touch. */
  private note({ tool, acknowledgedSequence, expired }: ToolSample): void {
    if (!this.wanted || this.first === undefined || acknowledgedSequence < this.first) return;
    if (this.isActing && expired) return this.beginAnew();
    if (expired) this.acting.delete(tool);
    if (expired || this.acting.has(tool)) return;
    this.acting.add(tool);
    if (this.isActing) this.changed();
  }

  /** Releases what the server may still hold, and begins the touch anew. */
  private beginAnew(): void {
    const { leaseId } = this;
    if (!leaseId || !this.wanted || this.beginsAnew) return;
    [this.first, this.beginsAnew] = [undefined, true];
    this.acting.clear();
    const released = this.send(leaseId, this.commands(undefined, performance.now()));
    void released.finally(() => {
      this.beginsAnew = false;
      this.changed();
    });
  }

  /** Sends the action, if that is due. */
  private tick(): void {
    if (!this.leaseId || this.beginsAnew) return;
    const now = performance.now();
    if (this.isActing && this.from === undefined && now - this.sentMs > MAX_SILENCE_MS) return this.beginAnew();
    const wanted = this.wanted?.(now);
    if (wanted && "leads" in wanted && this.datagrams.carries && !wanted.stays) return this.leadOn(wanted.leads, now);
    if (this.underWay >= IN_FLIGHT || now < this.waitsUntilMs) return;
    const isRest = !wanted && this.released;
    if (isRest && now - this.touchedMs > IDLE_MS) return void this.letGo();
    // At rest, sends just often enough to keep the lease.
    if (!this.fresh && now - this.sentMs < (isRest ? (LEASE_S * 1000) / 4 : REPEAT_MS)) return;
    this.fresh = wanted?.isMoving ?? false;
    this.sentMs = now;
    const commands = isRest ? [] : this.commands(wanted, now);
    this.released = !wanted;
    void this.send(this.leaseId, commands);
  }

  private leadOn(leads: readonly Lead[], now: number): void {
    this.from ??= this.sequence += APART;
    this.first ??= this.from;
    this.datagrams.lead({ leads, from: this.from });
    // Datagrams keep the lease.
    this.sentMs = now;
    this.fresh = false;
  }

  /** Returns the sequence of the next call. Datagrams after it begin anew. */
  private next(): bigint {
    this.datagrams.rest();
    this.sequence += this.from === undefined ? 1n : APART;
    this.from = undefined;
    return this.sequence;
  }

  /** Returns the commands of the next batch: one for each tool, all with the same sequence. */
  private commands(wanted: Wanted | undefined, now: number): Command[] {
    const sequence = this.next();
    const { tools } = this;
    const clientTimeNs = BigInt(Math.round(now * 1e6));
    if (!wanted) return tools.map((tool) => ({ tool, sequence, clientTimeNs, action: { case: "release", value: {} } }));
    this.first ??= sequence;
    const timeToLiveS = TIME_TO_LIVE_S;
    if ("action" in wanted) return [{ tool: this.tool, sequence, clientTimeNs, timeToLiveS, action: wanted.action }];
    return wanted.leads.map((lead, index) => {
      const action = { case: "pose" as const, value: poseOf(lead) };
      return { tool: tools[index], sequence, timeToLiveS, action };
    });
  }

  private async send(leaseId: string, commands: Command[]): Promise<void> {
    const begun = performance.now();
    this.underWay += 1;
    try {
      const request = { sessionId: this.sessionId, leaseId, commands };
      const { sample } = await this.server.haptics.sendCommands(request, { timeoutMs: CALL_TIMEOUT_MS });
      this.unreached = 0;
      if (sample && commands.length > 0) this.measure(sample, performance.now() - begun);
    } catch (error) {
      // Of two batches, the older one may arrive last; the newer one counts.
      if (reasonOf(error) !== "STALE_SEQUENCE" && this.leaseId === leaseId) this.failed(error);
    } finally {
      this.underWay -= 1;
    }
    this.tick();
  }

  private measure(sample: Sample, tookMs: number): void {
    const own = sample.tools.filter(({ tool }) => this.has(tool));
    for (const tool of own) this.note(tool);
    const [tool] = own;
    if (tool?.acknowledgedSequence === this.sequence) {
      this.callMs = Math.max(0, tookMs - Number(tool.serverHoldNs) / 1e6);
    }
  }

  private failed(error: unknown): void {
    if (isGone(error)) this.wanted = undefined;
    // Other calls for the session report that the server is lost. Here it is only called less and less often.
    if (isUnreached(error)) {
      this.waitsUntilMs = performance.now() + backoffMs(this.unreached++);
      return;
    }
    if (reasonOf(error) !== "NOT_HOLDER" && !isGone(error)) return this.onRefused(describe(error), reasonOf(error));
    // The server ended the lease because no command arrived for too long. If the user is still pressing, the tool is
    // taken again.
    this.lost();
    if (this.wanted) void this.take().then((holds) => holds && this.tick());
  }
}
