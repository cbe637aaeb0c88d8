// The server: its services, its errors, and streams that reconnect.

import type { DescMessage, MessageShape } from "@bufbuild/protobuf";
import { Code, ConnectError, type Client, createClient, type Interceptor } from "@connectrpc/connect";
import { createGrpcWebTransport } from "@connectrpc/connect-web";
import { ErrorInfoSchema } from "./gen/google/rpc/error_details_pb.js";
import { HapticService } from "./gen/palpate/v1/haptic_pb.js";
import { type Session, SessionService } from "./gen/palpate/v1/session_pb.js";
import { ViewService } from "./gen/palpate/v1/view_pb.js";

/** A call is sent on this often, one server after the other. */
const MAX_HOPS = 8;

/** Bytes of a message, at most: no honest server sends a longer one. */
const MAX_MESSAGE_BYTES = 4 << 20;

/** The lengths of the messages in a body, each after a byte of flags. They are kept until they are whole. */
class Lengths {
  private readonly head = new DataView(new ArrayBuffer(5));
  private filled = 0;
  private left = 0;

  /** Throws where a message begins that is too long. */
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

/** Where the calls for a session go. */
interface Way {
  url: string;
  /** Other servers of the fleet, asked in turn when that one can't be reached. */
  others: string[];
}

/**
 * A server, and the calls of its services. In a fleet, calls for a session that another server has go there, if that server lets
 * pages of this origin call it (`origins` of its configuration); if not, they fail as they were refused: `elsewhere` tells where
 * the session is.
 *
 * A browser speaks HTTP/1.1 to a port without TLS, with at most six connections for all its windows of one server. A window uses
 * two streams (frames and samples), two batches of commands, an acknowledgement and a status request. So frames can't have a
 * connection of their own, and a hidden window should close its streams.
 */
export class Server {
  /** Bytes received in response bodies, without HTTP headers. */
  readonly received = { bytes: 0 };
  readonly sessions: Client<typeof SessionService>;
  readonly haptics: Client<typeof HapticService>;
  readonly views: Client<typeof ViewService>;
  /** Whether calls go to the server that has the session. */
  follows = true;
  /** Another server has a session. */
  onElsewhere: (endpoint: string, sessionId: string) => void = () => {};
  private isLeft = false;
  /** By session; of those that this server has itself, none. */
  private readonly ways = new Map<string, Way>();
  /** Where frames come from, and so their acknowledgements go. */
  private viewing = "";

  /** `url`: scheme, host and port. `token`: who calls; empty where the server knows nobody. */
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
          // The refusal says more than that a browser does not call that server.
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
  }

  /** The URL of the server that has a session, as far as this one knows. */
  urlOf(sessionId: string): string {
    return this.ways.get(sessionId)?.url ?? this.url;
  }

  /** Keeps what an answer tells of the fleet. */
  private learn(answer: object, base: string): void {
    const session = "session" in answer ? (answer.session as Session | undefined) : undefined;
    if (!session?.ownership) return;
    const { endpoint, others } = session.ownership;
    const known = this.ways.get(session.sessionId)?.url ?? base;
    this.ways.set(session.sessionId, { url: known, others: [...new Set([this.url, endpoint, ...others])] });
  }

  /** Keeps what a failure at `base` tells of a session. Returns whether another server has it, and may be called. */
  private note(error: unknown, base: string, sessionId: string): boolean {
    const endpoint = elsewhere(error);
    const others = this.ways.get(sessionId)?.others ?? [this.url];
    if (endpoint !== undefined && sessionId !== "") {
      const may = this.follows && this.mayCall(endpoint);
      this.onElsewhere(endpoint, sessionId);
      if (may) this.ways.set(sessionId, { url: endpoint, others });
      return may;
    }
    // The next call asks another; unless this one has been found wanting before.
    const isInVain = isUnreached(error) || reasonOf(error) === "FENCED";
    if (this.follows && isInVain && this.ways.has(sessionId) && this.urlOf(sessionId) === base) {
      const url = others[(others.indexOf(base) + 1) % others.length] ?? this.url;
      this.ways.set(sessionId, { url: this.mayCall(url) ? url : this.url, others });
    }
    return false;
  }

