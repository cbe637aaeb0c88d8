// `make bench-viewer`: a large sheet at 60 frames a second, and the time from a press to the pixel that shows it.

import { mkdtempSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { cpus } from "node:os";
import { launch, Page, Server } from "./harness.mjs";

const SECONDS = Number(process.env.SECONDS ?? 20);
const PRESSES = Number(process.env.PRESSES ?? 100);

/** The paper's tissue with more points; all of them awake, so that every frame is a full one. */
const LARGE = `
name = "large"
[sheet]
points = [331, 331]
spacing_m = 0.003
point_mass_kg = 0.0001
[springs]
stiffness_n_per_m = 10.0
[virtual_springs]
stiffness_n_per_m = 0.05
[damping]
coefficient_n_s_per_m = 0.001
[stepping]
tolerance = 1e-3
`;

/** @param {number[]} values @param {number} part */
function quantile(values, part) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.min(sorted.length - 1, Math.floor(part * sorted.length))] ?? NaN;
}

const scenes = mkdtempSync(join(tmpdir(), "palpate-"));
writeFileSync(join(scenes, "large.toml"), LARGE);
const browser = await launch();
const server = await Server.start(["--scenes", scenes]);
console.log(`Machine: ${cpus().length} × ${cpus()[0]?.model ?? "unknown"}; the page is drawn without a graphics processor.`);

/** @param {string} scene */
async function open(scene) {
  const context = await browser.newContext({ viewport: { width: 1000, height: 640 } });
  return await Page.open(context, `${server.url}/?scene=${scene}&refinement=0`);
}

// Frames: a hand strokes all the time, so that there is something new in each.
const page = await open("large");
await page.press(0.3, 0.5);
await page.until(({ largestM }) => largestM > 0);
const state = () => page.ask(({ frames, received }) => ({ ...frames, received, ms: performance.now() }));
const lags = [];
const before = await state();
for (let second = 0; second < SECONDS; second++) {
  const [x, y] = await page.at(0.3 + 0.4 * Math.abs(Math.sin(second)), 0.5);
  await page.page.mouse.move(x, y, { steps: 10 });
  await page.page.waitForTimeout(800);
  lags.push(await page.page.locator("#figures div", { hasText: "frame age" }).locator("dd").innerText());
}
const after = await state();
await page.page.mouse.up();
const seconds = (after.ms - before.ms) / 1000;
const rate = (/** @type {number} */ count) => (count / seconds).toFixed(1);
console.log(`331 × 331 points, asked for 60 frames a second, for ${seconds.toFixed(1)} s:`);
console.log(`  delivered ${rate(after.taken - before.taken)} a second, drawn ${rate(after.drawn - before.drawn)} a second`);
console.log(`  left out by the server for want of credit: ${after.skipped - before.skipped}`);
console.log(`  ${((after.received - before.received) / seconds / 1e6).toFixed(2)} MB/s`);
console.log(`  age of the newest frame in the page, second by second (a queue that grew would show here): ${lags.join(", ")}`);
await page.page.context().close();

// Time from a press to its pixel, measured in the page.
for (const scene of ["paper", "large"]) {
  const page = await open(scene);
  await page.page.fill("#strength", "1");
  /** @type {number[]} */
  const times = [];
  for (let press = 0; press < PRESSES; press++) {
    await page.until(({ largestM, forceN }) => largestM < 1e-4 && forceN.length === 0);
    const [x, y] = await page.at(0.5, 0.5);
    await page.page.mouse.move(x, y);
    // Beside the place itself: there the tissue turns, and the light on it.
    const [left, top] = await page.at(0.515, 0.5);
    const shown = page.page.evaluate(`window.palpate.pixelAfterPress(${left}, ${top})`);
    // Two pictures, so that the one before the press is known.
    await page.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))");
    await page.page.mouse.down();
    times.push(Number(await shown));
    await page.page.mouse.up();
  }
  const [p50, p99] = [0.5, 0.99].map((part) => quantile(times, part).toFixed(1));
  console.log(`From a press to the pixel that shows it, ${scene}: p50 ${p50} ms, p99 ${p99} ms (${times.length} presses)`);
  await page.page.context().close();
}
await browser.close();
await server.stop();
