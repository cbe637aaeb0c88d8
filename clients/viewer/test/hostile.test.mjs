// The page at a hostile server: it reports what it can't show, runs no code from the server, and stays within bounds.

import assert from "node:assert/strict";
import { after, before, describe, test } from "node:test";
import { launch, TEST_TIMEOUT_MS } from "./harness.mjs";
import { Hostile, pause, SESSION } from "./hostile.mjs";

/** @typedef {import("./hostile.mjs").Way} Way */

/** @type {import("playwright-core").Browser} */
let browser;
before(async () => {
  browser = await launch();
});
after(() => browser?.close());

/** Opens the page at a server, and does something with it. @param {Record<string, Way>} ways */
async function at(ways, /** @type {(page: import("playwright-core").Page, hostile: Hostile) => Promise<void>} */ look) {
  const hostile = await Hostile.start(ways);
  const context = await browser.newContext({ viewport: { width: 820, height: 540 } });
  try {
    const page = await context.newPage();
    page.setDefaultTimeout(TEST_TIMEOUT_MS);
    await page.goto(hostile.url);
    await look(page, hostile);
  } finally {
    await context.close();
    await hostile.stop();
  }
}

/** @param {object} session @returns {Record<string, Way>} */
const sessionOf = (session) => ({
  CreateSession: async ({ say }) => void (await say({ session })),
  GetSession: async ({ say }) => void (await say({ session })),
});
/** @param {object} scene */
const sceneOf = (scene) => sessionOf({ ...SESSION, scene: { ...SESSION.scene, ...scene } });
/** @param {object} part @returns {Record<string, Way>} */
const meshOf = (part) => ({
  ...sceneOf({ mesh: { meshId: "m" }, sheet: undefined }),
  GetMesh: async ({ say }) => void (await say({ verticesX: 1, verticesY: 16, vertexSpacingM: 1, last: true, ...part })),
});
/** @param {number} count @param {(index: number) => T} of @template T */
const many = (count, of) => Array.from({ length: count }, (_, index) => of(index));

const CORNERS = [0, 0, 0, 1, 0, 0, 0, 1, 0];

