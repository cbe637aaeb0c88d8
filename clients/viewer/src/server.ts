// The server: its services, its errors, and streams that come back by themselves.

import { Code, ConnectError, createClient, type Interceptor } from "@connectrpc/connect";
import { createGrpcWebTransport } from "@connectrpc/connect-web";
import { ErrorInfoSchema } from "./gen/google/rpc/error_details_pb";
import { HapticService } from "./gen/palpate/v1/haptic_pb";
import { SessionService } from "./gen/palpate/v1/session_pb";
import { ViewService } from "./gen/palpate/v1/view_pb";

/** Bytes that came from the server, of answers' bodies: headers of HTTP are not counted. */
export const received = { bytes: 0 };

/** Counts what passes. */
const counted: typeof fetch = async (input, init) => {
  const answer = await fetch(input, init);
  if (!answer.body) return answer;
  const count = new TransformStream<Uint8Array, Uint8Array>({
    transform(chunk, out) {
      received.bytes += chunk.byteLength;
      out.enqueue(chunk);
    },
  });
  return new Response(answer.body.pipeThrough(count), answer);
};

/** Who calls: the token that the page was given (page.ts), or nothing. */
export const caller = { token: "" };

/** Shows with every call who calls, if a token was given. */
const identified: Interceptor = (next) => (request) => {
  if (caller.token) request.header.set("authorization", `Bearer ${caller.token}`);
  return next(request);
};

// A browser speaks HTTP/1.1 to a port without TLS, with at most six connections for all its windows of one server:
// here two streams, two batches of commands, an acknowledgement and a question after the session. So frames can't have a
// connection of their own among those, and a window that nobody sees gives its streams up.
const transport = createGrpcWebTransport({ baseUrl: location.origin, fetch: counted, interceptors: [identified] });

export const sessions = createClient(SessionService, transport);
export const haptics = createClient(HapticService, transport);
export const views = createClient(ViewService, transport);

/**
 * Of every call that is no stream: a server that does not answer by then has gone. Long, for a window that was busy sees
 * answers late; a server that is not there refuses at once.
 */
export const PATIENCE_MS = 20_000;

/** The server's own reason (README, "Errors"); empty if it gave none. */
export function reasonOf(error: unknown): string {
  return ConnectError.from(error).findDetails(ErrorInfoSchema)[0]?.reason ?? "";
}

/** What people are told of an error. */
export function describe(error: unknown): string {
  return ConnectError.from(error).rawMessage;
}

/** The session is over, and won't come back. */
export function isGone(error: unknown): boolean {
  return ["UNKNOWN_SESSION", "SESSION_DELETED"].includes(reasonOf(error));
}

export function isUnimplemented(error: unknown): boolean {
  return ConnectError.from(error).code === Code.Unimplemented;
}

/** Resolves after a while, or as soon as the signal says. */
export function sleep(ms: number, signal?: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    if (signal?.aborted) return resolve();
    const timer = setTimeout(done, ms);
    function done(): void {
      clearTimeout(timer);
      signal?.removeEventListener("abort", done);
      resolve();
    }
    signal?.addEventListener("abort", done);
  });
}

/** Waits longer from one failure to the next: 0.25 s to 8 s, each a bit different so that not all come back at once. */
export function backoffMs(failures: number): number {
  return Math.min(8000, 250 * 2 ** Math.min(failures, 6)) * (0.75 + 0.5 * Math.random());
}

/** What went wrong with a stream, as a worker can tell it too. */
export interface Failure {
  /** The session is over, and won't come back. */
  isGone: boolean;
  text: string;
}

/** Keeps a stream open until it is aborted or the session is gone. `onFailure` gets what went wrong and the wait. */
export async function keepOpen(
  read: (signal: AbortSignal, alive: () => void) => Promise<void>,
  signal: AbortSignal,
  onFailure: (failure: Failure, waitMs: number) => void,
): Promise<void> {
  let failures = 0;
  while (!signal.aborted) {
    try {
      await read(signal, () => (failures = 0));
      throw new ConnectError("the server ended the stream", Code.Unavailable);
    } catch (error) {
      if (signal.aborted) return;
      const waitMs = backoffMs(failures);
      failures += 1;
      onFailure({ isGone: isGone(error), text: describe(error) }, waitMs);
      if (isGone(error)) return;
      await sleep(waitMs, signal);
    }
  }
}
