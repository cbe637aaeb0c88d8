// The session that the page shows: its streams, its surface and the hands, until the user leaves it.

import { Body } from "./body";
import { Burning } from "./burning";
import { fingerM } from "./coefficients";
import { isBarred } from "./token-form";
import { fetchMesh, followWound, Frames, type FrameTold, type MeshData, norm, plus, type Vec3, Wound } from "palpate";
import { ExerciseRole, type Session, TipShape } from "palpate/v1";
import { Hand, type Reach } from "./hand";
import { Hands } from "./hands";
import { type Felt, sampleEvery, Samples, type Sense } from "./samples";
import { type Failure, keepOpen, CALL_TIMEOUT_MS, server, sessions, sleep } from "./server";
import { gridOf, Sheet } from "./sheet";
import type { Place, Surface } from "./surface";
import { VersionFollower } from "./version-follower";

/** Interval between two requests for the session's status. */
const ASK_MS = 1000;
/** The same for the trainer of an exercise, who is to see at once what is hidden while it goes on. */
const TRAINER_ASK_MS = 500;

/** The default refinement has at most this many vertices; the user may select more. */
const CHOSEN_VERTICES = 40_000;
/** Maximum number of vertices. With more, browsers are slow on any machine. */
const MAX_VERTICES = 1_500_000;

/** Maximum number of points of a sheet. */
const MAX_POINTS = 1 << 23;

/** Interval between two requests for a wound of which the server does not know the newest version yet. */
const WOUND_MS = 100;

/** Changes of the topology within this time belong to one cut, s of simulated time. */
const ONE_CUT_S = 1;

/** A moment of a journal. */
export interface JournalMoment {
  sessionId: string;
  run: number;
  step: bigint;
}

/** Maximum number of those who cut that are named. */
const MAX_CUTTERS = 8;

/** Callbacks of a shown session. */
export interface Told {
  onSession: (session: Session) => void;
  onTrouble: (failure: Failure, waitMs: number) => void;
  onWell: () => void;
  /** A frame has arrived. */
  onFrame: () => void;
  /** What blades have cut, or tips burnt, has changed as it is drawn. */
  onCut: () => void;
  /** What the caller may no longer do: the server's reason. */
  onBarred: (reason: string) => void;
}

export class ShownSession {
  readonly frames = new Frames(server);
  readonly samples: Samples;
  readonly hands: Hands;
  readonly reach: Reach;
  /** Width of the tissue, m. */
  readonly widthM: number;
  /** Typical edge length of a mesh, m. */
  readonly edgeM: number;
  readonly rateHz: number;
  readonly mostRefinement: number;
  surface: Surface;
  refinement = 0;
  roundTripMs: number | undefined;
  /** When the server last answered, by this window's clock. */
  heardMs = performance.now();
  /** Whether the server does not answer. If so, only one request at a time asks whether it is back. */
  private isLost = false;
  private asking = new AbortController();
  /** When its newest answer was requested. */
  askedMs = -Infinity;
  /** Points along the sides of a sheet; for a body, the number of vertices and 1. */
  private readonly points: [number, number];
  private readonly ended = new AbortController();
  private seen = new AbortController();
  private watching = new AbortController();
  /** Simulated and local time, s, from the fastest recent answer, and that answer's round trip. */
  private clock: { timeS: number; localS: number; roundTripMs: number; atMs: number; overruns: bigint } | undefined;
  private readonly mesh: MeshData | undefined;
  /** What blades have cut of the surface, as far as it is known here. */
  wound: Wound;
  /** What tips have burnt of it. */
  readonly burning: Burning;
  /** The longest time that the page has worked on one change of the wound, ms. */
  longestCutMs = 0;
  /** Follows the versions of the topology; if this server's wounds can't be shown, the surface stays whole. */
  private readonly cuts: VersionFollower;
  /** Whether what is drawn may be the wound of another session. */
  private hasFormerWound = false;
  /** The moments before the cuts that this page saw, also in the sessions from which this one goes on. */
  readonly beforeCuts: JournalMoment[];
  private frame: FrameTold | undefined;
  /** Simulated time of the last change of the topology, s. */
  private cutS = -Infinity;
  /** The hand and the press with which this page cut then; undefined if it did not. */
  private cutDrag: string | undefined;
  /** Who has cut while this page looked on. */
  readonly cutters = new Set<string>();

