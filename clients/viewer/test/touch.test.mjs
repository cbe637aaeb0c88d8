// Touch by datagram and by calls: `make test-viewer`.

import assert from "node:assert/strict";
import { after, before, describe, test } from "node:test";
import { cut, Page, pages, paper, Server } from "./harness.mjs";
import { Lossy } from "./lossy.mjs";

const { open, close, context } = pages({ width: 820, height: 540 });

/** @type {Server} */
let server;
before(async () => {
  server = await Server.start();
});
after(async () => assert.equal(await server?.stop(), 0, "the server ends well although pages were open"));

describe("touch", () => {
  /** Shows figures, chooses the tip, presses, and slides a way. @param {Page} page */
  const glide = async (page) => {
    await page.page.click("#details");
    await page.says("figures", /touch goes by\s*no tool is held/);
    await page.page.check("input[value=tip]");
    await page.press(0.4, 0.5);
    await page.until(({ largestM, forceN }) => largestM > 0.01 && forceN[0] > 0.05);
    const [left, top] = await page.at(0.6, 0.5);
    await page.page.mouse.move(left, top, { steps: 10 });
    await page.until(({ forceN, deepestM }) => forceN[0] > 0.05 && deepestM > 0.005);
  };

  test("goes by datagram where browser and server have them, and the tip is led by poses", async () => {
    const page = await open(paper(server));
    await glide(page);
    await page.says("figures", /touch goes by\s*datagrams/);
    const before = await page.ask(({ datagrams }) => datagrams);
    await page.until(
      ({ datagrams: { carries, sent, came, poses, samples } }, before) =>
        carries && sent > before.sent + 20 && came > before.came + 20 && poses > before.poses + 20 && samples > before.samples + 20,
      before,
    );
    await page.until(({ largestM, forceN }) => largestM > 0.01 && forceN[0] > 0.05);
    await page.says("felt", /deep, pushes back/);
    await page.picture("datagrams");
    await page.rests();
    // A push and a pull go by calls, and what they feel comes by datagram.
    await page.page.check("input[value=push]");
    const { poses, samples } = await page.ask(({ datagrams }) => datagrams);
    await page.press();
    await page.until(({ largestM, forceN, datagrams }, samples) => largestM > 0.02 && forceN[0] > 0.3 && datagrams.samples > samples + 20, samples);
    assert.equal(await page.ask(({ datagrams }) => datagrams.poses), poses);
    await page.rests();
    await page.page.keyboard.press("Escape");
    await page.says("figures", /touch goes by\s*no tool is held/);
    const closed = await page.ask(({ datagrams }) => datagrams);
    assert.equal(closed.carries, false);
    // Another lease has a session of its own.
    await page.page.check("input[value=tip]");
    await page.press(0.5, 0.4);
    await page.until(({ datagrams, forceN }, closed) => datagrams.poses > closed.poses + 20 && forceN[0] > 0.05, closed);
    await page.rests();
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("changes to calls and back without a word as a network swallows datagrams and lets them through", async () => {
    const network = await Lossy.open();
    const behind = await Server.start(["--datagrams-advertise", `127.0.0.1:${network.port}`]);
    network.to = Number(new URL(behind.url).port);
    const page = await open(`http://127.0.0.1:${network.port}/?scene=paper`);
    await glide(page);
    await page.until(({ datagrams }) => datagrams.carries && datagrams.poses > 20);
    network.isCut = true;
    await page.until(({ datagrams }) => !datagrams.carries);
    const { poses } = await page.ask(({ datagrams }) => datagrams);
    await page.page.mouse.move(...(await page.at(0.4, 0.4)), { steps: 3 });
    // It is led, and felt, by calls alone.
    await page.until(({ forceN, largestM }) => largestM > 0.01 && forceN[0] > 0.05);
    assert.equal(await page.ask(({ datagrams }) => datagrams.poses), poses);
    network.isCut = false;
    await page.until(({ datagrams }, poses) => datagrams.carries && datagrams.poses > poses + 20, poses);
    await page.says("figures", /touch goes by\s*datagrams/);
    await page.until(({ forceN, largestM }) => largestM > 0.01 && forceN[0] > 0.05);
    const { fellBack } = await page.ask(({ datagrams }) => datagrams);
    assert.ok(fellBack >= 1);
    assert.equal(await page.page.locator("#notice").isVisible(), false);
    await page.rests();
    // After some seconds the browser gives up the session. It logs to its console if another can't be opened yet.
    assert.deepEqual(page.complaints.filter((text) => !text.includes("Failed to establish a connection")), []);
    await close(page);
    assert.equal(await behind.stop(), 0);
    network.close();
  });

  test("goes by calls where the browser or the server has no datagrams", async () => {
    const without = await Server.start(["--no-datagrams"]);
    const bare = await context();
    await bare.addInitScript("delete window.WebTransport");
    for (const page of [await open(paper(without)), await Page.open(bare, paper(server))]) {
      await glide(page);
      await page.says("figures", /touch goes by\s*gRPC-web/);
      const { sent, came, carries } = await page.ask(({ datagrams }) => datagrams);
      assert.deepEqual({ sent, came, carries }, { sent: 0, came: 0, carries: false });
      await page.rests();
      assert.deepEqual(page.complaints, []);
      await close(page);
    }
    assert.equal(await without.stop(), 0);
  });

  /** Presses with a grasper, closes it, and lifts what it holds. @param {Page} page */
  const lift = async (page) => {
    await page.page.check("input[value=grasper]");
    const [left, top] = await page.press(0.45, 0.5);
    // Both jaws touch.
    await page.until(({ ownForcesN }) => ownForcesN.filter((forceN) => forceN > 1e-3).length >= 2);
    assert.doesNotMatch(await page.text("felt"), /jaws/);
    await page.page.mouse.down({ button: "right" });
    await page.says("touch", /deep.*jaws [−\d.]+ [mµ]?N·m/s);
    await page.page.mouse.move(left + 20, top - 60, { steps: 6 });
    await page.until(({ largestM }) => largestM > 0.005);
  };

  test("leads a grasper by several tools, whose jaws hold what they close on", async () => {
    const page = await open(`${server.url}/?scene=liver`);
    await lift(page);
    await page.says("touch", /lifted/);
    await page.says("holder", /hold the tool/);
    await page.picture("grasper");
    // Open jaws let go, and touch again.
    await page.page.mouse.up({ button: "right" });
    await page.until(({ largestM, ownForcesN }) => largestM < 0.004 && ownForcesN.filter((forceN) => forceN > 1e-3).length >= 2);
    assert.doesNotMatch(await page.text("felt"), /jaws/);
    await page.page.mouse.wheel(0, 200);
    await page.says("felt", /jaws/);
    await page.page.mouse.up();
    await page.until(({ largestM, forceN }) => largestM < 1e-4 && forceN.length === 0);
    // By keys.
    await page.page.focus("#tissue");
    await page.page.keyboard.down(" ");
    await page.until(({ ownForcesN }) => ownForcesN.filter((forceN) => forceN > 1e-3).length >= 2);
    await page.page.keyboard.press("c");
    await page.says("felt", /jaws/);
    await page.page.keyboard.press("c");
    await page.says("jaws-value", /52°/);
    await page.page.keyboard.up(" ");
    // The tip is one of its tools.
    await page.page.check("input[value=tip]");
    await page.press(0.5, 0.5);
    await page.until(({ forceN, ownForcesN }) => forceN[0] > 1e-3 && ownForcesN.length === 1);
    await page.page.mouse.up();
    assert.equal(await page.page.locator("#notice").isVisible(), false);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("leads a grasper by calls, and on a mesh", async () => {
    const bare = await context();
    await bare.addInitScript("delete window.WebTransport");
    const page = await Page.open(bare, `${server.url}/?scene=gallbladder`);
    await lift(page);
    await page.page.mouse.up({ button: "right" });
    await page.page.mouse.up();
    await page.until(({ largestM, forceN }) => largestM < 1e-4 && forceN.length === 0);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("closes the jaws of a grasper by a second finger, which does not turn the view", async () => {
    const page = await open(`${server.url}/?scene=liver&tool=grasper`, { hasTouch: true, viewport: { width: 390, height: 844 } });
    const camera = await page.ask(({ camera }) => camera);
    const fingers = await page.page.context().newCDPSession(page.page);
    const [x, y] = await page.at(0.5, 0.5);
    /** @param {"touchStart" | "touchMove" | "touchEnd"} type @param {[number, number][]} at */
    const touch = (type, ...at) => fingers.send("Input.dispatchTouchEvent", { type, touchPoints: at.map(([x, y], id) => ({ x, y, id })) });
    await touch("touchStart", [x, y]);
    await page.until(({ ownForcesN }) => ownForcesN.filter((forceN) => forceN > 1e-3).length >= 2);
    await touch("touchStart", [x, y], [x + 120, y]);
    for (let k = 1; k <= 5; k++) await touch("touchMove", [x, y], [x + 120 - 18 * k, y]);
    await page.says("touch", /jaws/);
    for (let k = 1; k <= 5; k++) await touch("touchMove", [x, y - 9 * k], [x + 30, y - 9 * k]);
    await page.says("touch", /lifted/);
    assert.deepEqual(await cut(page), []);
    assert.deepEqual(await page.ask(({ camera }) => camera), camera);
    await touch("touchEnd");
    await page.until(({ largestM, forceN }) => largestM < 1e-4 && forceN.length === 0);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });
});
