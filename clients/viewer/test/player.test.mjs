// Recordings on the page: `make test-viewer`.

import assert from "node:assert/strict";
import { mkdtempSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, describe, test } from "node:test";
import { callSession, cut, makeToken, pages, Server } from "./harness.mjs";

/** @typedef {import("./harness.mjs").Page} Page */

const { open, close } = pages({ width: 1100, height: 640 });

/** @type {Server} */
let server;

const folder = () => mkdtempSync(join(tmpdir(), "palpate-"));

/** @param {Page} page */
const sessionOf = (page) => new URL(page.page.url()).searchParams.get("session") ?? assert.fail("the address names no session");

/** Opens a session and presses twice, with a little rest before, between and after. @param {Server} server */
async function touch({ url }) {
  const page = await open(`${url}/?scene=paper`);
  for (let k = 0; k < 2; k++) {
    await page.page.waitForTimeout(500);
    await page.press();
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await page.page.waitForTimeout(1000);
    await page.page.mouse.up();
    await page.until(({ largestM, forceN }) => largestM < 0.004 && forceN.length === 0);
  }
  await page.page.waitForTimeout(500);
  return page;
}

/** A session that was touched and has ended: its ID. @param {Server} server */
async function record(server) {
  const page = await touch(server);
  const id = sessionOf(page);
  await close(page);
  assert.equal(await callSession(server, "DeleteSession", id), undefined);
  return id;
}

/** Waits until what was chosen is shown. @param {Page} page */
async function shown(page) {
  await page.until(({ recording }) => recording !== undefined && !recording.isBusy);
  return (await page.ask(({ recording }) => recording)) ?? assert.fail();
}

/** Opens what was recorded, and stops it at its beginning. @param {string} id @param {Server} server */
async function openStopped(id, { url } = server, options = {}) {
  const page = await open(`${url}/?journal=${id}`, options);
  await shown(page);
  await page.page.click("#player-play");
  await page.until(({ recording }) => recording?.isPlaying === false);
  await page.page.locator("#timeline").press("Home");
  assert.equal((await shown(page)).step, 0);
  return page;
}

/** A point of the window: this part of the timeline. @param {Page} page @param {number} part */
async function onTimeline(page, part) {
  const { x, y, width, height } = (await page.page.locator("#timeline").boundingBox()) ?? assert.fail();
  return /** @type {const} */ ([x + 7 + part * (width - 14), y + height / 3]);
}

/** Looks for a moment at which the tissue is pressed: its part of the timeline. @param {Page} page */
async function pressedPart(page) {
  for (let part = 0.1; part < 1; part += 0.05) {
    await page.page.mouse.move(...(await onTimeline(page, part)));
    // Both sides of it are pressed as well.
    const forces = [];
    for (const by of [0, 0.02, 0.04]) {
      await page.page.mouse.move(...(await onTimeline(page, part + by)));
      forces.push(await page.text("timeline-hover"));
    }
    if (forces.every((text) => / [3-9]\d\d\.?\d? mN| [1-9]\.\d\d N/.test(text))) return part + 0.02;
  }
  return assert.fail("nobody pressed");
}

/** Stops at a moment at which the tissue is pressed: a busy machine may not see it while time goes on. @param {Page} page */
async function stopAtPress(page) {
  await page.page.click("#player-play");
  await page.until(({ recording }) => recording?.isPlaying === false && !recording.isBusy);
  await page.page.mouse.click(...(await onTimeline(page, await pressedPart(page))));
  await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
}

before(async () => {
  server = await Server.start(["--journal", folder()]);
});
after(async () => {
  assert.equal(await server?.stop(), 0, "the server ends well although recordings were open");
});

