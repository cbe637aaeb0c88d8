// Tissues of any shape, also from files of the user: `make test-viewer`.

import assert from "node:assert/strict";
import { mkdtempSync, readFileSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, describe, test } from "node:test";
import { colourAt, cut, makeOrgan, pageProcesses, pages, Server, whileStopped } from "./harness.mjs";

/** @typedef {import("./harness.mjs").Page} Page */

const { chromium, open, close } = pages({ width: 820, height: 540 });

/** A scene on a mesh. @param {string} name */
const onMesh = (name) => `name = "${name}"
[mesh]
file = "${name}.obj"
unit = "m"
point_mass_kg = 5e-4
[springs]
stiffness_n_per_m = 20.0
[anchor_springs]
stiffness_n_per_m = 20.0
[damping]
coefficient_n_s_per_m = 0.1
[stepping]
tolerance = 1e-2
`;

describe("a body of any shape", () => {
  /** @type {string} */
  let folder;
  /** @type {Server} */
  let organs;
  before(async () => {
    folder = mkdtempSync(join(tmpdir(), "palpate-"));
    for (const [organ, edgeMm] of /** @type {const} */ ([["kidney", "4"], ["colon", "6"], ["patch", "8"]])) {
      makeOrgan(organ, edgeMm, join(folder, `${organ}.obj`));
      writeFileSync(join(folder, `${organ}.toml`), onMesh(organ));
    }
    organs = await Server.start(["--scenes", folder, "--journal", mkdtempSync(join(tmpdir(), "palpate-"))]);
  });
  after(async () => assert.equal(await organs?.stop(), 0));

  /** Drops a file on the page. @param {Page} page @param {string} name @param {string} content */
  const dropFile = async (page, name, content) => {
    const make = (/** @type {string[]} */ [name = "", content = ""]) => {
      const data = new DataTransfer();
      data.items.add(new File([content], name));
      return data;
    };
    const dataTransfer = await page.page.evaluateHandle(make, [name, content]);
    await page.page.dispatchEvent("#view", "drop", { dataTransfer });
  };

  /** @param {Page} page */
  const felt = (page) => page.until(({ largestM, forceN }) => largestM > 1e-3 && forceN[0] > 1e-3);

  test("is seen in full, turned by a drag beside it, and pressed on every side", async () => {
    const page = await open(`${organs.url}/?scene=kidney`, { viewport: { width: 1280, height: 800 } });
    const box = (await page.page.locator("#tissue").boundingBox()) ?? assert.fail();
    await page.until(({ drawing }) => drawing.hasTexture);
    for (const side of [1, 2]) {
      const [x, y] = await page.at(0.5, 0.5);
      const { red, green, blue } = await colourAt(page.page, x, y);
      assert.ok(red > 1.4 * green && red > 1.4 * blue, `side ${side} is tissue: ${red}, ${green}, ${blue}`);
      const corners = side > 1 ? [] : [[4, 4], [box.width - 4, 4], [box.width / 2, 8], [4, box.height / 2], [box.width - 4, box.height / 2]];
      for (const [left = 0, top = 0] of corners) {
        const beside = await colourAt(page.page, box.x + left, box.y + top);
        assert.ok(beside.red < 1.2 * beside.blue, "nothing is cut off");
      }
      await page.press();
      await felt(page);
      await page.says("felt", /deep, pushes back/);
      await page.until(({ deepestM }) => deepestM > 1e-3);
      await page.picture(`kidney-${side}`);
      await page.page.mouse.up();
      await page.until(({ forceN }) => forceN.length === 0);
      const height = await page.ask(({ cameraHeight }) => cameraHeight);
      await page.page.mouse.move(box.x + 20, box.y + 20);
      await page.page.mouse.down();
      // Beneath it.
      await page.page.mouse.move(box.x + 20, box.y + 20 - 0.45 * box.height, { steps: 5 });
      await page.page.mouse.up();
      if (side === 1) await page.until(({ cameraHeight }, before) => cameraHeight < before - 0.2, height);
    }
    assert.equal(await page.ask(({ holds }) => holds), true, "turning does not let go");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("is entered where it is open, touched from within, pulled and stroked", async () => {
    const page = await open(`${organs.url}/?scene=colon`, { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true });
    assert.deepEqual(await cut(page), []);
    await page.page.focus("#tissue");
    for (let k = 0; k < 22; k++) await page.page.keyboard.press("+");
    await page.page.waitForTimeout(300);
    const { red, blue } = await colourAt(page.page, ...(await page.at(0.5, 0.5)));
    assert.ok(red > 1.25 * blue && red > 60, `it is lit within: ${red}, ${blue}`);
    await page.press();
    await felt(page);
    await page.says("touch", /deep\s*.*N back/);
    await page.picture("colon-within");
    await page.page.mouse.up();
    await page.until(({ forceN }) => forceN.length === 0);
    for (const tool of ["pull", "stroke", "tip"]) {
      await page.page.check(`input[value=${tool}]`, { force: true });
      const [left, top] = await page.press();
      await page.page.mouse.move(left + 25, top + 25, { steps: 5 });
      await felt(page);
      await page.page.mouse.up();
      await page.until(({ forceN }) => forceN.length === 0);
    }
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("is touched on the same side of its lining after the browser stood still", async () => {
    const others = await pageProcesses(chromium());
    const page = await open(`${organs.url}/?scene=colon`);
    const stopped = (await pageProcesses(chromium())).filter((id) => !others.includes(id));
    await page.page.focus("#tissue");
    for (let k = 0; k < 22; k++) await page.page.keyboard.press("+");
    await page.page.waitForTimeout(300);
    await page.page.check("input[value=tip]", { force: true });
    await page.press();
    await felt(page);
    for (const stopMs of [200, 400, 800, 2500]) {
      await whileStopped(stopped, () => new Promise((done) => setTimeout(done, stopMs)));
      // What it shows first is from before.
      await page.page.waitForTimeout(600);
      await felt(page);
    }
    await page.page.mouse.up();
    await page.until(({ forceN }) => forceN.length === 0);
    await close(page);
  });

  test("comes from a file that is dropped: asks for its unit, mends it, tells what can't be read, and is touched", async () => {
    const page = await open(`${organs.url}/?scene=patch`);
    const lines = readFileSync(join(folder, "patch.obj"), "utf8").split("\n");
    const vertices = lines.filter((line) => line.startsWith("v "));
    // In millimetres.
    const scaled = vertices.map((line) => line.replace(/[-\d.e]+/g, (number) => (number === "v" ? number : String(1000 * Number(number)))));
    const faces = lines.filter((line) => line.startsWith("f ")).map((line) => line.replace(/\/\d*/g, ""));
    const third = `f 1 ${faces[0]?.split(" ")[2]} ${vertices.length + 1}`;
    const [text, flawed] = [[...scaled, ...faces], [...scaled, "v 0 0 200", ...faces, faces[0]?.replace(/\d+$/, String(vertices.length + 1)), third]];
    /** @param {string} name @param {string} content */
    const drop = (name, content) => dropFile(page, name, content);
    await drop("own.obj", text.join("\n"));
    // A piece of 100 mm is likelier than one of 100 m.
    await page.says("own-units", /100 × 1?[0-9.]+ × .* mm in millimetres/);
    assert.equal(await page.page.locator("#own-units input:checked").inputValue(), "mm");
    await page.says("own-problems", /journals of sessions on this mesh contain it, and stay 30 days/);
    await page.page.click("#own-buttons button.main");
    // A mesh without a flaw waits for no further answer.
    await page.says("connection", /Connected to own/);
    await page.page.locator("#own").waitFor({ state: "hidden" });
    const size = await page.ask(({ widthM }) => widthM);
    assert.ok(size > 0.1 && size < 0.2, `its size is ${size} m`);
    await page.press();
    // A newton and some dent it by millimetres.
    await page.until(({ deepestM, forceN }) => deepestM > 2e-3 && deepestM < 0.03 && forceN[0] > 1e-3);
    await page.picture("own");
    await page.page.mouse.up();

    // A lump of your own: shown to its creator, and stiff.
    assert.ok(await page.page.locator("#lumps-shown").isHidden());
    await page.page.click("#put-lump");
    const place = await page.at(0.5, 0.5);
    await page.page.mouse.click(...place);
    await page.says("notice", /The lump is in/);
    assert.ok(await page.page.locator("#lumps").isChecked());
    const shown = await colourAt(page.page, ...place);
    await page.page.uncheck("#lumps");
    await page.page.mouse.move(5, 300);
    await page.page.waitForTimeout(300);
    const hidden = await colourAt(page.page, ...place);
    assert.ok(shown.blue / shown.red > 1.3 * (hidden.blue / hidden.red), JSON.stringify([shown, hidden]));
    await page.page.click("#take-lumps");
    await page.page.locator("#lumps-shown").waitFor({ state: "hidden" });

    await drop("flawed.obj", flawed.join("\n"));
    await page.page.click("#own-buttons button.main");
    await page.says("own-problems", /triangles share this edge/);
    await page.picture("flawed");
    await page.page.click("#own-buttons button:text('Mend it')");
    await page.page.click("#own-buttons button:text('Touch its surface')");
    await page.says("connection", /Connected to flawed/);

    await drop("junk.obj", "v 0 0\n");
    await page.says("own-said", /does not work: .*junk\.obj: line 1/);
    await page.page.click("#own-buttons button");
    await page.press();
    await felt(page);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("comes as a solid from a file whose triangles form no surface: some are doubled or turned, and one is on an edge of two others", async () => {
    const page = await open(`${organs.url}/?scene=patch`);
    const lines = readFileSync(join(folder, "kidney.obj"), "utf8").split("\n");
    const vertices = lines.filter((line) => line.startsWith("v "));
    const faces = lines.filter((line) => line.startsWith("f ")).map((line) => line.replace(/\/\d*/g, ""));
    const corners = (/** @type {number} */ k) => faces[k]?.split(" ").slice(1) ?? [];
    const flawed = faces.flatMap((face, k) => {
      const [a = "", b = "", c = ""] = corners(k);
      return k % 50 === 0 ? [`f ${a} ${c} ${b}`] : k % 50 === 25 ? [face, face] : [face];
    });
    // A third triangle on an edge.
    const [a = "", b = "", c = ""] = corners(25);
    const beside = [...corners(26), ...corners(27), ...corners(28)].find((vertex) => ![a, b, c].includes(vertex));
    flawed.push(`f ${a} ${b} ${beside}`);
    await dropFile(page, "bad.obj", [...vertices, ...flawed].join("\n"));
    await page.page.check("#own-units input[value=m]");
    await page.page.click("#own-buttons button.main");
    await page.says("own-said", /It can be a solid/);
    assert.equal(await page.page.locator("#own-buttons button:text('Touch its surface')").count(), 0);
    await page.picture("bad");
    await page.page.click("#own-buttons button:text('Touch it as a solid')");
    await page.says("connection", /Connected to bad/);
    await page.page.locator("#own").waitFor({ state: "hidden" });
    await page.press();
    await felt(page);
    await page.picture("bad-solid");
    await page.page.mouse.up();
    await page.until(({ forceN }) => forceN.length === 0);
    // A solid is touched with a rigid tip.
    await page.page.check("input[value=tip]", { force: true });
    assert.match((await page.page.locator("#meaning").textContent()) ?? "", /a rigid disc of/);
    await page.press();
    await felt(page);
    await page.says("touch", /deep\s*.*N back/);
    await page.page.mouse.up();
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("comes as a solid from a label of a scan, which the page asks for", async () => {
    const page = await open(`${organs.url}/?scene=patch`);
    const header = 'NRRD0004\ntype: uchar\ndimension: 3\nsizes: 24 20 20\nencoding: raw\nspace: left-posterior-superior\nspace directions: (5,0,0) (0,5,0) (0,0,5)\nspace units: "mm" "mm" "mm"\n\n';
    const isInside = (/** @type {number} */ at, /** @type {number} */ side) => at >= 3 && at < side - 3;
    const label = (/** @type {number} */ n) => {
      const [x, y, z] = [n % 24, Math.floor(n / 24) % 20, Math.floor(n / 480)];
      return isInside(y, 20) && isInside(z, 20) && isInside(x, 24) ? (x < 12 ? 3 : 7) : 0;
    };
    const voxels = Array.from({ length: 9600 }, (_, n) => String.fromCharCode(label(n)));
    await dropFile(page, "scan.nrrd", header + voxels.join(""));
    await page.says("own-said", /scan\.nrrd: the file is a label map: choose one of its labels 3, 7\.$/);
    assert.equal(await page.page.locator("#own-units input").inputValue(), "3");
    await page.page.fill("#own-units input", "7");
    await page.page.click("#own-buttons button.main");
    // 9 × 14 × 14 voxels of 5 mm, rounded at the edges.
    await page.says("own-said", /4\d\.?\d? × [67]\d\.?\d? × [67]\d\.?\d? mm/);
    await page.picture("label");
    await page.page.click("#own-buttons button:text('Touch it as a solid')");
    await page.says("connection", /Connected to scan/);
    await page.page.locator("#own").waitFor({ state: "hidden" });
    await page.press();
    await felt(page);
    await page.page.mouse.up();
    assert.deepEqual(
      page.complaints.filter((complaint) => !complaint.includes("Failed to load resource")),
      [],
    );
    await close(page);
  });
});
