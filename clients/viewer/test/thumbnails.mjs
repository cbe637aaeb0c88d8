// `make scene-pictures`: small pictures of the shipped scenes for the page's list, clients/viewer/src/scenes; of some alone:
// `npm run scene-pictures -- NAME …`.

import { readdirSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { launch, Page, ROOT, Server } from "./harness.mjs";

const server = await Server.start();
const browser = await launch();
const context = await browser.newContext({ viewport: { width: 1100, height: 640 }, colorScheme: "light", deviceScaleFactor: 1 });
const shipped = readdirSync(join(ROOT, "scenes")).filter((name) => name.endsWith(".toml")).map((name) => name.replace(/\.toml$/, ""));
const asked = process.argv.slice(2);
for (const scene of asked.length > 0 ? asked : shipped) {
  const page = await Page.open(context, `${server.url}/?scene=${scene}&quality=high`);
  await page.until(({ drawing }) => drawing.hasTexture);
  // Light in folds is looked for a while.
  await page.page.waitForTimeout(2500);
  const url = await page.ask(({ thumbnail }) => thumbnail());
  const target = join("clients/viewer/src/scenes", `${scene}.jpg`);
  writeFileSync(join(ROOT, target), Buffer.from(url.split(",")[1] ?? "", "base64"));
  console.log(target);
  await page.page.close();
}
await browser.close();
await server.stop();
