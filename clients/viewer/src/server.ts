// The server that the page came from, called with the caller's token.

import { CALL_TIMEOUT_MS, Server } from "palpate";
import type { WatchExerciseResponse } from "palpate/v1";

export const server = new Server(location.origin);
export const { sessions, haptics, exercises, received } = server;

export { backoffMs, describe, type Failure, fieldOf, isGone, isPassing, isUnimplemented, keepOpen, CALL_TIMEOUT_MS, reasonOf, sleep } from "palpate";

/** Returns what the stream of an exercise tells first, and ends the stream, which would keep its connection otherwise. */
export async function exerciseNow(sessionId: string, signal?: AbortSignal): Promise<WatchExerciseResponse | undefined> {
  const ended = new AbortController();
  const signals = [ended.signal, AbortSignal.timeout(CALL_TIMEOUT_MS), ...(signal ? [signal] : [])];
  try {
    for await (const told of exercises.watchExercise({ sessionId }, { signal: AbortSignal.any(signals) })) return told;
  } finally {
    ended.abort();
  }
  return undefined;
}
