// Measured curves beside those of the tissue on the page: `make test-viewer`.

import assert from "node:assert/strict";
import { after, before, describe, test } from "node:test";
import { cut, pages, paper, Server } from "./harness.mjs";

/** @typedef {import("./harness.mjs").Page} Page */

const { open, close } = pages({ width: 1100, height: 760 });

/** @type {Server} */
let server;
before(async () => {
  server = await Server.start();
});
after(async () => assert.equal(await server?.stop(), 0, "the server ends well although pages were open"));

/** Two presses of 4 mm in 0.1 s, with the same force at each sample. @param {number} forceN */
function presses(forceN) {
  const rows = ["small,60", "wide,120"].flatMap((curve) => Array.from({ length: 21 }, (_, k) => `${curve},${5 * k},${0.2 * k},${forceN}`));
  return `curve,tip_radius_mm,time_ms,depth_mm,force_n\n${rows.join("\n")}\n`;
}

/** @param {string} name @param {string} text */
const file = (name, text) => ({ name, mimeType: "text/csv", buffer: Buffer.from(text) });

/** How many pixels of a canvas have nearly the colour of a variable of the page. @param {Page} page @param {string} id @param {string} variable @returns {Promise<number>} */
function coloured(page, id, variable) {
  return page.page.evaluate(
    ([id = "", variable = ""]) => {
      const canvas = /** @type {HTMLCanvasElement} */ (document.getElementById(id));
      const pen = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
      const probe = /** @type {CanvasRenderingContext2D} */ (document.createElement("canvas").getContext("2d"));
      const mark = document.body.appendChild(document.createElement("i"));
      mark.style.color = `var(${variable})`;
      probe.fillStyle = getComputedStyle(mark).color;
      mark.remove();
      probe.fillRect(0, 0, 1, 1);
      const wanted = probe.getImageData(0, 0, 1, 1).data;
      const pixels = pen.getImageData(0, 0, canvas.width, canvas.height).data;
      let count = 0;
      for (let i = 0; i < pixels.length; i += 4) {
        const isNear = [0, 1, 2].every((k) => Math.abs((pixels[i + k] ?? 0) - (wanted[k] ?? 0)) < 24);
        count += Number(isNear && (pixels[i + 3] ?? 0) > 200);
      }
      return count;
    },
    [id, variable],
  );
}

describe("measured curves", () => {
  test("are drawn beside those of the tissue, told in words and numbers, and chosen by keys", async () => {
    const page = await open(paper(server));
    await page.page.setInputFiles("#compare-file", file("lab.csv", presses(0.5)));
    await page.until(({ comparison }) => comparison.isOpen && comparison.curves === 2 && comparison.relativeRms > 0);
    await page.says("comparison-name", /^lab\.csv$/);
    await page.says("comparison-said", /Between them [\d.]+ m?N .*, [\d.]+ % of the largest force; R² .*Pressed by a disc of even pressure of 60\.0 mm radius\./);
    for (const colorScheme of /** @type {const} */ (["light", "dark"])) {
      await page.page.emulateMedia({ colorScheme });
      await page.page.waitForTimeout(100);
      for (const id of ["comparison-depth", "comparison-time"]) {
        assert.ok((await coloured(page, id, "--depth")) > 20, `${id} has measured points (${colorScheme})`);
        assert.ok((await coloured(page, id, "--force")) > 20, `${id} has the tissue's line (${colorScheme})`);
      }
      assert.ok((await coloured(page, "comparison-residual", "--force")) > 20, `the residual is drawn (${colorScheme})`);
      await page.picture(`comparison-${colorScheme}`);
    }
    const label = await page.page.getAttribute("#comparison-depth", "aria-label");
    assert.match(label ?? "", /^Force over depth: measured up to 500 mN, this tissue up to [\d.]+ m?N, at depths up to 4\.00 mm/);
    await page.page.click("#comparison-shown summary");
    assert.equal(await page.page.locator("#comparison-table tbody tr").count(), 21);
    assert.match(await page.page.locator("#comparison-table tbody tr").last().innerText(), /100 ms\s+4\.00 mm\s+500 mN/);
    assert.deepEqual(await cut(page), []);
    await page.page.setViewportSize({ width: 390, height: 844 });
    assert.deepEqual(await cut(page), []);
    await page.picture("comparison-phone");
    // The second curve, by keys.
    await page.page.focus("#comparison-curve");
    await page.page.keyboard.press("ArrowDown");
    await page.says("comparison-said", /of 120 mm radius/);
    await page.page.keyboard.press("Escape");
    await page.until(({ comparison }) => !comparison.isOpen);
    // The browser would rather have known that this test reads the plots back.
    assert.deepEqual(
      page.complaints.filter((complaint) => !complaint.includes("willReadFrequently")),
      [],
    );
    await close(page);
  });

  test("that say no tip are pressed by the chosen one, and what can't be read is named", async () => {
    const page = await open(`${server.url}/?scene=phantom`);
    const table = "time_s,depth_mm,force_n\n0,0,0\n0.05,0.5,0.1\n0.1,1,0.2\n";
    // Dropped on the page, as a mesh is.
    await page.page.evaluate((text) => {
      const data = new DataTransfer();
      data.items.add(new File([text], "probe.csv", { type: "text/csv" }));
      dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));
    }, table);
    await page.says("comparison-said", /Pressed by a disc of even pressure of 5\.00 mm radius/);
    await page.page.click("#comparison > details summary");
    await page.page.selectOption("#comparison-shape", { label: "Rigid disc" });
    await page.page.fill("#comparison-radius", "12");
    await page.page.keyboard.press("Enter");
    await page.says("comparison-said", /Pressed by a rigid disc of 12\.0 mm radius/);
    await page.page.click("#comparison-close");
    await page.page.setInputFiles("#compare-file", file("bad.csv", "time_s,depth_mm,force_n\n0,0,0\n0.1,deep,1\n"));
    await page.says("comparison-said", /This does not work: bad\.csv:3: depth_mm: `deep` is not a finite number/);
    await page.page.setInputFiles("#compare-file", file("long.csv", `${"#".repeat(1_000_001)}\n${table}`));
    await page.says("comparison-said", /the table has more than 1 MB/);
    assert.equal(await page.page.locator("#comparison-shown").isVisible(), false);
    assert.deepEqual(
      page.complaints.filter((complaint) => !complaint.includes("Failed to load resource")),
      [],
    );
    await close(page);
  });
});
