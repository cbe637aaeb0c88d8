// A blade on the page, and what it cuts: `make test-viewer`.

import assert from "node:assert/strict";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, describe, test } from "node:test";
import { colourAt, pages, scenesToCut, Server, sweep } from "./harness.mjs";
import { Hostile, SESSION } from "./hostile.mjs";

/** @typedef {import("./harness.mjs").Page} Page */

const { open, close } = pages({ width: 820, height: 560 });

/** @type {Server} */
let server;
const journals = mkdtempSync(join(tmpdir(), "palpate-wound-"));
const scenes = scenesToCut();
before(async () => {
  server = await Server.start(["--journal", journals, "--scenes", scenes]);
});
after(async () => {
  assert.equal(await server?.stop(), 0, "the server ends well although pages were open");
  for (const folder of [journals, scenes]) rmSync(folder, { recursive: true });
});

/** Waits until the blade stands in the tissue: it feels nothing of one without toughness. @param {Page} page */
async function sinks(page) {
  await page.until(({ hands, holds }) => holds && hands.both[0]?.touches === true);
  const { sampledS } = await page.ask(({ sampledS }) => ({ sampledS }));
  await page.until(({ sampledS }, before) => sampledS > before + 1, sampledS);
}

/** Cuts from one place to another, more than so many springs. @param {Page} page @param {[number, number]} from @param {[number, number]} to */
async function cut(page, from, to, severed = 10) {
  await page.press(...from);
  await sinks(page);
  await sweep(page, from, to, severed);
  await page.page.mouse.up();
}

/** Sum of the light of a few pixels around a place of the sheet. @param {Page} page @param {number} x @param {number} y */
async function darkest(page, x, y) {
  const [left, top] = await page.at(x, y);
  const lights = [];
  for (let dx = -3; dx <= 3; dx++) {
    const { red, green, blue } = await colourAt(page.page, left + dx, top);
    lights.push(red + green + blue);
  }
  return Math.min(...lights);
}

describe("a blade", () => {
  test("cuts a sheet where it is dragged, and a late page shows the same wound", async () => {
    const page = await open(`${server.url}/?scene=liver&tool=blade`);
    assert.ok(await page.page.isChecked("input[value=blade]"));
    assert.equal(await page.text("strength-name"), "Depth");
    await page.page.click("#details");
    await page.until(({ drawing }) => drawing.hasTexture);
    const whole = await darkest(page, 0.5, 0.5);
    await cut(page, [0.485, 0.3], [0.485, 0.75], 30);
    await page.until(({ wound }) => wound.severed > 30 && wound.waiting === 0 && wound.shown > 8);
    await page.says("figures", /cut\s*\d+ springs, by you/);
    // Both lips of each spring; a cut that ends in the sheet leaves one piece.
    const { vertices, pieces, version } = await page.ask(({ wound }) => wound);
    assert.ok(pieces === 1 && version > 0 && vertices >= 20 && vertices % 2 === 0, `${pieces} ${version} ${vertices}`);
    await page.page.keyboard.press("Escape");
    await page.page.mouse.move(5, 300);
    await page.until(({ holds }) => !holds);
    await page.picture("wound-of-sheet");
    let dark = Infinity;
    for (const x of [0.47, 0.48, 0.485, 0.49, 0.5]) dark = Math.min(dark, await darkest(page, x, 0.5));
    assert.ok(dark < 0.6 * whole, `the lips are as bright as the tissue: ${dark}, ${whole} before`);
    const late = await open(page.page.url());
    const known = await page.ask(({ wound }) => wound);
    await late.until(({ wound }, known) => wound.vertices === known.vertices && wound.shown === known.shown && wound.waiting === 0, known);
    await close(late);
    // Without refinement it has the same lips.
    const [fineness, { shown }] = [page.page.locator("#refinement"), known];
    await fineness.fill("0");
    await page.until(({ wound }, known) => wound.vertices === known.vertices && wound.shown > 0, { ...known, shown });
    await page.page.check("#wireframe");
    await page.picture("wound-of-sheet-as-net");
    await page.page.uncheck("#wireframe");
    // What was cut is whole again in a session that goes on from before.
    await page.page.locator("#undo-cut:enabled").waitFor();
    const former = page.page.url();
    await page.page.click("#undo-cut");
    await page.until(({ wound }) => wound.severed === 0 && wound.shown === 0 && wound.vertices === 0);
    assert.notEqual(page.page.url(), former);
    await page.page.locator("#undo-cut").waitFor({ state: "hidden" });
    await page.picture("wound-undone");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("that has cut a lot burdens no picture with all of it", async () => {
    const sheet = { pointsX: 41, pointsY: 41, spacingM: 0.01, pointMassKg: 1e-3 };
    const session = { ...SESSION, topologyVersion: 1, severed: 3000, scene: { ...SESSION.scene, sheet } };
    const vertices = 161 * 161;
    // 2500 triangles of the refined sheet, each in two parts, with a lip each.
    const cut = Array.from({ length: 2500 }, (_, k) => ({ first: k, count: 1, corners: [k, vertices + k, k + 1, k + 1, vertices + k, k + 161] }));
    const lips = cut.map((_, k) => ({ host: k, second: k + 1, secondPart: 0.5 }));
    const fake = await Hostile.start({
      CreateSession: async ({ say }) => void (await say({ session })),
      GetSession: async ({ say }) => void (await say({ session })),
      GetWound: async ({ say }) => void (await say({ version: 1, continues: true, firstVertex: vertices, vertices: lips, triangles: cut, severed: 3000, pieces: 1, last: true })),
    });
    const page = await open(fake.url);
    await page.until(({ wound }) => wound.shown === 2500 && wound.waiting === 0);
    const { mostAtOnce } = await page.ask(({ wound }) => wound);
    assert.equal(mostAtOnce, 512);
    await close(page);
    await fake.stop();
  });

  test("is led by keys", async () => {
    const page = await open(`${server.url}/?scene=liver&tool=blade&refinement=1`);
    await page.page.focus("#tissue");
    await page.page.keyboard.down(" ");
    await sinks(page);
    for (let k = 0; k < 6; k++) {
      await page.page.keyboard.press("ArrowUp");
      await new Promise((done) => setTimeout(done, 150));
    }
    await page.page.keyboard.up(" ");
    await page.until(({ wound }) => wound.severed > 10 && wound.shown > 3 && wound.waiting === 0);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("opens a solid, which is seen into", async () => {
    const page = await open(`${server.url}/?scene=liver-solid&tool=blade`);
    await cut(page, [0.42, 0.5], [0.6, 0.5]);
    await page.until(({ wound }) => wound.severed > 10 && wound.cutFaces > 10 && wound.waiting === 0);
    const { cutFaces, severed } = await page.ask(({ wound }) => wound);
    assert.ok(cutFaces <= 2 * severed, `${cutFaces} faces of ${severed}`);
    await page.page.keyboard.press("Escape");
    // Pressed beside the cut, one side goes down, and the other shows its face.
    await page.page.check("input[value=tip]", { force: true });
    await page.press(0.5, 0.44);
    await page.until(({ deepestM }) => deepestM > 0.003);
    await page.picture("cut-of-solid");
    await page.page.mouse.up();
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("cuts the surface of an organ", async () => {
    const page = await open(`${server.url}/?scene=gallbladder&tool=blade`);
    await cut(page, [0.42, 0.5], [0.6, 0.5]);
    await page.until(({ wound }) => wound.severed > 10 && wound.shown > 10 && wound.waiting === 0);
    await page.page.keyboard.press("Escape");
    await page.picture("wound-of-organ");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });
});
