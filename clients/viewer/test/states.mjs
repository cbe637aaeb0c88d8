// `make page-states`: a picture of each state of the page, at three widths, light and dark, in target/viewer/states.
// `STATES=first,lost` takes some only, `WIDTHS=390` one width.

import { mkdirSync, mkdtempSync, readFileSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { launch, makeOrgan, makeToken, Page, PICTURES, Server } from "./harness.mjs";

const FOLDER = join(PICTURES, process.env.STATES_FOLDER ?? "states");
/** Windows, in pixels. The first is a phone's. */
const SIZES = [
  [390, 844],
  [1280, 800],
  [1920, 1080],
].filter(([width]) => !process.env.WIDTHS || process.env.WIDTHS.split(",").includes(String(width)));
const SCHEMES = /** @type {const} */ (["light", "dark"]);
/** A picture that stands still is drawn in full after this time. */
const CALM_MS = 1300;

mkdirSync(FOLDER, { recursive: true });
const temporary = () => mkdtempSync(join(tmpdir(), "palpate-"));
const browser = await launch();
const server = await Server.start(["--journal", temporary()]);

/** @typedef {{ page: Page, end?: () => Promise<unknown> }} State */

/** @param {import("playwright-core").BrowserContext} context @param {string} path */
async function shown(context, path) {
  const page = await Page.open(context, `${server.url}/${path}`);
  await page.until(({ drawing }) => drawing.hasTexture);
  return page;
}

/** Presses for a while. @param {Page} page @param {string} tool */
async function pressed(page, tool, x = 0.42, y = 0.5) {
  // Without scrolling there: on a phone the tissue would go out of sight, and figures that come meanwhile move the tools.
  await page.page.locator(`input[value=${tool}]`).evaluate((radio) => /** @type {HTMLInputElement} */ (radio).click());
  await page.press(x, y);
  await page.until(({ forceN }) => forceN[0] > 1e-3);
  await page.page.waitForTimeout(2500);
}

/** A page whose exercise goes on. @param {import("playwright-core").BrowserContext} context */
async function begun(context) {
  const page = await shown(context, "?exercise=lumps-2");
  await page.page.click("#begin-exercise");
  await pressed(page, "tip");
  return page;
}

/** A page without its tissue. @param {import("playwright-core").BrowserContext} context @param {string} url */
async function bare(context, url) {
  const page = new Page(await context.newPage());
  await page.page.goto(url);
  await page.page.waitForTimeout(2500);
  return page;
}

/** @type {Record<string, (context: import("playwright-core").BrowserContext) => Promise<State>>} */
const STATES = {
  briefing: async (context) => ({ page: await shown(context, "?exercise=lumps-2") }),
  exercise: async (context) => ({ page: await begun(context) }),
  debriefing: async (context) => {
    const page = await shown(context, "?exercise=lumps-2");
    await page.page.click("#begin-exercise");
    await page.page.waitForTimeout(1500);
    await page.page.click("#mark-here");
    await page.page.mouse.click(...(await page.at(0.45, 0.55)));
    await page.until(({ exercise }) => exercise.answers === 1);
    await page.page.click("#finish-exercise");
    await page.until(({ exercise }) => exercise.isDebriefing);
    return { page };
  },
  trainees: async (context) => {
    const page = await bare(context, `${server.url}/trainer.html`);
    await page.page.fill("#trainee", "Ann");
    await page.page.click("#add button");
    await page.page.waitForTimeout(2500);
    return { page };
  },
  first: async (context) => ({ page: await shown(context, "") }),
  list: async (context) => {
    const page = await shown(context, "");
    await page.page.waitForTimeout(2500);
    await page.page.click("#scene");
    return { page };
  },
  pressed: async (context) => {
    const page = await shown(context, "?name=Ann");
    await pressed(page, "push");
    return { page };
  },
  tip: async (context) => {
    const page = await shown(context, "?name=Ann");
    await pressed(page, "tip");
    return { page };
  },
  grasper: async (context) => {
    const page = await shown(context, "?scene=gallbladder&name=Ann");
    await page.page.check("input[value=grasper]", { force: true });
    const [left, top] = await page.press(0.42, 0.5);
    await page.until(({ ownForcesN }) => ownForcesN.filter((forceN) => forceN > 1e-3).length >= 2);
    await page.page.mouse.down({ button: "right" });
    await page.says("touch", /jaws/);
    await page.page.mouse.move(left + 20, top - 40, { steps: 6 });
    await page.page.waitForTimeout(2500);
    return { page };
  },
  "two-hands": async (context) => {
    const page = await shown(context, "?scene=gallbladder&tool=grasper,stroke&name=Ann");
    const [left, top] = await page.press(0.45, 0.48);
    await page.until(({ hands: { both } }) => (both[0]?.forceN ?? 0) > 1e-3);
    await page.page.mouse.down({ button: "right" });
    await page.until(({ hands: { both } }) => both[0]?.grips);
    await page.page.mouse.move(left, top - 40, { steps: 6 });
    await page.page.keyboard.press("p");
    await page.page.mouse.up({ button: "right" });
    await page.page.mouse.up();
    await page.press(0.25, 0.42);
    await page.until(({ hands: { both } }) => (both[1]?.forceN ?? 0) > 1e-3);
    await page.page.waitForTimeout(2500);
    return { page };
  },
  sewing: async (context) => {
    const page = await shown(context, "?scene=liver&tool=thread&name=Ann");
    const tap = async (/** @type {number} */ x, /** @type {number} */ y) => await page.page.mouse.click(...(await page.at(x, y)));
    for (const [x, y] of [[0.42, 0.42], [0.54, 0.48], [0.42, 0.54]]) await tap(x, y);
    await page.page.click("#lay");
    await page.until(({ sewing }) => sewing.ties.length === 1);
    for (const [x, y] of [[0.62, 0.42], [0.7, 0.5]]) await tap(x, y);
    await page.page.waitForTimeout(2500);
    return { page };
  },
  lumps: async (context) => {
    const page = await shown(context, "");
    await page.page.check("#lumps");
    await page.page.mouse.move(...(await page.at(0.6, 0.45)));
    return { page };
  },
  "own-lump": async (context) => {
    const file = join(temporary(), "kidney.obj");
    makeOrgan("kidney", "4", file);
    const page = await shown(context, "");
    await page.page.setInputFiles("#own-file", file);
    await page.page.click("#own-buttons button.main");
    await page.says("connection", /Connected to kidney/);
    await page.until(({ drawing }) => drawing.hasTexture);
    await page.page.click("#put-lump");
    await page.page.mouse.click(...(await page.at(0.5, 0.5)));
    await page.says("notice", /The lump is in/);
    await page.page.click("#tissue-values summary");
    return { page };
  },
  net: async (context) => ({ page: await shown(context, "?scene=stomach&wireframe=1") }),
  held: async (context) => {
    const page = await shown(context, "?name=Ann");
    const id = new URL(page.page.url()).searchParams.get("session");
    const other = await shown(context, `?session=${id}&name=Ben`);
    await pressed(other, "push");
    await page.page.bringToFront();
    await page.page.waitForTimeout(1500);
    return { page };
  },
  ...Object.fromEntries(
    ["liver", "stomach", "fibrotic", "colon", "gallbladder"].map((scene) => [
      scene,
      async (/** @type {import("playwright-core").BrowserContext} */ context) => ({ page: await shown(context, `?scene=${scene}`) }),
    ]),
  ),
  "colon-tip": async (context) => {
    const page = await shown(context, "?scene=colon");
    await page.page.fill("#strength", "0.85");
    await pressed(page, "tip", 0.5, 0.6);
    return { page };
  },
  own: async (context) => {
    const file = join(temporary(), "kidney.obj");
    makeOrgan("kidney", "4", file);
    const page = await shown(context, "");
    await page.page.setInputFiles("#own-file", file);
    await page.says("own-units", /millimetres/);
    return { page };
  },
  flawed: async (context) => {
    const file = join(temporary(), "patch.obj");
    makeOrgan("patch", "8", file);
    const text = readFileSync(file, "utf8");
    const faces = text.split("\n").filter((line) => line.startsWith("f "));
    writeFileSync(file, `${text}${faces[0]}\nv 0 0 0.2\nf 1 2 1\n`);
    const page = await shown(context, "");
    await page.page.setInputFiles("#own-file", file);
    await page.page.click("#own-buttons button.main");
    await page.page.locator("#own-problems li").first().waitFor();
    return { page };
  },
  comparison: async (context) => {
    const page = await shown(context, "?scene=paper");
    const rows = Array.from({ length: 41 }, (_, k) => `60,${(0.0025 * k).toFixed(4)},${0.1 * k},${(0.02 * k + 0.02 * Math.sin(3 * k)).toFixed(4)}`);
    const table = `tip_radius_mm,time_s,depth_mm,force_n\n${rows.join("\n")}\n`;
    await page.page.setInputFiles("#compare-file", { name: "lab.csv", mimeType: "text/csv", buffer: Buffer.from(table) });
    await page.until(({ comparison }) => comparison.curves > 0);
    return { page };
  },
  recording: async (context) => {
    const page = await shown(context, "");
    const id = new URL(page.page.url()).searchParams.get("session");
    await pressed(page, "push");
    await page.page.mouse.up();
    await page.page.waitForTimeout(1500);
    await page.page.goto(`${server.url}/?journal=${id}`);
    await page.until(({ recording, drawing }) => recording !== undefined && !recording.isBusy && drawing.hasTexture);
    await page.page.waitForTimeout(1500);
    return { page };
  },
  forbidden: async (context) => {
    const tokens = join(temporary(), "tokens.toml");
    makeToken(tokens, "create,touch");
    const asking = await Server.start(["--tokens", tokens]);
    return { page: await bare(context, asking.url), end: () => asking.stop() };
  },
  watcher: async (context) => {
    const tokens = join(temporary(), "tokens.toml");
    const token = makeToken(tokens, "watch");
    const asking = await Server.start(["--tokens", tokens]);
    return { page: await bare(context, `${asking.url}/#token=${token}`), end: () => asking.stop() };
  },
  lost: async (context) => {
    const own = await Server.start();
    const page = await Page.open(context, own.url);
    await page.until(({ drawing }) => drawing.hasTexture);
    await page.page.waitForTimeout(1500);
    await own.stop();
    await page.says("light", /^Lost/);
    await page.page.waitForTimeout(5000);
    return { page };
  },
  ended: async (context) => ({ page: await bare(context, `${server.url}/?session=0123456789abcdef0123456789abcdef`) }),
};

const wanted = process.env.STATES?.split(",") ?? Object.keys(STATES);
for (const name of wanted) {
  for (const isPhone of [true, false]) {
    const sizes = SIZES.filter(([width = 0]) => width < 700 === isPhone);
    const [first] = sizes;
    if (!first) continue;
    const context = await browser.newContext({
      viewport: { width: first[0] ?? 0, height: first[1] ?? 0 },
      colorScheme: "light",
      ...(isPhone ? { isMobile: true, hasTouch: true, deviceScaleFactor: 2 } : {}),
    });
    const { page, end } = await (STATES[name] ?? (() => Promise.reject(new Error(`no state ${name}`))))(context);
    for (const [width = 0, height = 0] of sizes) {
      await page.page.setViewportSize({ width, height });
      for (const colorScheme of SCHEMES) {
        await page.page.emulateMedia({ colorScheme });
        await page.page.waitForTimeout(CALM_MS);
        await page.page.screenshot({ path: join(FOLDER, `${name}-${width}-${colorScheme}.png`) });
      }
    }
    await context.close();
    await end?.();
  }
  console.log(join(FOLDER, name));
}
await browser.close();
await server.stop();
