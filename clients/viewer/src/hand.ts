// A hand: a tool (of the package `palpate`) that is controlled by mouse, finger or keys. The page has two (hands.ts).
//
// A push is the paper's surgical force at the place where the drag began, leaning in the direction of the drag. A
// stroke moves that place along, leaning in its direction of movement. A pull grasps a mass point and moves it with
// the drag. A tip is held at a depth, and glides. A blade stands upright at a depth, and cuts along the drag.
// A cautery is a small tip that burns what it touches for long enough. A grasper (grasper.ts) has several tools. A place has a side on which
// it is touched, and pushes go into the tissue from there. A parked tool stays where it is, as a held instrument does.

import { type Action, type Lead, plus, Tool, type Vec3, type Wanted } from "palpate";
import { type Sample, TipShape } from "palpate/v1";
import type { ShownBlade } from "./blade-mark";
import { Grasper, type View } from "./grasper";
import { server } from "./server";
import type { Place, Surface } from "./surface";

export type Mode = "push" | "pull" | "stroke" | "tip" | "blade" | "cautery" | "grasper" | "thread" | "clip";

/** Length of a blade's edge, in depths of the deepest cut: it reaches out of the tissue, also of one that gives way. */
const EDGE = 2;
/** How far around its edge a blade feels the surface, in falloff lengths. */
const BLADE = 0.3;
/** Radius of a cautery in falloff lengths, and its depth in depths of a tip. */
const CAUTERY = { radius: 0.6, depth: 0.4 };
/** Time of contact after which a cautery severs the tissue, s. */
export const BURN_S = 0.6;

/** A tip moves down from beside the tissue in this time, so that the server knows from which side it comes. */
const SINK_MS = 250;
/** Additional time until what it feels is known here. */
const SETTLES_MS = 400;

/** Effect of strength 1 on the tissue. */
export interface Reach {
  /** Falloff length of a push; on a sheet, the spacing of its points. */
  lengthM: number;
  /** Force of a push: on a sheet at the centre of the tool, on a body in total, N. */
  mostN: number;
  /** Approximate force of the strongest push on the point at the centre of the tool, N. */
  pointN: number;
  /** Length of a drag that tilts a push fully, and of a pull by keys, m. */
  depthM: number;
  /** Shape of the tip: a solid yields to a rigid one at any depth, and is unstable under an even pressure that is deep. */
  tipShape: TipShape;
  /** Number of tips of a grasper's jaw: on a mesh, each takes much time to compute. */
  jawTips: number;
}

export class Hand {
  /** Strength, 0 to 1. */
  strength = 0.5;
  /** How often it has begun to press. */
  presses = 0;
  readonly grasper: Grasper;
  onChange: () => void = () => {};
  /** Called with samples of the hand's tools that arrived by datagram. */
  onSample: (sample: Sample) => void = () => {};
  onJaws: () => void = () => {};
  onRefused: (message: string, reason: string) => void = () => {};
  private readonly single: Tool;
  private chosen: Mode = "push";
  private place: Place | undefined;
  private onSurfaceM: Vec3 = [0, 0, 0];
  private leanM: Vec3 = [0, 0, 0];
  /** Time from which the tip moves down; undefined while the server does not act on this touch. */
  private sinksFromMs: number | undefined;
  private isLeft = false;
  private bladeLead: Lead | undefined;
  /** How far the tissue is shifted sideways where the blade goes, m. */
  private shiftedM: Vec3 = [0, 0, 0];

  /** The hand has the tool `firstTool` of the session, and a grasper those after it, too. */
  constructor(
    sessionId: string,
    name: string,
    readonly reach: Reach,
    private readonly surface: () => Surface,
    sampleEverySteps: number,
    firstTool: number,
  ) {
    this.single = new Tool(server, sessionId, name, sampleEverySteps, firstTool);
    this.grasper = new Grasper(sessionId, name, reach, sampleEverySteps, firstTool);
    for (const tool of [this.single, this.grasper.tool]) {
      tool.onChange = () => this.onChange();
      tool.onRefused = (message, reason) => this.onRefused(message, reason);
      tool.datagrams.onSample = (sample) => this.onSample(sample);
    }
  }

  /** The tool of the present mode. */
  get tool(): Tool {
    return this.mode === "grasper" ? this.grasper.tool : this.single;
  }

  get mode(): Mode {
    return this.chosen;
  }

  /** Chooses another mode, which ends a touch. */
  set mode(mode: Mode) {
    const former = this.tool;
    this.isLeft = false;
    former.rest();
    this.chosen = mode;
    if (former !== this.tool) this.tool.takeAfter(former.letGo());
  }

