// The examples, in a real browser with a real server.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { fileURLToPath } from "node:url";
import { launch, TEST_TIMEOUT_MS, PICTURES, Server } from "../../viewer/test/harness.mjs";

/** @type {import("playwright-core").Browser} */
let browser;
/** @type {Server} */
let server;

before(async () => {
  server = await Server.start(["--viewer", fileURLToPath(new URL("../examples/dist", import.meta.url))]);
  browser = await launch();
});

after(async () => {
  await browser.close();
  await server.stop();
});

/** Opens an example, and waits until its text matches a pattern. @param {string} address @param {RegExp} pattern */
async function says(address, pattern) {
  const page = await browser.newPage();
  page.setDefaultTimeout(TEST_TIMEOUT_MS);
  /** @type {string[]} */
  const faults = [];
  page.on("pageerror", (error) => faults.push(String(error)));
  await page.goto(`${server.url}/${address}`);
  const until = (/** @type {RegExp} */ wanted) => page.locator("#told", { hasText: wanted }).waitFor();
  await until(pattern);
  return { page, until, faults };
}

test("an example looks at a tissue that it pushes", async () => {
  const { page, faults } = await says("look.html", /\d frames, step \d+, deepest -[1-9]/);
  assert.deepEqual(faults, []);
  await page.close();
});

test("an example presses a tip into a tissue and feels it", async () => {
  const { page, until, faults } = await says("touch.html", /step \d+, at most \d/);
  await until(/at most 0\.[1-9]/);
  assert.deepEqual(faults, []);
  await page.close();
});

test("an example draws an organ and touches it where the mouse is", async () => {
  const { page, until, faults } = await says("front.html?scene=liver-organ", /liver-organ: 0\.00 N/);
  const { width, height } = page.viewportSize() ?? { width: 0, height: 0 };
  await page.mouse.move(width / 2, height / 2);
  await page.mouse.down();
  await page.mouse.move(width / 2 + 2, height / 2);
  await until(/: (0\.[1-9]|[1-9])/);
  await page.screenshot({ path: `${PICTURES}/front-example.png` });
  await page.mouse.up();
  await until(/: 0\.00 N/);
  assert.deepEqual(faults, []);
  await page.close();
});
