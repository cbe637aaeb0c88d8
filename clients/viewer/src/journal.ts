// Recordings of the server: the list of journals, and the contents of one, as the page shows them.

import type { ForceMoment, GetJournalResponse } from "palpate/v1";
import { CALL_TIMEOUT_MS, sessions } from "./server";

/** A journal: of a session, in one run of the server. 0 is the newest. */
export interface JournalName {
  sessionId: string;
  run: number;
}

/** An entry of the list. */
export interface Listed extends JournalName {
  sceneName: string;
  begun: Date;
  lengthS: number;
  /** Whether the session is still running. */
  isLive: boolean;
}

/**
 * Returns the journals that can be played, the newest first. Empty if the server keeps none, does not support them,
 * or refuses to list them for this caller; a link to a journal can be used nevertheless.
 */
export async function listJournals(): Promise<Listed[]> {
  try {
    const { journals } = await sessions.listJournals({}, { timeoutMs: CALL_TIMEOUT_MS });
    const looked = journals.some(({ live }) => live) ? await lookedAt() : new Set();
    const listed = journals
      .filter(({ fault, live, sessionId }) => fault === "" && (!live || looked.has(sessionId)))
      .map((info) => ({
        sessionId: info.sessionId,
        run: info.run,
        sceneName: info.sceneName,
        begun: new Date(Number(info.beginUnixNs / 1_000_000n)),
        lengthS: Math.max(0, Number(info.endUnixNs - info.beginUnixNs) / 1e9),
        isLive: info.live,
      }));
    return listed.sort((a, b) => b.begun.getTime() - a.begun.getTime());
  } catch {
    return [];
  }
}

/**
 * Returns the sessions that have viewers. A session whose pages were closed continues for a while, and ends by
 * itself.
 */
async function lookedAt(): Promise<Set<string>> {
  const { sessions: all } = await sessions.listSessions({}, { timeoutMs: CALL_TIMEOUT_MS });
  return new Set(all.filter(({ streams }) => streams > 0).map(({ sessionId }) => sessionId));
}

/** Contents of a journal, as far as it was on disk when it was requested. Steps are completed steps. */
export class Recording implements JournalName {
  readonly sessionId: string;
  readonly run: number;
  readonly sceneName: string;
  readonly begun: Date;
  readonly isLive: boolean;
  readonly rateHz: number;
  readonly begin: number;
  readonly end: number;
  readonly forces: ForceMoment[];
  /** Steps from which playback can start immediately. */
  readonly snapshots: number[];
  /** Where it is damaged; it ends before that. Empty if it is intact. */
  readonly fault: string;

  static async of({ sessionId, run }: JournalName): Promise<Recording> {
    return new Recording(await sessions.getJournal({ sessionId, run }, { timeoutMs: CALL_TIMEOUT_MS }));
  }

  private constructor({ info, rateHz, beginStep, endStep, forces, snapshotSteps }: GetJournalResponse) {
    this.sessionId = info?.sessionId ?? "";
    this.run = info?.run ?? 0;
    this.sceneName = info?.sceneName ?? "";
    this.begun = new Date(Number((info?.beginUnixNs ?? 0n) / 1_000_000n));
    this.isLive = info?.live ?? false;
    this.rateHz = rateHz > 0 ? rateHz : 1000;
    this.begin = Number(beginStep);
    this.end = Math.max(Number(endStep), this.begin);
    this.forces = forces;
    this.snapshots = snapshotSteps.map(Number);
    this.fault = info?.fault ?? "";
  }

  /** Time since its beginning, s. */
  timeS(step: number): number {
    return (step - this.begin) / this.rateHz;
  }

  get lengthS(): number {
    return this.timeS(this.end);
  }

  /** Returns the step that is `seconds` after another, limited to the journal. */
  after(step: number, seconds: number): number {
    return this.clamp(step + Math.round(seconds * this.rateHz));
  }

  clamp(step: number): number {
    return Math.min(Math.max(Math.round(step), this.begin), this.end);
  }
}

/** Formats a time as in video players: minutes, seconds and tenths. */
export function clockText(seconds: number): string {
  // A tenth counts once it has passed.
  const tenths = Math.floor(10 * Math.max(seconds, 0) + 1e-6);
  const [minutes, rest] = [Math.floor(tenths / 600), tenths % 600];
  return `${String(minutes).padStart(2, "0")}:${(rest / 10).toFixed(1).padStart(4, "0")}`;
}

/** Formats the time of a recording: the time of day if it was today, otherwise with the date. */
export function whenText(begun: Date): string {
  const isToday = begun.toDateString() === new Date().toDateString();
  const time = { hour: "2-digit", minute: "2-digit" } as const;
  return isToday
    ? begun.toLocaleTimeString(undefined, { ...time, second: "2-digit" })
    : begun.toLocaleString(undefined, { ...time, day: "numeric", month: "short", year: "numeric" });
}

/** A length of time in words. */
export function lengthText(seconds: number): string {
  if (seconds < 60) return `${seconds.toFixed(0)} s`;
  const whole = Math.round(seconds);
  const [hours, minutes] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60];
  const two = (value: number) => String(value).padStart(2, "0");
  return hours > 0 ? `${hours}:${two(minutes)} h` : `${minutes}:${two(whole % 60)} min`;
}
