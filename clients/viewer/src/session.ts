// The session that the page shows: its streams, its surface and the hand, until the user leaves it.

import { Body } from "./body";
import { fingerM } from "./coefficients";
import { isBarred } from "./token-form";
import { fetchMesh, Frames, type MeshData, norm } from "palpate";
import type { Session } from "palpate/v1";
import { Hand, type Reach } from "./hand";
import { type Felt, sampleEvery, Samples, type Sense } from "./samples";
import { type Failure, keepOpen, CALL_TIMEOUT_MS, server, sessions, sleep } from "./server";
import { Sheet } from "./sheet";
import type { Place, Surface } from "./surface";

/** Interval between two requests for the session's status. */
const ASK_MS = 1000;

/** The default refinement has at most this many vertices; the user may select more. */
const CHOSEN_VERTICES = 40_000;
/** Above this browsers get slow on any machine. */
const MAX_VERTICES = 1_500_000;

/** Points of a sheet, at most. */
const MAX_POINTS = 1 << 23;

/** Callbacks of a shown session. */
export interface Told {
  onSession: (session: Session) => void;
  onTrouble: (failure: Failure, waitMs: number) => void;
  onWell: () => void;
  /** What a caller may no longer do: the server's reason. */
  onBarred: (reason: string) => void;
}

export class ShownSession {
  readonly frames = new Frames(server);
  readonly samples: Samples;
  readonly hand: Hand;
  readonly reach: Reach;
  /** Width of the tissue, m. */
  readonly widthM: number;
  /** The usual length of an edge of a mesh, m. */
  readonly edgeM: number;
  readonly rateHz: number;
  readonly mostRefinement: number;
  surface: Surface;
  refinement = 0;
  roundTripMs: number | undefined;
  /** When the server last answered, of this window's clock. */
  heardMs = performance.now();
  /** Whether the server does not answer: then only one question after the other asks whether it is back. */
  private isLost = false;
  private asking = new AbortController();
  /** When its newest answer was asked for. */
  askedMs = -Infinity;
  /** Points of a sheet along its sides; vertices and 1 of a body. */
  private readonly points: [number, number];
  private readonly ended = new AbortController();
  private seen = new AbortController();
  private watching = new AbortController();
  /** Simulated and local time, s, from the fastest recent answer, and that answer's round trip. */
  private clock: { timeS: number; localS: number; roundTripMs: number; atMs: number; overruns: bigint } | undefined;
  private readonly mesh: MeshData | undefined;

  /** Finds out what the session shows, which for a body is its mesh. It takes over the surface of one with the same tissue. */
  static async to(
    session: Session,
    holder: string,
    refinement: number | undefined,
    told: Told,
    former?: ShownSession,
  ): Promise<ShownSession> {
    check(session);
    const mesh = former ? former.mesh : session.scene?.mesh && (await fetchMesh(server, session.sessionId));
    return new ShownSession(session, holder, refinement, told, mesh, former);
  }

