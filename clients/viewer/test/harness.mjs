// A real server and a real browser.

import { spawn, spawnSync } from "node:child_process";
import { cpSync, existsSync, mkdirSync, mkdtempSync, readFileSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { delimiter, join, resolve } from "node:path";
import { createInterface } from "node:readline";
import { after, before } from "node:test";
import { fileURLToPath } from "node:url";
import { constants, inflateSync } from "node:zlib";
import { chromium } from "playwright-core";

export const ROOT = resolve(fileURLToPath(new URL(".", import.meta.url)), "../../..");
/** Where pictures of tests are kept. */
export const PICTURES = join(ROOT, "target/viewer");
mkdirSync(PICTURES, { recursive: true });

/** Long enough for any machine; what waits so long has failed. */
export const TEST_TIMEOUT_MS = 120_000;

const NAMES = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];

/** @returns {string | undefined} */
function installed() {
  const folders = (process.env.PATH ?? "").split(delimiter);
  const paths = NAMES.flatMap((name) => folders.map((folder) => join(folder, name)));
  return [process.env.BROWSER_PROGRAM ?? "", ...paths].find((path) => path !== "" && existsSync(path));
}

/** The machine's browser; where there is none it is installed if that needs no question. */
function browserProgram() {
  const found = installed();
  if (found) return found;
  const line = "apt-get install -y chromium";
  if (process.getuid?.() === 0 && spawnSync("apt-get", ["--version"]).status === 0) {
    console.error(`There is no browser on this machine: ${line}`);
    // Files of tests run at the same time: the first installs it, and the others wait.
    const lock = join(tmpdir(), "palpate-browser.lock");
    const once = `command -v ${NAMES.join(" || command -v ")} || { apt-get update -q && ${line}; }`;
    spawnSync("flock", [lock, "sh", "-c", once], { stdio: ["ignore", "ignore", "inherit"] });
    const now = installed();
    if (now) return now;
  }
  console.error(`The tests of the page need a browser: sudo ${line}   (or set BROWSER_PROGRAM to one)`);
  process.exit(1);
}

export function launch() {
  // A profile of its own, which goes with the browser.
  return chromium.launch({
    executablePath: browserProgram(),
    args: [
      "--no-sandbox",
      "--disable-gpu",
      "--enable-unsafe-swiftshader",
      "--no-first-run",
      "--disable-background-networking",
      "--disable-component-update",
      "--disable-sync",
    ],
  });
}

/**
 * A browser for the tests of a file, and pages in it. Each page has a profile of its own, so that other pages'
 * connections are not counted with its.
 * @param {{ width: number, height: number }} viewport
 */
export function pages(viewport) {
  /** @type {import("playwright-core").Browser} */
  let browser;
  before(async () => {
    browser = await launch();
  });
  after(() => browser?.close());
  const context = (options = {}) => browser.newContext({ viewport, ...options });
  return {
    chromium: () => browser,
    context,
    /** @param {string} url */
    open: async (url, options = {}) => await Page.open(await context(options), url),
    /** @param {Page} page */
    close: async (page) => await page.page.context().close(),
  };
}

/** A page that is being loaded can't answer yet. @param {unknown} error */
function whileLoading(error) {
  if (/context was destroyed|navigation|Cannot find context/.test(String(error))) return false;
  throw error;
}

/** The server: what `make build` has built, or another one. */
const PROGRAM = process.env.SERVER_PROGRAM ?? join(ROOT, "target/release/palpate");

/** A new token, added to a file. @param {string} file @param {string} roles */
export function makeToken(file, roles) {
  const made = spawnSync(PROGRAM, ["token", "--name", `page ${roles}`, "--role", roles, "--tokens", file], { encoding: "utf8" });
  if (made.status !== 0) throw new Error(made.stderr);
  return made.stdout.trim();
}

/** An organ's surface as an OBJ file. @param {string} organ @param {string} edgeMm @param {string} file */
export function makeOrgan(organ, edgeMm, file) {
  const made = spawnSync(PROGRAM, ["organ", organ, "--edge-mm", edgeMm, "--output", file], { encoding: "utf8" });
  if (made.status !== 0) throw new Error(made.stderr);
}

