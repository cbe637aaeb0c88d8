// A visit to a session: its streams, its surface and the hand, until the user leaves.

import { Frames } from "./frames";
import type { Session } from "./gen/palpate/v1/session_pb";
import { Hand, type Reach } from "./hand";
import { Samples } from "./samples";
import { type Failure, keepOpen, PATIENCE_MS, sessions, sleep } from "./server";
import { Surface } from "./surface";

/** Interval between two requests for the session's status. */
const ASK_MS = 1000;

/** The default refinement has at most this many vertices; the user may select more. */
const CHOSEN_VERTICES = 40_000;
/** Above this browsers get slow on any machine. */
const MOST_VERTICES = 1_500_000;

/** Callbacks of a visit. */
export interface Told {
  onSession: (session: Session) => void;
  onTrouble: (failure: Failure, waitMs: number) => void;
  onWell: () => void;
}

export class Visit {
  readonly frames = new Frames();
  readonly samples: Samples;
  readonly hand: Hand;
  readonly reach: Reach;
  readonly extentM: [number, number];
  readonly rateHz: number;
  readonly mostRefinement: number;
  surface: Surface;
  refinement: number;
  roundTripMs: number | undefined;
  /** When the server last answered, of this window's clock. */
  heardMs = performance.now();
  private readonly points: [number, number];
  private readonly ended = new AbortController();
  private seen = new AbortController();
  private watching = new AbortController();
  /** Simulated time minus local time, s, from the fastest recent answer, and that answer's round trip. */
  private clock: { offsetS: number; roundTripMs: number; atMs: number; overruns: bigint } | undefined;

  constructor(
    public session: Session,
    holder: string,
    refinement: number | undefined,
    private readonly told: Told,
  ) {
    const sheet = session.scene?.sheet;
    this.points = [sheet?.pointsX ?? 1, sheet?.pointsY ?? 1];
    const spacingM = sheet?.spacingM ?? 1;
    this.extentM = [(this.points[0] - 1) * spacingM, (this.points[1] - 1) * spacingM];
    this.rateHz = session.scene?.stepping?.rateHz ?? 1000;
    // A push falls off over a spacing, so that a few points share it: it sinks in by about two spacings.
    const k = session.scene?.springs?.stiffnessNPerM ?? 0;
    const virtual = session.scene?.virtualSprings?.stiffnessNPerM ?? 0;
    this.reach = { spacingM, mostN: 2 * spacingM * (2 * k + virtual) || spacingM, depthM: 3 * spacingM };
    this.samples = new Samples(this.reach.mostN);
    this.hand = new Hand(session.sessionId, holder, this.reach);
    this.mostRefinement = 10;
    while (this.mostRefinement > 0 && this.vertices(this.mostRefinement) > MOST_VERTICES) this.mostRefinement -= 1;
    let chosen = 3;
    while (chosen > 0 && this.vertices(chosen) > CHOSEN_VERTICES) chosen -= 1;
    this.refinement = Math.min(refinement ?? chosen, this.mostRefinement);
    this.surface = this.newSurface();
  }

  /** Vertices of refinement n: M = (m − 1)·n + m along a side. */
  private vertices(n: number): number {
    return this.points.map((m) => (m - 1) * n + m).reduce((x, y) => x * y);
  }

  private newSurface(): Surface {
    const n = this.refinement;
    const [nx, ny] = this.points.map((m) => (m - 1) * n + m) as [number, number];
    return new Surface(nx, ny, this.reach.spacingM / (n + 1), n + 1);
  }

  begin(): void {
    void this.ask();
    this.look();
  }

  /** Opens the streams. */
  look(): void {
    if (this.ended.signal.aborted) return;
    this.seen.abort();
    this.seen = new AbortController();
    const { signal } = this.seen;
    void this.samples.run(this.session.sessionId, this.rateHz, signal, this.told.onTrouble);
    this.watch();
  }

  private watch(): void {
    this.watching.abort();
    this.watching = new AbortController();
    const { signal } = this.watching;
    this.seen.signal.addEventListener("abort", () => this.watching.abort());
    this.frames.run(this.session.sessionId, this.refinement, this.surface, signal, this.told.onTrouble);
  }

  /** Closes the streams and leaves the session unchanged. */
  lookAway(): void {
    this.seen.abort();
  }

  /** Switches to another refinement, with a new surface. */
  refine(n: number): Surface {
    this.refinement = n;
    this.surface = this.newSurface();
    if (!this.seen.signal.aborted) this.watch();
    return this.surface;
  }

  leave(): void {
    void this.hand.letGo();
    this.ended.abort();
    this.seen.abort();
  }

  /** Estimate of the simulated time now, s. */
  nowS(): number | undefined {
    return this.clock && performance.now() / 1000 + this.clock.offsetS;
  }

  private ask(): Promise<void> {
    return keepOpen(
      async (signal, alive) => {
        while (!signal.aborted) {
          const begun = performance.now();
          const { session } = await sessions.getSession(
            { sessionId: this.session.sessionId },
            { signal, timeoutMs: PATIENCE_MS },
          );
          const ended = performance.now();
          alive();
          if (session) this.heard(session, begun, ended);
          await sleep(ASK_MS, signal);
        }
      },
      this.ended.signal,
      (failure, waitMs) => {
        if (failure.isGone) this.leave();
        this.told.onTrouble(failure, waitMs);
      },
    );
  }

  private heard(session: Session, begunMs: number, endedMs: number): void {
    this.session = session;
    this.heardMs = endedMs;
    const roundTripMs = endedMs - begunMs;
    this.roundTripMs = roundTripMs;
    // The fastest answer gives the most exact time. After a while slower ones count again, because clocks drift, and
    // also after dropped steps.
    const clock = this.clock;
    const overruns = session.overrunCount;
    const isOld = clock && (endedMs - clock.atMs > 10_000 || overruns !== clock.overruns);
    if (!clock || isOld || roundTripMs <= clock.roundTripMs) {
      const middleS = (begunMs + endedMs) / 2000;
      this.clock = { offsetS: session.simulationTimeS - middleS, roundTripMs, atMs: endedMs, overruns };
    }
    this.told.onSession(session);
    this.told.onWell();
  }
}
