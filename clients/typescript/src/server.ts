// The server: its services, its errors, and streams that reconnect.

import type { DescMessage, MessageShape } from "@bufbuild/protobuf";
import { Code, ConnectError, type Client, createClient, type Interceptor } from "@connectrpc/connect";
import { createGrpcWebTransport } from "@connectrpc/connect-web";
import { ErrorInfoSchema } from "./gen/google/rpc/error_details_pb.js";
import { ExerciseService } from "./gen/palpate/v1/exercise_pb.js";
import { HapticService } from "./gen/palpate/v1/haptic_pb.js";
import { type Session, SessionService } from "./gen/palpate/v1/session_pb.js";
import { ViewService } from "./gen/palpate/v1/view_pb.js";

/** Maximum number of times that a call is forwarded from one server to the next. */
const MAX_HOPS = 8;

/** Maximum size of a message, bytes. A correct server sends no longer ones. */
const MAX_MESSAGE_BYTES = 4 << 20;

/**
 * Checks the lengths of the messages in a response body. Each length comes after a byte of flags, and may be split
 * between chunks.
 */
class Lengths {
  private readonly head = new DataView(new ArrayBuffer(5));
  private filled = 0;
  private left = 0;

  /** Checks the next bytes. Throws where a message begins that is too long. */
  pass(chunk: Uint8Array): void {
    for (let at = 0; at < chunk.length; ) {
      if (this.left > 0) {
        const passed = Math.min(this.left, chunk.length - at);
        this.left -= passed;
        at += passed;
        continue;
      }
      this.head.setUint8(this.filled++, chunk[at++]!);
      if (this.filled < 5) continue;
      this.filled = 0;
      this.left = this.head.getUint32(1);
      if (this.left > MAX_MESSAGE_BYTES) throw new RangeError(`the server sends a message of ${this.left} bytes`);
    }
  }
}

/** Where the calls for a session are sent. */
interface Way {
  url: string;
  /** Other servers of the fleet, which are tried in turn if this one can't be reached. */
  others: string[];
}

/**
 * A server, and the calls of its services. In a fleet, calls for a session of another server are sent there if that
 * server allows pages of this origin to call it (`origins` in its configuration). Otherwise they fail with the
 * original refusal, and `elsewhere` returns where the session is.
 *
 * To a port without TLS, a browser speaks HTTP/1.1, with at most six connections to a server for all windows. A
 * window uses two streams (frames and samples), two batches of commands, an acknowledgement and a status request. So
 * frames can't have a connection of their own, and a hidden window should close its streams.
 */
export class Server {
  /** Number of bytes received in response bodies, without HTTP headers. */
  readonly received = { bytes: 0 };
  readonly sessions: Client<typeof SessionService>;
  readonly haptics: Client<typeof HapticService>;
  readonly views: Client<typeof ViewService>;
  readonly exercises: Client<typeof ExerciseService>;
  /** Whether calls are sent to the server that owns the session. */
  follows = true;
  /** Called when another server owns a session. */
  onElsewhere: (endpoint: string, sessionId: string) => void = () => {};
  private isLeft = false;
  /** By session; sessions that this server owns have no entry. */
  private readonly ways = new Map<string, Way>();
  /** The server that sends frames; their acknowledgements are sent to it too. */
  private viewing = "";

