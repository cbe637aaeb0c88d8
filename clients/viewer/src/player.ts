// The player shows a recording, like a film. A playback is a session that the server creates for this window alone.
// For another moment or speed, it is replaced by another playback.

import { type Session, SessionState } from "palpate/v1";
import { clockText, type JournalName, Recording, whenText } from "./journal";
import { part } from "./page";
import { backoffMs, describe, isGone, isPassing, CALL_TIMEOUT_MS, sessions, sleep } from "./server";
import { excerpt } from "./text";
import { Timeline } from "./timeline";
import type { ShownSession } from "./session";

/** A playback is deleted after this time without a request, because a window that vanished can't delete it. */
const IDLE_S = 120;
/** How often a playback is deleted at most: the first try may wait too long for a connection. */
const DISCARD_TRIES = 5;
/** "What was that?" begins this long before now, and the player's buttons jump by this time. */
export const BACK_S = 10;
/**
 * Minimum interval between two checks of how far a recording has grown, and the interval as a multiple of the
 * duration of a check.
 */
const GROWS_MS = 2000;
const GROWS_TIMES = 10;
/** Playback of a recording in progress continues once this much more is available, s. */
const MORE_S = 1;
const TICK_MS = 50;

/** What the player needs of the page. */
export interface Host {
  present: () => ShownSession | undefined;
  /**
   * Shows a session in place of the present one, which has the same tissue. Returns false if the page shows something
   * else meanwhile.
   */
  exchange: (session: Session, step: number) => Promise<boolean>;
  /** Changes to a live session, which has the same tissue. */
  goLive: (session: Session) => Promise<void>;
  notice: (text: string) => void;
  /** Nothing can be shown any more. */
  over: (why: string) => void;
}

/** A recording, and a playback of it from a step on. */
export interface Opened {
  recording: Recording;
  step: number;
  session: Session;
}

/** The shown part of a recording, in steps, and the session that plays it. */
export interface Shown extends JournalName {
  begin: number;
  end: number;
  step: number;
  isPlaying: boolean;
  /** Whether another moment or speed was chosen and is not shown yet. */
  isBusy: boolean;
  speed: number;
  playback: string;
}

/** Deletes a playback. If the server can't be reached for too long, it does so itself after `IDLE_S`. */
export function discard(playback: Session): void {
  void deleteSoon(playback);
}