  private constructor(
    public session: Session,
    holder: string,
    refinement: number | undefined,
    private readonly told: Told,
    mesh: MeshData | undefined,
    former: ShownSession | undefined,
  ) {
    this.mesh = mesh;
    this.edgeM = mesh?.edgeM ?? 0;
    const sheet = session.scene?.sheet;
    const count = mesh ? mesh.restM.length / 3 : 1;
    this.points = mesh ? [count, 1] : [sheet?.pointsX ?? 1, sheet?.pointsY ?? 1];
    this.rateHz = session.scene?.stepping?.rateHz ?? 1000;
    const k = session.scene?.springs?.stiffnessNPerM ?? 0;
    const anchor = session.scene?.anchorSprings?.stiffnessNPerM ?? 0;
    if (mesh) {
      const sizeM = boxOf(mesh);
      const lengthM = fingerM(sizeM, mesh.edgeM);
      // Springs across carry the less of a push, the more points share it.
      const aPointN = 2 * lengthM * (anchor + 2 * k * Math.min(1, (mesh.edgeM / lengthM) ** 2));
      this.surface = former?.surface ?? new Body(mesh, lengthM, session.points);
      const { sum } = this.surface.push(this.surface.middle(), lengthM);
      // Of a tissue whose springs are not all alike nothing is told.
      const mostN = rounded(sum * aPointN || 2);
      this.reach = { lengthM, mostN, pointN: mostN / sum, depthM: 3 * lengthM };
      this.widthM = sizeM;
    } else {
      // A push falls off over a spacing, so that a few points share it: it sinks in by about two spacings.
      const lengthM = sheet?.spacingM ?? 1;
      const mostN = 2 * lengthM * (2 * k + anchor) || lengthM;
      this.reach = { lengthM, mostN, pointN: mostN, depthM: 3 * lengthM };
      this.widthM = (this.points[0] - 1) * lengthM;
    }
    // A mesh is shown with its own vertices.
    this.mostRefinement = mesh ? 0 : 10;
    while (this.mostRefinement > 0 && this.vertices(this.mostRefinement) > MAX_VERTICES) this.mostRefinement -= 1;
    if (!mesh) {
      let chosen = 3;
      while (chosen > 0 && this.vertices(chosen) > CHOSEN_VERTICES) chosen -= 1;
      this.refinement = former?.refinement ?? Math.min(refinement ?? chosen, this.mostRefinement);
    }
    this.surface ??= former?.surface ?? this.newSheet();
    this.samples = new Samples(this.reach.pointN, (tool) => this.sense(tool));
    // Until its own come, those of the other are what is seen.
    if (former) this.samples.follow(former.samples, session.simulationTimeS);
    this.hand = new Hand(session.sessionId, holder, this.reach, () => this.surface, sampleEvery(this.rateHz));
    this.hand.tool.datagrams.onSample = (sample) => this.samples.takeOwn(sample);
  }

  /** Vertices of refinement n: M = (m − 1)·n + m along a side of a sheet. */
  private vertices(n: number): number {
    return this.points.map((m) => (m - 1) * n + m).reduce((x, y) => x * y);
  }

  private newSheet(): Surface {
    const n = this.refinement;
    const [nx, ny] = this.points.map((m) => (m - 1) * n + m) as [number, number];
    return new Sheet(nx, ny, this.reach.lengthM / (n + 1), n + 1);
  }

  /** The side that a tool touches. Only of the own hand is known how a force is spread. */
  private sense(tool: Felt): Sense {
    const isMine = tool.tool === 0 && this.hand.holds;
    const outward = (isMine && this.hand.outward) || this.placeOf(tool)?.outward || [0, 0, 1];
    return { outward, share: isMine ? this.hand.share : 1 };
  }

  /** Where a tool touches. The own hand knows from which side. */
  placeOf(tool: Felt): Place | undefined {
    const isMine = tool.tool === 0 && this.hand.holds;
    return this.surface.ofTool(tool, isMine ? this.hand.isOuter : undefined);
  }

  begin(): void {
    void this.ask();
    this.look();
  }

  /** Opens the streams. */
  look(): void {
    if (this.ended.signal.aborted || this.isLost) return;
    this.seen.abort();
    this.seen = new AbortController();
    const { signal } = this.seen;
    void this.samples.run(this.session.sessionId, this.rateHz * this.speed, signal, (failure, waitMs) => this.broken(failure, waitMs));
    this.watch();
  }

  private watch(): void {
    this.watching.abort();
    this.watching = new AbortController();
    const { signal } = this.watching;
    this.seen.signal.addEventListener("abort", () => this.watching.abort());
    this.frames.run(this.session.sessionId, this.refinement, this.surface.field, signal, (failure, waitMs) => this.broken(failure, waitMs));
  }

  /** A stream has failed. Whether the server is there, its status tells. */
  private broken(failure: Failure, waitMs: number): void {
    if (!this.isLost && !isBarred(failure.reason)) this.told.onTrouble(failure, waitMs);
  }

  /** Closes the streams and leaves the session unchanged. */
  lookAway(): void {
    this.seen.abort();
  }

  /** Switches to another refinement of a sheet, with a new surface. */
  refine(n: number): Surface {
    if (this.session.scene?.mesh) return this.surface;
    this.refinement = n;
    this.surface = this.newSheet();
    if (!this.seen.signal.aborted) this.watch();
    return this.surface;
  }

  leave(): void {
    void this.hand.letGo();
    this.ended.abort();
    this.seen.abort();
  }

