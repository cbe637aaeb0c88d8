// `make film`: a blade cuts a line into tissue under pretension, which gapes, and a thread through eight places closes it; in
// target/viewer/suture.

import { rmSync } from "node:fs";
import { Film } from "./film.mjs";
import { launch, Page, scenesToCut, Server } from "./harness.mjs";

/** Pretension of the tissue: a wound gapes by some millimetres. */
const PRETENSION_N_PER_M = 20;

const scenes = scenesToCut(PRETENSION_N_PER_M);
const server = await Server.start(["--scenes", scenes]);
const browser = await launch();
const context = await browser.newContext({ viewport: { width: 1100, height: 760 }, colorScheme: "light" });
const page = await Page.open(context, `${server.url}/?scene=liver&tool=blade`);
await page.until(({ drawing }) => drawing.hasTexture);
const film = await Film.begin(page, "suture");

const { mouse, keyboard } = page.page;
await page.press(0.485, 0.3);
await page.until(({ holds, hands }) => holds && hands.both[0]?.touches === true);
await film.moment("1-blade", "figures");
await film.lead(6, (part) => page.at(0.485, 0.3 + 0.4 * part));
await page.until(({ wound }) => wound.severed > 30);
await film.moment("2-cut", "figures");
await mouse.up();
await keyboard.press("Escape");
await mouse.move(5, 300);
await page.until(({ wound, holds }) => wound.shown > 8 && wound.waiting === 0 && !holds);
await film.moment("3-gapes", "figures");
await page.page.check("input[value=thread]", { force: true });
for (let bite = 0; bite < 8; bite++) {
  await mouse.click(...(await page.at(bite % 2 === 0 ? 0.42 : 0.55, 0.34 + 0.04 * bite)));
  await page.until(({ sewing }, picked) => sewing.picked === picked, bite + 1);
}
await film.moment("4-bites", "bites");
await page.page.focus("#tissue");
await keyboard.press("Enter");
await page.until(({ sewing }) => sewing.picked === 0 && sewing.ties.length === 1);
await film.moment("5-thread", "ties");
const length = page.page.locator("#thread-length");
for (const part of [0.95, 0.9, 0.85, 0.8, 0.75]) {
  await length.fill(String(part));
  await page.page.waitForTimeout(400);
}
await mouse.move(5, 300);
await film.moment("6-closed", "ties");
await film.end();
await browser.close();
await server.stop();
rmSync(scenes, { recursive: true });
if (!film.write()) process.exit(1);