async function deleteSoon({ sessionId }: Session): Promise<void> {
  for (let tries = 0; tries < DISCARD_TRIES; tries++) {
    try {
      await sessions.deleteSession({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
      return;
    } catch (error) {
      if (!isPassing(error)) return;
      await sleep(backoffMs(tries));
    }
  }
}

/** Creates a playback of a recording from a step on. */
function playback(recording: Recording, step: number, speed: number, paused: boolean): Promise<Session> {
  const { sessionId, run } = recording;
  const value = { sessionId, run, step: BigInt(step), plays: true, speed };
  return created({ source: { case: "journal", value }, paused, idleTimeoutS: IDLE_S });
}

async function created(request: Parameters<typeof sessions.createSession>[0]): Promise<Session> {
  const { session } = await sessions.createSession(request, { timeoutMs: CALL_TIMEOUT_MS });
  if (!session) throw new Error("the server made no session");
  return session;
}

export class Player {
  private readonly bar = part("player", HTMLElement);
  private readonly button = part("player-play", HTMLButtonElement);
  private readonly time = part("player-time", HTMLElement);
  private readonly title = part("player-title", HTMLElement);
  private readonly speeds = part("player-speed", HTMLSelectElement);
  private readonly goOn = part("go-on", HTMLButtonElement);
  private readonly back = part("back-to-live", HTMLButtonElement);
  private readonly timeline = new Timeline({
    onScrub: (step) => this.seek(step, true),
    onSeek: (step) => this.seek(step),
    onCancel: () => this.seek(this.step),
  });
  private opened: Opened | undefined;
  /** Whether it should play: after a drag, and when the recording grows. */
  private isPlaying = false;
  private isScrubbing = false;
  /** Whether the playback is running, as far as is known here, and since when. */
  private runs = { is: false, sinceMs: 0 };
  /** The chosen step, until it is shown, and whether it still has to be requested. */
  private aimed: number | undefined;
  private isDue = false;
  private isBusy = false;
  private wasPlaying = false;
  /** Whether it waits for a recording in progress to grow. */
  private waits = false;
  /** How often another playback was requested since the last one was lost. */
  private lost = 0;

  constructor(private readonly host: Host) {
    this.button.addEventListener("click", () => this.toggle());
    this.speeds.addEventListener("change", () => this.seek(this.step));
    part("player-back", HTMLButtonElement).addEventListener("click", () => this.by(-BACK_S));
    part("player-forth", HTMLButtonElement).addEventListener("click", () => this.by(BACK_S));
    this.goOn.addEventListener("click", () => void this.branch());
    this.back.addEventListener("click", () => void this.toLive());
    document.addEventListener("keydown", (event) => this.key(event));
    setInterval(() => this.tick(), TICK_MS);
  }

  /** Creates a playback from a step that depends on the length of the recording. Then show it, and `attach` it. */
  async begin(of: JournalName, from: (recording: Recording) => number): Promise<Opened> {
    const recording = await Recording.of(of);
    const step = recording.clamp(from(recording));
    return { recording, step, session: await playback(recording, step, 1, false) };
  }

  /** To be called when the page shows this playback. */
  attach(opened: Opened): void {
    this.close();
    this.opened = opened;
    const { recording, session } = opened;
    this.isPlaying = session.state === SessionState.RUNNING;
    this.runs = { is: this.isPlaying, sinceMs: performance.now() };
    this.speeds.value = String(session.playback?.speed ?? 1);
    this.bar.hidden = false;
    this.timeline.show(recording);
    this.tell();
    if (recording.fault) this.host.notice(`The recording is shown up to where its file is ${recording.fault}.`);
    if (recording.isLive) void this.grow();
  }

  /** Leaves the recording. */
  close(): void {
    const { opened } = this;
    if (!opened) return;
    this.opened = this.aimed = undefined;
    this.isDue = this.isScrubbing = this.isPlaying = this.wasPlaying = this.waits = false;
    this.lost = 0;
    this.bar.hidden = true;
    discard(opened.session);
  }

  get isOpen(): boolean {
    return this.opened !== undefined;
  }

  /** What is shown, for the page's address and for tests. */
  get moment(): Shown | undefined {
    if (!this.opened) return undefined;
    const { recording, session } = this.opened;
    const { sessionId, run, begin, end } = recording;
    const isBusy = this.isBusy || this.aimed !== undefined;
    const { step, isPlaying } = this;
    return { sessionId, run, begin, end, step, isPlaying, isBusy, playback: session.sessionId, speed: session.playback?.speed ?? 1 };
  }

  /** Height of the bar at the bottom of the picture. */
  get heightPx(): number {
    return this.bar.hidden ? 0 : this.bar.offsetHeight;
  }

  /** Shows the bar before its contents are known, because the picture has to leave room for it. */
  makeRoom(): void {
    this.bar.hidden = false;
  }

  /** Handles a new status of the playback. */
  heard(session: Session): void {
    if (session.sessionId !== this.opened?.session.sessionId || this.isBusy || this.isScrubbing) return;
    // A status that was requested before the last change is outdated.
    if ((this.host.present()?.askedMs ?? 0) < this.runs.sinceMs) return;
    this.runs.is = session.state === SessionState.RUNNING;
    if (!this.runs.is && !this.isAtEnd) this.isPlaying = false;
    else if (this.runs.is) this.isPlaying = true;
  }

  /** Replaces a playback that is gone because the server ended or nobody requested it. */
  revive(): void {
    if (this.lost > 0) return;
    this.lost = 1;
    this.seek(this.step);
  }

  /** A hidden window does not play. */
  look(isSeen: boolean): void {
    if (!isSeen) [this.wasPlaying, this.isPlaying] = [this.isPlaying, false];
    else if (this.wasPlaying) this.isPlaying = true;
    void this.follow();
  }

  /** The shown step. */
  private get step(): number {
    if (!this.opened) return 0;
    if (this.aimed !== undefined) return this.aimed;
    const { recording, session } = this.opened;
    const shownSession = this.host.present();
    const isShown = shownSession?.session.sessionId === session.sessionId;
    const newest = isShown ? Math.max(Number(shownSession.samples.newest?.step ?? 0n), Number(shownSession.session.step)) : 0;
    return recording.clamp(Math.max(newest, Number(session.step)));
  }

  /** Whether the shown or chosen step is the end of the playback. */
  private get aimsAtEnd(): boolean {
    const end = this.opened?.session.playback?.endStep;
    return end !== undefined && this.step >= Number(end);
  }

  /** Whether the end of the playback was reached. */
  private get isAtEnd(): boolean {
    return this.aimed === undefined && this.aimsAtEnd;
  }

  toggle(): void {
    if (!this.opened) return;
    this.isPlaying = !this.isPlaying;
    const { recording } = this.opened;
    // At its end, playing starts again from the beginning, also while another speed is on its way.
    if (this.isPlaying && this.aimsAtEnd && !recording.isLive) this.seek(recording.begin);
    else void this.follow();
  }

  private by(seconds: number): void {
    if (this.opened) this.seek(this.opened.recording.after(this.step, seconds));
  }

  /** Goes to a step. While the user is still scrubbing, it does not play. */
  seek(step: number, isScrubbing = false): void {
    if (!this.opened) return;
    this.waits = false;
    this.aimed = this.opened.recording.clamp(step);
    this.isScrubbing = isScrubbing;
    this.isDue = true;
    this.tick();
    void this.follow();
  }

  /** Applies what was chosen, one request after the other, always the newest. */
  private async follow(): Promise<void> {
    if (this.isBusy) return;
    this.isBusy = true;
    const opened = this.opened;
    try {
      while (opened && this.opened === opened) {
        const shallRun = this.isPlaying && !this.isScrubbing;
        if (this.isDue && this.aimed !== undefined) {
          await this.exchange(opened, this.aimed, !shallRun);
        } else if (this.runs.is !== shallRun && !(shallRun && this.isAtEnd)) {
          const { sessionId } = opened.session;
          if (shallRun) await sessions.startSession({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
          else await sessions.pauseSession({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
          this.runs = { is: shallRun, sinceMs: performance.now() };
        } else {
          break;
        }
      }
    } catch (error) {
      if (this.opened === opened) this.failed(error);
    } finally {
      this.isBusy = false;
    }
    if (this.opened !== opened) void this.follow();
  }

  private async exchange(opened: Opened, step: number, paused: boolean): Promise<void> {
    this.isDue = false;
    const former = opened.session;
    const next = await playback(opened.recording, step, Number(this.speeds.value), paused);
    if (this.opened !== opened) return discard(next);
    opened.session = next;
    this.runs = { is: next.state === SessionState.RUNNING, sinceMs: performance.now() };
    await this.host.exchange(next, step);
    discard(former);
    this.lost = 0;
    if (!this.isDue && this.opened === opened) this.aimed = undefined;
  }

  private failed(error: unknown): void {
    if (this.lost > 0 && this.aimed !== undefined) {
      if (!isPassing(error)) return this.host.over(`The recording can't be played any more: ${describe(error)}.`);
      const { opened, aimed } = this;
      setTimeout(() => this.opened === opened && this.seek(aimed), backoffMs((this.lost += 1)));
      return;
    }
    // The session can't be started or stopped; its streams may not know yet that it is gone.
    const wasGone = isGone(error) && this.aimed === undefined;
    this.isPlaying = this.runs.is;
    this.isScrubbing = this.isDue = false;
    this.aimed = undefined;
    this.speeds.value = String(this.opened?.session.playback?.speed ?? 1);
    if (wasGone) setTimeout(() => this.revive());
    else this.host.notice(`That can't be played: ${describe(error)}.`);
  }

  /** Starts a live session at the shown step. */
  private async branch(): Promise<void> {
    const { opened } = this;
    if (!opened || this.goOn.disabled) return;
    this.goOn.disabled = true;
    try {
      // The visible state is the one that continues.
      this.isPlaying = false;
      await this.calm();
      const { sessionId } = opened.session;
      if (this.runs.is) await sessions.pauseSession({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
      const { session: shown } = await sessions.getSession({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
      const { recording } = opened;
      const value = { sessionId: recording.sessionId, run: recording.run, step: shown?.step ?? BigInt(this.step) };
      const session = await created({ source: { case: "journal", value } });
      if (this.opened === opened) await this.host.goLive(session);
    } catch (error) {
      this.host.notice(`It can't go on from here: ${describe(error)}.`);
    } finally {
      this.goOn.disabled = false;
    }
  }

  /** Resolves when no request is in progress. */
  private async calm(): Promise<void> {
    void this.follow();
    while (this.isBusy) await sleep(TICK_MS);
  }

  /** Returns to the session that is still being recorded. */
  async toLive(): Promise<void> {
    const { opened } = this;
    if (!opened) return;
    try {
      const { sessionId } = opened.recording;
      const { session } = await sessions.getSession({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
      if (session && this.opened === opened) await this.host.goLive(session);
    } catch (error) {
      this.host.notice(isGone(error) ? "The session has ended." : `The session can't be reached: ${describe(error)}.`);
    }
  }

  /** Checks how far a recording in progress has grown. */
  private async grow(): Promise<void> {
    const { opened } = this;
    let waitMs = GROWS_MS;
    while (opened && this.opened === opened && opened.recording.isLive) {
      await sleep(waitMs);
      if (this.opened !== opened || document.hidden) continue;
      const begun = performance.now();
      try {
        const { sessionId } = opened.recording;
        // The session itself is deleted if nobody requests it.
        await sessions.getSession({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS }).catch(() => {});
        opened.recording = await Recording.of(opened.recording);
      } catch {
        // The playback's own streams report if the server is lost.
      }
      waitMs = Math.max(GROWS_MS, GROWS_TIMES * (performance.now() - begun));
      if (this.opened !== opened) return;
      this.timeline.show(opened.recording);
      this.tell();
    }
  }

  /** At the end of the playback: continues with what was recorded meanwhile. */
  private goOnPlaying(): void {
    const { opened } = this;
    if (!opened || !this.isPlaying || !this.isAtEnd || this.isBusy || this.isScrubbing) return;
    const { recording, session } = opened;
    const end = Number(session.playback?.endStep ?? 0n);
    this.runs.is = false;
    if (recording.timeS(recording.end) - recording.timeS(end) >= MORE_S) {
      // While a tissue is at rest, nothing is recorded until something happens. Such a pause is skipped in the
      // playback.
      this.seek(this.waits ? Math.max(end, recording.after(recording.end, -BACK_S)) : end);
    } else if (recording.isLive) {
      this.waits = true;
    } else {
      this.isPlaying = false;
    }
  }

  private tick(): void {
    if (!this.opened || document.hidden) return;
    this.goOnPlaying();
    const { recording } = this.opened;
    const { step, isPlaying } = this;
    this.timeline.moveTo(step, isPlaying && this.aimed === undefined);
    const text = `${clockText(recording.timeS(step))} / ${clockText(recording.lengthS)}`;
    if (this.time.textContent !== text) this.time.textContent = text;
    const does = isPlaying ? "Pause" : "Play";
    if (this.button.dataset.does !== does) {
      this.button.dataset.does = does;
      this.button.setAttribute("aria-label", does);
      this.button.title = `${does} (Space)`;
    }
  }

  /** Shows what is played. */
  private tell(): void {
    const { recording } = this.opened ?? {};
    if (!recording) return;
    this.title.textContent = `${excerpt(recording.sceneName)}, ${whenText(recording.begun)}`;
    this.back.hidden = !recording.isLive;
    this.tick();
  }

  private key(event: KeyboardEvent): void {
    const { target } = event;
    if (!this.opened || event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey) return;
    if (target instanceof HTMLInputElement || target instanceof HTMLSelectElement || document.querySelector("dialog[open]")) return;
    const { recording } = this.opened;
    const isOnTimeline = target === this.timeline.element;
    const seconds = event.shiftKey ? BACK_S : 1;
    if (event.key === " ") {
      if (target instanceof HTMLButtonElement || (target instanceof HTMLElement && target.closest("summary"))) return;
      if (!event.repeat) this.toggle();
    } else if (event.key === "ArrowLeft" || (isOnTimeline && event.key === "ArrowDown")) {
      this.by(-seconds);
    } else if (event.key === "ArrowRight" || (isOnTimeline && event.key === "ArrowUp")) {
      this.by(seconds);
    } else if (isOnTimeline && event.key === "PageDown") {
      this.by(-BACK_S);
    } else if (isOnTimeline && event.key === "PageUp") {
      this.by(BACK_S);
    } else if (isOnTimeline && event.key === "Home") {
      this.seek(recording.begin);
    } else if (isOnTimeline && event.key === "End") {
      this.seek(recording.end);
    } else {
      return;
    }
    event.preventDefault();
  }

  /** Moves the keyboard focus to the player. */
  focus(): void {
    this.timeline.element.focus({ preventScroll: true });
  }
}
