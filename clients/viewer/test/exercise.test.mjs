// Exercises on the page, for a trainee and for a trainer: `make test-viewer`.

import assert from "node:assert/strict";
import { after, before, describe, test } from "node:test";
import { cut, pages, Server, TEST_TIMEOUT_MS } from "./harness.mjs";

/** @typedef {import("./harness.mjs").Page} Page */

const { open, close, context } = pages({ width: 1100, height: 760 });

/** @type {Server} */
let server;
before(async () => {
  server = await Server.start();
});
after(async () => assert.equal(await server?.stop(), 0, "the server ends well although pages were open"));

/** Presses a place of the tissue for a while. @param {Page} page @param {[number, number]} place */
async function press(page, place) {
  await page.press(...place);
  await page.until(({ holds, hands }) => holds && hands.both[0]?.touches === true);
  const { sampledS } = await page.ask(({ sampledS }) => ({ sampledS }));
  await page.until(({ sampledS }, before) => sampledS > before + 0.5, sampledS);
  await page.page.mouse.up();
}

describe("an exercise", () => {
  test("is chosen, read, done and answered, and its result is told", async () => {
    const page = await open(`${server.url}/?exercise=lumps-1`);
    await page.until(({ exercise }) => exercise.isBriefing && exercise.isTrainee);
    await page.says("briefing-title", /Find the lumps/);
    await page.says("briefing-limits", /Time\s*2:00\s*Force\s*at most 5\.00 N/);
    await page.until(({ drawing }) => drawing.isDrawn);
    await page.picture("exercise-briefing");
    // Time does not pass while it is read.
    assert.equal(await page.text("exercise-time"), "0:00 of 2:00");
    assert.match(await page.text("briefing-instructions"), /mark each place where you feel/, "a line break is a space");
    assert.equal(await page.page.locator("#lumps-shown").isVisible(), false);
    await page.page.click("#begin-exercise");
    await page.until(({ exercise }) => !exercise.isBriefing);
    await page.says("exercise-time", /(0:0[1-9]|[01]:[1-5]\d|1:0\d) of 2:00/);
    await page.page.check("input[value=tip]", { force: true });
    await press(page, [0.45, 0.55]);
    await page.page.click("#mark-here");
    await page.page.mouse.click(...(await page.at(0.45, 0.55)));
    await page.until(({ exercise }) => exercise.answers === 1);
    await page.says("answers", /1 marked/);
    await page.says("exercise-figures", /Peak force/);
    await page.picture("exercise-going-on");
    assert.deepEqual(await cut(page), []);
    await page.page.click("#finish-exercise");
    await page.until(({ exercise }) => exercise.isDebriefing && exercise.finished && (exercise.scorePercent ?? -1) >= 0);
    await page.says("debriefing-score", /^\d+ %$/);
    await page.says("debriefing-said", /It took \d:\d\d\. [12] lumps? (was|were) hidden, 1 marked\./);
    await page.says("debriefing-tables", /Hits/);
    assert.deepEqual(await cut(page), []);
    await page.picture("exercise-debriefing");
    await page.page.click("#debriefing-look");
    await page.picture("exercise-result");
    await page.page.click("#show-result");
    // Another truth, from the beginning.
    await page.page.click("#debriefing-again");
    await page.until(({ exercise }) => exercise.isBriefing && !exercise.finished && exercise.answers === 0);
    assert.equal(await page.text("answers"), "");
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("has phases, each with its instructions and its time, and goes on when the trainee does", async () => {
    const page = await open(`${server.url}/?exercise=search-mark`);
    await page.until(({ exercise }) => exercise.isBriefing && exercise.isTrainee && exercise.phase === 1);
    await page.says("briefing-limits", /Search\s*at most 1:30\s*Mark\s*at most 0:45/);
    await page.page.click("#begin-exercise");
    await page.until(({ exercise }) => !exercise.isBriefing);
    await page.says("phase-title", /^1 of 2: Search$/);
    await page.says("phase-instructions", /Press the whole surface/);
    await page.says("phase-time", /(1:[012]\d|0:\d\d) left/);
    await page.picture("exercise-phase");
    assert.equal(await page.text("next-phase"), "Next: Mark");
    await page.page.click("#next-phase");
    await page.until(({ exercise }) => exercise.phase === 2);
    await page.says("phase-title", /^2 of 2: Mark$/);
    assert.equal(await page.page.locator("#next-phase").isVisible(), false);
    assert.deepEqual(await cut(page), []);
    await page.page.click("#finish-exercise");
    await page.until(({ exercise }) => exercise.isDebriefing && exercise.finished);
    await page.says("debriefing-tables", /Coverage share, phase 1/);
    await page.says("debriefing-tables", /Search, [01]:\d\d/);
    assert.deepEqual(page.complaints, []);
    await close(page);
  });

  test("is followed, and helped, by a trainer who sees what is hidden", async () => {
    const trainer = await (await context()).newPage();
    trainer.setDefaultTimeout(TEST_TIMEOUT_MS);
    await trainer.goto(`${server.url}/trainer.html`);
    await trainer.locator("#exercise option").first().waitFor({ state: "attached" });
    await trainer.selectOption("#exercise", "lumps-2");
    await trainer.fill("#trainee", "Ada");
    await trainer.click("#add button");
    const row = trainer.locator("#trainees li");
    await row.getByText("Has not begun").waitFor();
    const [link, watch] = [await row.getByText("The trainee's link").getAttribute("href"), await row.getByText("Look on").getAttribute("href")];
    const trainee = await open(link ?? "");
    await trainee.until(({ exercise }) => exercise.isBriefing);
    await trainee.page.click("#begin-exercise");
    await row.getByText(/\d:\d\d of/).waitFor();
    await row.locator("input").fill("Press with less force");
    await row.getByText("Send").click();
    await trainee.says("exercise-advice", /Press with less force/);
    // The trainer points at a place on a page that shows the lumps.
    const looking = await open(watch ?? "");
    await looking.until(({ exercise }) => exercise.isShown && !exercise.isTrainee);
    await looking.page.check("#lumps", { force: true });
    await looking.page.click("#point-out");
    await looking.page.mouse.click(...(await looking.at(0.5, 0.5)));
    await trainee.until(({ exercise }) => exercise.advised === 2);
    assert.match((await looking.text("exercise-score")) ?? "", /\d+ %|none/);
    await looking.picture("exercise-trainer");
    await trainer.screenshot({ path: "../../target/viewer/exercise-trainees.png" });
    // Another lump is on that page as soon as it is in the tissue, and a press that was asked for is still taken as such.
    const before = await looking.ask(({ lumps }) => lumps);
    assert.ok(before >= 1);
    await looking.page.click("#point-out");
    await row.getByText("Another lump").click();
    await trainer.locator("#said").getByText(/Ada has another lump, 1[0-6] mm wide/).waitFor();
    await looking.until(({ lumps }, before) => lumps === before + 1, before);
    assert.equal(await looking.page.getAttribute("#point-out", "aria-pressed"), "true");
    await looking.page.click("#point-out");
    await looking.picture("exercise-another-lump");
    // Who does not want to see lumps sees none before the end.
    await looking.page.uncheck("#lumps", { force: true });
    await looking.until(({ lumps }) => lumps === 0);
    // The trainee's page knows of no lump.
    const { exercise, lumps, sampledS } = await trainee.ask(({ exercise, lumps, sampledS }) => ({ exercise, lumps, sampledS }));
    assert.deepEqual([exercise.advised, lumps], [2, 0]);
    await trainee.until(({ sampledS }, before) => sampledS > before + 2, sampledS);
    assert.equal(await trainee.ask(({ lumps }) => lumps), 0);
    await row.getByText("Finish").click();
    await trainee.until(({ exercise }) => exercise.finished && exercise.isDebriefing);
    const told = (await trainee.ask(({ exercise }) => exercise)).lumpsTold;
    assert.equal(told, before + 1, "those from the beginning, and another one");
    for (const page of [trainee, looking]) await page.until(({ exercise, lumps }, told) => exercise.finished && lumps === told, told);
    await row.getByText(/Finished after/).waitFor();
    await row.getByText("Another lump").waitFor({ state: "hidden" });
    assert.deepEqual([...trainee.complaints, ...looking.complaints], []);
    await close(looking);
    await close(trainee);
    await trainer.context().close();
  });
});
