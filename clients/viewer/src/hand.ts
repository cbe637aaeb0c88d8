// The hand: one tool, held by a lease, controlled by mouse, finger or keys.
//
// A push is the paper's surgical force at the place where the drag began, leaning in the direction of the drag. A
// stroke moves that place along, leaning in its direction of movement. A pull grasps a mass point and brings it where
// you drag it. A tip is led at a depth, and glides. A place has a side on which it is touched, and pushes go into the
// tissue from there.
//
// Commands go by calls. Poses of a tip go by datagram while datagrams get through (datagrams.ts); they have times, by which
// the server plays them. Poses that go by calls have none, and act when they come: a page can't promise one every 50 ms.

import type { MessageInitShape } from "@bufbuild/protobuf";
import type { CommandSchema, Sample } from "./gen/palpate/v1/haptic_pb";
import { Datagrams } from "./datagrams";
import { poseOf, type Lead } from "./poses";
import type { Vec3 } from "./samples";
import type { Place, Surface } from "./surface";
import { describe, haptics, isGone, PATIENCE_MS, reasonOf } from "./server";

export type Mode = "push" | "pull" | "stroke" | "tip";
type Command = MessageInitShape<typeof CommandSchema>;

/** The number of the tool that all pages use. */
const TOOL = 0;
/** In the tissue's own time, without a newer command: a page that vanishes does not keep pressing. */
const TIME_TO_LIVE_S = 2;
/** Interval between identical commands: well within the time to live. */
const REPEAT_MS = 100;
/** Interval between checks for something to send. */
const TICK_MS = 15;
const LEASE_S = 4;
/** After this time without a touch the hand releases the tool. */
const IDLE_MS = 5000;
/** A tip goes down over this time from beside the tissue: so the server knows from which side it comes. */
const SINK_MS = 250;
/** Between sequences of what goes different ways: datagrams count on from theirs. */
const APART = 1n << 32n;
/** Batches in flight: a round trip does not slow the hand down, and connections stay free for other calls. */
const IN_FLIGHT = 2;

/** The effect of strength 1 on the tissue. */
export interface Reach {
  /** A push falls off over this length: on a sheet the spacing of its points. */
  lengthM: number;
  /** Force of a push: on a sheet in the middle of the tool, on a body all of it together, N. */
  mostN: number;
  /** Force of the strongest push on the point in the middle of the tool, about, N. */
  pointN: number;
  /** Length of a drag that leans a push fully, and of a pull by keys, m. */
  depthM: number;
}

export class Hand {
  mode: Mode = "push";
  /** Strength, 0 to 1. */
  strength = 0.5;
  /** Round trip of the last batch minus the time that the server held it, ms. */
  private callMs: number | undefined;
  onChange: () => void = () => {};
  onRefused: (message: string) => void = () => {};
  private leaseId: string | undefined;
  private taking: Promise<boolean> | undefined;
  private sequence = 0n;
  private pressed = false;
  private place: Place | undefined;
  private onSurfaceM: Vec3 = [0, 0, 0];
  private leanM: Vec3 = [0, 0, 0];
  private released = true;
  private underWay = 0;
  private sentMs = 0;
  private touchedMs = 0;
  private timer: ReturnType<typeof setInterval> | undefined;
  private pressedMs = 0;
  private fresh = false;
  readonly datagrams: Datagrams;
  /** The sequence from which datagrams count, while poses go by them. */
  private from: bigint | undefined;

  constructor(
    readonly sessionId: string,
    private readonly name: string,
    readonly reach: Reach,
    private readonly surface: () => Surface,
    sampleEverySteps: number,
  ) {
    this.datagrams = new Datagrams(sessionId, TOOL, sampleEverySteps);
    this.datagrams.onChange = () => {
      this.fresh = true;
      this.tick();
    };
    this.datagrams.onRejected = (reason, message) => {
      if (!["STALE_SEQUENCE", "NOT_HOLDER"].includes(reason)) this.onRefused(message);
    };
  }

  /** Round trip of commands minus the time that the server held them, ms. */
  get networkMs(): number | undefined {
    return this.datagrams.networkMs ?? this.callMs;
  }

  get holds(): boolean {
    return this.leaseId !== undefined;
  }

  get touches(): boolean {
    return this.pressed;
  }

