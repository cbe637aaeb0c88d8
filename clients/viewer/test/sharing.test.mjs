// Several pages on one session: `make test-viewer`.

import assert from "node:assert/strict";
import { mkdtempSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, describe, test } from "node:test";
import { pageProcesses, pages, paper, Server, whileStopped } from "./harness.mjs";

/** @typedef {import("./harness.mjs").Page} Page */

const { open, close, chromium } = pages({ width: 820, height: 540 });

/** @type {Server} */
let server;
before(async () => {
  server = await Server.start();
});
after(async () => assert.equal(await server?.stop(), 0, "the server ends well although pages were open"));

/** Lets go, presses again, and sees many frames. @param {Page} page */
async function pressAgain(page) {
  const taken = await page.ask(({ frames }) => frames.taken);
  do {
    await page.rests();
    await page.press();
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
  } while ((await page.ask(({ frames }) => frames.taken)) < taken + 30);
}

describe("several pages on one session", () => {
  test("see the same, and only one may touch", async () => {
    const holder = await open(`${paper(server)}&name=first`);
    const other = await open(holder.page.url().replace("first", "second"));
    await holder.press();
    await holder.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await other.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await other.says("holder", /first holds the tool/);
    const [left, top] = await other.at(0.3, 0.3);
    await other.page.mouse.move(left, top);
    await other.page.mouse.down();
    await other.says("notice", /first holds the tool\. You can touch as soon as first lets go/);
    assert.equal(await other.ask(({ holds }) => holds), false);
    await other.picture("observer");
    await other.page.mouse.up();
    await holder.page.mouse.up();
    await other.until(({ largestM }) => largestM < 0.004);
    await holder.page.keyboard.press("Escape");
    // Free again: the other may.
    await other.says("holder", /Nobody touches/);
    await other.press();
    await holder.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    for (const page of [holder, other]) assert.deepEqual(page.complaints, []);
    await close(other);
    // No user touches the tissue, and nothing continues to press.
    await holder.until(({ largestM, forceN }) => largestM < 0.004 && forceN.length === 0);
    await close(holder);
  });

  test("are not delayed by one that stalls, closes or reloads, and nothing of it is left", async () => {
    // Each page uses two streams: if they were not released, the second reload would find none.
    const config = join(mkdtempSync(join(tmpdir(), "palpate-")), "config.toml");
    writeFileSync(config, "[limits]\nstreams_per_session = 5\n");
    const strict = await Server.start(["--config", config]);
    const well = await open(paper(strict));
    const others = await pageProcesses(chromium());
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
    await well.rests();
    answer();
    await stalled;
    // More than its credit: frames were taken in, and credit given back, all the while.
    await ill.until(({ frames }, before) => frames.taken > before + 8, illTook);
    await well.press();
    await ill.until(({ largestM }) => largestM > 0.02);
    // All of it stands still, with its worker: its processes are stopped.
    const stopped = (await pageProcesses(chromium())).filter((id) => !others.includes(id));
    assert.notEqual(stopped.length, 0);
    await whileStopped(stopped, () => pressAgain(well));
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
    const page = await open(paper(first));
    await page.press();
    await page.until(({ largestM }) => largestM > 0.02);
    await first.stop();
    await page.says("light", /^Lost/);
    await page.says("connection", /connection is lost\. Trying again/);
    // It holds a tool, has two streams, and asks how the session is: while the server is away one call after the other is enough.
    let calls = 0;
    page.page.on("request", () => (calls += 1));
    await page.page.mouse.up();
    await page.page.waitForTimeout(2000);
    assert.ok(calls <= 12, `${calls} calls in 2 s to a server that is away`);
    // No messages of the browser itself, and one state at a time.
    assert.doesNotMatch(await page.page.evaluate("document.body.innerText"), /Connected|fetch/i);
    await page.picture("lost");
    const second = await Server.start([], new URL(first.url).host);
    // Its session ended with the first server; the page says so and offers another.
    await page.page.click("#try-now").catch(() => {});
    await page.says("notice", /has ended/);
    await page.says("light", /^Ended$/);
    await page.page.click("#notice button");
    await page.says("connection", /Connected/);
    await page.press();
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await close(page);
    assert.equal(await second.stop(), 0);
  });
});