  /** Whether a grasper touches. */
  get grasps(): boolean {
    return this.mode === "grasper" && this.holds;
  }

  get holds(): boolean {
    return this.tool.holds;
  }

  get touches(): boolean {
    return this.tool.touches;
  }

  /** Whether the tool stays where it is although nothing leads it. */
  get isParked(): boolean {
    return this.isLeft && this.touches;
  }

  set isParked(on: boolean) {
    this.isLeft = on && this.touches;
    this.tool.changed();
    this.onChange();
  }

  /** Whether the tool holds tissue, which moves with a drag from wherever that begins. */
  get holdsTissue(): boolean {
    return this.touches && (this.mode === "pull" || (this.mode === "grasper" && this.grasper.grips));
  }

  /** How far it leans from the place of the press, or from where it gripped, m. */
  get leaningM(): Vec3 {
    return this.leanM;
  }

  /** Where the tissue that it holds is drawn to, m. */
  get heldM(): Vec3 {
    return (this.grasps ? this.grasper.endsM : undefined) ?? plus(this.onSurfaceM, this.leanM);
  }

  /**
   * Direction out of the tissue at the place that it touches or touched last. A tip may slip to a place with another
   * direction.
   */
  get outward(): Vec3 | undefined {
    return this.isPosed ? undefined : this.place?.outward;
  }

  /** Whether it touches the outer side of the tissue. It stays on its side wherever it slips. */
  get isOuter(): boolean | undefined {
    return this.place && this.surface().isOuter(this.place);
  }

  /** Its blade as drawn; undefined while that does not touch. */
  get blade(): ShownBlade | undefined {
    const { edgeM, positionM } = this.bladeLead ?? {};
    if (this.mode !== "blade" || !this.touches || !edgeM || !positionM) return undefined;
    return { tool: this.tool.tool, tipM: positionM, edgeM };
  }

  /** Whether it severs what it touches. */
  get severs(): boolean {
    return this.mode === "blade" || this.mode === "cautery";
  }

  /** Whether poses lead it: it is at a depth, and glides. */
  get isPosed(): boolean {
    return this.mode === "tip" || this.mode === "blade" || this.mode === "cautery" || this.mode === "grasper";
  }

  /** Depth of a tip, a blade, a cautery or of open jaws, which are thinner, m. */
  get depthM(): number {
    const part = this.mode === "grasper" ? 0.5 : this.mode === "cautery" ? CAUTERY.depth : 1;
    return part * this.strength * this.reach.depthM;
  }

  /** Target depth of the tip, once it has had the time to get there; undefined if no tip is used. */
  get setM(): number | undefined {
    const hasSunk = performance.now() - (this.sinksFromMs ?? Infinity) > SINK_MS + SETTLES_MS;
    return this.mode === "tip" && this.tool.touches && hasSunk ? this.depthM : undefined;
  }

  /** Factor for displayed forces on the tool: for a push on a body, the total force is shown. */
  get share(): number {
    return this.place && ["push", "stroke"].includes(this.mode) ? this.surface().push(this.place, this.reach.lengthM).share : 1;
  }

  /** Begins to touch at `place`, which is now at `onSurfaceM`. */
  async press(place: Place, onSurfaceM: Vec3, view: View): Promise<void> {
    this.presses++;
    this.isLeft = false;
    this.place = place;
    this.onSurfaceM = onSurfaceM;
    this.shiftedM = this.shiftedAt(place);
    this.leanM = [0, 0, 0];
    this.sinksFromMs = undefined;
    if (this.mode === "grasper") this.grasper.begin(place, view);
    await this.tool.touch((now) => this.wanted(place, now));
  }

  /** Moves to another place, leaning in the direction of the movement. */
  goOn(place: Place): void {
    const [from, to] = [this.place?.restM ?? place.restM, place.restM];
    const way = [to[0] - from[0], to[1] - from[1], to[2] - from[2]] as const;
    // The earlier tilt fades over the length that tilts a push fully.
    const kept = Math.exp(-Math.hypot(...way) / this.reach.depthM);
    this.place = place;
    this.shiftedM = this.shiftedAt(place);
    this.lean([kept * this.leanM[0] + way[0], kept * this.leanM[1] + way[1], kept * this.leanM[2] + way[2]]);
  }

  /** Opens the jaws to a fraction of their largest angle. */
  openJaws(part: number): void {
    const { grips } = this.grasper;
    this.grasper.opening = part;
    // What they grip moves with the drag from here on.
    if (this.grasper.grips && !grips) this.leanM = [0, 0, 0];
    this.onJaws();
  }