  /** How fast its time goes on: other than 1 only of what is played. */
  get speed(): number {
    return this.session.playback?.speed ?? 1;
  }

  /** Estimate of the simulated time now, s. */
  nowS(): number | undefined {
    return this.clock && this.clock.timeS + this.speed * (performance.now() / 1000 - this.clock.localS);
  }

  /** Age of the newest frame here, ms. */
  get frameAgeMs(): number | undefined {
    const [now, { newest }] = [this.nowS(), this.frames];
    return now === undefined || !newest ? undefined : Math.max(0, (1000 * (now - newest.timeS)) / this.speed);
  }

  /** Asks at once whether the server is back. */
  askNow(): void {
    this.asking.abort();
    if (!this.ended.signal.aborted) void this.ask();
  }

  private ask(): Promise<void> {
    this.asking = new AbortController();
    this.ended.signal.addEventListener("abort", () => this.asking.abort());
    return keepOpen(
      async (signal, alive) => {
        while (!signal.aborted) {
          const begun = performance.now();
          const { session } = await sessions.getSession(
            { sessionId: this.session.sessionId },
            { signal, timeoutMs: CALL_TIMEOUT_MS },
          );
          const ended = performance.now();
          alive();
          if (session) this.heard(session, begun, ended);
          await sleep(ASK_MS, signal);
        }
      },
      this.asking.signal,
      (failure, waitMs) => {
        if (failure.isGone || isBarred(failure.reason)) this.leave();
        if (isBarred(failure.reason)) return this.told.onBarred(failure.reason);
        // Each stream would ask on its own.
        this.isLost = true;
        this.seen.abort();
        this.told.onTrouble(failure, waitMs);
      },
    );
  }

  private heard(session: Session, begunMs: number, endedMs: number): void {
    this.session = session;
    this.heardMs = endedMs;
    this.askedMs = begunMs;
    const roundTripMs = endedMs - begunMs;
    this.roundTripMs = roundTripMs;
    // The fastest answer gives the most exact time. After a while slower ones count again, because clocks drift, and
    // also after dropped steps.
    const clock = this.clock;
    const overruns = session.overrunCount;
    const isOld = clock && (endedMs - clock.atMs > 10_000 || overruns !== clock.overruns);
    if (!clock || isOld || roundTripMs <= clock.roundTripMs) {
      const localS = (begunMs + endedMs) / 2000;
      this.clock = { timeS: session.simulationTimeS, localS, roundTripMs, atMs: endedMs, overruns };
    }
    if (this.isLost) {
      this.isLost = false;
      if (!document.hidden) this.look();
    }
    this.told.onSession(session);
    this.told.onWell();
  }
}

/** Throws if a session can't be shown, whatever its server says. */
function check({ scene }: Session): void {
  const isPositive = (value = 1) => Number.isFinite(value) && value > 0;
  const { sheet, stepping, springs, anchorSprings } = scene ?? {};
  const isNumber = (value = 0) => Number.isFinite(value);
  if (!isPositive(stepping?.rateHz)) throw new RangeError(`it has ${stepping?.rateHz} steps a second`);
  if (!isNumber(springs?.stiffnessNPerM) || !isNumber(anchorSprings?.stiffnessNPerM)) throw new RangeError("its springs are no numbers");
  if (!sheet) return;
  const { pointsX = 1, pointsY = 1, spacingM } = sheet;
  if (pointsX < 1 || pointsY < 1 || pointsX * pointsY > MAX_POINTS || !isPositive(spacingM)) {
    throw new RangeError(`it is a sheet of ${pointsX} × ${pointsY} points, ${spacingM} m apart`);
  }
}

/** The diagonal of the box around the triangles of a mesh, m. */
function boxOf({ restM, triangles }: MeshData): number {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (const vertex of triangles) {
    for (let c = 0; c < 3; c++) {
      low[c] = Math.min(low[c]!, restM[3 * vertex + c]!);
      high[c] = Math.max(high[c]!, restM[3 * vertex + c]!);
    }
  }
  return norm([high[0]! - low[0]!, high[1]! - low[1]!, high[2]! - low[2]!]);
}

/** One or two digits of a force: a slider goes up to it. */
function rounded(force: number): number {
  return Number(force.toPrecision(2));
}
