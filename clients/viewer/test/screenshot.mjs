// `make screenshot`: the picture of the README, docs/viewer.png.

import { join } from "node:path";
import { launch, Page, ROOT, Server } from "./harness.mjs";

const server = await Server.start();
const browser = await launch();
const context = await browser.newContext({ viewport: { width: 1100, height: 640 }, colorScheme: "light" });
const page = await Page.open(context, `${server.url}/?name=Guest&refinement=3&quality=high`);
await page.page.fill("#strength", "0.8");
const [left, top] = await page.press(0.48, 0.45);
await page.until(({ largestM }) => largestM > 0.02);
await page.page.mouse.move(left + 60, top - 20, { steps: 12 });
// Until the plots have something to tell.
await page.page.waitForTimeout(3500);
await page.page.screenshot({ path: join(ROOT, "docs/viewer.png") });
await browser.close();
await server.stop();
console.log("docs/viewer.png");
