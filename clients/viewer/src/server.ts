// The server: its services, its errors, and streams that reconnect.

import { Code, ConnectError, createClient, type Interceptor } from "@connectrpc/connect";
import { createGrpcWebTransport } from "@connectrpc/connect-web";
import { ErrorInfoSchema } from "./gen/google/rpc/error_details_pb";
import { HapticService } from "./gen/palpate/v1/haptic_pb";
import { SessionService } from "./gen/palpate/v1/session_pb";
import { ViewService } from "./gen/palpate/v1/view_pb";

/** Bytes received from the server in response bodies, without HTTP headers. */
export const received = { bytes: 0 };

/** Whether the window is being left: what is sent then still arrives. */
let isLeft = false;
export function leave(): void {
  isLeft = true;
}

/** Counts the bytes that pass. */
const counted: typeof fetch = async (input, init) => {
  const answer = await fetch(input, isLeft ? { ...init, keepalive: true } : init);
  if (!answer.body) return answer;
  const count = new TransformStream<Uint8Array, Uint8Array>({
    transform(chunk, out) {
      received.bytes += chunk.byteLength;
      out.enqueue(chunk);
    },
  });
  return new Response(answer.body.pipeThrough(count), answer);
};

/** The identity of the caller: the token that the page was given (page.ts), or nothing. */
export const caller = { token: "" };

/** Sends the token, if there is one, with every call. */
const identified: Interceptor = (next) => (request) => {
  if (caller.token) request.header.set("authorization", `Bearer ${caller.token}`);
  return next(request);
};

// A browser speaks HTTP/1.1 to a port without TLS, with at most six connections for all its windows of one server. A
// window uses two streams, two batches of commands, an acknowledgement and a status request. So frames can't have a
// connection of their own, and a hidden window closes its streams.
const transport = createGrpcWebTransport({ baseUrl: location.origin, fetch: counted, interceptors: [identified] });

export const sessions = createClient(SessionService, transport);
export const haptics = createClient(HapticService, transport);
export const views = createClient(ViewService, transport);

/**
 * Timeout of every call that is not a stream: a server that takes longer is gone. It is long, because a busy window
 * sees answers late; a server that is not running refuses at once.
 */
export const PATIENCE_MS = 20_000;

/** The server's reason code (README, "Errors"); empty if it gave none. */
export function reasonOf(error: unknown): string {
  return ConnectError.from(error).findDetails(ErrorInfoSchema)[0]?.reason ?? "";
}

/** The message for an error. */
export function describe(error: unknown): string {
  return ConnectError.from(error).rawMessage;
}

/** Whether the session is over for good. */
export function isGone(error: unknown): boolean {
  return ["UNKNOWN_SESSION", "SESSION_DELETED"].includes(reasonOf(error));
}

/** Whether the same call may be answered later: a refusal with any other reason would be repeated. */
export function isPassing(error: unknown): boolean {
  return ["", "SHUTTING_DOWN", "TOO_MANY"].includes(reasonOf(error));
}

export function isUnimplemented(error: unknown): boolean {
  return ConnectError.from(error).code === Code.Unimplemented;
}

/** Resolves after `ms`, or when `signal` aborts. */
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

/** The wait grows with each failure, from 0.25 s to 8 s, with some jitter so that not all clients return at once. */
export function backoffMs(failures: number): number {
  return Math.min(8000, 250 * 2 ** Math.min(failures, 6)) * (0.75 + 0.5 * Math.random());
}

/** A stream's failure, in a form that a worker can send. */
export interface Failure {
  /** Whether the session is over for good. */
  isGone: boolean;
  text: string;
}

/** Keeps a stream open until it is aborted or the session is gone. `onFailure` gets the failure and the wait. */
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
