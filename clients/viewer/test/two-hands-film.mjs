// `make film`: a grasper lifts a gallbladder and is parked, and a second tool strokes the tissue; in target/viewer/two-hands.

import { Film } from "./film.mjs";
import { launch, Page, Server } from "./harness.mjs";

/** How far the mouse lifts. */
const LIFT_PX = 80;

const server = await Server.start();
const browser = await launch();
const context = await browser.newContext({ viewport: { width: 960, height: 600 }, colorScheme: "light" });
const page = await Page.open(context, `${server.url}/?scene=gallbladder&tool=grasper,stroke&name=Ann`);
await page.until(({ drawing }) => drawing.hasTexture);
const film = await Film.begin(page, "two-hands");

const { mouse, keyboard } = page.page;
const [left, top] = await page.press(0.45, 0.48);
await page.until(({ hands: { both } }) => (both[0]?.forceN ?? 0) > 1e-3);
await film.moment("1-open-jaws", "felt");
await mouse.down({ button: "right" });
await page.until(({ hands: { both } }) => both[0]?.grips);
await film.moment("2-closed-jaws", "felt");
await film.lead(3, (part) => [left + 10 * part, top - LIFT_PX * part]);
await film.moment("3-lifted", "felt");
await keyboard.press("p");
await mouse.up({ button: "right" });
await mouse.up();
await film.moment("4-parked", "felt");
const [x, y] = await page.at(0.25, 0.42);
await film.lead(1, (part) => [left + (x - left) * part, top - LIFT_PX + (y - top + LIFT_PX) * part]);
await mouse.down();
await page.until(({ hands: { both } }) => (both[1]?.forceN ?? 0) > 1e-3);
await film.lead(3, (part) => [x + 45 * Math.sin(6 * part) ** 2, y - 15 * Math.sin(3 * part)]);
await film.moment("5-stroked", "felt");
await film.lead(3, (part) => [x + 45 * Math.sin(6 + 6 * part) ** 2, y - 15 * Math.sin(3 + 3 * part)]);
await mouse.up();
await film.moment("6-still-parked", "felt");
await film.end();
await browser.close();
await server.stop();
if (!film.write()) process.exit(1);
