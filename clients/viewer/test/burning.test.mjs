// A cautery on the page, and what it burns: `make test-viewer`.

import assert from "node:assert/strict";
import { rmSync } from "node:fs";
import { after, before, describe, test } from "node:test";
import { lights, pages, scenesToCut, Server } from "./harness.mjs";

/** @typedef {import("./harness.mjs").Page} Page */

const { open, close } = pages({ width: 820, height: 560 });

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

/**
 * The light near a place of the tissue, as a square of 33 pixels shows it: the mean, and that of the darkest tenth. A
 * tip burns the points that are nearest to it, at most half their spacing beside the place that was pressed.
 * @param {Page} page @param {number} x @param {number} y
 */
async function lightNear(page, x, y) {
  const [left, top] = await page.at(x, y);
  const clip = { x: Math.round(left) - 16, y: Math.round(top) - 16, width: 33, height: 33 };
  const all = await lights(page, await page.page.screenshot({ clip }));
  const mean = (/** @type {number[]} */ of) => of.reduce((sum, light) => sum + light, 0) / of.length;
  return { mean: mean(all), darkest: mean(all.slice(0, all.length / 10)) };
}

/** Lets go, and takes the pointer away. @param {Page} page */
async function leave(page) {
  await page.page.mouse.up();
  await page.page.keyboard.press("Escape");
  await page.page.mouse.move(5, 300);
  await page.until(({ holds }) => !holds);
  await page.until(({ picture }) => picture !== undefined);
  await page.page.waitForTimeout(500);
}

describe("a cautery", () => {
  test("darkens a sheet where it touches, severs it, and a late page shows the same burns", async () => {
    const page = await open(`${server.url}/?scene=liver&tool=cautery`);
    assert.ok(await page.page.isChecked("input[value=cautery]"));
    assert.equal(await page.text("strength-name"), "Depth");
    await page.until(({ drawing }) => drawing.hasTexture);
    const before = await lightNear(page, 0.5, 0.5);
    const beside = await lightNear(page, 0.8, 0.5);
    await page.press(0.5, 0.5);
    await page.until(({ burns }) => burns.burnt > 3 && burns.through > 0);
    await page.until(({ wound }) => wound.severed > 2);
    await leave(page);
    await page.picture("burn-of-sheet");
    const burnt = await lightNear(page, 0.5, 0.5);
    assert.ok(burnt.darkest < 0.4 * before.darkest, `${burnt.darkest} where it burnt, ${before.darkest} before`);
    const same = await lightNear(page, 0.8, 0.5);
    assert.ok(Math.abs(same.mean - beside.mean) < 0.1 * beside.mean, `${same.mean} beside, ${beside.mean} before`);
    const known = await page.ask(({ burns }) => burns);
    const late = await open(page.page.url());
    await late.until(({ burns }, known) => burns.version === known.version && burns.burnt === known.burnt, known);
    await close(late);
    // Another fineness has other vertices, and the same burns.
    await page.page.locator("#refinement").fill("0");
    await page.until(({ burns }, known) => burns.version === known.version && burns.burnt > 0 && burns.burnt < known.burnt, known);
    const coarse = await lightNear(page, 0.5, 0.5);
    assert.ok(coarse.darkest < 0.5 * before.darkest, `${coarse.darkest} at another fineness, ${before.darkest} before`);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("burns the surface of an organ", async () => {
    const page = await open(`${server.url}/?scene=gallbladder&tool=cautery`);
    await page.until(({ drawing }) => drawing.hasTexture);
    const before = await lightNear(page, 0.5, 0.5);
    await page.press(0.5, 0.5);
    await page.until(({ burns }) => burns.through > 0);
    await leave(page);
    await page.picture("burn-of-organ");
    const burnt = await lightNear(page, 0.5, 0.5);
    assert.ok(burnt.darkest < 0.5 * before.darkest, `${burnt.darkest} where it burnt, ${before.darkest} before`);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("is led by keys", async () => {
    const page = await open(`${server.url}/?scene=liver&tool=cautery&refinement=1`);
    await page.page.focus("#tissue");
    await page.page.keyboard.down(" ");
    await page.until(({ burns }) => burns.burnt > 0);
    await page.page.keyboard.up(" ");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("burns the cells of a solid, and severs them from each other", async () => {
    const page = await open(`${server.url}/?scene=liver-solid&tool=cautery`);
    assert.ok(await page.page.isChecked("input[value=cautery]"));
    await page.until(({ drawing }) => drawing.hasTexture);
    const before = await lightNear(page, 0.5, 0.5);
    await page.press(0.5, 0.5);
    await page.until(({ burns }) => burns.through > 0);
    await page.until(({ wound }) => wound.severed > 2);
    await leave(page);
    await page.picture("burn-of-solid");
    const burnt = await lightNear(page, 0.5, 0.5);
    assert.ok(burnt.darkest < 0.5 * before.darkest, `${burnt.darkest} where it burnt, ${before.darkest} before`);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });
});