  /** `url`: scheme, host and port. `token`: identifies the caller; empty if the server knows no callers. */
  constructor(
    readonly url: string,
    public token = "",
  ) {
    const identified: Interceptor = (next) => (request) => {
      if (this.token) request.header.set("authorization", `Bearer ${this.token}`);
      return next(request);
    };
    const followed: Interceptor = (next) => async (request) => {
      const sent = request.stream ? await firstOf(request.message) : request.message;
      const sessionId = textOf(sent, "sessionId");
      const path = `/${request.service.typeName}/${request.method.name}`;
      let base = this.urlOf(sessionId);
      if (this.viewing && textOf(sent, "viewerId")) base = this.viewing;
      for (let hops = 0, refusal: unknown; ; hops++) {
        const url = base.replace(/\/?$/, path);
        try {
          const answer = await next(request.stream ? { ...request, url, message: only(sent) } : { ...request, url });
          if (request.method.name === "WatchFrames") this.viewing = base;
          if (answer.stream) return { ...answer, message: this.noting(answer.message, base, sessionId) };
          this.learn(answer.message, base);
          return answer;
        } catch (error) {
          const isSentOn = this.note(error, base, sessionId);
          // The refusal is more helpful than the message that the browser can't call that server.
          if (!isSentOn || hops >= MAX_HOPS) throw refusal !== undefined && isUnreached(error) ? refusal : error;
          refusal = error;
          base = this.urlOf(sessionId);
        }
      }
    };
    const counted: typeof fetch = (input, init) => this.fetch(input, init);
    const transport = createGrpcWebTransport({ baseUrl: url, fetch: counted, interceptors: [followed, identified] });
    this.sessions = createClient(SessionService, transport);
    this.haptics = createClient(HapticService, transport);
    this.views = createClient(ViewService, transport);
    this.exercises = createClient(ExerciseService, transport);
  }

  /** Returns the URL of the server that owns a session, as far as it is known here. */
  urlOf(sessionId: string): string {
    return this.ways.get(sessionId)?.url ?? this.url;
  }

  /** Remembers what a response says about the fleet. */
  private learn(answer: object, base: string): void {
    const session = "session" in answer ? (answer.session as Session | undefined) : undefined;
    if (!session?.ownership) return;
    const { endpoint, others } = session.ownership;
    const known = this.ways.get(session.sessionId)?.url ?? base;
    this.ways.set(session.sessionId, { url: known, others: [...new Set([this.url, endpoint, ...others])] });
  }

  /**
   * Remembers what a failure at `base` says about a session. Returns whether another server owns it, and may be
   * called.
   */
  private note(error: unknown, base: string, sessionId: string): boolean {
    const endpoint = elsewhere(error);
    const others = this.ways.get(sessionId)?.others ?? [this.url];
    if (endpoint !== undefined && sessionId !== "") {
      const may = this.follows && this.mayCall(endpoint);
      this.onElsewhere(endpoint, sessionId);
      if (may) this.ways.set(sessionId, { url: endpoint, others });
      return may;
    }
    // The next call tries another server, unless the failure came from a server that is no longer used.
    const isInVain = isUnreached(error) || reasonOf(error) === "FENCED";
    if (this.follows && isInVain && this.ways.has(sessionId) && this.urlOf(sessionId) === base) {
      const url = others[(others.indexOf(base) + 1) % others.length] ?? this.url;
      this.ways.set(sessionId, { url: this.mayCall(url) ? url : this.url, others });
    }
    return false;
  }

  /** Passes a stream on, and remembers what its failure says. */
  private async *noting<T>(messages: AsyncIterable<T>, base: string, sessionId: string): AsyncGenerator<T> {
    try {
      yield* messages;
    } catch (error) {
      this.note(error, base, sessionId);
      throw error;
    }
  }

  /**
   * Returns whether a server may be called: a token is never sent unencrypted, and a connection with TLS is not
   * replaced by one without.
   */
  private mayCall(endpoint: string): boolean {
    if (!URL.canParse(endpoint)) return false;
    const { protocol, hostname } = new URL(endpoint);
    const isHere = ["localhost", "127.0.0.1", "[::1]"].includes(hostname);
    if (protocol === "https:") return true;
    return protocol === "http:" && new URL(this.url).protocol === "http:" && (isHere || !this.token);
  }

  /** To be called when the window is being closed: requests from now on still arrive. */
  leave(): void {
    this.isLeft = true;
  }

  /** Fetches, and counts the received bytes. */
  private async fetch(input: RequestInfo | URL, init?: RequestInit): Promise<Response> {
    const answer = await fetch(input, this.isLeft ? { ...init, keepalive: true } : init);
    if (!answer.body) return answer;
    const { received } = this;
    const lengths = answer.headers.get("content-type")?.startsWith("application/grpc-web") ? new Lengths() : undefined;
    const count = new TransformStream<Uint8Array, Uint8Array>({
      transform(chunk, out) {
        received.bytes += chunk.byteLength;
        lengths?.pass(chunk);
        out.enqueue(chunk);
      },
    });
    return new Response(answer.body.pipeThrough(count), answer);
  }
}