  /** Passes a stream on, and notes how it fails. */
  private async *noting<T>(messages: AsyncIterable<T>, base: string, sessionId: string): AsyncGenerator<T> {
    try {
      yield* messages;
    } catch (error) {
      this.note(error, base, sessionId);
      throw error;
    }
  }

  /** A token never goes in the clear, and nobody goes from TLS to none. */
  private mayCall(endpoint: string): boolean {
    if (!URL.canParse(endpoint)) return false;
    const { protocol, hostname } = new URL(endpoint);
    const isHere = ["localhost", "127.0.0.1", "[::1]"].includes(hostname);
    if (protocol === "https:") return true;
    return protocol === "http:" && new URL(this.url).protocol === "http:" && (isHere || !this.token);
  }

  /** The window is being left: what is sent from now on still arrives. */
  leave(): void {
    this.isLeft = true;
  }

  /** Counts the bytes that pass. */
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
 * Timeout of every call that is not a stream: a server that takes longer is gone. It is long, because a busy window
 * sees answers late; a server that is not running refuses at once.
 */
export const CALL_TIMEOUT_MS = 20_000;

/** The server's reason code (docs/protocol.md, "Errors"); empty if it gave none. */
export function reasonOf(error: unknown): string {
  return ConnectError.from(error).findDetails(ErrorInfoSchema)[0]?.reason ?? "";
}

/** The URL of the server of the fleet that has the session, if a call was refused because another server was called. */
export function elsewhere(error: unknown): string | undefined {
  const info = ConnectError.from(error).findDetails(ErrorInfoSchema)[0];
  return info?.reason === "ELSEWHERE" ? info.metadata.endpoint : undefined;
}

/** Whether a call has not come to a server, or its answer not back. */
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

/** A field of a message; empty if it has none of that name. */
function textOf(message: MessageShape<DescMessage>, key: string): string {
  const value: unknown = Object.entries(message).find(([name]) => name === key)?.[1];
  return typeof value === "string" ? value : "";
}

/** What browsers say of a network that fails, each in its own words. */
const NETWORK_FAILED = /fetch|network|load failed|input stream|connection/i;

/** The message for an error, without a full stop. */
export function describe(error: unknown): string {
  const { rawMessage, cause, code } = ConnectError.from(error);
  if (cause instanceof TypeError && NETWORK_FAILED.test(rawMessage)) return "the server can't be reached";
  if (code === Code.DeadlineExceeded && reasonOf(error) === "") return "the server does not answer";
  return rawMessage;
}

/** Whether the session is over for good. */
export function isGone(error: unknown): boolean {
  return ["UNKNOWN_SESSION", "SESSION_DELETED"].includes(reasonOf(error));
}

/** Whether the same call may be answered later: a refusal with any other reason would be repeated. */
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

/** The wait grows with each failure, from 0.25 s to 30 s, with some jitter so that not all clients return at once. */
export function backoffMs(failures: number): number {
  return Math.min(30_000, 250 * 2 ** Math.min(failures, 7)) * (0.75 + 0.5 * Math.random());
}

/** A stream's failure, in a form that a worker can send. */
export interface Failure {
  /** Whether the session is over for good. */
  isGone: boolean;
  /** The server's reason code; empty if it gave none. */
  reason: string;
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
      // A session that has moved goes on at once.
      const waitMs = elsewhere(error) !== undefined && failures === 0 ? 0 : backoffMs(failures);
      failures += 1;
      if (waitMs === 0) continue;
      onFailure({ isGone: isGone(error), reason: reasonOf(error), text: describe(error) }, waitMs);
      if (isGone(error)) return;
      await sleep(waitMs, signal);
    }
  }
}
