// Threads and clips on the page: the places that the user picks, the list of what the session has, and how long a thread is.
//
// A thread or clip belongs to the session. So all of them are listed, also those of others, and anybody may take them off.

import { type MessageInitShape } from "@bufbuild/protobuf";
import { norm, plus, type Tool, type Vec3 } from "palpate";
import type { BiteSchema, LaidTie, Thread } from "palpate/v1";
import { Vector3 } from "three";
import type { Mode } from "./hand";
import { part } from "./page";
import { quantity } from "./plot";
import type { ShownSession } from "./session";
import type { Stage } from "./stage";
import type { Place, Surface } from "./surface";
import type { ShownTie } from "./tie-marks";

/** Most bites of a thread, and of a clip. */
const MOST = { thread: 16, clip: 2 };
/** Threads and clips are numbered below this. */
const NUMBERS = 64;
/** Radius of a bite, in lengths of a finger. */
const BITE = 0.4;
/** Friction of a thread. */
const FRICTION = 0.2;
/** Places of the surface between two bites over which a thread is drawn. */
const BETWEEN = 6;
/** Time after which a session tells of what was just laid, ms. */
const TOLD_MS = 80;
/** A tool that has only laid or cut something is released after this time, so that others can use it. */
const LEAVES_MS = 600;

/** Returns whether a press picks a bite. */
export function sews(mode: Mode): mode is "thread" | "clip" {
  return mode === "thread" || mode === "clip";
}

function bitesOf({ tie }: LaidTie): Vec3[] {
  if (tie?.kind.case !== "thread" && tie?.kind.case !== "clip") return [];
  return tie.kind.value.bites.map(({ placeM }) => [placeM?.x ?? 0, placeM?.y ?? 0, placeM?.z ?? 0] as const);
}

/** Returns the sum of the distances between successive bites at rest, m. */
function wayM(bites: readonly Vec3[]): number {
  return bites.slice(1).reduce((sum, bite, k) => sum + norm(plus(bite, bites[k]!, -1)), 0);
}

/** Returns a thread or clip as drawn. */
function shownTie(surface: Surface, laid: LaidTie): ShownTie {
  const bites = bitesOf(laid).map((restM) => surface.at(restM));
  const isClip = laid.tie?.kind.case === "clip";
  const way = bites.flatMap((bite, k) => {
    const next = bites[k + 1];
    if (!next || isClip) return [bite];
    const apart = new Vector3(...plus(next.restM, bite.restM, -1));
    const between = Array.from({ length: BETWEEN }, (_, at) => surface.beside(bite, apart.clone().multiplyScalar((at + 1) / (BETWEEN + 1))));
    return [bite, ...between];
  });
  return { isClip, bites, way };
}

/** What this module needs of the page. */
export interface SewingHost {
  present: () => ShownSession | undefined;
  onChange: () => void;
}

export class Sewing {
  private readonly length = part("thread-length", HTMLInputElement);
  private readonly list = part("ties", HTMLUListElement);
  private bites: Place[] = [];
  /** The thread whose length the slider sets. */
  private chosen: number | undefined;
  /** What was laid and the session has not told of yet. */
  private unseen: number | undefined;
  private leaving: ReturnType<typeof setTimeout> | undefined;
  private isSending = false;
  private isStale = false;
  private drawn = { surface: undefined as Surface | undefined, key: "" };

  constructor(
    private readonly stage: Stage,
    private readonly host: SewingHost,
  ) {
    for (const id of ["lay", "lay-here"]) part(id, HTMLButtonElement).addEventListener("click", () => void this.lay());
    part("drop-bites", HTMLButtonElement).addEventListener("click", () => this.drop());
    this.length.addEventListener("input", () => void this.tighten());
  }

  /** Number of places that are picked. */
  get picked(): number {
    return this.bites.length;
  }

  private get kind(): "thread" | "clip" | undefined {
    const mode = this.host.present()?.hand.mode;
    return mode && sews(mode) ? mode : undefined;
  }

  /** Length of a thread as a part of the way between its bites at rest. */
  private get part(): number {
    return Number(this.length.value);
  }