describe("the page at a hostile server", () => {
  test("says of what it can't show that it can't", async () => {
    const sheet = { pointsX: 5, pointsY: 5, spacingM: 0.01, pointMassKg: 1e-3 };
    const numbers = many(60_000, () => 0);
    /** @type {Record<string, Record<string, Way>>} */
    const attacks = {
      "no session": { CreateSession: async ({ say }) => void (await say({})) },
      "a spacing that is no number": sceneOf({ sheet: { ...sheet, spacingM: NaN } }),
      "a sheet without points": sceneOf({ sheet: { ...sheet, pointsX: 0 } }),
      "a sheet without an end": sceneOf({ sheet: { ...sheet, pointsX: 4294967295, pointsY: 4294967295 } }),
      "a rate of 0": sceneOf({ stepping: { rateHz: 0 } }),
      "a triangle of vertices that are not there": meshOf({ restPositionM: CORNERS, triangles: [0, 1, 99] }),
      "vertices that are nowhere": meshOf({ restPositionM: [NaN, ...CORNERS.slice(1)], triangles: [0, 1, 2] }),
      "half a vertex": meshOf({ restPositionM: CORNERS.slice(1), triangles: [0, 1, 0] }),
      "frames of another size": meshOf({ restPositionM: CORNERS, triangles: [0, 1, 2], verticesX: 4294967295, verticesY: 4294967295 }),
      "a mesh without an end": {
        ...meshOf({}),
        GetMesh: async ({ say }) => {
          while (await say({ verticesX: 1, verticesY: 16, restPositionM: numbers }));
        },
      },
    };
    const each = Object.entries(attacks).map(([name, ways]) =>
      at(ways, async (page, { calls }) => {
        await page.locator("#notice", { hasText: /can't be shown/ }).waitFor().catch(() => assert.fail(name));
        assert.ok((calls.get("CreateSession") ?? 0) < 3, `${name}: ${calls.get("CreateSession")} sessions`);
      }),
    );
    await Promise.all(each);
  });

  test("draws a tissue whole whose wound can't be shown, and asks for that no more", async () => {
    const cut = { ...SESSION, topologyVersion: 7, severed: 3, pieces: 1 };
    const lip = { host: 0, second: 1, secondPart: 0.5 };
    const corners = many(60_000, () => 0);
    /** @type {Record<string, Way>} */
    const wounds = {
      "a vertex that rides on none": async ({ say }) => void (await say({ version: 7, firstVertex: 289, vertices: [{ ...lip, host: 4_000_000_000 }], last: true })),
      "triangles that are none": async ({ say }) => void (await say({ version: 7, firstVertex: 289, triangles: [{ first: 4_294_967_290, count: 4_294_967_290 }], last: true })),
      "nothing at all": async () => {},
      "a wound without an end": async ({ say }) => {
        while (await say({ version: 7, firstVertex: 289, triangles: [{ first: 0, count: 1, corners }] }));
      },
    };
    const each = Object.entries(wounds).map(([name, GetWound]) =>
      at({ ...sessionOf(cut), GetWound }, async (page, { calls }) => {
        while (!calls.get("GetWound")) await pause(50);
        const taken = () => page.evaluate("window.palpate.frames.taken");
        const before = Number(await taken());
        while (Number(await taken()) < before + 20) await pause(100);
        assert.deepEqual(await page.evaluate("[window.palpate.wound.shown, window.palpate.wound.vertices]"), [0, 0], name);
        assert.equal(calls.get("GetWound"), 1, name);
      }),
    );
    await Promise.all(each);
  });

  test("shows text as text, and nothing that acts", async () => {
    const text = '<img src=x onerror="window.ran = true"><script>window.ran = true</script>\u0000\u001b[31m\u202e!';
    const session = { ...SESSION, scene: { ...SESSION.scene, name: text }, warnings: [text], heldTools: [{ tool: 0, holder: text }] };
    const ways = /** @type {Record<string, Way>} */ ({
      ...sessionOf(session),
      ListScenes: async ({ say }) => void (await say({ sceneNames: [text] })),
      ListScripts: async ({ say }) => void (await say({ scriptNames: [text] })),
      ListJournals: async ({ say }) => void (await say({ journals: [{ sessionId: "s", run: 1, sceneName: text, beginUnixNs: 2n ** 63n - 1n }] })),
    });
    await at(ways, async (page) => {
      for (const id of ["connection", "notice", "holder"]) await page.locator(`#${id}`, { hasText: "<img" }).waitFor();
      await page.locator("#script option", { hasText: "<img" }).waitFor({ state: "attached" });
      const shown = await page.evaluate("document.body.textContent + [...document.images].map((image) => image.src)");
      assert.doesNotMatch(String(shown), /[\u0000\u001b\u202e]|\/x(,|$)/);
      assert.equal(await page.evaluate("window.ran"), undefined);
    });
  });

  test("cuts lists, and takes no message or frame without an end", async () => {
    const lists = /** @type {Record<string, Way>} */ ({ ListScenes: async ({ say }) => void (await say({ sceneNames: many(300_000, (i) => `s${i}`) })) });
    await at(lists, async (page) => {
      await page.waitForFunction("document.querySelectorAll('#scene option').length >= 1000", undefined, { polling: 100 });
      assert.ok(Number(await page.evaluate("document.querySelectorAll('option').length")) < 1100);
    });
    // Data that is sent before the page stops.
    let sent = 0;
    const zeros = Buffer.alloc(1 << 16);
    /** @type {Way} */
    const long = async ({ bytes }) => {
      await bytes(Buffer.from([0, 255, 255, 255, 255]));
      for (sent = 0; await bytes(zeros); sent += zeros.length);
    };
    await at({ CreateSession: long }, async (page) => {
      await page.locator("#connection", { hasText: "Trying again" }).waitFor();
    });
    assert.ok(sent < 64 << 20, `${sent} bytes of one message`);
    const patch = { firstX: 0, firstY: 0, countX: 17, countY: 17, displacement: new Uint8Array(17 * 17 * 6) };
    const patches = many(100, () => patch);
    let streams = 0;
    /** @type {Way} */
    const parts = async ({ say }) => {
      streams += 1;
      for (sent = 0; await say({ viewerId: "v", frameId: 1n, encoding: 2, patches }); sent += 100 * 17 * 17 * 6) await pause(0);
    };
    await at({ WatchFrames: parts }, async (page) => {
      await page.locator("#light[data-light=lost]").waitFor();
    });
    assert.ok(streams > 0 && sent < 256 << 20, `${sent} bytes of one frame`);
  });
});