/** Elements that are seen and reach beyond the window's sides, or whose text does not fit. @param {Page} page @returns {Promise<string[]>} */
export function cut(page) {
  return page.page.evaluate(`[...document.body.querySelectorAll("*")].filter((element) => {
    if (!element.checkVisibility() || element.closest("option") || element.tagName === "INPUT") return false;
    const { left, right, width } = element.getBoundingClientRect();
    if (width === 0) return false;
    const fits = element.tagName === "SELECT" || element.id === "view" || element.scrollWidth <= element.clientWidth + 1 || getComputedStyle(element).display === "inline";
    return left < -0.5 || right > innerWidth + 0.5 || !fits;
  }).map((element) => element.tagName + "#" + element.id + ": " + element.textContent.slice(0, 40))`);
}

/**
 * A call of the session service that names a session and nothing else. Returns the reason of a refusal, or nothing.
 * @param {Server} server @param {string} method @param {string} sessionId
 */
export async function callSession({ url }, method, sessionId) {
  const id = Buffer.from(sessionId);
  // A frame of gRPC-web: no flags, the length, and field 1 of the request.
  const body = Buffer.concat([Buffer.from([0, 0, 0, 0, id.length + 2, 0x0a, id.length]), id]);
  const headers = { "content-type": "application/grpc-web+proto", "x-grpc-web": "1" };
  const answer = await fetch(`${url}/palpate.v1.SessionService/${method}`, { method: "POST", headers, body });
  const told = Buffer.from(await answer.arrayBuffer()).toString("latin1");
  const [status, message] = [
    answer.headers.get("grpc-status") ?? /grpc-status:\s*(\d+)/.exec(told)?.[1] ?? "none",
    answer.headers.get("grpc-message") ?? /grpc-message:\s*([^\r\n]*)/.exec(told)?.[1] ?? "",
  ];
  return status === "0" ? undefined : `${status} ${message}`;
}

/**
 * A folder with the shipped scenes, in which a blade feels nothing: on a busy machine a touch begins anew again and again, and tough tissue
 * that was pushed is whole then. In `liver` a wound gapes by a pretension, N/m. The caller removes the folder.
 */
export function scenesToCut(pretensionNPerM = 0) {
  const folder = mkdtempSync(join(tmpdir(), "palpate-scenes-"));
  cpSync(join(ROOT, "scenes"), folder, { recursive: true });
  const liver = readFileSync(join(folder, "liver.toml"), "utf8");
  const soft = liver.replace(/^toughness_j_per_m2 = .*$/m, "toughness_j_per_m2 = 0.0");
  if (soft === liver) throw new Error("the scene has no toughness to take out");
  const tense = soft.replace("[springs]", `[springs]\npretension_n_per_m = ${pretensionNPerM.toFixed(1)}\n#`);
  if (tense === soft) throw new Error("the scene has no springs");
  writeFileSync(join(folder, "liver.toml"), tense);
  return folder;
}

/**
 * Leads a blade that is in the tissue along a line, in small steps as a hand does: to and fro until it has severed more than so many springs. On a busy
 * machine it comes later than the pointer, or begins anew on its way.
 * @param {Page} page @param {[number, number]} from @param {[number, number]} to @param {number} severed
 */
export async function sweep(page, from, to, severed) {
  for (let turn = 0; turn === 0 || (turn < 8 && (await page.ask(({ wound }) => wound)).severed <= severed); turn++) {
    const [begin, end] = turn % 2 === 0 ? [from, to] : [to, from];
    for (let k = 1; k <= 30; k++) {
      await page.page.mouse.move(...(await page.at(begin[0] + ((end[0] - begin[0]) * k) / 30, begin[1] + ((end[1] - begin[1]) * k) / 30)));
      await new Promise((done) => setTimeout(done, 40));
    }
  }
}

/** The tissue of most tests: a push moves it by centimetres. @param {Server} server */
export const paper = ({ url }) => `${url}/?scene=paper`;

/** Red, green and blue of a pixel of a screenshot. @param {import("playwright-core").Page} page @param {number} x @param {number} y */
export async function colourAt(page, x, y) {
  const png = await page.screenshot({ clip: { x: Math.round(x), y: Math.round(y), width: 1, height: 1 } });
  // Its first chunk of data: a byte for the row's filter, which does nothing to the first pixel, then the pixel.
  const at = png.indexOf("IDAT");
  const data = png.subarray(at + 4, at + 4 + png.readUInt32BE(at - 4));
  const [, red = 0, green = 0, blue = 0] = inflateSync(data, { finishFlush: constants.Z_SYNC_FLUSH });
  return { red, green, blue };
}

/**
 * Red, green, blue and alpha of each pixel of a screenshot.
 * @param {Page} page @param {Buffer} png
 * @returns {Promise<number[][]>}
 */