  /** Picks a place for the next thread or clip. */
  pick(place: Place): void {
    if (this.unseen !== undefined || this.kind === undefined || this.bites.length === MOST[this.kind]) return;
    this.bites = [...this.bites, place];
    // A clip has no other choice.
    if (this.kind === "clip" && this.bites.length === MOST.clip) return void this.lay();
    this.tell();
  }

  /** Takes back the last place. Returns false if none is picked. */
  unpick(): boolean {
    if (this.bites.length === 0) return false;
    this.bites = this.bites.slice(0, -1);
    this.tell();
    return true;
  }

  /** Takes back all places. Returns false if none is picked. */
  drop(): boolean {
    if (this.bites.length === 0) return false;
    [this.bites, this.unseen] = [[], undefined];
    this.tell();
    return true;
  }

  /** Lays the thread or clip through what is picked. */
  async lay(): Promise<void> {
    const [session, kind] = [this.host.present(), this.kind];
    if (!session || !kind || this.bites.length < 2 || this.unseen !== undefined) return;
    const taken = new Set(session.session.ties.map(({ tie }) => tie?.number));
    const number = Array.from({ length: NUMBERS }, (_, k) => k).find((k) => !taken.has(k)) ?? NUMBERS;
    const radiusM = BITE * (session.edgeM || session.reach.lengthM);
    const bites: MessageInitShape<typeof BiteSchema>[] = this.bites.map(({ restM: [x, y, z] }) => ({ placeM: { x, y, z }, radiusM }));
    const lengthM = this.part * wayM(this.bites.map(({ restM }) => restM));
    this.unseen = number;
    const { tool } = session.hand;
    const isLaid = await (kind === "clip" ? tool.clip(number, { bites }) : tool.thread(number, { bites, lengthM, friction: FRICTION }));
    if (this.host.present() !== session) return;
    if (!isLaid) this.unseen = undefined;
    else if (kind === "thread") this.chosen = number;
    this.done(session, tool);
    this.tell();
  }

  /** Gives the chosen thread the length of the slider: one call at a time, the newest length last. */
  private async tighten(): Promise<void> {
    this.tell();
    this.isStale = true;
    if (this.isSending) return;
    this.isSending = true;
    while (this.isStale) {
      this.isStale = false;
      const session = this.host.present();
      const thread = session && this.threadOf(session, this.chosen);
      if (!session || !thread || this.chosen === undefined) break;
      const { bites, friction, strengthN } = thread.value;
      const { tool } = session.hand;
      await tool.thread(this.chosen, { bites, lengthM: this.part * wayM(thread.bites), friction, strengthN });
      this.done(session, tool);
    }
    this.isSending = false;
  }

  private async takeOff(number: number): Promise<void> {
    const session = this.host.present();
    if (!session) return;
    const { tool } = session.hand;
    await tool.untie(number);
    this.done(session, tool);
  }

  /** Asks for what was done, and leaves the tool to others unless it touches. */
  private done(session: ShownSession, tool: Tool): void {
    setTimeout(() => this.host.present() === session && session.askNow(), TOLD_MS);
    clearTimeout(this.leaving);
    this.leaving = setTimeout(() => {
      if (!tool.touches) void tool.letGo();
    }, LEAVES_MS);
  }

  /** Returns a thread of the session by its number, and its bites. */
  private threadOf({ session }: ShownSession, number: number | undefined): { value: Thread; bites: Vec3[]; lengthM: number } | undefined {
    const laid = session.ties.find(({ tie }) => tie?.number === number);
    return laid?.tie?.kind.case === "thread" ? { value: laid.tie.kind.value, bites: bitesOf(laid), lengthM: laid.lengthM } : undefined;
  }

  /** Forgets what was picked in another session, or with another tool. */
  begin(): void {
    [this.bites, this.chosen, this.unseen] = [[], undefined, undefined];
    this.tell();
  }

  /** Shows the threads and clips of the session as it is now. */
  tell(): void {
    const session = this.host.present();
    if (!session) return;
    const { ties } = session.session;
    if (this.unseen !== undefined && ties.some(({ tie }) => tie?.number === this.unseen)) [this.bites, this.unseen] = [[], undefined];
    if (this.chosen !== undefined && this.unseen !== this.chosen && !ties.some(({ tie }) => tie?.number === this.chosen)) this.chosen = undefined;
    this.tellControls(session);
    this.tellList(ties);
    this.draw(session);
    this.host.onChange();
  }