  /**
   * Loads what the session shows: the surface of every tissue whose points are no grid. With `former`, takes over the
   * surface of a session with the same tissue.
   */
  static async to(
    session: Session,
    holder: string,
    refinement: number | undefined,
    told: Told,
    former?: ShownSession,
  ): Promise<ShownSession> {
    check(session);
    const mesh = former ? former.mesh : gridOf(session.scene) ? undefined : await fetchMesh(server, session.sessionId);
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
    const grid = gridOf(session.scene);
    const count = mesh ? mesh.restM.length / 3 : 1;
    this.points = mesh ? [count, 1] : (grid?.points ?? [1, 1]);
    this.rateHz = session.scene?.stepping?.rateHz ?? 1000;
    const k = session.scene?.springs?.stiffnessNPerM ?? 0;
    const anchor = session.scene?.anchorSprings?.stiffnessNPerM ?? 0;
    const tipShape = session.scene?.solid === undefined ? TipShape.DISC : TipShape.RIGID_DISC;
    if (mesh) {
      const sizeM = boxOf(mesh);
      const lengthM = fingerM(sizeM, mesh.edgeM);
      // The more points share a push, the less of it the springs between them carry.
      const aPointN = 2 * lengthM * (anchor + 2 * k * Math.min(1, (mesh.edgeM / lengthM) ** 2));
      this.surface = former?.surface ?? new Body(mesh, lengthM, session.points);
      const { sum } = this.surface.push(this.surface.middle(), lengthM);
      // If the springs of a tissue differ, no such force can be given.
      const mostN = rounded(sum * aPointN || 2);
      this.reach = { lengthM, mostN, pointN: mostN / sum, depthM: 3 * lengthM, tipShape, jawTips: 1 };
      this.widthM = sizeM;
    } else {
      // A push falls off over a spacing, so that a few points share it: its depth is about two spacings.
      const lengthM = grid?.spacingM ?? 1;
      const mostN = 2 * lengthM * (2 * k + anchor) || lengthM;
      this.reach = { lengthM, mostN, pointN: mostN, depthM: 3 * lengthM, tipShape, jawTips: 3 };
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
    this.wound = this.newWound();
    this.hasFormerWound = former !== undefined && (former.hasFormerWound || former.wound.version > 0);
    this.cuts = new VersionFollower((newest) => this.hasFormerWound || this.wound.version < newest, () => this.askForCuts(), this.ended.signal);
    this.burning = new Burning(session.sessionId, this.surface, this.refinement, former !== undefined, this.ended.signal, () => this.told.onCut());
    this.beforeCuts = session.playback ? [] : (former?.beforeCuts ?? []);
    this.frames.onFrame = (frame) => this.framed(frame);
    this.samples = new Samples(this.reach.pointN, (tool) => this.sense(tool), (tools) => this.joined(tools));
    // Until its own samples arrive, those of the former session are shown.
    if (former) this.samples.follow(former.samples, session.simulationTimeS);
    // All pages use the same tools.
    const hand = (firstTool: number) => new Hand(session.sessionId, holder, this.reach, () => this.surface, sampleEvery(this.rateHz), firstTool);
    this.hands = new Hands([hand(0), hand(2 * this.reach.jawTips)]);
    for (const each of this.hands.both) each.onSample = (sample) => this.samples.takeOwn(sample);
  }

  /** Returns the number of vertices along a side of a sheet at refinement n: M = (m − 1)·n + m. */
  private vertices(n: number): number {
    return this.points.map((m) => (m - 1) * n + m).reduce((x, y) => x * y);
  }

  private newWound(): Wound {
    const { vertexCount, triangleCount, field } = this.surface;
    return new Wound(vertexCount, triangleCount, field.cutRows * field.ny);
  }

  private newSheet(): Surface {
    const n = this.refinement;
    const [nx, ny] = this.points.map((m) => (m - 1) * n + m) as [number, number];
    return new Sheet(nx, ny, this.reach.lengthM / (n + 1), n + 1);
  }

  /** The hand that is chosen. */
  get hand(): Hand {
    return this.hands.chosen;
  }

  /** Returns the side that a tool touches. How a force is distributed is known only of this page's hands. */
  private sense(tool: Felt): Sense {
    const hand = this.handOf(tool);
    const outward = hand?.outward ?? this.placeOf(tool)?.outward ?? [0, 0, 1];
    return { outward, share: hand?.share ?? 1 };
  }

  /** Returns where a tool touches. For this page's hands, the side is known. */
  placeOf(tool: Felt): Place | undefined {
    return this.surface.ofTool(tool, this.handOf(tool)?.isOuter);
  }

  /** Returns the hand of this page whose first tool this is, if it holds it. */
  handOf({ tool }: Felt): Hand | undefined {
    return this.hands.both.find((hand) => hand.holds && hand.tool.tool === tool);
  }

  /** Returns tools with those of each hand as one, the chosen hand's first. */
  private joined(tools: Felt[]): Felt[] {
    const of = (hand: Hand) => tools.filter(({ tool }) => hand.holds && hand.tool.has(tool));
    const { chosen, other } = this.hands;
    const own = [of(chosen), of(other)] as const;
    const others = tools.filter((tool) => !own.flat().includes(tool));
    return [...this.joinedOf(chosen, own[0]), ...this.joinedOf(other, own[1]), ...others];
  }

  /** Returns the tools of a grasper as one: at the tip that feels most, with the sum of the forces. */
  private joinedOf({ grasps, grasper }: Hand, own: Felt[]): Felt[] {
    const felt = grasps ? grasper.felt(own) : undefined;
    if (!felt || own.length === 0) return own;
    const most = own.reduce((a, b) => (norm(b.forceN) > norm(a.forceN) ? b : a));
    const appliedN = own.reduce<Vec3>((sum, tool) => plus(sum, tool.appliedN), [0, 0, 0]);
    const openingNM = grasper.grips ? felt.openingNM : undefined;
    return [{ ...most, tool: grasper.tool.tool, forceN: felt.forceN, appliedN, openingNM }];
  }

  begin(): void {
    void this.ask();
    this.look();
    this.cuts.heard(this.session.topologyVersion);
    this.burning.heard(0);
  }

  private framed(frame: FrameTold): void {
    this.told.onFrame();
    this.noteMoment(frame);
    this.cuts.heard(frame.topologyVersion);
    this.burning.heard(frame.burnVersion);
  }

  /** Asks for what blades have cut since, and shows it. */
  private async askForCuts(): Promise<void> {
    const { surface, wound } = this;
    const { signal } = this.ended;
    const { version } = wound;
    const change = await followWound(server, this.session.sessionId, this.refinement, wound, signal);
    // Another refinement has another wound.
    if (signal.aborted || surface !== this.surface) return;
    this.hasFormerWound = false;
    const begunMs = performance.now();
    surface.wound.take(wound, change);
    this.longestCutMs = Math.max(this.longestCutMs, performance.now() - begunMs);
    this.told.onCut();
    if (wound.version === version) await sleep(WOUND_MS, signal);
  }

  /** Notes the moment before a cut that begins. */
  private noteMoment(frame: FrameTold): void {
    const { frame: before, session } = this;
    this.frame = frame;
    if (!before || frame.topologyVersion <= before.topologyVersion) return;
    // A drag is one cut, however long it rests between.
    const press = this.hands.both.findIndex((hand) => hand.severs && hand.holds);
    const drag = press < 0 ? undefined : `${press} ${this.hands.both[press]!.presses}`;
    const isSameDrag = drag !== undefined && drag === this.cutDrag;
    const isNew = frame.timeS - this.cutS > ONE_CUT_S && !isSameDrag;
    [this.cutS, this.cutDrag] = [frame.timeS, drag];
    if (isNew && session.journal && !session.playback) {
      this.beforeCuts.push({ sessionId: session.sessionId, run: session.journal.run, step: before.step });
    }
  }

  /** Notes who cuts: this page, or else whoever holds other tools. */
  private noteCutters(before: Session, now: Session): void {
    if (now.severed <= before.severed) return;
    const { both } = this.hands;
    if (both.some((hand) => hand.severs && hand.holds)) return void this.cutters.add("you");
    for (const { tool, holder } of now.heldTools) if (!this.hands.of(tool) && this.cutters.size < MAX_CUTTERS) this.cutters.add(holder || "somebody");
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

  /** A stream has failed. Whether the server is there is determined by the status requests. */
  private broken(failure: Failure, waitMs: number): void {
    if (!this.isLost && !isBarred(failure.reason)) this.told.onTrouble(failure, waitMs);
  }

  /** Closes the streams and leaves the session unchanged. */
  lookAway(): void {
    this.seen.abort();
  }

  /** Switches to another refinement of a sheet, with a new surface. */
  refine(n: number): Surface {
    if (this.mesh) return this.surface;
    this.refinement = n;
    this.surface = this.newSheet();
    this.wound = this.newWound();
    void this.cuts.follow();
    this.burning.refine(this.surface, n);
    if (!this.seen.signal.aborted) this.watch();
    return this.surface;
  }

  leave(): void {
    void this.hands.letGo();
    this.ended.abort();
    this.seen.abort();
  }

  /** Speed of its time: different from 1 only in a playback. */
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
          await sleep(this.session.exercise?.role === ExerciseRole.TRAINER ? TRAINER_ASK_MS : ASK_MS, signal);
        }
      },
      this.asking.signal,
      (failure, waitMs) => {
        if (failure.isGone || isBarred(failure.reason)) this.leave();
        if (isBarred(failure.reason)) return this.told.onBarred(failure.reason);
        // Otherwise each stream would retry on its own.
        this.isLost = true;
        this.seen.abort();
        this.told.onTrouble(failure, waitMs);
      },
    );
  }

  private heard(session: Session, begunMs: number, endedMs: number): void {
    this.noteCutters(this.session, session);
    this.session = session;
    this.cuts.heard(session.topologyVersion);
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

/** Throws if a session can't be shown, whatever its server claims. */
function check({ scene }: Session): void {
  const isPositive = (value = 1) => Number.isFinite(value) && value > 0;
  const { stepping, springs, anchorSprings } = scene ?? {};
  const grid = gridOf(scene);
  const isNumber = (value = 0) => Number.isFinite(value);
  if (!isPositive(stepping?.rateHz)) throw new RangeError(`it has ${stepping?.rateHz} steps a second`);
  if (!isNumber(springs?.stiffnessNPerM) || !isNumber(anchorSprings?.stiffnessNPerM)) throw new RangeError("its springs are no numbers");
  if (!grid) return;
  const [pointsX, pointsY] = grid.points;
  if (pointsX < 1 || pointsY < 1 || pointsX * pointsY > MAX_POINTS || !isPositive(grid.spacingM)) {
    throw new RangeError(`it is a sheet of ${pointsX} × ${pointsY} points, ${grid.spacingM} m apart`);
  }
}

/** Returns the diagonal of the bounding box of a mesh, m. */
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

/** Rounds a force to one or two digits, as the maximum of a slider. */
function rounded(force: number): number {
  return Number(force.toPrecision(2));
}