  /** The side of the tissue that it touches, or touched last. */
  get outward(): Vec3 | undefined {
    return this.place?.outward;
  }

  /** What forces on the tool are told times: a push on a body is told by all of it. */
  get share(): number {
    return this.place && ["push", "stroke"].includes(this.mode) ? this.surface().push(this.place, this.reach.lengthM).share : 1;
  }

  /** Takes the tool if it is free. */
  take(): Promise<boolean> {
    if (this.leaseId) return Promise.resolve(true);
    this.taking ??= this.acquire().finally(() => (this.taking = undefined));
    return this.taking;
  }

  private async acquire(): Promise<boolean> {
    const request = { sessionId: this.sessionId, tool: TOOL, leaseS: LEASE_S, holder: this.name };
    try {
      const { leaseId } = await haptics.acquireTool(request, { timeoutMs: PATIENCE_MS });
      this.leaseId = leaseId;
      this.sequence = 0n;
      this.from = undefined;
      this.datagrams.open(leaseId);
      this.touchedMs = performance.now();
      this.timer ??= setInterval(() => this.tick(), TICK_MS);
      this.onChange();
      return true;
    } catch (error) {
      this.pressed = false;
      this.onRefused(reasonOf(error) === "TOOL_HELD" ? "Somebody else holds the tool: you can only watch." : describe(error));
      this.onChange();
      return false;
    }
  }

  /** Begins to touch at `place`; its tissue is at `onSurfaceM` now. */
  async press(place: Place, onSurfaceM: Vec3): Promise<void> {
    this.pressed = true;
    this.released = false;
    this.place = place;
    this.onSurfaceM = onSurfaceM;
    this.leanM = [0, 0, 0];
    this.touchedMs = this.pressedMs = performance.now();
    this.fresh = true;
    if (await this.take()) this.tick();
  }

  /** Moves to another place, leaning in the direction of the movement. */
  goOn(place: Place): void {
    const [from, to] = [this.place?.restM ?? place.restM, place.restM];
    const way = [to[0] - from[0], to[1] - from[1], to[2] - from[2]] as const;
    // The earlier lean fades over the length that leans a push fully.
    const kept = Math.exp(-Math.hypot(...way) / this.reach.depthM);
    this.place = place;
    this.lean([kept * this.leanM[0] + way[0], kept * this.leanM[1] + way[1], kept * this.leanM[2] + way[2]]);
  }

  /** Leans by `leanM` from the place of the press. */
  lean(leanM: Vec3): void {
    if (!this.pressed) return;
    this.leanM = leanM;
    this.touchedMs = performance.now();
    this.fresh = true;
    this.tick();
  }

  /** Ends the touch; the hand keeps the tool for a while. */
  lift(): void {
    if (!this.pressed) return;
    this.pressed = false;
    this.datagrams.rest();
    this.touchedMs = performance.now();
    this.fresh = true;
    this.tick();
  }

  /** Releases the tool. */
  async letGo(): Promise<void> {
    const leaseId = this.leaseId;
    this.pressed = false;
    this.lost();
    if (!leaseId) return;
    try {
      await haptics.releaseTool({ sessionId: this.sessionId, leaseId }, { timeoutMs: PATIENCE_MS });
    } catch {
      // The lease lapses by itself, and the tool's action ends with it.
    }
  }

  private lost(): void {
    this.leaseId = undefined;
    this.datagrams.close();
    clearInterval(this.timer);
    this.timer = undefined;
    this.onChange();
  }

  /** Sends the present action, if it is due. */
  private tick(): void {
    if (!this.leaseId) return;
    const now = performance.now();
    if (this.pressed && this.mode === "tip" && this.datagrams.carries) return this.leadTip(now);
    if (this.underWay >= IN_FLIGHT) return;
    const isRest = !this.pressed && this.released;
    if (isRest && now - this.touchedMs > IDLE_MS) return void this.letGo();
    // At rest, send just often enough to keep the lease.
    if (!this.fresh && now - this.sentMs < (isRest ? (LEASE_S * 1000) / 4 : REPEAT_MS)) return;
    // A tip that sinks is news at each tick.
    this.fresh = this.mode === "tip" && this.pressed && now - this.pressedMs < SINK_MS;
    this.sentMs = now;
    const commands = isRest ? [] : [this.command(now)];
    this.released = !this.pressed;
    void this.send(this.leaseId, commands);
  }