  private tellControls(session: ShownSession): void {
    const { kind, bites } = this;
    part("sewing", HTMLElement).hidden = kind === undefined;
    part("length-part", HTMLElement).hidden = kind !== "thread" && this.chosen === undefined;
    const count = bites.length === 1 ? "1 place" : `${bites.length} places`;
    const next = kind === "clip" ? "Press the two places that the clip holds together." : "Press where the thread goes through the tissue.";
    const text = bites.length === 0 ? next : this.unseen !== undefined ? "Laying it …" : bites.length < 2 ? `${count}: press the next one.` : `${count}: more, or Enter.`;
    const line = part("bites", HTMLElement);
    if (line.textContent !== text) line.textContent = text;
    const isReady = kind !== undefined && bites.length >= 2 && this.unseen === undefined;
    part("lay", HTMLButtonElement).disabled = !isReady;
    part("lay-here", HTMLButtonElement).hidden = !isReady;
    part("drop-bites", HTMLButtonElement).disabled = bites.length === 0;
    const chosen = this.threadOf(session, this.chosen);
    const way = wayM(chosen?.bites ?? bites.map(({ restM }) => restM));
    const percent = `${Math.round(100 * this.part)} %`;
    part("thread-length-value", HTMLOutputElement).value = way > 0 ? quantity(this.part * way, "m") : percent;
    this.length.setAttribute("aria-valuetext", `${percent} of the way between its bites`);
  }

  private tellList(ties: readonly LaidTie[]): void {
    this.list.hidden = ties.length === 0;
    while (this.list.children.length > ties.length) this.list.lastElementChild?.remove();
    ties.forEach((laid, index) => {
      const number = laid.tie?.number ?? 0;
      const isThread = laid.tie?.kind.case === "thread";
      let item = this.list.children[index] as HTMLLIElement | undefined;
      if (!item) {
        item = document.createElement("li");
        const [pick, off] = [document.createElement("button"), document.createElement("button")];
        for (const button of [pick, off]) button.type = "button";
        off.textContent = "Take off";
        const numberOf = () => Number(off.dataset.number);
        pick.addEventListener("click", () => this.choose(numberOf()));
        off.addEventListener("click", () => void this.takeOff(numberOf()));
        item.append(pick, off);
        this.list.append(item);
      }
      const [pick, off] = item.children as unknown as [HTMLButtonElement, HTMLButtonElement];
      const name = `${isThread ? "Thread" : "Clip"} ${number + 1}`;
      const state = laid.broken ? "broken" : `${quantity(laid.pathM, "m")}, ${quantity(laid.tensionN, "N")}`;
      const text = `${name}: ${state}`;
      if (pick.textContent !== text) pick.textContent = text;
      pick.disabled = !isThread;
      pick.setAttribute("aria-pressed", String(number === this.chosen));
      off.dataset.number = String(number);
      off.setAttribute("aria-label", `Take off ${name.toLowerCase()}`);
    });
  }

  /** The slider sets the length of this thread from now on. */
  private choose(number: number): void {
    const session = this.host.present();
    const thread = session && this.threadOf(session, number);
    if (!thread) return;
    this.chosen = this.chosen === number ? undefined : number;
    if (this.chosen !== undefined) this.length.value = String(thread.value.lengthM / wayM(thread.bites));
    this.tell();
  }

  /** Draws what has changed. */
  private draw({ surface, session }: ShownSession): void {
    const shown = session.ties.filter(({ broken }) => !broken);
    const key = JSON.stringify([shown.map(({ tie }) => [tie?.kind.case, tie?.number]), shown.map(bitesOf)]);
    const isSame = this.drawn.surface === surface && this.drawn.key === key;
    if (!isSame) this.drawn = { surface, key };
    this.stage.setTies(isSame ? undefined : shown.map((laid) => shownTie(surface, laid)), this.bites);
  }
}
