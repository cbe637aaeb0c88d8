// The page in a real browser at a real server: `make test-viewer`.

import assert from "node:assert/strict";
import { mkdtempSync, readFileSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, describe, test } from "node:test";
import { bluest, cut, extremes, makeToken, Page, pages, paper, ROOT, Server } from "./harness.mjs";

const { open, close, context } = pages({ width: 820, height: 540 });

/** @type {Server} */
let server;
before(async () => {
  server = await Server.start();
});
after(async () => assert.equal(await server?.stop(), 0, "the server ends well although pages were open"));

/** Pixels from one side of the tissue's middle to the other, this part of its width. @param {Page} page @param {number} part */
async function across(page, part) {
  const [from, to] = [await page.at(0.5 - part / 2, 0.5), await page.at(0.5 + part / 2, 0.5)];
  return Math.hypot(to[0] - from[0], to[1] - from[1]);
}

describe("the page", () => {
  test("opens a session of its own, moves under a drag and feels a force", async () => {
    const page = await open(paper(server));
    assert.match(page.page.url(), /\?session=[0-9a-f]+/);
    const rest = await page.picture("rest");
    // Only a user who feels less than the set strength needs an explanation.
    const why = page.page.locator("#why");
    await why.waitFor({ state: "hidden" });
    const [left, top] = await page.press();
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    await page.says("felt", /pushes back/);
    await why.waitFor({ state: "visible" });
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
    await page.says("holder", /Nobody touches/);
    assert.deepEqual(page.complaints, [], "the console stays clean");
    await close(page);
  });

  test("pulls, strokes, and obeys keys alone", async () => {
    const page = await open(paper(server));
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
    const page = await open(paper(server));
    await page.press();
    // Around the place, by the weights of the force.
    await page.until(({ forceN }) => forceN[0] > 0.3);
    await page.until(({ largestM }) => largestM > 0.02);
    // Until it gives way no further: only then does the change make the difference.
    let before = 0;
    for (let now = 0.02; now > 1.01 * before; now = await page.ask(({ largestM }) => largestM)) {
      before = now;
      await new Promise((done) => setTimeout(done, 500));
    }
    const said = await page.text("k-value");
    const answered = page.page.waitForResponse((response) => response.url().endsWith("/UpdateTissue"));
    await page.page.locator("#k").evaluate((/** @type {HTMLInputElement} */ slider) => {
      slider.value = slider.min;
      slider.dispatchEvent(new Event("input", { bubbles: true }));
    });
    // A page that loads anew drops a call that is under way.
    await (await answered).finished();
    await page.until(({ largestM }, before) => largestM > 1.3 * before, before);
    await page.page.mouse.up();
    // The session's value, not only the slider's.
    await page.page.reload();
    await page.shows();
    await page.says("k-value", /^1\.00 N\/m/);
    assert.notEqual(await page.text("k-value"), said);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("draws the mass points as a wireframe, and other refinements", async () => {
    const page = await open(paper(server));
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
    const page = await open(`${paper(server)}&refinement=5`);
    await page.page.click("#details");
    await page.says("figures", /1 vertex in 2 a side.*no graphics processor/);
    const rest = await page.picture("coarse-rest");
    await page.press();
    await page.until(({ largestM }) => largestM > 0.02);
    assert.notDeepEqual(rest, await page.picture("coarse-pressed"));
    await page.page.goto(`${page.page.url()}&refinement=5&quality=high`);
    await page.shows();
    await page.page.click("#details");
    await page.says("figures", /picture\s*no graphics processor/);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("plays a shipped script", async () => {
    const page = await open(`${server.url}/?scene=liver`);
    await page.until(() => document.querySelectorAll("#script option").length > 0);
    // Only those that are made for liver.
    const names = await page.page.locator("#script option").allTextContents();
    assert.deepEqual(names, ["cut", "grasp", "press", "push", "stroke", "suture"]);
    await page.page.selectOption("#script", "press");
    await page.page.click("#play");
    // By the plot: a picture may come too late for what lasts a second.
    await page.until(({ deepestM }) => deepestM > 0.003);
    await page.says("play", /^Play$/);
    await page.until(({ largestM, forceN }) => largestM < 0.001 && forceN.length === 0);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("says that the tissue recovered, how often and why", async () => {
    const folder = mkdtempSync(join(tmpdir(), "palpate-"));
    const config = join(mkdtempSync(join(tmpdir(), "palpate-")), "config.toml");
    // The error of a scene whose every push fails appears at once.
    writeFileSync(config, "[limits]\nrehearsal_work = 1\n");
    const paper = readFileSync(join(ROOT, "scenes/paper.toml"), "utf8");
    const stiff = paper.replace("stiffness_n_per_m = 10.0", "stiffness_n_per_m = 1e9");
    writeFileSync(join(folder, "stiff.toml"), `${stiff}\n[stepping]\nsubsteps = 1\n`);
    const failing = await Server.start(["--config", config, "--scenes", folder]);
    const page = await open(`${failing.url}/?scene=stiff`);
    await page.page.selectOption("#script", "vertical-60");
    await page.page.click("#play");
    await page.says("connection", /Connected to .*The tissue recovered (once|\d+ times), .* because after step \d+ /);
    await close(page);
    assert.equal(await failing.stop(), 0);
  });

  test("shows the server a token from behind the address, and keeps it out of that", async () => {
    const tokens = join(mkdtempSync(join(tmpdir(), "palpate-")), "tokens.toml");
    const [token, watching] = [makeToken(tokens, "create,touch"), makeToken(tokens, "watch")];
    const asking = await Server.start(["--tokens", tokens]);
    const page = new Page(await (await context()).newPage());
    await page.page.goto(paper(asking));
    // One clear sentence, a field, and nothing that can't help.
    await page.says("token-form", /This server asks for a token\..*can give you one/s);
    for (const useless of ["aside", "#arriving", "#notice", "#scene", "#open-file", "#share", "#hint", "#corner"]) {
      assert.ok(await page.page.locator(useless).isHidden(), useless);
    }
    assert.doesNotMatch(await page.page.evaluate("document.body.innerText"), /fetching|lost|Bearer|authorization/i);
    assert.deepEqual(await cut(page), []);
    await page.page.fill("#token-form-token", `${token}x`);
    await page.page.keyboard.press("Enter");
    await page.says("token-form", /does not know your token/);
    await page.page.fill("#token-form-token", token);
    await page.page.keyboard.press("Enter");
    await page.shows();
    assert.ok(await page.page.locator("#token-form").isHidden());
    assert.ok(await page.page.locator("#scene option[value=paper]").count());
    // Behind the address it goes as well.
    await page.page.evaluate("sessionStorage.clear()");
    await page.page.goto("about:blank");
    await page.page.goto(`${paper(asking)}#token=${token}`);
    await page.shows();
    assert.match(page.page.url(), /\?session=[0-9a-f]+$/);
    await page.page.reload();
    await page.shows();
    await page.press();
    await page.until(({ largestM, forceN }) => largestM > 0.02 && forceN[0] > 0.3);
    assert.deepEqual(page.complaints, []);
    await close(page);
    // A user who may only watch is told so, and how to continue.
    const watcher = new Page(await (await context()).newPage());
    await watcher.page.goto(`${asking.url}/#token=${watching}`);
    await watcher.says("token-form", /does not let you open a tissue/);
    await close(watcher);
    assert.equal(await asking.stop(), 0);
  });

  test("fits a phone, light and dark, and tells the force while a finger touches", async () => {
    const [width, height] = [390, 844];
    for (const colorScheme of /** @type {const} */ (["light", "dark"])) {
      const page = await open(server.url, { viewport: { width, height }, colorScheme, hasTouch: true, isMobile: true });
      await page.says("connection", /Connected/);
      await page.says("hint", /One finger touches/);
      const [left, top] = await page.at(0.5, 0.5);
      assert.ok(left > 0 && left < width && top > 0 && top < height, "the tissue is in sight");
      assert.deepEqual(await cut(page), [], "nothing is cut");
      await page.press();
      await page.says("touch", /deep\s*.*N back/);
      const { x, y, width: wide, height: high } = (await page.page.locator("#touch").boundingBox()) ?? assert.fail();
      assert.ok(x >= 0 && y >= 0 && x + wide <= width && y + high <= height, "the force is in sight");
      assert.deepEqual(await cut(page), [], "nor while somebody touches");
      await page.picture(`phone-${colorScheme}`);
      await page.page.mouse.up();
      await page.page.click("#details");
      assert.deepEqual(await cut(page), [], "nor are the figures");
      assert.deepEqual(page.complaints, []);
      await close(page);
    }
  });

  test("begins with an organ, without one word of what the server's makers call things", async () => {
    const page = await open(server.url, { viewport: { width: 1280, height: 800 } });
    await page.says("connection", /Connected to liver-organ/);
    assert.equal(await page.page.inputValue("#scene"), "liver-organ");
    // The list is grouped, and each scene has a title and a picture.
    const groups = await page.page.locator("#scene optgroup:not([hidden])").evaluateAll((all) => all.map((group) => group.getAttribute("label")));
    assert.deepEqual(groups.slice(0, 3), ["Organs", "Slabs of tissue", "From the paper"]);
    const scenes = page.page.locator("#scene optgroup:is([label=Organs], [label^=Slabs], [label^=From]) option");
    assert.equal(await scenes.count(), 12);
    assert.equal(await scenes.locator("img").count(), 12);
    assert.equal((await scenes.first().textContent())?.trim(), "Liver with two lumps");
    assert.deepEqual(await cut(page), []);
    const [panel, room] = await page.page.evaluate(
      "[document.querySelector('aside').scrollHeight, document.querySelector('aside').clientHeight]",
    );
    assert.ok(panel <= room, `scripts and looks are in sight without scrolling: ${panel} px in ${room}`);
    const words = await page.page.evaluate("document.body.innerText");
    assert.doesNotMatch(words, /\b(reset|magnitude|z|free to take)\b/i);
    await close(page);
  });

  test("shows where the pointer is, goes back to the whole tissue, and shows lumps to an instructor", async () => {
    const page = await open(server.url);
    const ring = page.page.locator("#pointer-ring");
    const place = await page.at(0.5, 0.5);
    await page.page.mouse.move(...place);
    await page.page.waitForFunction("document.getElementById('pointer-ring').hasAttribute('d')");
    const box = (await ring.boundingBox()) ?? assert.fail();
    assert.ok(Math.abs(box.x + box.width / 2 - place[0]) < 4 && Math.abs(box.y + box.height / 2 - place[1]) < 4, JSON.stringify([box, place]));
    assert.ok(await page.page.locator("#full-screen").isVisible());
    // Another view, and back.
    const home = await page.ask(({ camera }) => camera);
    assert.ok(await page.page.locator("#reset-view").isHidden());
    await page.page.mouse.wheel(0, -600);
    await page.until(({ camera }, home) => camera.some((v, k) => Math.abs(v - (home[k] ?? 0)) > 1e-3), home);
    await page.page.click("#reset-view");
    await page.until(({ camera }, home) => camera.every((v, k) => Math.abs(v - (home[k] ?? 0)) < 1e-6), home);
    // Lumps are seen on demand only.
    const picture = async () => await page.page.locator("#tissue").screenshot();
    await page.page.mouse.move(5, 300);
    const without = await bluest(page, await picture());
    await page.page.check("#lumps");
    await page.page.waitForTimeout(300);
    assert.ok((await bluest(page, await picture())) > without + 0.2);
    // A tip is controlled by depth.
    assert.equal(await page.text("strength-name"), "Strength");
    await page.page.check("input[value=tip]", { force: true });
    assert.equal(await page.text("strength-name"), "Depth");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("draws slabs and folds without white dots and black seams", async () => {
    const page = await open(`${server.url}/?scene=liver`, { viewport: { width: 1280, height: 800 } });
    await page.until(({ drawing }) => drawing.hasTexture);
    await page.page.waitForTimeout(700);
    // The corner in front, where the lamp was a dot.
    const corner = await extremes(page, await page.page.screenshot({ clip: { x: 20, y: 480, width: 300, height: 200 } }));
    assert.ok(corner.whitest < 0.85, `a pixel of ${corner.whitest}`);
    await page.page.goto(`${server.url}/?scene=colon`);
    await page.until(({ drawing }) => drawing.hasTexture);
    await page.page.waitForTimeout(900);
    // The tube from outside, which the lamp shines on.
    const outside = await extremes(page, await page.page.screenshot({ clip: { x: 200, y: 120, width: 150, height: 160 } }));
    assert.ok(outside.blackest > 0.25, `a pixel of ${outside.blackest}`);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("has a right scale bar, also after a turn of the wheel", async () => {
    const page = await open(`${server.url}/?scene=liver`);
    for (const turns of [0, -400]) {
      if (turns !== 0) {
        const before = await across(page, 0.2);
        const [left, top] = await page.at(0.5, 0.5);
        await page.page.mouse.move(left, top);
        await page.page.mouse.wheel(0, turns);
        await page.until(({ at }, before) => Math.abs(at(0.6, 0.5)[0] - at(0.4, 0.5)[0]) > 1.05 * before, before);
      }
      await page.page.waitForTimeout(500);
      const said = /^([\d.]+) mm/.exec((await page.text("scale-text")).trim())?.[1];
      const bar = await page.page.locator("#scale-bar").boundingBox();
      const pixels = await across(page, Number(said) / 1000 / (await page.ask(({ widthM }) => widthM)));
      assert.ok(Math.abs((bar?.width ?? 0) / pixels - 1) < 0.05, `${said} mm are ${pixels} pixels, not ${bar?.width}`);
    }
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("never draws the tool in the tissue, nor looks from below", async () => {
    const page = await open(`${server.url}/?scene=liver`);
    /** @param {string} when */
    const isClear = async (when) => {
      const clear = await page.ask((inside) => inside.clear);
      if (clear !== undefined) assert.ok(clear > -0.003, `${when}: ${clear}`);
    };
    await page.page.fill("#strength", "1");
    const [left, top] = await page.press();
    await page.until(({ forceN }) => forceN[0] > 0.1);
    for (let k = 0; k < 8; k++) {
      await page.page.mouse.move(left + 90 * Math.cos(k), top + 60 * Math.sin(k), { steps: 3 });
      await isClear(`leaning ${k}`);
    }
    await page.page.mouse.up();
    await page.page.check("input[value=pull]", { force: true });
    await page.page.mouse.move(left, top);
    await page.page.mouse.down();
    await page.page.mouse.move(left, top - 60, { steps: 6 });
    await page.until(({ largestM }) => largestM > 0.004);
    await isClear("pulling");
    await page.page.focus("#tissue");
    for (let k = 0; k < 30; k++) await page.page.keyboard.press("Shift+ArrowDown");
    for (let k = 0; k < 20; k++) await page.page.keyboard.press("+");
    await page.page.waitForTimeout(300);
    const height = await page.ask(({ cameraHeight }) => cameraHeight);
    assert.ok(height > 0.02, `the camera is ${height} of the width above the tissue`);
    await page.picture("low");
    await page.page.mouse.up();
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("draws the tissue in light and shade before its texture comes", async () => {
    const page = new Page(await (await context()).newPage());
    /** @type {() => void} */
    let answer = () => {};
    const held = new Promise((done) => (answer = () => done(undefined)));
    await page.page.route("**/textures/**", async (route) => {
      await held;
      await route.continue();
    });
    await page.page.goto(paper(server));
    await page.shows();
    await page.until(({ drawing }) => drawing.isDrawn && !drawing.hasTexture);
    const rest = await page.picture("untextured");
    await page.press();
    await page.until(({ largestM }) => largestM > 0.02);
    assert.notDeepEqual(rest, await page.picture("untextured-pressed"));
    answer();
    await page.until(({ drawing }) => drawing.hasTexture);
    await page.page.mouse.up();
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("shows one light: good, and slow when answers take long", async () => {
    const page = await open(`${server.url}/?scene=liver`);
    await page.says("light", /^Good$/);
    assert.equal(await page.page.locator("#figures").isVisible(), false, "figures come on demand");
    // A tissue at rest has no picture that gets older.
    await page.page.click("#details");
    await page.says("figures", /frame age\s*still/);
    const wire = await page.page.context().newCDPSession(page.page);
    const slower = { offline: false, latency: 600, downloadThroughput: -1, uploadThroughput: -1 };
    await wire.send("Network.enable");
    await wire.send("Network.emulateNetworkConditions", slower);
    await page.says("light", /^Slow: answers take/);
    await wire.send("Network.emulateNetworkConditions", { ...slower, latency: 0 });
    await page.says("light", /^Good$/);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });
});