async function pixelsOf(page, png) {
  const bytes = await page.page.evaluate(async (data) => {
    const image = new Image();
    image.src = `data:image/png;base64,${data}`;
    await image.decode();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.width, image.height];
    const pen = canvas.getContext("2d");
    pen?.drawImage(image, 0, 0);
    return [...(pen?.getImageData(0, 0, image.width, image.height).data ?? [])];
  }, png.toString("base64"));
  return Array.from({ length: bytes.length / 4 }, (_, i) => bytes.slice(4 * i, 4 * i + 4));
}

/**
 * Of a screenshot's pixels the whitest and the blackest, 0 to 1, and the largest ratio of blue to red of those that are not dark.
 * @param {Page} page @param {Buffer} png
 */
export async function extremes(page, png) {
  let [whitest, blackest, bluest] = [0, 1, 0];
  for (const [red = 0, green = 0, blue = 0] of await pixelsOf(page, png)) {
    whitest = Math.max(whitest, Math.min(red, green, blue) / 255);
    blackest = Math.min(blackest, Math.max(red, green, blue) / 255);
    bluest = Math.max(bluest, (blue - red) / 255);
  }
  return { whitest, blackest, bluest };
}

/** Light (red, green and blue, added) of each pixel of a screenshot, ascending. @param {Page} page @param {Buffer} png */
export async function lights(page, png) {
  const pixels = await pixelsOf(page, png);
  return pixels.map(([red = 0, green = 0, blue = 0]) => red + green + blue).sort((a, b) => a - b);
}

/** How much more blue than red a screenshot's bluest pixel is. @param {Page} page @param {Buffer} png */
export async function bluest(page, png) {
  return (await extremes(page, png)).bluest;
}

/** A configuration under which a busy machine refuses no session for want of processor time. */
const BUSY_MACHINE = "tests/common/busy_machine.toml";

/** `palpate serve` on a free port, or on `listen`. A configuration among the options replaces that of tests. */
export class Server {
  /** @param {string[]} options */
  static async start(options = [], listen = "127.0.0.1:0") {
    const config = options.includes("--config") ? [] : ["--config", BUSY_MACHINE];
    const child = spawn(PROGRAM, ["serve", "--listen", listen, "--log", "warn", ...config, ...options], {
      cwd: ROOT,
      stdio: ["ignore", "pipe", "inherit"],
    });
    // The server ends with the tests, however they end.
    process.on("exit", () => child.kill("SIGKILL"));
    for await (const line of createInterface(child.stdout)) {
      const url = /http:\S+/.exec(line)?.[0];
      if (url) return new Server(child, url);
    }
    throw new Error("the server did not start");
  }

  /**
   * @param {import("node:child_process").ChildProcess} child
   * @param {string} url
   */
  constructor(child, url) {
    this.child = child;
    this.url = url;
  }

  async stop() {
    if (this.child.exitCode !== null) return this.child.exitCode;
    const ended = new Promise((done) => this.child.once("exit", done));
    this.child.kill("SIGTERM");
    return await ended;
  }
}

/**
 * @typedef {{
 *   sampledS: number, hands: { both: { mode: string, touches: boolean, isParked: boolean, grips: boolean, forceN: number }[], chosen: number, isTwo: boolean },
 *   frames: { taken: number, skipped: number, drawn: number, timeS: number }, received: number, largestM: number, deepestM: number, forceN: number[], ownForcesN: number[],
 *   clear: number | undefined, cameraHeight: number, widthM: number, drawing: { isDrawn: boolean, isTextured: boolean, hasTexture: boolean },
 *   recording: { sessionId: string, run: number, begin: number, end: number, step: number, isPlaying: boolean, isBusy: boolean, speed: number, playback: string } | undefined,
 *   camera: number[],
 *   datagrams: { carries: boolean, sent: number, came: number, poses: number, samples: number, fellBack: number },
 *   wound: { severed: number, pieces: number, version: number, vertices: number, shown: number, waiting: number, cutFaces: number, mostAtOnce: number },
 *   burns: { version: number, burnt: number, through: number },
 *   sewing: { ties: { number: number, kind: string | undefined, lengthM: number, pathM: number, tensionN: number, broken: boolean }[], picked: number },
 *   takeLongest: () => { pictureMs: number, woundMs: number },
 *   comparison: { isOpen: boolean, curves: number, relativeRms: number },
 *   exercise: { isShown: boolean, isTrainee: boolean, isBriefing: boolean, isDebriefing: boolean, answers: number, phase: number, advised: number, finished: boolean, lumpsTold: number, scorePercent: number | undefined },
 *   lumps: number, ageMs: number | undefined, picture: string, holds: boolean, at: (x: number, y: number) => [number, number], pixelAfterPress: (x: number, y: number) => Promise<number>, thumbnail: () => string,
 * }} Inside State that the page exposes for tests (src/main.ts).
 */

