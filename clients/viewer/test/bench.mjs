// `make bench-viewer`: a large sheet at 60 frames a second, and the time from a press to the pixel that shows it.

import { mkdtempSync, writeFileSync } from "node:fs";
import { cpus, tmpdir } from "node:os";
import { join } from "node:path";
import { launch, Page, Server } from "./harness.mjs";

const SECONDS = Number(process.env.SECONDS ?? 15);
const PRESSES = Number(process.env.PRESSES ?? 100);
/** Until a press is seen; what takes longer was not. */
const SEEN_MS = 15_000;

/** As many points as the issue asks for, heavy enough that one substep does: a core has more to do here than step. */
const LARGE = `
name = "large"
[sheet]
points = [331, 331]
spacing_m = 0.003
point_mass_kg = 0.004
[springs]
stiffness_n_per_m = 10.0
[anchor_springs]
stiffness_n_per_m = 1.0
[damping]
coefficient_n_s_per_m = 0.06
[stepping]
tolerance = 1e-2
`;

const SCENES = mkdtempSync(join(tmpdir(), "palpate-"));
const SCRIPTS = mkdtempSync(join(tmpdir(), "palpate-"));
writeFileSync(join(SCENES, "large.toml"), LARGE);
/** Up and down all over the sheet, so that all tiles change in each frame. @param {number} middle @param {number} forceN */
function sway(middle, forceN) {
  const [durationS, everyS] = [SECONDS + 60, 0.2];
  writeFileSync(
    join(SCRIPTS, "sway.toml"),
    `name = "sway"
duration_s = ${durationS}
sample_every_s = 1.0
[[force]]
point = [${middle}, ${middle}]
force_n = [0.0, 0.0, -1.0]
falloff_per_m = 3.0
falloff_offset = 0.0
profile = { type = "trace", file = "sway.csv" }
`,
  );
  const rows = Array.from({ length: durationS / everyS }, (_, i) => `${(i * everyS).toFixed(1)},0,0,${i % 2 ? forceN : -forceN}\n`);
  writeFileSync(join(SCRIPTS, "sway.csv"), `time_s,fx_n,fy_n,fz_n\n${rows.join("")}`);
}

/** @param {number[]} values @param {number} part */
function quantile(values, part) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.min(sorted.length - 1, Math.floor(part * sorted.length))] ?? NaN;
}

/** @param {number} ms */
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

const browser = await launch();
console.log(`Machine: ${cpus().length} × ${cpus()[0]?.model ?? "unknown"}; Chromium ${browser.version()}.`);
console.log("Server and browser share it, and without a graphics processor so does what draws.");

/** A page at a server of its own: a session that goes on with nobody there would take its time from the next. @param {string} scene */
async function open(scene) {
  const server = await Server.start(["--scripts", SCRIPTS, ...(scene === "large" ? ["--scenes", SCENES] : [])]);
  const context = await browser.newContext({ viewport: { width: 1000, height: 640 } });
  const page = await Page.open(context, `${server.url}/?scene=${scene}&refinement=0`);
  const close = async () => {
    await context.close();
    await server.stop();
  };
  return { page, close };
}

/** All the sheet in motion: every frame is a full one. @param {string} scene @param {number} side @param {number} forceN */
async function frames(scene, side, forceN) {
  sway((side - 1) / 2, forceN);
  const { page, close } = await open(scene);
  await page.page.selectOption("#script", "sway");
  await page.page.click("#play");
  await page.until(({ largestM }) => largestM > 0.005);
  // Waits until the page knows its drawing speed.
  await sleep(6000);
  const state = () => page.ask(({ frames, received, ageMs }) => ({ ...frames, received, ageMs, ms: performance.now() }));
  const lags = [];
  const before = await state();
  for (let second = 0; second < SECONDS; second++) {
    await sleep(1000);
    lags.push((await state()).ageMs?.toFixed(0) ?? "–");
    if (second % 10 === 9) console.error(`  ${second + 1} s of ${SECONDS} s …`);
  }
  const after = await state();
  const seconds = (after.ms - before.ms) / 1000;
  const rate = (/** @type {number} */ count) => (count / seconds).toFixed(1);
  const taken = after.taken - before.taken;
  const bytes = after.received - before.received;
  console.log(`${scene}: ${side} × ${side} points, all of them moving, asked for 60 frames a second, for ${seconds.toFixed(1)} s:`);
  console.log(`  delivered ${rate(taken)} a second, drawn ${rate(after.drawn - before.drawn)} a second`);
  console.log(`  simulated time ran at ${((after.timeS - before.timeS) / seconds).toFixed(2)} of real: what is far below 1 had no machine to run on`);
  console.log(`  left out by the server for want of credit: ${after.skipped - before.skipped}`);
  console.log(`  ${(bytes / seconds / 1e6).toFixed(2)} MB/s, ${(bytes / taken / 1e3).toFixed(0)} kB a frame (all vertices: ${((6 * side * side) / 1e3).toFixed(0)} kB)`);
  console.log(`  a picture: ${await page.ask(({ picture }) => picture)}`);
  console.log(`  age of the newest frame in the page, ms, second by second (a queue that grew would show here): ${lags.join(", ")}`);
  await close();
}