  /** Leans by `leanM` from the place of the press. */
  lean(leanM: Vec3): void {
    if (!this.tool.touches) return;
    this.leanM = leanM;
    this.tool.changed();
  }

  /** Ends the touch, unless the tool is parked; the hand keeps the tool for a while. */
  lift(): void {
    if (!this.isParked) this.tool.rest();
  }

  /** Releases the tool. */
  letGo(): Promise<void> {
    this.isLeft = false;
    return this.tool.letGo();
  }

  /** Returns what the tool should do: at the place of the press, or where it has moved to. */
  private wanted(pressed: Place, now: number): Wanted {
    const place = this.place ?? pressed;
    if (this.isPosed) {
      this.sinksFromMs = this.tool.isActing ? (this.sinksFromMs ?? now) : undefined;
      const isMoving = this.sunk(now) < 1;
      const stays = this.isParked;
      if (this.mode !== "grasper") return { leads: [this.tip(place, now)], isMoving, stays };
      const wanted = this.grasper.wanted(place, this.outM(now), !isMoving, this.leanM, now);
      return { ...wanted, isMoving: isMoving || wanted.isMoving, stays };
    }
    return { action: this.action(place) };
  }

  /** Returns which part of its way down the tip has gone. */
  private sunk(now: number): number {
    return this.sinksFromMs === undefined ? 0 : Math.min(1, (now - this.sinksFromMs) / SINK_MS);
  }

  /** Returns how far the tissue is shifted sideways at a place, m. */
  private shiftedAt(place: Place): Vec3 {
    const { x, y, z } = this.surface().displacementAt(place);
    const [nx, ny, nz] = place.outward;
    return plus([x, y, z], place.outward, -(x * nx + y * ny + z * nz));
  }

  /**
   * Returns the position of the tip at a place. The edge of a blade runs from there straight out of the tissue. A blade that pushes tissue
   * ahead of it goes to where the place is seen: at its place at rest it would stay behind the pointer.
   */
  private tip({ restM, outward }: Place, now: number): Lead {
    const { lengthM, depthM, tipShape } = this.reach;
    const positionM = plus(restM, outward, this.outM(now));
    if (this.mode === "cautery") return { positionM, radiusM: CAUTERY.radius * lengthM, shape: tipShape, burnS: BURN_S };
    if (this.mode !== "blade") return { positionM, radiusM: lengthM, shape: tipShape };
    const edgeM = plus([0, 0, 0], outward, EDGE * depthM);
    const bladeM = plus(positionM, this.shiftedM);
    return (this.bladeLead = { positionM: bladeM, radiusM: BLADE * lengthM, shape: TipShape.BLADE, edgeM });
  }

  /** Returns the height of a tip above its place at rest: on its way from beside the tissue, or at its depth. */
  private outM(now: number): number {
    const part = this.sunk(now);
    return (1 - part) * 1.1 * this.reach.lengthM - part * this.depthM;
  }

  private action(place: Place): Action {
    const { reach } = this;
    const surface = this.surface();
    if (this.mode === "pull") {
      const [from, lean] = [this.onSurfaceM, this.leanM];
      const positionM = { x: from[0] + lean[0], y: from[1] + lean[1], z: from[2] + lean[2] };
      const target = { case: "positionM" as const, value: positionM };
      return { case: "position", value: { ...surface.point(place), target } };
    }
    const middleN = (reach.mostN * this.strength) / surface.push(place, reach.lengthM).sum;
    const value = { centre: surface.centre(place), forceN: this.forceN(middleN, place), falloffPerM: 1 / reach.lengthM };
    return { case: "force", value };
  }

  /**
   * Returns the force: into the tissue, plus a part in the direction of the drag, tilted by 45° when the drag is as
   * long as the reach.
   */
  private forceN(strengthN: number, { outward: n }: Place): { x: number; y: number; z: number } {
    const { leanM: lean, reach } = this;
    const out = lean[0] * n[0] + lean[1] * n[1] + lean[2] * n[2];
    const across = [0, 1, 2].map((c) => (lean[c]! - out * n[c]!) / reach.depthM);
    const most = Math.max(1, Math.hypot(...across));
    const [x, y, z] = across.map((v, c) => v / most - n[c]!) as [number, number, number];
    const scale = strengthN / Math.hypot(x, y, z);
    return { x: x * scale, y: y * scale, z: z * scale };
  }
}