/** The processes that a browser runs pages in. @param {import("playwright-core").Browser} browser */
export async function pageProcesses(browser) {
  const session = await browser.newBrowserCDPSession();
  const { processInfo } = await session.send("SystemInfo.getProcessInfo");
  await session.detach();
  return processInfo.filter(({ type }) => type === "renderer").map(({ id }) => id);
}

/** Does something while processes are stopped. @param {number[]} ids @param {() => Promise<unknown>} act */
export async function whileStopped(ids, act) {
  ids.forEach((id) => process.kill(id, "SIGSTOP"));
  try {
    await act();
  } finally {
    ids.forEach((id) => process.kill(id, "SIGCONT"));
  }
}

/** A page, and all that its console was told. */
export class Page {
  /**
   * @param {import("playwright-core").BrowserContext} context
   * @param {string} url
   */
  static async open(context, url) {
    const opened = new Page(await context.newPage());
    await opened.page.goto(url);
    await opened.shows();
    return opened;
  }

  /** @param {import("playwright-core").Page} page */
  constructor(page) {
    this.page = page;
    /** @type {string[]} */
    this.complaints = [];
    page.setDefaultTimeout(TEST_TIMEOUT_MS);
    page.on("console", (message) => {
      // Without a graphics processor the browser itself reads each picture back, and warns the page.
      if (!message.text().endsWith("GPU stall due to ReadPixels") && !message.text().includes("no longer repeat")) {
        this.complaints.push(`${message.type()}: ${message.text()}`);
      }
    });
    page.on("pageerror", (error) => this.complaints.push(String(error)));
  }

  /** Waits for the first frame. */
  shows() {
    return this.until((inside) => inside.frames.taken > 0 && inside.frames.drawn > 0);
  }

  /**
   * Waits until the exposed state of the page satisfies a condition. (It is polled from here: the page's own policy forbids
   * to evaluate text.)
   * @template T
   * @param {(inside: Inside, argument: T) => boolean | undefined} condition
   * @param {T} [argument]
   */
  async until(condition, argument) {
    const source = `window.palpate !== undefined && (${condition.toString()})(window.palpate, ${JSON.stringify(argument)})`;
    const begun = Date.now();
    while (!(await this.page.evaluate(source).catch(whileLoading))) {
      if (Date.now() - begun > TEST_TIMEOUT_MS) {
        const told = await this.page.evaluate("JSON.stringify(window.palpate)").catch(String);
        throw new Error(`waited in vain for ${condition.toString()} with ${JSON.stringify(argument)}: ${told}`);
      }
      await new Promise((done) => setTimeout(done, 50));
    }
  }

  /**
   * @template T
   * @param {(inside: Inside) => T} question
   * @returns {Promise<T>}
   */
  ask(question) {
    return this.page.evaluate(`(${question.toString()})(window.palpate)`);
  }

  /**
   * Where the tissue of a place is, in parts of the sheet.
   * @param {number} x
   * @param {number} y
   * @returns {Promise<[number, number]>}
   */
  at(x, y) {
    return this.page.evaluate(`window.palpate.at(${x}, ${y})`);
  }

  /** Lets go, and waits until the tissue is at rest. */
  async rests() {
    await this.page.mouse.up();
    await this.until(({ largestM, forceN }) => largestM < 0.004 && forceN.length === 0);
  }

  /** Presses with the mouse in the middle, or elsewhere. */
  async press(x = 0.5, y = 0.5) {
    const [left, top] = await this.at(x, y);
    await this.page.mouse.move(left, top);
    await this.page.mouse.down();
    return /** @type {[number, number]} */ ([left, top]);
  }

  /** @param {string} name */
  picture(name) {
    return this.page.screenshot({ path: join(PICTURES, `${name}.png`) });
  }

  /** @param {string} id */
  text(id) {
    return this.page.locator(`#${id}`).innerText();
  }

  /** @param {string} id @param {RegExp} pattern */
  async says(id, pattern) {
    await this.page.locator(`#${id}`, { hasText: pattern }).waitFor();
  }
}
