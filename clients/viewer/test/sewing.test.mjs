// Threads and clips on the page: `make test-viewer`.

import assert from "node:assert/strict";
import { rmSync } from "node:fs";
import { after, before, describe, test } from "node:test";
import { cut, pages, scenesToCut, Server, sweep } from "./harness.mjs";

/** @typedef {import("./harness.mjs").Page} Page */

const { open, close } = pages({ width: 820, height: 760 });

/** @type {Server} */
let server;
const scenes = scenesToCut();
before(async () => {
  server = await Server.start(["--scenes", scenes]);
});
after(async () => {
  assert.equal(await server?.stop(), 0, "the server ends well although pages were open");
  rmSync(scenes, { recursive: true });
});

/** Cuts the middle of the sheet. @param {Page} page */
async function cutMiddle(page) {
  await page.press(0.485, 0.3);
  await page.until(({ holds, hands }) => holds && hands.both[0]?.touches === true);
  const { sampledS } = await page.ask(({ sampledS }) => ({ sampledS }));
  await page.until(({ sampledS }, before) => sampledS > before + 1, sampledS);
  await sweep(page, [0.485, 0.3], [0.485, 0.75], 30);
  await page.until(({ wound }) => wound.severed > 30);
  await page.page.mouse.up();
  await page.page.keyboard.press("Escape");
  await page.until(({ wound, holds }) => wound.shown > 8 && wound.waiting === 0 && !holds);
}

/** Taps a place of the sheet. @param {Page} page @param {[number, number]} place */
async function tap(page, place) {
  await page.page.mouse.click(...(await page.at(...place)));
}

describe("a thread", () => {
  test("through four places draws the lips of a wound together, as far as its slider says", async () => {
    const page = await open(`${server.url}/?scene=liver&tool=blade`);
    await page.until(({ drawing }) => drawing.hasTexture);
    await page.picture("suture-before");
    await cutMiddle(page);
    await page.picture("suture-cut");
    await page.page.check("input[value=thread]", { force: true });
    assert.ok(await page.page.isDisabled("#lay"));
    // From one side of the cut to the other.
    const bites = /** @type {[number, number][]} */ ([[0.43, 0.44], [0.54, 0.49], [0.43, 0.54], [0.54, 0.59]]);
    for (const [index, bite] of bites.entries()) {
      await tap(page, bite);
      await page.until(({ sewing }, picked) => sewing.picked === picked, index + 1);
    }
    await page.says("bites", /4 places: more, or Enter/);
    // A place too many is taken back.
    await tap(page, [0.43, 0.64]);
    await page.until(({ sewing }) => sewing.picked === 5);
    await page.page.focus("#tissue");
    await page.page.keyboard.press("Backspace");
    await page.until(({ sewing }) => sewing.picked === 4);
    await page.picture("suture-bites");
    await page.page.locator("#thread-length").fill("1");
    await page.page.focus("#tissue");
    await page.page.keyboard.press("Enter");
    await page.until(({ sewing }) => sewing.picked === 0 && sewing.ties.length === 1);
    await page.says("ties", /Thread 1: [\d.]+ mm/);
    const wayM = (await page.ask(({ sewing }) => sewing.ties[0]))?.pathM ?? NaN;
    await page.page.locator("#thread-length").fill("0.7");
    // The opening, between places beside the cut, shrinks with the thread.
    await page.until(({ sewing }, wayM) => sewing.ties[0]?.pathM < 0.75 * wayM && sewing.ties[0].tensionN > 1e-3, wayM);
    await page.picture("suture-sewn");
    assert.deepEqual(await cut(page), []);
    await page.until(({ holds }) => !holds);
    // Another page sees the same thread, and takes it off.
    const late = await open(page.page.url());
    await late.says("ties", /Thread 1/);
    await late.page.getByRole("button", { name: "Take off thread 1" }).click();
    await late.until(({ sewing }) => sewing.ties.length === 0);
    await page.until(({ sewing }) => sewing.ties.length === 0);
    await page.page.locator("#ties").waitFor({ state: "hidden" });
    await close(late);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("and a clip are laid by keys on an organ, in the dark and on a phone's width", async () => {
    const page = await open(`${server.url}/?scene=gallbladder&tool=thread`, { colorScheme: "dark", viewport: { width: 390, height: 844 } });
    await page.until(({ drawing }) => drawing.hasTexture);
    await page.page.focus("#tissue");
    const pick = async () => {
      const { picked } = await page.ask(({ sewing }) => sewing);
      await page.page.keyboard.press(" ");
      return picked;
    };
    const go = async (/** @type {string} */ key, times = 4) => {
      for (let k = 0; k < times; k++) await page.page.keyboard.press(key);
    };
    for (let k = 0; k < 3; k++) {
      const before = await pick();
      await page.until(({ sewing }, picked) => sewing.picked === picked, before + 1);
      await go("ArrowRight");
    }
    await page.picture("suture-by-keys");
    assert.deepEqual(await cut(page), []);
    await page.page.keyboard.press("Enter");
    await page.until(({ sewing }) => sewing.ties.length === 1 && sewing.ties[0].kind === "thread");
    await page.page.check("input[value=clip]", { force: true });
    await page.page.focus("#tissue");
    await go("ArrowDown", 2);
    await pick();
    await go("ArrowRight", 1);
    await pick();
    await page.until(({ sewing }) => sewing.ties.length === 2 && sewing.ties[1].kind === "clip" && sewing.ties[1].lengthM < 1e-3);
    await page.picture("suture-and-clip");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });
});
