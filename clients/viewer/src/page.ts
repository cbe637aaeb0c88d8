// Elements of the page by id, and the parameters in its address (README, "The page").

import type { JournalName } from "./journal";
import { server } from "./server";

export function part<T extends HTMLElement>(id: string, kind: new () => T): T {
  const element = document.getElementById(id);
  if (!(element instanceof kind)) throw new Error(`the page has no ${id}`);
  return element;
}

/** Makes an element. */
export function element<K extends keyof HTMLElementTagNameMap>(kind: K, of: Partial<HTMLElementTagNameMap[K]> = {}): HTMLElementTagNameMap[K] {
  return Object.assign(document.createElement(kind), of);
}

/** Returns a table with a heading and rows of cells. */
export function table(heading: readonly string[], rows: readonly (readonly string[])[]): HTMLTableElement {
  const made = element("table");
  const head = made.createTHead().insertRow();
  for (const title of heading) head.append(element("th", { scope: "col", textContent: title }));
  const body = made.createTBody();
  for (const cells of rows) {
    const row = body.insertRow();
    for (const text of cells) row.insertCell().textContent = text;
  }
  return made;
}

export const asked = new URLSearchParams(location.search);

/** An integer parameter of the address, if it is within the range. */
export function askedNumber(key: string, least: number, most: number): number | undefined {
  const text = asked.get(key);
  const value = Number(text);
  return text !== null && text !== "" && value >= least && value <= most ? value : undefined;
}

/**
 * Returns what the address names: a session, or a moment of a recording (`journal=ID`, and `run` and `step` if they
 * are known).
 */
export function addressed(): { sessionId?: string; moment?: JournalName & { step?: number } } {
  const address = new URLSearchParams(location.search);
  const sessionId = address.get("journal");
  if (!sessionId) return { sessionId: address.get("session") ?? undefined };
  const whole = (key: string) => {
    const value = Number(address.get(key) ?? "");
    return Number.isSafeInteger(value) && value > 0 ? value : undefined;
  };
  return { moment: { sessionId, run: whole("run") ?? 0, step: whole("step") } };
}

/** Writes what is shown to the address, so that reloading and sharing work. */
function write(values: Record<string, string>, isNew: boolean): void {
  const address = new URL(location.href);
  for (const key of ["session", "scene", "exercise", "journal", "run", "step"]) address.searchParams.delete(key);
  for (const [key, value] of Object.entries(values)) address.searchParams.set(key, value);
  if (isNew) history.pushState(null, "", address);
  else history.replaceState(null, "", address);
}

/** Returns the address of the page with another session. */
export function withSession(session: string): string {
  const address = new URL(location.href);
  address.search = new URLSearchParams({ session }).toString();
  return address.href;
}

/** Writes the session to the address. */
export function writeAddress(session: string, isNew: boolean): void {
  write({ session }, isNew);
}

/** Writes a moment of a recording to the address. */
export function writeMoment({ sessionId, run }: JournalName, step: number, isNew: boolean): void {
  write({ journal: sessionId, run: String(run), step: String(step) }, isNew);
}

/** The name that others see: from the address, or generated for this window. */
export function holderName(): string {
  const given = asked.get("name")?.slice(0, 60);
  if (given) return given;
  let name = sessionStorage.getItem("name");
  if (!name) {
    name = `Guest ${Math.floor(Math.random() * 9000 + 1000)}`;
    sessionStorage.setItem("name", name);
  }
  return name;
}

/**
 * Removes the token (`#token=…`) from the address, because people share addresses. It comes after `#`, so it is never
 * sent to a server or written to a log. Returns true if there was one.
 */
function takeToken(): boolean {
  const behind = new URLSearchParams(location.hash.slice(1));
  const token = behind.get("token");
  if (token === null) return false;
  keepToken(token.trim());
  history.replaceState(history.state, "", location.pathname + location.search);
  return true;
}

/** Stores a token until this window is closed, and sends it with each call from now on. */
export function keepToken(token: string): void {
  sessionStorage.setItem("token", token);
  server.token = token;
}

takeToken();
server.token = sessionStorage.getItem("token") ?? "";
// Adding a token to the address of an open page does not reload it by itself.
addEventListener("hashchange", () => takeToken() && location.reload());

/** Moves to the page of another server of the fleet, with the token after `#`, where `takeToken` reads it. */
function moveTo(endpoint: string, sessionId: string): void {
  const address = new URL(endpoint);
  // A token is never sent unencrypted. In addition, the page of this server would forward it endlessly.
  const isHere = ["localhost", "127.0.0.1", "[::1]"].includes(address.hostname);
  const isSafe = address.protocol === "https:" || (location.protocol === "http:" && (isHere || !server.token));
  if (!isSafe || address.origin === location.origin) return;
  address.search = location.search;
  for (const key of ["scene", "journal", "run", "step"]) address.searchParams.delete(key);
  address.searchParams.set("session", sessionId);
  address.searchParams.set("name", holderName());
  if (server.token) address.hash = new URLSearchParams({ token: server.token }).toString();
  location.replace(address);
}

/** Returns whether a server answers at all. */
async function isThere(endpoint: string): Promise<boolean> {
  try {
    await fetch(endpoint, { mode: "no-cors", cache: "no-store", signal: AbortSignal.timeout(2000) });
    return true;
  } catch {
    return false;
  }
}

// The whole page moves to the server that it calls, so the browser's origin rules do not get in the way.
server.follows = false;
server.onElsewhere = moveTo;

/**
 * Used when the session's server can't be reached. Another server of its fleet may have taken the session over, and
 * knows where it is.
 */
export async function seekAt(others: readonly string[], sessionId: string): Promise<void> {
  for (const endpoint of others) if (await isThere(endpoint)) return moveTo(endpoint, sessionId);
}
