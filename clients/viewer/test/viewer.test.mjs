// The page in a real browser at a real server: `make test-viewer`.

import assert from "node:assert/strict";
import { mkdtempSync, readFileSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, describe, test } from "node:test";
import { launch, makeToken, Page, pageProcesses, ROOT, Server } from "./harness.mjs";

/** @type {import("playwright-core").Browser} */
let browser;
/** @type {Server} */
let server;

const VIEWPORT = { viewport: { width: 820, height: 540 } };

/** A page of its own, in a profile of its own: other pages' connections are not counted with its. */
async function open(url = server.url, options = {}) {
  return await Page.open(await browser.newContext({ ...VIEWPORT, ...options }), url);
}

/** @param {Page} page */
async function close(page) {
  await page.page.context().close();
}

before(async () => {
  browser = await launch();
  server = await Server.start();
});
after(async () => {
  await browser?.close();
  assert.equal(await server?.stop(), 0, "the server ends well although pages were open");
});

describe("the page", () => {
  test("opens a session of its own, moves under a drag and feels a force", async () => {
    const page = await open();
    assert.match(page.page.url(), /\?session=[0-9a-f]+/);
    const rest = await page.picture("rest");
    const [left, top] = await page.press();
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await page.says("felt", /pushes back with/);
    await page.says("holder", /^You/);
    const pressed = await page.picture("pressed");
    assert.notDeepEqual(rest, pressed);
    // Dragged aside the push leans, and the tissue goes along.
    const straight = await page.ask((inside) => inside.at(0.5, 0.5));
    await page.page.mouse.move(left + 120, top, { steps: 6 });
    await page.until(({ at }, before) => at(0.5, 0.5)[0] > before + 3, straight[0]);
    await page.picture("leaning");
    await page.page.mouse.up();
    await page.until(({ largestM, forceN }) => largestM < 0.004 && forceN.length === 0);
    await page.page.keyboard.press("Escape");
    await page.until(({ holds }) => !holds);
    await page.says("holder", /free/);
    assert.deepEqual(page.complaints, [], "the console stays clean");
    await close(page);
  });

  test("pulls, strokes, and obeys keys alone", async () => {
    const page = await open();
    const keys = page.page.keyboard;
    await page.page.check("input[value=pull]");
    const [left, top] = await page.press();
    await page.page.mouse.move(left, top - 60, { steps: 8 });
    await page.until(({ largestM, forceN }) => largestM > 0.04 && forceN[0] > 0.2);
    await page.picture("pulled");
    await page.page.mouse.up();
    await page.until(({ largestM }) => largestM < 0.004);

    await page.page.check("input[value=stroke]");
    await page.press(0.3, 0.5);
    await page.until(({ largestM }) => largestM > 0.01);
    const [right, across] = await page.at(0.7, 0.5);
    await page.page.mouse.move(right, across, { steps: 20 });
    await page.until(({ at, forceN }) => at(0.7, 0.5) !== undefined && forceN[0] > 0.05);
    await page.picture("stroked");
    await page.page.mouse.up();
    await page.until(({ largestM }) => largestM < 0.004);

    await page.page.check("input[value=push]");
    await page.page.focus("#tissue");
    await keys.press("ArrowLeft");
    await keys.press("ArrowUp");
    await keys.down(" ");
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await page.picture("keys");
    await keys.up(" ");
    await page.until(({ largestM }) => largestM < 0.004);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("changes k of the running tissue, which then gives way further", async () => {
    const page = await open();
    await page.press();
    await page.until(({ forceN }) => forceN[0] > 0.5);
    await page.until(({ largestM }) => largestM > 0.02);
    const before = await page.ask(({ largestM }) => largestM);
    const said = await page.text("k-value");
    await page.page.locator("#k").evaluate((/** @type {HTMLInputElement} */ slider) => {
      slider.value = slider.min;
      slider.dispatchEvent(new Event("input", { bubbles: true }));
    });
    await page.until(({ largestM }, before) => largestM > 1.3 * before, before);
    await page.page.mouse.up();
    // What the session says, not only the slider.
    await page.page.reload();
    await page.shows();
    await page.says("k-value", /^1\.00 N\/m/);
    assert.notEqual(await page.text("k-value"), said);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("draws the mass points as a wireframe, and other refinements", async () => {
    const page = await open();
    const skin = await page.picture("skin");
    await page.page.check("#wireframe");
    await page.press();
    await page.until(({ largestM }) => largestM > 0.02);
    const wires = await page.picture("wireframe");
    assert.notDeepEqual(skin, wires);
    for (const n of ["0", "5"]) {
      await page.page.fill("#refinement", n);
      await page.until(({ largestM }) => largestM > 0.02);
      assert.equal(await page.text("refinement-value"), n);
    }
    await page.page.mouse.up();
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("says when a picture is drawn with less effort, and draws in full if asked", async () => {
    const page = await open(`${server.url}/?refinement=5`);
    await page.says("figures", /1 vertex in 2 a side.*no graphics processor/);
    const rest = await page.picture("coarse-rest");
    await page.press();
    await page.until(({ largestM }) => largestM > 0.02);
    assert.notDeepEqual(rest, await page.picture("coarse-pressed"));
    await page.page.goto(`${page.page.url()}&refinement=5&quality=high`);
    await page.shows();
    await page.says("figures", /picture\s*no graphics processor/);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("plays a shipped script", async () => {
    const page = await open();
    await page.page.selectOption("#script", "vertical-60");
    await page.page.click("#play");
    // By the plot: a picture may come too late for what lasts half a second.
    await page.until(({ deepestM }) => deepestM > 0.03);
    await page.says("play", /^Play$/);
    await page.until(({ largestM, forceN }) => largestM < 0.01 && forceN.length === 0);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("says that the tissue recovered, how often and why", async () => {
    const folder = mkdtempSync(join(tmpdir(), "palpate-"));
    const config = join(mkdtempSync(join(tmpdir(), "palpate-")), "config.toml");
    // Nobody has to wait for the error of a scene whose every push fails.
    writeFileSync(config, "[limits]\nrehearsal_work = 1\n");
    const paper = readFileSync(join(ROOT, "scenes/paper.toml"), "utf8");
    const stiff = paper.replace("stiffness_n_per_m = 10.0", "stiffness_n_per_m = 1e9");
    writeFileSync(join(folder, "stiff.toml"), `${stiff}\n[stepping]\nsubsteps = 1\n`);
    const failing = await Server.start(["--config", config, "--scenes", folder]);
    const page = await open(`${failing.url}/?scene=stiff`);
    await page.page.selectOption("#script", "vertical-60");
    await page.page.click("#play");
    await page.says("connection", /Connected to a session of .*The tissue recovered (once|\d+ times), .* because after step \d+ /);
    await close(page);
    assert.equal(await failing.stop(), 0);
  });

  test("shows the server a token from behind the address, and keeps it out of that", async () => {
    const tokens = join(mkdtempSync(join(tmpdir(), "palpate-")), "tokens.toml");
    const token = makeToken(tokens, "create,touch");
    const asking = await Server.start(["--tokens", tokens]);
    const page = new Page(await (await browser.newContext(VIEWPORT)).newPage());
    await page.page.goto(asking.url);
    await page.says("notice", /asks who you are/);
    await page.page.goto(`${asking.url}/#token=${token}`);
    await page.shows();
    assert.match(page.page.url(), /\?session=[0-9a-f]+$/);
    await page.page.reload();
    await page.shows();
    await page.press();
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    assert.deepEqual(page.complaints, []);
    await close(page);
    assert.equal(await asking.stop(), 0);
  });

  test("fits a phone, light and dark", async () => {
    for (const colorScheme of /** @type {const} */ (["light", "dark"])) {
      const page = await open(server.url, { viewport: { width: 360, height: 720 }, colorScheme, hasTouch: true });
      await page.says("connection", /Connected/);
      const wide = await page.page.evaluate("document.documentElement.scrollWidth - innerWidth");
      assert.equal(wide, 0, "nothing is wider than the window");
      const [left, top] = await page.at(0.5, 0.5);
      assert.ok(left > 0 && left < 360 && top > 0 && top < 720, "the tissue is in sight");
      await page.picture(`phone-${colorScheme}`);
      assert.deepEqual(page.complaints, []);
      await close(page);
    }
  });
});

/** Nobody presses. @param {Page} page */
async function rests(page) {
  await page.page.mouse.up();
  await page.until(({ largestM, forceN }) => largestM < 0.004 && forceN.length === 0);
}

/** Lets go, presses again, and sees many frames. @param {Page} page */
async function pressAgain(page) {
  const taken = await page.ask(({ frames }) => frames.taken);
  do {
    await rests(page);
    await page.press();
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
  } while ((await page.ask(({ frames }) => frames.taken)) < taken + 30);
}

describe("several pages on one session", () => {
  test("see the same, and only one may touch", async () => {
    const holder = await open(`${server.url}/?name=first`);
    const other = await open(holder.page.url().replace("first", "second"));
    await holder.press();
    await holder.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await other.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await other.says("holder", /first holds the tool/);
    const [left, top] = await other.at(0.3, 0.3);
    await other.page.mouse.move(left, top);
    await other.page.mouse.down();
    await other.says("notice", /Somebody else holds the tool/);
    assert.equal(await other.ask(({ holds }) => holds), false);
    await other.picture("observer");
    await other.page.mouse.up();
    await holder.page.mouse.up();
    await other.until(({ largestM }) => largestM < 0.004);
    await holder.page.keyboard.press("Escape");
    // Free again: the other may.
    await other.says("holder", /free/);
    await other.press();
    await holder.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    for (const page of [holder, other]) assert.deepEqual(page.complaints, []);
    await close(other);
    // Nobody's hand is on the tissue any more, and nothing goes on pressing.
    await holder.until(({ largestM, forceN }) => largestM < 0.004 && forceN.length === 0);
    await close(holder);
  });

  test("are not delayed by one that stalls, closes or reloads, and nothing of it is left", async () => {
    // Two streams a page: were they not given back, the second reload would find none left.
    const config = join(mkdtempSync(join(tmpdir(), "palpate-")), "config.toml");
    writeFileSync(config, "[limits]\nstreams_per_session = 5\n");
    const strict = await Server.start(["--config", config]);
    const well = await open(strict.url);
    const others = await pageProcesses(browser);
    const ill = await open(well.page.url());
    await well.press();
    await ill.until(({ largestM }) => largestM > 0.02);
    for (let round = 0; round < 4; round++) {
      await well.page.mouse.up();
      await well.page.mouse.down();
      // In the midst of frames.
      await ill.page.reload();
      await ill.shows();
      await ill.until(({ largestM }) => largestM > 0.005);
    }
    // It stalls: a request that is not answered holds its only thread.
    /** @type {() => void} */
    let answer = () => {};
    const held = new Promise((done) => (answer = () => done(undefined)));
    await ill.page.route("**/hold", async (route) => {
      await held;
      await route.fulfill({ status: 204 });
    });
    let isStalled = true;
    const takenBefore = ill.ask(({ frames }) => frames.taken);
    const stalled = ill.page
      .evaluate("const ask = new XMLHttpRequest(); ask.open('GET', '/hold', false); ask.send();")
      .then(() => (isStalled = false));
    const illTook = await takenBefore;
    await pressAgain(well);
    assert.ok(isStalled, "all that while the other stood still");
    await rests(well);
    answer();
    await stalled;
    // More than its credit: frames were taken in, and credit given back, all the while.
    await ill.until(({ frames }, before) => frames.taken > before + 8, illTook);
    await well.press();
    await ill.until(({ largestM }) => largestM > 0.02);
    // All of it stands still, with its worker: its processes are stopped.
    const stopped = (await pageProcesses(browser)).filter((id) => !others.includes(id));
    assert.notEqual(stopped.length, 0);
    stopped.forEach((id) => process.kill(id, "SIGSTOP"));
    try {
      await pressAgain(well);
    } finally {
      stopped.forEach((id) => process.kill(id, "SIGCONT"));
    }
    // It has the newest at once: credit kept what it missed on the server.
    await ill.until(({ largestM }) => largestM > 0.02);
    await close(ill);
    const next = await open(well.page.url());
    await next.until(({ largestM }) => largestM > 0.02);
    assert.deepEqual(well.complaints, []);
    await close(next);
    await close(well);
    assert.equal(await strict.stop(), 0);
  });

  test("come back by themselves when the server does", async () => {
    const first = await Server.start();
    const page = await open(first.url);
    await first.stop();
    await page.says("connection", /Connection lost.*Trying again in/);
    await page.picture("lost");
    const second = await Server.start([], new URL(first.url).host);
    // Its session went with the first server, and the page says so and offers another.
    await page.says("notice", /has ended/);
    await page.page.click("#notice button");
    await page.says("connection", /Connected/);
    await page.press();
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await close(page);
    assert.equal(await second.stop(), 0);
  });
});
