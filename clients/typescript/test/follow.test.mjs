// Calls follow a session from server to server of a fleet. Both servers are fakes, which answer in gRPC-web.

import assert from "node:assert/strict";
import { createServer } from "node:http";
import { after, test } from "node:test";
import { create, toBinary } from "@bufbuild/protobuf";
import { backoffMs, describe, elsewhere, reasonOf, Server, watchSamples } from "palpate";
import { GetSessionResponseSchema, WatchSamplesResponseSchema } from "palpate/v1";

/** @type {import("node:http").Server[]} */
const servers = [];
after(() => servers.forEach((server) => (server.closeAllConnections(), server.close())));

/**
 * @typedef {{ path: string, token: string | undefined }} Asked
 * @typedef {(asked: Asked, answer: import("node:http").ServerResponse) => void} Answer
 */

/** Starts a server. @param {Answer} answer */
async function serve(answer) {
  const server = createServer((request, response) => {
    request.resume();
    request.on("end", () => answer({ path: request.url ?? "", token: request.headers.authorization }, response));
  });
  servers.push(server);
  await /** @type {Promise<void>} */ (new Promise((done) => server.listen(0, "127.0.0.1", done)));
  const address = server.address();
  return `http://127.0.0.1:${typeof address === "object" && address ? address.port : 0}`;
}

/** Encodes a length-delimited field of a protobuf message. @param {number} number @param {Buffer | string} value */
function field(number, value) {
  const bytes = Buffer.from(value);
  assert(bytes.length < 1 << 14);
  const length = bytes.length < 128 ? [bytes.length] : [(bytes.length & 127) | 128, bytes.length >> 7];
  return Buffer.concat([Buffer.from([(number << 3) | 2, ...length]), bytes]);
}

/** Refuses a call. @param {import("node:http").ServerResponse} answer @param {string} reason @param {string} [endpoint] */
function refuse(answer, reason, endpoint) {
  const metadata = endpoint ? field(3, Buffer.concat([field(1, "endpoint"), field(2, endpoint)])) : Buffer.alloc(0);
  const info = Buffer.concat([field(1, reason), field(2, "palpate"), metadata]);
  const any = Buffer.concat([field(1, "type.googleapis.com/google.rpc.ErrorInfo"), field(2, info)]);
  const status = Buffer.concat([Buffer.from([8, 9]), field(2, "no"), field(3, any)]);
  answer.writeHead(200, {
    "content-type": "application/grpc-web+proto",
    "grpc-status": "9",
    "grpc-message": "no",
    "grpc-status-details-bin": status.toString("base64"),
  });
  answer.end();
}

/** Answers a call. @param {import("node:http").ServerResponse} answer @param {Uint8Array[]} messages */
function tell(answer, messages) {
  answer.writeHead(200, { "content-type": "application/grpc-web+proto" });
  const part = (/** @type {number} */ flags, /** @type {Uint8Array} */ bytes) => {
    const head = Buffer.alloc(5);
    head[0] = flags;
    head.writeUInt32BE(bytes.length, 1);
    return Buffer.concat([head, bytes]);
  };
  answer.end(Buffer.concat([...messages.map((bytes) => part(0, bytes)), part(0x80, Buffer.from("grpc-status: 0\r\n"))]));
}

const session = toBinary(GetSessionResponseSchema, create(GetSessionResponseSchema, { session: { sessionId: "s", step: 7n } }));

test("a call is made at the server that has the session, and so are those after it", async () => {
  /** @type {Asked[]} */
  const asked = [];
  const owner = await serve((call, answer) => (asked.push(call), tell(answer, [session])));
  let refused = 0;
  const near = await serve((_, answer) => (refused++, refuse(answer, "ELSEWHERE", owner)));
  const server = new Server(near, "secret");
  for (let calls = 0; calls < 2; calls++) {
    const found = await server.sessions.getSession({ sessionId: "s" });
    assert.equal(found.session?.step, 7n);
  }
  assert.deepEqual([refused, server.urlOf("s"), server.urlOf("other")], [1, owner, near]);
  const path = "/palpate.v1.SessionService/GetSession";
  assert.deepEqual(asked, [{ path, token: "Bearer secret" }, { path, token: "Bearer secret" }]);
});

test("a token goes to no other machine in the clear, and a page that does not follow is told where the session is", async () => {
  const far = "http://fleet.example:7117";
  const near = await serve((_, answer) => refuse(answer, "ELSEWHERE", far));
  const server = new Server(near, "secret");
  /** @type {string[][]} */
  const told = [];
  server.onElsewhere = (...where) => told.push(where);
  const refused = await server.sessions.getSession({ sessionId: "s" }).catch((error) => error);
  assert.deepEqual([reasonOf(refused), elsewhere(refused), told], ["ELSEWHERE", far, [[far, "s"]]]);
  const owner = await serve((_, answer) => tell(answer, [session]));
  const other = new Server(await serve((_, answer) => refuse(answer, "ELSEWHERE", owner)));
  other.follows = false;
  assert.equal(elsewhere(await other.sessions.getSession({ sessionId: "s" }).catch((error) => error)), owner);
});

test("an owner that is gone is not asked for ever", async () => {
  const gone = await serve((_, answer) => answer.destroy());
  let isBack = false;
  const near = await serve((_, answer) => (isBack ? tell(answer, [session]) : refuse(answer, "ELSEWHERE", gone)));
  const server = new Server(near);
  const refused = await server.sessions.getSession({ sessionId: "s" }).catch((error) => error);
  assert.equal(elsewhere(refused), gone);
  isBack = true;
  assert.equal((await server.sessions.getSession({ sessionId: "s" })).session?.step, 7n);
});

test("samples of a server that had the session before are left out", async () => {
  const sample = (/** @type {bigint} */ step, /** @type {bigint} */ ownershipRevision) =>
    toBinary(WatchSamplesResponseSchema, create(WatchSamplesResponseSchema, { sample: { step, ownershipRevision } }));
  const owner = await serve((_, answer) => tell(answer, [sample(1n, 5n), sample(9n, 4n), sample(2n, 6n)]));
  const near = await serve((_, answer) => refuse(answer, "ELSEWHERE", owner));
  const ended = new AbortController();
  /** @type {bigint[]} */
  const steps = [];
  await watchSamples(new Server(near), "s", 1, ({ step }) => steps.push(step), ended.signal, () => ended.abort());
  assert.deepEqual(steps, [1n, 2n]);
});

test("a server that is away is told of in words of ours, and asked ever more seldom", async () => {
  // A port on which no server listens any more.
  const closed = createServer();
  await /** @type {Promise<void>} */ (new Promise((done) => closed.listen(0, "127.0.0.1", done)));
  const address = closed.address();
  closed.close();
  const server = new Server(`http://127.0.0.1:${typeof address === "object" && address ? address.port : 0}`);
  const error = await server.sessions.getSession({ sessionId: "s" }).catch((/** @type {unknown} */ error) => error);
  assert.equal(describe(error), "the server can't be reached");
  // A refusal is reported with the server's own message.
  const refusing = new Server(await serve((_, answer) => refuse(answer, "TOO_MANY")));
  assert.equal(describe(await refusing.sessions.getSession({}).catch((/** @type {unknown} */ error) => error)), "no");
  for (const [failures, ms] of /** @type {const} */ ([[0, 250], [3, 2000], [20, 30_000]])) {
    const waits = backoffMs(failures);
    assert.ok(waits >= 0.75 * ms && waits <= 1.25 * ms, `${failures} failures: ${waits} ms`);
  }
});
