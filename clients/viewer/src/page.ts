// Elements of the page by id, and the parameters in its address (README, "The page").

import { caller } from "./server";

export function part<T extends HTMLElement>(id: string, kind: new () => T): T {
  const element = document.getElementById(id);
  if (!(element instanceof kind)) throw new Error(`the page has no ${id}`);
  return element;
}

export const asked = new URLSearchParams(location.search);

/** An integer parameter of the address, if it is within the range. */
export function askedNumber(key: string, least: number, most: number): number | undefined {
  const text = asked.get(key);
  const value = Number(text);
  return text !== null && text !== "" && value >= least && value <= most ? value : undefined;
}

/** Writes the session into the address, so that reloading and sharing work. */
export function writeAddress(sessionId: string, isNew: boolean): void {
  const address = new URL(location.href);
  address.searchParams.set("session", sessionId);
  address.searchParams.delete("scene");
  if (isNew) history.pushState(null, "", address);
  else history.replaceState(null, "", address);
}

/** The name that others see: from the address, or generated for this window. */
export function holderName(): string {
  const given = asked.get("name")?.slice(0, 60);
  if (given) return given;
  let name = sessionStorage.getItem("name");
  if (!name) {
    name = `viewer ${Math.floor(Math.random() * 9000 + 1000)}`;
    sessionStorage.setItem("name", name);
  }
  return name;
}

/**
 * Removes the token (`#token=…`) from the address, because people share addresses. It comes after `#`, so that it never
 * reaches a server or a log. Returns true if there was one.
 */
function keepToken(): boolean {
  const behind = new URLSearchParams(location.hash.slice(1));
  const token = behind.get("token");
  if (token === null) return false;
  sessionStorage.setItem("token", token.trim());
  history.replaceState(history.state, "", location.pathname + location.search);
  return true;
}

keepToken();
caller.token = sessionStorage.getItem("token") ?? "";
// Adding a token to the address of an open page does not reload it by itself.
addEventListener("hashchange", () => keepToken() && location.reload());
