// Two hands on the page: `make test-viewer`.

import assert from "node:assert/strict";
import { after, before, describe, test } from "node:test";
import { cut, pageProcesses, pages, Server, whileStopped } from "./harness.mjs";

/** @typedef {import("./harness.mjs").Page} Page */

const { chromium, open, close } = pages({ width: 820, height: 540 });

/** Simulated time for which a tool stays: longer than a command without a newer one, a lease, and a tool at rest last. */
const STAY_S = 6;

/** @type {Server} */
let server;
before(async () => {
  server = await Server.start();
});
after(async () => assert.equal(await server?.stop(), 0));

describe("two hands", () => {
  /** @param {Page} page */
  const handsOf = (page) => page.ask(({ hands }) => hands);

  /** Waits until both tools touch, and both are felt. @param {Page} page */
  const feelsBoth = (page) => page.until(({ hands: { both } }) => both.every(({ touches, forceN }) => touches && forceN > 1e-3));

  /** Waits until simulated time has passed. @param {Page} page @param {number} timeS */
  const passes = async (page, timeS) => {
    const begunS = await page.ask(({ sampledS }) => sampledS);
    await page.until(({ sampledS }, endS) => sampledS > endS, begunS + timeS);
  };

  /** The force on the first hand's tool once it no longer changes. @param {Page} page */
  const steadyN = async (page) => {
    for (let before = NaN; ;) {
      const [hand] = (await handsOf(page)).both;
      const forceN = hand?.forceN ?? 0;
      if (Math.abs(forceN - before) < 1e-3 * forceN) return forceN;
      before = forceN;
      await passes(page, 1);
    }
  };

  /** Closes the jaws of the first hand, and lifts what they hold. @param {Page} page */
  const lift = async (page) => {
    const [left, top] = await page.press(0.4, 0.5);
    await page.until(({ hands: { both } }) => (both[0]?.forceN ?? 0) > 1e-3);
    await page.page.mouse.down({ button: "right" });
    await page.until(({ hands: { both } }) => both[0]?.grips);
    await page.page.mouse.move(left, top - 40, { steps: 6 });
    await page.until(({ largestM }) => largestM > 0.004);
  };

  /** The parked tool feels the same after a while. @param {Page} page */
  const staysPut = async (page) => {
    const forceN = await steadyN(page);
    await passes(page, STAY_S);
    const [hand] = (await handsOf(page)).both;
    assert.ok(forceN > 0.05 && Math.abs((hand?.forceN ?? 0) - forceN) < 0.01 * forceN, `${forceN} N, then ${hand?.forceN} N`);
    assert.ok(hand?.isParked && hand.grips);
    return forceN;
  };

  test("a grasper that is parked holds what it lifted, with a constant force, while another tool strokes", async () => {
    const page = await open(`${server.url}/?scene=gallbladder&tool=grasper,stroke`);
    assert.ok(await page.page.locator("#park").isDisabled());
    await lift(page);
    await page.page.keyboard.press("p");
    // Neither what the pointer does now, nor its end, concerns the parked tool.
    const parkedN = steadyN(page);
    await page.page.mouse.move(400, 100);
    await page.page.mouse.up({ button: "right" });
    await page.page.mouse.up();
    await parkedN;
    const forceN = await staysPut(page);
    assert.match(await page.text("hand-0"), /parked/);
    assert.equal((await handsOf(page)).chosen, 1);
    const [left, top] = await page.press(0.25, 0.4);
    await feelsBoth(page);
    await page.page.mouse.move(left + 20, top, { steps: 10 });
    await page.says("felt", /First hand, parked: .* back.*Second hand: .* back/s);
    await page.says("touch", /First hand, parked.*back.*jaws/);
    await page.says("touch-other", /Second hand.*back/);
    await page.says("holder", /hold two tools/);
    await page.picture("two-hands");
    await page.page.mouse.up();
    await page.until(({ hands: { both } }) => both[1]?.touches === false && both[0]?.isParked);
    // The first hand moves on what it holds, from wherever the drag begins.
    await page.page.keyboard.press("1");
    const [x, y] = await page.press(0.3, 0.4);
    await page.page.mouse.move(x, y + 25, { steps: 5 });
    await page.page.mouse.up();
    await page.until(({ hands: { both } }, before) => both[0]?.grips && both[0].forceN < 0.8 * before, forceN);
    await page.page.click("#park");
    await page.until(({ hands: { both }, largestM }) => both.every(({ touches }) => !touches) && largestM < 1e-4);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("keys alone park a grasper and lead the other hand", async () => {
    const page = await open(`${server.url}/?scene=liver&tool=grasper`);
    const keys = page.page.keyboard;
    await page.page.focus("#tissue");
    await keys.down(" ");
    await page.until(({ hands: { both } }) => (both[0]?.forceN ?? 0) > 1e-3);
    await keys.press("c");
    await page.until(({ hands: { both } }) => both[0]?.grips);
    for (let k = 0; k < 3; k++) await keys.press("ArrowUp");
    await keys.press("p");
    await keys.up(" ");
    assert.equal((await handsOf(page)).isTwo, true);
    assert.ok(await page.page.locator("#two-hands").isChecked());
    await page.page.check("input[value=push]", { force: true });
    await page.page.focus("#tissue");
    for (let k = 0; k < 6; k++) await keys.press("ArrowRight");
    await keys.down(" ");
    await feelsBoth(page);
    await keys.up(" ");
    await page.until(({ hands: { both } }) => both[0]?.isParked && !both[1]?.touches);
    // Each hand has a tool and a strength of its own.
    await page.page.fill("#strength", "0.9");
    await keys.press("1");
    await page.page.focus("#tissue");
    await keys.press("1");
    assert.equal(await page.page.inputValue("#strength"), "0.5");
    assert.ok(await page.page.locator("input[value=grasper]").isChecked());
    await keys.press("Escape");
    await page.until(({ hands: { both } }) => both.every(({ touches }) => !touches));
    // One hand: the second lets go.
    await page.page.uncheck("#two-hands", { force: true });
    await page.until(({ holds }) => !holds);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("a parked grasper holds what it lifted again after the browser stood still", async () => {
    const page = await open(`${server.url}/?scene=liver&tool=grasper`);
    await lift(page);
    await page.page.keyboard.press("p");
    await page.page.mouse.up({ button: "right" });
    await page.page.mouse.up();
    const forceN = await steadyN(page);
    // So long that the server has ended the touch.
    await whileStopped(await pageProcesses(chromium()), () => new Promise((done) => setTimeout(done, 3000)));
    await page.until(({ sampledS }, before) => sampledS > before + 2, await page.ask(({ sampledS }) => sampledS));
    await page.until(({ hands: { both } }, before) => both[0]?.isParked && both[0].forceN > 0.8 * before, forceN);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("two fingers lead two tools, and both are felt", async () => {
    const page = await open(`${server.url}/?scene=gallbladder&tool=grasper,stroke`, { hasTouch: true, isMobile: true, viewport: { width: 390, height: 844 } });
    const camera = await page.ask(({ camera }) => camera);
    await page.says("hint", /Each finger/);
    const fingers = await page.page.context().newCDPSession(page.page);
    /** @param {"touchStart" | "touchMove" | "touchEnd"} type @param {(readonly [number, number])[]} at */
    const touch = (type, ...at) => fingers.send("Input.dispatchTouchEvent", { type, touchPoints: at.map(([x, y], id) => ({ x, y, id })) });
    const [first, second] = [await page.at(0.55, 0.5), await page.at(0.35, 0.5)];
    await touch("touchStart", first);
    await page.until(({ hands: { both } }) => (both[0]?.forceN ?? 0) > 1e-3);
    await touch("touchStart", first, second);
    await feelsBoth(page);
    for (let k = 1; k <= 5; k++) await touch("touchMove", first, [second[0] + 3 * k, second[1]]);
    await feelsBoth(page);
    // Further fingers close the jaws by a button on the picture, and leave the grasper there.
    /** @type {[number, number][]} */
    const down = [first, [second[0] + 15, second[1]]];
    const button = async (/** @type {string} */ id) => {
      const { x, y, width, height } = (await page.page.locator(`#${id}`).boundingBox()) ?? assert.fail();
      down.push([x + width / 2, y + height / 2]);
      await touch("touchStart", ...down);
    };
    await button("jaws-here");
    await page.until(({ hands: { both } }) => both[0]?.grips);
    assert.deepEqual(await cut(page), []);
    await page.picture("two-fingers");
    await button("park-here");
    await page.until(({ hands: { both } }) => both[0]?.isParked);
    await touch("touchEnd");
    await page.until(({ hands: { both } }) => both[0]?.isParked && !both[1]?.touches);
    assert.deepEqual(await page.ask(({ camera }) => camera), camera, "the view does not turn");
    await page.page.tap("#release");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });
});
