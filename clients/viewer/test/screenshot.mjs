// `make screenshot`: the picture of the README, docs/viewer.png. It shows the page at work, with its figures: so it is
// taken while they are healthy, or not at all.

import { existsSync, readdirSync, writeFileSync } from "node:fs";
import { setPriority } from "node:os";
import { join } from "node:path";
import { launch, Page, ROOT, Server } from "./harness.mjs";

/** Sessions that are tried: one that was late once shows its overruns for ever. */
const TRIES = 5;
/** How long one may take to become healthy, ms. */
const SETTLES_MS = 30_000;
/** At least so many frames arrive and are drawn each second, and the newest is at most so old. */
const LEAST_FRAMES = 15;
const LEAST_DRAWN = 5;
const MOST_AGE_MS = 150;

const server = await Server.start();
const browser = await launch();
const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, colorScheme: "light" });

/**
 * Without a graphics processor the browser draws on the cores that the server steps on: the server goes first. Each thread
 * by itself, since some take a high priority for themselves when they begin.
 */
async function giveWay() {
  const session = await browser.newBrowserCDPSession();
  const { processInfo } = await session.send("SystemInfo.getProcessInfo");
  await session.detach();
  for (const { id } of processInfo) {
    const tasks = existsSync(`/proc/${id}/task`) ? readdirSync(`/proc/${id}/task`) : [];
    for (const task of tasks) setPriority(Number(task), 19);
  }
}

/**
 * The status line as it is shown: what is wrong with it, or nothing.
 * @param {Page} page
 * @returns {Promise<string[]>}
 */
async function complaints(page) {
  /** @type {Record<string, string>} */
  const shown = await page.page.evaluate(
    `Object.fromEntries([...document.querySelectorAll("#figures div")].map((row) =>
      [row.querySelector("dt").textContent, row.querySelector("dd").textContent]))`,
  );
  const [arrived, drawn] = /^(\d+)\/s, drawn (\d+)\/s/.exec(shown["frames"] ?? "")?.slice(1).map(Number) ?? [0, 0];
  const ageMs = parseFloat(shown["frame age"] ?? "");
  return [
    arrived >= LEAST_FRAMES ? "" : `${arrived} frames a second, not ${LEAST_FRAMES}`,
    drawn >= LEAST_DRAWN ? "" : `${drawn} drawn a second, not ${LEAST_DRAWN}`,
    ageMs <= MOST_AGE_MS ? "" : `the newest frame is ${shown["frame age"] ?? "not there"}, not below ${MOST_AGE_MS} ms old`,
    shown["overruns"] === "0" ? "" : `${shown["overruns"] ?? "no count of"} overruns`,
  ].filter((complaint) => complaint !== "");
}

/** Strokes a session of its own until it is healthy, and takes its picture; else tells what was wrong at last. */
async function take() {
  const page = await Page.open(context, `${server.url}/?name=Guest&refinement=3`);
  await giveWay();
  await page.page.fill("#strength", "0.8");
  const [left, top] = await page.press(0.48, 0.45);
  await page.until(({ largestM }) => largestM > 0.004);
  const begun = Date.now();
  let wrong = ["it did not begin"];
  let [turn, healthy] = [0, 0];
  while (Date.now() - begun < SETTLES_MS) {
    // A still tissue sends no frames.
    turn += 0.2;
    await page.page.mouse.move(left + 40 + 30 * Math.cos(turn), top - 10 + 15 * Math.sin(turn));
    await page.page.waitForTimeout(50);
    wrong = await complaints(page);
    healthy = wrong.length === 0 ? healthy + 1 : 0;
    // For as long as the plots take to have something to tell.
    if (healthy < 70) continue;
    const picture = await page.page.screenshot();
    wrong = await complaints(page);
    if (wrong.length === 0) {
      writeFileSync(join(ROOT, "docs/viewer.png"), picture);
      break;
    }
    healthy = 0;
  }
  await page.page.close();
  return wrong;
}

/** @type {string[]} */
let wrong = [];
for (let tried = 0; tried < TRIES; tried++) {
  wrong = await take();
  if (wrong.length === 0) break;
  console.error(`not healthy: ${wrong.join(", ")}`);
}
await browser.close();
await server.stop();
if (wrong.length > 0) {
  console.error("docs/viewer.png is left as it was: this machine has too much to do, or too little to do it with");
  process.exit(1);
}
console.log("docs/viewer.png");
