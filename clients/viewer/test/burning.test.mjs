// A cautery on the page, and what it burns: `make test-viewer`.

import assert from "node:assert/strict";
import { rmSync } from "node:fs";
import { after, before, describe, test } from "node:test";
import { colourAt, pages, scenesToCut, Server } from "./harness.mjs";

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

/** The mean light of pixels around a place of the tissue. @param {Page} page @param {number} x @param {number} y */
async function light(page, x, y) {
  const [left, top] = await page.at(x, y);
  let sum = 0;
  for (const [dx, dy] of [[0, 0], [-2, 0], [2, 0], [0, -2], [0, 2]]) {
    const { red, green, blue } = await colourAt(page.page, left + (dx ?? 0), top + (dy ?? 0));
    sum += red + green + blue;
  }
  return sum / 5;
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
    const [before, beside] = [await light(page, 0.5, 0.5), await light(page, 0.8, 0.5)];
    await page.press(0.5, 0.5);
    await page.until(({ burns }) => burns.burnt > 3 && burns.through > 0);
    await page.until(({ wound }) => wound.severed > 2);
    await leave(page);
    await page.picture("burn-of-sheet");
    const burnt = await light(page, 0.5, 0.5);
    assert.ok(burnt < 0.4 * before, `${burnt} where it burnt, ${before} before`);
    const same = await light(page, 0.8, 0.5);
    assert.ok(Math.abs(same - beside) < 0.1 * beside, `${same} beside, ${beside} before`);
    const known = await page.ask(({ burns }) => burns);
    const late = await open(page.page.url());
    await late.until(({ burns }, known) => burns.version === known.version && burns.burnt === known.burnt, known);
    await close(late);
    // Another fineness has other vertices, and the same burns.
    await page.page.locator("#refinement").fill("0");
    await page.until(({ burns }, known) => burns.version === known.version && burns.burnt > 0 && burns.burnt < known.burnt, known);
    assert.ok((await light(page, 0.5, 0.5)) < 0.5 * before);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("burns the surface of an organ", async () => {
    const page = await open(`${server.url}/?scene=gallbladder&tool=cautery`);
    await page.until(({ drawing }) => drawing.hasTexture);
    const before = await light(page, 0.5, 0.5);
    await page.press(0.5, 0.5);
    await page.until(({ burns }) => burns.through > 0);
    await leave(page);
    await page.picture("burn-of-organ");
    const burnt = await light(page, 0.5, 0.5);
    assert.ok(burnt < 0.5 * before, `${burnt} where it burnt, ${before} before`);
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

  test("is not for a solid", async () => {
    const page = await open(`${server.url}/?scene=liver-solid&tool=cautery`);
    assert.ok(await page.page.isDisabled("input[value=cautery]"));
    assert.ok(await page.page.isChecked("input[value=tip]"));
    assert.match((await page.page.getAttribute("#cautery-part", "title")) ?? "", /not a solid/);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });
});
