// A hostile server: it serves the page, and answers each call as a test determines.

import { createServer } from "node:http";
import { readFileSync } from "node:fs";
import { extname, join } from "node:path";
import { create, toBinary } from "@bufbuild/protobuf";
import * as v1 from "palpate/v1";
import { ROOT } from "./harness.mjs";

const TYPES = /** @type {Record<string, string>} */ ({ ".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".jpg": "image/jpeg" });
const DIST = join(ROOT, "clients/viewer/dist");

/** A frame of gRPC-web. @param {Uint8Array} bytes */
function frame(bytes, flags = 0) {
  const head = Buffer.alloc(5);
  head[0] = flags;
  head.writeUInt32BE(bytes.length, 1);
  return Buffer.concat([head, bytes]);
}

const END = frame(Buffer.from("grpc-status: 0\r\n"), 0x80);

/** A small sheet, as an honest server tells it. */
export const SESSION = {
  sessionId: "0123456789abcdef0123456789abcdef",
  state: v1.SessionState.RUNNING,
  timeDilation: 1,
  points: 25,
  sceneName: "sheet",
  scene: {
    name: "sheet",
    sheet: { pointsX: 5, pointsY: 5, spacingM: 0.01, pointMassKg: 1e-3 },
    springs: { stiffnessNPerM: 10 },
    anchorSprings: { stiffnessNPerM: 5 },
    damping: { coefficientNSPerM: 0.1 },
    stepping: { rateHz: 1000, tolerance: 1e-3 },
  },
};

/**
 * @typedef {{ say: (message: object) => Promise<boolean>, bytes: (raw: Uint8Array) => Promise<boolean>, isOpen: () => boolean }} Answer
 * @typedef {(answer: Answer) => Promise<void>} Way
 */

export class Hostile {
  /** How often each call came. @type {Map<string, number>} */
  calls = new Map();

  /** @param {Record<string, Way>} ways What it does at each call; at others it is honest. */
  static async start(ways) {
    const hostile = new Hostile(ways);
    await new Promise((done) => hostile.server.listen(0, "127.0.0.1", () => done(undefined)));
    return hostile;
  }

  /** @param {Record<string, Way>} ways */
  constructor(ways) {
    this.ways = /** @type {Record<string, Way>} */ ({ ...HONEST, ...ways });
    this.server = createServer((request, response) => void this.answer(request, response).catch(() => response.destroy()));
  }

  get url() {
    return `http://127.0.0.1:${/** @type {import("node:net").AddressInfo} */ (this.server.address()).port}`;
  }

  stop() {
    this.server.closeAllConnections();
    return new Promise((done) => this.server.close(done));
  }

  /** @param {import("node:http").IncomingMessage} request @param {import("node:http").ServerResponse} response */
  async answer(request, response) {
    const path = new URL(request.url ?? "/", this.url).pathname;
    const call = path.split("/").pop() ?? "";
    if (request.method !== "POST") {
      if (path in this.ways) return void (await this.ways[path]?.(answerTo(response, undefined)));
      const file = path === "/" ? "index.html" : path.slice(1);
      if (path.startsWith("/textures")) return void response.writeHead(204).end();
      try {
        const bytes = readFileSync(join(DIST, file));
        return void response.writeHead(200, { "content-type": TYPES[extname(file)] ?? "application/octet-stream" }).end(bytes);
      } catch {
        return void response.writeHead(404).end();
      }
    }
    request.resume();
    this.calls.set(call, (this.calls.get(call) ?? 0) + 1);
    const way = this.ways[call];
    if (!way) return void response.writeHead(200, { "content-type": "application/grpc-web+proto", "grpc-status": "12" }).end();
    response.writeHead(200, { "content-type": "application/grpc-web+proto" });
    const schema = /** @type {Record<string, any>} */ (v1)[`${call}ResponseSchema`];
    await way(answerTo(response, schema));
    if (!response.writableEnded && !response.destroyed) response.end(END);
  }
}

/** @param {import("node:http").ServerResponse} response @param {any} schema @returns {Answer} */
function answerTo(response, schema) {
  const bytes = (/** @type {Uint8Array} */ raw) =>
    new Promise((done) => {
      if (response.destroyed) return done(false);
      const goesOn = response.write(raw, () => {});
      if (goesOn) return done(true);
      const ended = () => {
        response.off("drain", ended).off("close", ended);
        done(!response.destroyed);
      };
      response.once("drain", ended).once("close", ended);
    });
  return {
    bytes: /** @type {Answer["bytes"]} */ (bytes),
    say: (message) => /** @type {Promise<boolean>} */ (bytes(frame(toBinary(schema, create(schema, message))))),
    isOpen: () => !response.destroyed,
  };
}

/** @param {number} ms */
export const pause = (ms) => new Promise((done) => setTimeout(done, ms));

/** @type {Record<string, Way>} */
const HONEST = {
  ListScenes: async ({ say }) => void (await say({ sceneNames: ["sheet"] })),
  CreateSession: async ({ say }) => void (await say({ session: SESSION })),
  GetSession: async ({ say }) => void (await say({ session: SESSION })),
  ListJournals: async ({ say }) => void (await say({ journals: [] })),
  ListSessions: async ({ say }) => void (await say({ sessions: [] })),
  ListScripts: async ({ say }) => void (await say({})),
  AcknowledgeFrames: async ({ say }) => void (await say({})),
  WatchSamples: async ({ isOpen }) => {
    while (isOpen()) await pause(100);
  },
  WatchFrames: async ({ say, isOpen }) => {
    // At refinement n a side of five points has 4n + 5 vertices; it asks for 3.
    const displacement = new Uint8Array(17 * 17 * 6);
    const patch = { firstX: 0, firstY: 0, countX: 17, countY: 17, displacement };
    for (let frameId = 1n; isOpen(); frameId++) {
      await say({ viewerId: "v", frameId, step: frameId, encoding: v1.Encoding.I16, patches: [patch], full: true, last: true });
      await pause(50);
    }
  },
};
