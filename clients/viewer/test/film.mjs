// Films of the page: pictures of moments, and all that the browser draws, as a film. The film needs ffmpeg; without it there are the pictures alone.

import { spawnSync } from "node:child_process";
import { mkdirSync, rmSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { PICTURES } from "./harness.mjs";

/** @typedef {import("./harness.mjs").Page} Page */

/** Pictures a second of a film. */
const RATE_HZ = 25;
/** A picture that stands still is drawn in full after this time. */
const CALM_MS = 1300;

export class Film {
  /** Pictures of the film, and the time of each, s. @type {{ name: string, timeS: number }[]} */
  pictures = [];

  /** @param {Page} page @param {string} name @param {import("playwright-core").CDPSession} screen */
  constructor(page, name, screen) {
    this.page = page;
    this.screen = screen;
    this.folder = join(PICTURES, name);
    this.frames = join(this.folder, "frames");
    this.path = join(this.folder, `${name}.webm`);
    rmSync(this.folder, { recursive: true, force: true });
    mkdirSync(this.frames, { recursive: true });
  }

  /** Begins to film a page, into a folder of this name. @param {Page} page @param {string} name */
  static async begin(page, name) {
    const screen = await page.page.context().newCDPSession(page.page);
    const film = new Film(page, name, screen);
    screen.on("Page.screencastFrame", ({ data, metadata, sessionId }) => {
      const name = `${String(film.pictures.length).padStart(5, "0")}.jpg`;
      writeFileSync(join(film.frames, name), Buffer.from(data, "base64"));
      film.pictures.push({ name, timeS: metadata.timestamp ?? Date.now() / 1000 });
      void screen.send("Page.screencastFrameAck", { sessionId }).catch(() => undefined);
    });
    await screen.send("Page.startScreencast", { format: "jpeg", quality: 90 });
    return film;
  }

  /** A picture of this moment, and what the page says of it. @param {string} name @param {string} field */
  async moment(name, field) {
    await this.page.page.waitForTimeout(CALM_MS);
    await this.page.page.screenshot({ path: join(this.folder, `${name}.png`) });
    console.log(`${name}: ${(await this.page.text(field)).replaceAll("\n", "; ")}`);
  }

  /** Moves the mouse along a path in about so many seconds. @param {number} seconds @param {(part: number) => [number, number] | Promise<[number, number]>} path */
  async lead(seconds, path) {
    const begun = Date.now();
    for (let part = 0; part < 1; ) {
      part = Math.min(1, (Date.now() - begun) / (1000 * seconds));
      await this.page.page.mouse.move(...(await path(part)));
      await this.page.page.waitForTimeout(40);
    }
  }

  async end() {
    await this.screen.send("Page.stopScreencast");
  }

  /** Writes the film. Returns whether it could, or ffmpeg is missing. */
  write() {
    const { pictures, frames, path } = this;
    // Each picture is shown until the next one came.
    const list = pictures.flatMap(({ name, timeS }, k) => [`file '${name}'`, `duration ${Math.max((pictures[k + 1]?.timeS ?? timeS + 1) - timeS, 1e-3).toFixed(3)}`]);
    writeFileSync(join(frames, "list.txt"), `ffconcat version 1.0\n${list.join("\n")}\n`);
    const scaled = `fps=${RATE_HZ},scale=trunc(iw/2)*2:trunc(ih/2)*2`;
    const options = ["-loglevel", "error", "-y", "-f", "concat", "-i", join(frames, "list.txt"), "-vf", scaled, "-c:v", "libvpx-vp9", "-b:v", "0", "-crf", "34"];
    const made = spawnSync("ffmpeg", [...options, "-row-mt", "1", "-cpu-used", "5", path], { stdio: "inherit" });
    console.log(`${pictures.length} pictures of the film are in ${frames}`);
    if (made.error) console.error("There is no film, because ffmpeg is missing (Debian: apt-get install ffmpeg).");
    else if (made.status === 0) console.log(path);
    return made.error !== undefined || made.status === 0;
  }
}