describe("what was recorded", () => {
  /** @type {string} */
  let id;
  before(async () => {
    id = await record(server);
  });

  test("is in the list with its scene, when and how long, and plays when it is chosen", async () => {
    const page = await open(`${server.url}/?scene=stomach`);
    const entry = page.page.locator("#scene optgroup[label=Recorded] option");
    await entry.first().waitFor({ state: "attached" });
    const texts = await entry.allTextContents();
    assert.equal(texts.length, 1);
    assert.match(texts[0] ?? "", /^paper, .*\d\d:\d\d.*, \d+ s$/);
    await page.page.selectOption("#scene", { label: texts[0] ?? "" });
    const { sessionId, begin, end } = await shown(page);
    assert.equal(sessionId, id);
    assert.ok(begin === 0 && end > 3000, `it has ${end} steps`);
    await page.until(({ recording }) => recording?.isPlaying && recording.step > 300);
    assert.match(page.page.url(), new RegExp(`journal=${id}&run=1&step=0$`));
    await page.says("player-time", /^00:0\d\.\d \/ 00:\d\d\.\d$/);
    await page.says("player-title", /^paper, /);
    await page.says("holder", /^Recorded/);
    assert.deepEqual(await cut(page), []);
    // The recorded press is shown, with its force, again.
    await stopAtPress(page);
    await page.picture("recorded");
    // It can't be touched.
    assert.ok(await page.page.locator("#release").isDisabled());
    const { playback } = await shown(page);
    // Another scene is an ordinary session, and nothing is left of the playback.
    await page.page.selectOption("#scene", "liver");
    await page.says("connection", /Connected to liver/);
    await page.page.locator("#player").waitFor({ state: "hidden" });
    assert.match(page.page.url(), /\?session=[0-9a-f]+$/);
    await gone(server, playback);
    // The browser's back button leads to the recording.
    await page.page.goBack();
    assert.equal((await shown(page)).sessionId, id);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("is stopped, and sought by click, drag and keys, from where the camera is and without a flash", async () => {
    const page = await openStopped(id);
    const keys = page.page.keyboard;
    const timeline = page.page.locator("#timeline");
    const camera = await page.ask(({ camera }) => camera);
    const { end, playback } = await shown(page);
    // A click moves there, and time is paused.
    await page.page.mouse.click(...(await onTimeline(page, 0.5)));
    const half = await shown(page);
    assert.ok(Math.abs(half.step - end / 2) < end / 100, `${half.step} is not half of ${end}`);
    assert.notEqual(half.playback, playback);
    await gone(server, playback);
    await page.page.waitForTimeout(300);
    assert.equal((await shown(page)).step, half.step);
    // Keys.
    await timeline.focus();
    await keys.press("ArrowLeft");
    assert.equal((await shown(page)).step, half.step - 1000);
    await keys.press("ArrowRight");
    await keys.press("ArrowRight");
    assert.equal((await shown(page)).step, half.step + 1000);
    await keys.press("Shift+ArrowRight");
    assert.equal((await shown(page)).step, Math.min(half.step + 11_000, end));
    await keys.press("Home");
    assert.equal((await shown(page)).step, 0);
    assert.equal(await timeline.getAttribute("aria-valuenow"), "0.0");
    // A drag shows each moment that it stops at.
    const pressed = await pressedPart(page);
    await page.page.mouse.move(...(await onTimeline(page, 0)));
    await page.page.mouse.down();
    await page.page.mouse.move(...(await onTimeline(page, pressed)), { steps: 3 });
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await page.picture("scrubbed");
    // While one goes from pressed to pressed, the tissue is never seen at rest.
    await page.page.evaluate(`{
      window.least = Infinity;
      window.looking = setInterval(() => (window.least = Math.min(window.least, window.palpate.largestM)), 1);
    }`);
    for (const by of [0.01, -0.01, 0]) {
      await page.page.mouse.move(...(await onTimeline(page, pressed + by)));
      await page.page.waitForTimeout(100);
    }
    await page.page.mouse.up();
    const at = await shown(page);
    assert.ok(!at.isPlaying && Math.abs(at.step / end - pressed) < 0.01);
    const least = await page.page.evaluate("clearInterval(window.looking), window.least");
    assert.ok(least > 0.02, `it was seen at ${least} m`);
    assert.deepEqual(await page.ask(({ camera }) => camera), camera, "the camera stays");
    // Space plays and stops.
    await keys.press(" ");
    await page.until(({ recording }, step) => recording?.isPlaying && recording.step > step + 100, at.step);
    await keys.press(" ");
    await page.until(({ recording }) => recording?.isPlaying === false && !recording.isBusy);
    const { step } = await shown(page);
    await page.page.waitForTimeout(1500);
    assert.ok(Math.abs((await shown(page)).step - step) < 200, "time stands");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("is played at other speeds, stops at its end, and begins again", async () => {
    const page = await openStopped(id);
    const button = page.page.locator("#player-play");
    for (const speed of ["0.1", "8"]) {
      await page.page.selectOption("#player-speed", speed);
      assert.equal((await shown(page)).speed, Number(speed));
    }
    assert.equal(await button.getAttribute("aria-label"), "Play");
    await button.click();
    await page.until(({ recording }) => recording?.isPlaying === false && recording.step === recording.end);
    assert.equal(await button.getAttribute("aria-label"), "Play");
    // So slow that a busy machine sees it play.
    await page.page.selectOption("#player-speed", "0.1");
    await button.click();
    await page.until(({ recording }) => recording?.isPlaying && !recording.isBusy && recording.step < recording.end);
    assert.equal((await shown(page)).speed, 0.1, "the speed stays");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("goes on from a moment as a live session that can be touched", async () => {
    const page = await openStopped(id);
    await page.page.mouse.click(...(await onTimeline(page, await pressedPart(page))));
    await page.until(({ largestM }) => largestM > 0.02);
    const { step, playback, end } = await shown(page);
    const camera = await page.ask(({ camera }) => camera);
    await page.page.click("#go-on");
    await page.until(({ recording }) => recording === undefined);
    const own = sessionOf(page);
    assert.ok(own !== id && own !== playback);
    assert.deepEqual(await page.ask(({ camera }) => camera), camera, "the camera stays");
    await gone(server, playback);
    // All tools are let go.
    await page.until(({ largestM, frames }, fromS) => largestM < 0.004 && frames.timeS > fromS, step / 1000);
    await page.says("holder", /Nobody touches/);
    await page.press(0.4, 0.5);
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await page.page.mouse.up();
    // It has a journal of its own; that of the first stays as it was.
    await page.page.locator("#what-was-that").waitFor();
    await page.page.goto(`${server.url}/?journal=${id}&step=${step}`);
    const again = await shown(page);
    assert.ok(again.end === end && again.step >= step);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("fits a phone, where a finger seeks", async () => {
    const page = await openStopped(id, server, { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true, colorScheme: "dark" });
    const pressed = await pressedPart(page);
    await page.page.touchscreen.tap(...(await onTimeline(page, pressed)));
    const { step, end } = await shown(page);
    assert.ok(Math.abs(step / end - pressed) < 0.02);
    await page.until(({ largestM }) => largestM > 0.02);
    assert.deepEqual(await cut(page), []);
    const { y, height } = (await page.page.locator("#view").boundingBox()) ?? assert.fail();
    const { y: top } = (await page.page.locator("#player").boundingBox()) ?? assert.fail();
    const [, near] = await page.at(0.5, 0);
    assert.ok(top > y && top < y + height && near < top, "the tissue is seen above the bar");
    await page.picture("recorded-phone");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("plays by a link for those who may not list it", async () => {
    const tokens = join(folder(), "tokens.toml");
    const token = makeToken(tokens, "create,touch");
    const asking = await Server.start(["--tokens", tokens, "--journal", folder()]);
    const page = await open(`${asking.url}/?scene=paper#token=${token}`);
    const own = sessionOf(page);
    await page.page.locator("#what-was-that").waitFor();
    await page.page.locator("#scene").hover();
    await page.page.goto(`${asking.url}/?journal=${own}`);
    assert.equal((await shown(page)).sessionId, own);
    assert.equal(await page.page.locator("#scene optgroup:is([label=Live], [label=Recorded]) option").count(), 0);
    await page.page.goto(`${asking.url}/?journal=${own.replace(/./g, "0")}`);
    await page.says("notice", /There is no such recording/);
    await close(page);
    assert.equal(await asking.stop(), 0);
  });

  test("is played on when the server comes back", async () => {
    const kept = folder();
    const first = await Server.start(["--journal", kept]);
    const page = await openStopped(await record(first), first);
    await page.page.mouse.click(...(await onTimeline(page, await pressedPart(page))));
    const before = await shown(page);
    await page.until(({ largestM }) => largestM > 0.02);
    await first.stop();
    await page.says("light", /^Lost/);
    const second = await Server.start(["--journal", kept], new URL(first.url).host);
    await page.until(({ recording }, playback) => recording && !recording.isBusy && recording.playback !== playback, before.playback);
    assert.equal((await shown(page)).step, before.step);
    await page.says("light", /^(Good|Slow)/);
    await page.until(({ largestM }) => largestM > 0.02);
    await page.page.click("#player-play");
    await page.until(({ recording }, step) => recording && recording.step > step + 300, before.step);
    await close(page);
    assert.equal(await second.stop(), 0);
  });

  test("leaves the list of live sessions when its pages are closed", async () => {
    const [first, other] = [await open(`${server.url}/?scene=paper`), await open(`${server.url}/?scene=stomach`)];
    const live = other.page.locator("#scene optgroup[label=Live] option");
    /** @param {number} count */
    const lists = async (count) => {
      for (let tries = 0; (await live.count()) !== count; tries++) {
        assert.ok(tries < 80, `there are ${await live.count()}, not ${count}`);
        // An old list is fetched again when it is shown.
        await other.page.dispatchEvent("#scene", "pointerenter");
        await other.page.waitForTimeout(250);
      }
    };
    await lists(1);
    await close(first);
    await lists(0);
    assert.deepEqual(other.complaints, []);
    await close(other);
  });

  test("is nowhere told of by a server that keeps no journals", async () => {
    const without = await Server.start();
    const page = await open(`${without.url}/?scene=paper`);
    await page.until(() => document.querySelectorAll("#scene option").length > 3);
    await page.page.waitForTimeout(1500);
    assert.equal(await page.page.locator("#scene optgroup:is([label=Live], [label=Recorded]) option").count(), 0);
    assert.ok(await page.page.locator("#what-was-that").isHidden());
    assert.ok(await page.page.locator("#player").isHidden());
    assert.deepEqual(page.complaints, []);
    await close(page);
    assert.equal(await without.stop(), 0);
  });
});

/** Waits until a session is deleted. @param {Server} server @param {string} id */
async function gone(server, id) {
  for (let tries = 0; (await callSession(server, "GetSession", id)) === undefined; tries++) {
    assert.ok(tries < 1200, "the playback is still there");
    await new Promise((done) => setTimeout(done, 50));
  }
}

describe("a live session that is recorded", () => {
  test("shows what was, follows with a delay, and is there to be touched again", async () => {
    const page = await touch(server);
    const id = sessionOf(page);
    const camera = await page.ask(({ camera }) => camera);
    await page.page.click("#what-was-that");
    const { sessionId, begin, end, step, playback } = await shown(page);
    assert.equal(sessionId, id);
    assert.ok(step >= Math.max(begin, end - 10_000) - 100 && step < end, `${step} of ${end}`);
    assert.deepEqual(await page.ask(({ camera }) => camera), camera, "the camera stays");
    assert.match(page.page.url(), new RegExp(`journal=${id}`));
    // The press is seen again.
    await stopAtPress(page);
    await page.picture("what-was-that");
    await page.page.click("#player-play");
    // Meanwhile another user continues: the recording grows, and playback continues.
    const other = await open(`${server.url}/?session=${id}`);
    await other.press();
    await other.until(({ largestM }) => largestM > 0.02);
    await page.until(({ recording }, end) => recording && recording.end > end + 1000, end);
    await page.page.click("#player-forth");
    await page.until(({ recording }, end) => recording && !recording.isBusy && recording.isPlaying && recording.step > end, end);
    await other.page.mouse.up();
    await close(other);
    // Keys lead back as well.
    await page.page.click("#player-back");
    await shown(page);
    await page.page.click("#back-to-live");
    await page.until(({ recording }) => recording === undefined);
    assert.equal(sessionOf(page), id);
    assert.deepEqual(await page.ask(({ camera }) => camera), camera, "the camera stays");
    await gone(server, playback);
    // The other user's page is closed; if its last request did not arrive, its lease has to lapse.
    await page.says("holder", /Nobody touches/);
    await page.press(0.4, 0.5);
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await page.page.mouse.up();
    assert.deepEqual(page.complaints, []);
    // The browser's back button leads to the earlier state.
    await page.page.goBack();
    assert.equal((await shown(page)).sessionId, id);
    const left = await shown(page);
    // A page that is left deletes its playback. (A browser that is closed may be too quick for that.)
    await page.page.goto("about:blank");
    await gone(server, left.playback);
    await close(page);
  });
});