/** Time from a press to its pixel, measured in the page. @param {string} scene @param {number} side */
async function presses(scene, side) {
  // At a point that coarse pictures have too, and a point beside it, where the tissue turns, and the light on it. Further
  // away one would wait for the tissue.
  const [point, beside] = [4 * Math.round(side / 8), 4 * Math.round(side / 8) + 1].map((at) => at / (side - 1));
  const { page, close } = await open(scene);
  await page.page.fill("#strength", "1");
  // The first presses take the tool, and show the page its drawing speed.
  let unmeasured = 5;
  /** @type {number[]} */
  const times = [];
  while (times.length < PRESSES) {
    await page.until(({ largestM, forceN }) => largestM < 1e-4 && forceN.length === 0);
    const [x, y] = await page.at(point, point);
    await page.page.mouse.move(x, y);
    const [left, top] = await page.at(beside, point);
    const shown = page.page.evaluate(`window.palpate.pixelAfterPress(${left}, ${top})`);
    // Two pictures, so that the one before the press is known.
    await page.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))");
    await page.page.mouse.down();
    const ms = await Promise.race([shown, sleep(SEEN_MS)]);
    if (typeof ms !== "number") throw new Error(`press ${times.length + 1} on ${scene} showed nowhere within ${SEEN_MS} ms`);
    await page.page.mouse.up();
    if (unmeasured-- > 0) continue;
    times.push(ms);
    if (times.length % 25 === 0) console.error(`  ${times.length} presses of ${PRESSES} on ${scene} …`);
  }
  const [p50, p99] = [0.5, 0.99].map((part) => quantile(times, part).toFixed(1));
  console.log(`From a press to the pixel that shows it, ${scene}: p50 ${p50} ms, p99 ${p99} ms (${times.length} presses)`);
  console.log(`  a picture: ${await page.ask(({ picture }) => picture)}`);
  await close();
}

/** A drag across a tissue, with a blade or with a tip. @param {string} scene @param {string} tool */
async function drag(scene, tool) {
  const { page, close } = await open(scene);
  await page.until(({ drawing }) => drawing.hasTexture);
  await page.page.check(`input[value=${tool}]`, { force: true });
  await page.press(0.4, 0.5);
  await page.until(({ holds, hands }) => holds && hands.both[0]?.touches === true);
  await sleep(1500);
  await page.ask(({ takeLongest }) => takeLongest());
  for (let k = 1; k <= 60; k++) {
    await page.page.mouse.move(...(await page.at(0.4 + (0.2 * k) / 60, 0.5)));
    await sleep(50);
  }
  await page.page.mouse.up();
  await page.until(({ wound }) => wound.waiting === 0);
  const { severed, longest } = await page.ask(({ wound, takeLongest }) => ({ severed: wound.severed, longest: takeLongest() }));
  const [picture, wound] = [longest.pictureMs.toFixed(1), longest.woundMs.toFixed(1)];
  console.log(`${tool} across ${scene}: the page worked at most ${picture} ms on a picture, and ${wound} ms on a change of the wound; ${severed} springs severed`);
  await close();
}

for (const tool of ["tip", "blade"]) await drag("liver-organ", tool);
await frames("paper", 31, 0.3);
await frames("large", 331, 0.03);
await presses("paper", 31);
await presses("large", 331);
await browser.close();