/**
 * Timeout of every call that is not a stream. It is long, because a busy window sees responses late; a server that is
 * not running refuses at once.
 */
export const CALL_TIMEOUT_MS = 20_000;

/** Returns the server's reason code (docs/protocol.md, "Errors"); empty if it gave none. */
export function reasonOf(error: unknown): string {
  return ConnectError.from(error).findDetails(ErrorInfoSchema)[0]?.reason ?? "";
}

/** Returns the field of the request that the server refused; empty if it named none. */
export function fieldOf(error: unknown): string {
  return ConnectError.from(error).findDetails(ErrorInfoSchema)[0]?.metadata.field ?? "";
}

/** If a call was refused because another server of the fleet owns the session, returns the URL of that server. */
export function elsewhere(error: unknown): string | undefined {
  const info = ConnectError.from(error).findDetails(ErrorInfoSchema)[0];
  return info?.reason === "ELSEWHERE" ? info.metadata.endpoint : undefined;
}

/** Returns whether a call did not reach a server, or its response did not arrive. */
export function isUnreached(error: unknown): boolean {
  return reasonOf(error) === "" && ConnectError.from(error).code !== Code.Canceled;
}

async function firstOf<T>(messages: AsyncIterable<T>): Promise<T> {
  for await (const message of messages) return message;
  throw new ConnectError("no message to send", Code.Internal);
}

async function* only<T>(message: T): AsyncGenerator<T> {
  yield await Promise.resolve(message);
}

/** Returns a text field of a message; empty if it has no such field. */
function textOf(message: MessageShape<DescMessage>, key: string): string {
  const value: unknown = Object.entries(message).find(([name]) => name === key)?.[1];
  return typeof value === "string" ? value : "";
}

/** The words with which different browsers report a network failure. */
const NETWORK_FAILED = /fetch|network|load failed|input stream|connection/i;

/** Returns the message of an error, without a full stop. */
export function describe(error: unknown): string {
  const { rawMessage, cause, code } = ConnectError.from(error);
  if (cause instanceof TypeError && NETWORK_FAILED.test(rawMessage)) return "the server can't be reached";
  if (code === Code.DeadlineExceeded && reasonOf(error) === "") return "the server does not answer";
  return rawMessage;
}

/** Returns whether the session no longer exists. */
export function isGone(error: unknown): boolean {
  return ["UNKNOWN_SESSION", "SESSION_DELETED"].includes(reasonOf(error));
}

/** Returns whether the same call may succeed later: with any other reason it would be refused again. */
export function isPassing(error: unknown): boolean {
  return ["", "SHUTTING_DOWN", "TOO_MANY", "FENCED", "ELSEWHERE"].includes(reasonOf(error));
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

/**
 * The wait increases with each failure, from 0.25 s to 30 s, with some jitter so that not all clients return at once.
 */
export function backoffMs(failures: number): number {
  return Math.min(30_000, 250 * 2 ** Math.min(failures, 7)) * (0.75 + 0.5 * Math.random());
}

/** A stream's failure, in a form that a worker can send. */
export interface Failure {
  /** Whether the session no longer exists. */
  isGone: boolean;
  /** The server's reason code; empty if it gave none. */
  reason: string;
  text: string;
}

/**
 * Keeps a stream open until it is aborted or the session no longer exists. Calls `onFailure` with each failure and
 * the wait.
 */
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
      // If a session has moved, reconnects at once.
      const waitMs = elsewhere(error) !== undefined && failures === 0 ? 0 : backoffMs(failures);
      failures += 1;
      if (waitMs === 0) continue;
      onFailure({ isGone: isGone(error), reason: reasonOf(error), text: describe(error) }, waitMs);
      if (isGone(error)) return;
      await sleep(waitMs, signal);
    }
  }
}
