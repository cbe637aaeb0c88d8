// `make film`: a grasper lifts a gallbladder and is parked, and a second tool strokes the tissue. A picture of each moment and a film,
// in target/viewer/two-hands. The film needs ffmpeg; without it there are the pictures alone.

import { spawnSync } from "node:child_process";
import { mkdirSync, rmSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { launch, Page, PICTURES, Server } from "./harness.mjs";

const FOLDER = join(PICTURES, "two-hands");
const FRAMES = join(FOLDER, "frames");
const FILM = join(FOLDER, "two-hands.webm");
/** Pictures a second of the film. */
const RATE_HZ = 25;
/** How far the mouse lifts. */
const LIFT_PX = 80;
/** A picture that stands still is drawn in full after this time. */
const CALM_MS = 1300;

rmSync(FOLDER, { recursive: true, force: true });
mkdirSync(FRAMES, { recursive: true });
const server = await Server.start();
const browser = await launch();
const context = await browser.newContext({ viewport: { width: 960, height: 600 }, colorScheme: "light" });
const page = await Page.open(context, `${server.url}/?scene=gallbladder&tool=grasper,stroke&name=Ann`);
await page.until(({ drawing }) => drawing.hasTexture);

/** Pictures of the film, and the time of each, s. @type {{ name: string, timeS: number }[]} */
const frames = [];
const screen = await context.newCDPSession(page.page);
screen.on("Page.screencastFrame", ({ data, metadata, sessionId }) => {
  const name = `${String(frames.length).padStart(5, "0")}.jpg`;
  writeFileSync(join(FRAMES, name), Buffer.from(data, "base64"));
  frames.push({ name, timeS: metadata.timestamp ?? Date.now() / 1000 });
  void screen.send("Page.screencastFrameAck", { sessionId }).catch(() => undefined);
});
await screen.send("Page.startScreencast", { format: "jpeg", quality: 90 });

/** A picture of this moment, and what is felt. @param {string} name */
async function moment(name) {
  await page.page.waitForTimeout(CALM_MS);
  await page.page.screenshot({ path: join(FOLDER, `${name}.png`) });
  console.log(`${name}: ${(await page.text("felt")).replace("\n", "; ")}`);
}

/** Moves the mouse along a path in about so many seconds. @param {number} seconds @param {(part: number) => [number, number]} path */
async function lead(seconds, path) {
  const begun = Date.now();
  for (let part = 0; part < 1; ) {
    part = Math.min(1, (Date.now() - begun) / (1000 * seconds));
    await page.page.mouse.move(...path(part));
    await page.page.waitForTimeout(40);
  }
}

const { mouse, keyboard } = page.page;
const [left, top] = await page.press(0.45, 0.48);
await page.until(({ hands: { both } }) => (both[0]?.forceN ?? 0) > 1e-3);
await moment("1-open-jaws");
await mouse.down({ button: "right" });
await page.until(({ hands: { both } }) => both[0]?.grips);
await moment("2-closed-jaws");
await lead(3, (part) => [left + 10 * part, top - LIFT_PX * part]);
await moment("3-lifted");
await keyboard.press("p");
await mouse.up({ button: "right" });
await mouse.up();
await moment("4-parked");
const [x, y] = await page.at(0.25, 0.42);
await lead(1, (part) => [left + (x - left) * part, top - LIFT_PX + (y - top + LIFT_PX) * part]);
await mouse.down();
await page.until(({ hands: { both } }) => (both[1]?.forceN ?? 0) > 1e-3);
await lead(3, (part) => [x + 45 * Math.sin(6 * part) ** 2, y - 15 * Math.sin(3 * part)]);
await moment("5-stroked");
await lead(3, (part) => [x + 45 * Math.sin(6 + 6 * part) ** 2, y - 15 * Math.sin(3 + 3 * part)]);
await mouse.up();
await moment("6-still-parked");
await screen.send("Page.stopScreencast");
await browser.close();
await server.stop();

// Each picture is shown until the next one came.
const list = frames.flatMap(({ name, timeS }, k) => [`file '${name}'`, `duration ${Math.max((frames[k + 1]?.timeS ?? timeS + 1) - timeS, 1e-3).toFixed(3)}`]);
writeFileSync(join(FRAMES, "list.txt"), `ffconcat version 1.0\n${list.join("\n")}\n`);
const scaled = `fps=${RATE_HZ},scale=trunc(iw/2)*2:trunc(ih/2)*2`;
const options = ["-loglevel", "error", "-y", "-f", "concat", "-i", join(FRAMES, "list.txt"), "-vf", scaled, "-c:v", "libvpx-vp9", "-b:v", "0", "-crf", "34"];
const made = spawnSync("ffmpeg", [...options, "-row-mt", "1", "-cpu-used", "5", FILM], { stdio: "inherit" });
console.log(`${frames.length} pictures of the film are in ${FRAMES}`);
if (made.error) console.error("There is no film, because ffmpeg is missing (Debian: apt-get install ffmpeg).");
else if (made.status !== 0) process.exit(1);
else console.log(FILM);