  private leadTip(now: number): void {
    if (!this.place) return;
    this.from ??= this.sequence += APART;
    this.datagrams.lead({ lead: this.tip(this.place, now), from: this.from });
    // They keep the lease.
    this.sentMs = now;
    this.fresh = false;
  }

  /** Where the tip is at a place: on its way from beside the tissue, or at its depth. */
  private tip({ restM, outward: n }: Place, now: number): Lead {
    const radiusM = this.reach.lengthM;
    const part = Math.min(1, (now - this.pressedMs) / SINK_MS);
    const outM = (1 - part) * 1.1 * radiusM - part * this.strength * this.reach.depthM;
    return { positionM: [restM[0] + outM * n[0], restM[1] + outM * n[1], restM[2] + outM * n[2]], radiusM };
  }

  private command(now: number): Command {
    this.datagrams.rest();
    this.sequence += this.from === undefined ? 1n : APART;
    this.from = undefined;
    const command = { tool: TOOL, sequence: this.sequence, clientTimeNs: BigInt(Math.round(now * 1e6)) };
    const { place, reach } = this;
    if (!this.pressed || !place) return { ...command, action: { case: "release", value: {} } };
    const surface = this.surface();
    const timeToLiveS = TIME_TO_LIVE_S;
    if (this.mode === "pull") {
      const [from, lean] = [this.onSurfaceM, this.leanM];
      const positionM = { x: from[0] + lean[0], y: from[1] + lean[1], z: from[2] + lean[2] };
      const target = { case: "positionM" as const, value: positionM };
      return { ...command, timeToLiveS, action: { case: "position", value: { ...surface.point(place), target } } };
    }
    if (this.mode === "tip") {
      return { ...command, clientTimeNs: 0n, timeToLiveS, action: { case: "pose", value: poseOf(this.tip(place, now)) } };
    }
    const middleN = (reach.mostN * this.strength) / surface.push(place, reach.lengthM).sum;
    const value = { centre: surface.centre(place), forceN: this.forceN(middleN, place), falloffPerM: 1 / reach.lengthM };
    return { ...command, timeToLiveS, action: { case: "force", value } };
  }

  /** Into the tissue, plus the direction of the drag across: at 45° when the drag is as long as the reach. */
  private forceN(strengthN: number, { outward: n }: Place): { x: number; y: number; z: number } {
    const { leanM: lean, reach } = this;
    const out = lean[0] * n[0] + lean[1] * n[1] + lean[2] * n[2];
    const across = [0, 1, 2].map((c) => (lean[c]! - out * n[c]!) / reach.depthM);
    const most = Math.max(1, Math.hypot(...across));
    const [x, y, z] = across.map((v, c) => v / most - n[c]!) as [number, number, number];
    const scale = strengthN / Math.hypot(x, y, z);
    return { x: x * scale, y: y * scale, z: z * scale };
  }

  private async send(leaseId: string, commands: Command[]): Promise<void> {
    const begun = performance.now();
    this.underWay += 1;
    try {
      const request = { sessionId: this.sessionId, leaseId, commands };
      const { sample } = await haptics.sendCommands(request, { timeoutMs: PATIENCE_MS });
      if (sample && commands.length > 0) this.measure(sample, performance.now() - begun);
    } catch (error) {
      // Two batches may overtake each other: the newer one counts.
      if (reasonOf(error) !== "STALE_SEQUENCE" && this.leaseId === leaseId) this.failed(error);
    } finally {
      this.underWay -= 1;
    }
    this.tick();
  }

  private measure(sample: Sample, tookMs: number): void {
    const tool = sample.tools[0];
    if (tool && tool.acknowledgedSequence === this.sequence) {
      this.callMs = Math.max(0, tookMs - Number(tool.serverHoldNs) / 1e6);
    }
  }

  private failed(error: unknown): void {
    if (isGone(error)) this.pressed = false;
    if (reasonOf(error) !== "NOT_HOLDER" && !isGone(error)) return this.onRefused(describe(error));
    // The server ended the lease because no command came for too long. A user who still presses takes the tool again.
    this.lost();
    if (this.pressed) void this.take().then((holds) => holds && this.tick());
  }
}
