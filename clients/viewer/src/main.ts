// The page: connects the parts.
//
// It shows only what frames and samples say. A worker receives frames and returns credit (four in flight), so a page that
// draws slowly is not sent less. Positions and normals are computed once for each picture, for what is drawn; picking and
// figures use all vertices. Commands go in batches of one with at most two in flight, the newest place only; each push has a
// time to live, each lease four seconds. Without TLS a browser speaks HTTP/1.1 with six connections: hence one stream of
// frames, one of samples, and one acknowledgement at a time.

import type { Session } from "./gen/palpate/v1/session_pb";
import { SessionState } from "./gen/palpate/v1/session_pb";
import type { Mode } from "./hand";
import { Input } from "./input";
import { Latency } from "./latency";
import { depthText, Overlay } from "./overlay";
import { asked, askedNumber, holderName, part, writeAddress } from "./page";
import { Plots, quantity } from "./plot";
import { norm } from "./samples";
import { playScript } from "./script";
import { backoffMs, describe, type Failure, isGone, PATIENCE_MS, reasonOf, received, sessions, sleep } from "./server";
import { Stage } from "./stage";
import { Status } from "./status";
import { tissueTexture } from "./texture";
import { TissueValues } from "./tissue";
import { Visit } from "./visit";

/** The scene of a new session, if the server has it and the address names no other. */
const DEFAULT_SCENE = "liver";

/** When samples are so much newer than the newest frame, nothing moves: frames come 60 times a second. */
const STILL_S = 0.25;

const canvas = part("tissue", HTMLCanvasElement);
const stage = new Stage(canvas, asked.get("quality") === "high");
const overlay = new Overlay(stage);
const latency = new Latency(stage);
const status = new Status(
  part("light", HTMLElement),
  part("connection", HTMLElement),
  part("figures", HTMLElement),
  part("details", HTMLButtonElement),
);
const plots = new Plots(part("plot-displacement", HTMLCanvasElement), part("plot-force", HTMLCanvasElement));
const tissue = new TissueValues(heard, notice);
const holder = holderName();
let visit: Visit | undefined;
let playing: AbortController | undefined;

new Input(canvas, stage, latency, () => visit);

let noticed: ReturnType<typeof setTimeout> | undefined;
/** Shows a message for `seconds`; permanently if 0. */
function notice(text: string, seconds = 5): void {
  const line = part("notice", HTMLElement);
  clearTimeout(noticed);
  line.textContent = text;
  line.hidden = text === "";
  if (seconds > 0) noticed = setTimeout(() => (line.hidden = true), 1000 * seconds);
}

/** Opens a session: an existing one, or a new one of a scene. */
async function open(sessionId: string | undefined, scene: string | undefined): Promise<void> {
  visit?.leave();
  visit = undefined;
  playing?.abort();
  for (let failures = 0; ; failures++) {
    try {
      const session = sessionId
        ? (await sessions.getSession({ sessionId }, { timeoutMs: PATIENCE_MS })).session
        : (await sessions.createSession({ source: { case: "sceneName", value: scene ?? DEFAULT_SCENE } }, {})).session;
      if (session) return await show(session, sessionId === undefined);
    } catch (error) {
      const refused = describe(error);
      if (isGone(error)) return over("This session no longer exists.");
      if (reasonOf(error) === "UNAUTHENTICATED") {
        return over(`The server asks who you are (${refused}). Put your token behind the address, as in #token=…`);
      }
      // A refusal with any other reason would be repeated.
      if (!["", "SHUTTING_DOWN", "TOO_MANY"].includes(reasonOf(error))) return over(`${refused}.`);
      const waitMs = backoffMs(failures);
      status.lose();
      status.say(`Unexpected answer from the server (${refused}). Trying again in ${(waitMs / 1000).toFixed(1)} s.`);
      await sleep(waitMs);
    }
  }
}

/** A session has ended: the user decides what to do. */
function over(why: string): void {
  visit?.leave();
  visit = undefined;
  status.lose();
  status.say(why);
  notice(`${why} `, 0);
  const again = document.createElement("button");
  again.textContent = "Start a new session";
  again.addEventListener("click", () => {
    notice("", 0);
    void open(undefined, part("scene", HTMLSelectElement).value || undefined);
  });
  part("notice", HTMLElement).append(again);
}

async function show(session: Session, isNew: boolean): Promise<void> {
  writeAddress(session.sessionId, isNew && new URLSearchParams(location.search).has("session"));
  const next = new Visit(session, holder, askedNumber("refinement", 0, 10), {
    onSession: heard,
    onTrouble: trouble,
    onWell: () => visit === next && status.found(wellText(next.session)),
  });
  visit = next;
  void listScripts(session.sessionId);
  next.hand.mode = chosenMode();
  next.hand.strength = Number(part("strength", HTMLInputElement).value);
  next.hand.onRefused = notice;
  next.hand.onChange = holding;
  next.frames.onFrame = () => stage.drawFrame();
  next.samples.onSample = () => felt(next);
  const slider = part("refinement", HTMLInputElement);
  slider.max = String(next.mostRefinement);
  slider.value = String(next.refinement);
  tellControls();
  tissue.begin(session);
  // Shaded by its shape at once; the texture comes when it is painted.
  stage.show(next.surface, next.extentM, false);
  stage.setTools([], 1);
  part("arriving", HTMLElement).hidden = true;
  next.begin();
  if (document.hidden) next.lookAway();
  const texture = await tissueTexture(session.sessionId);
  if (visit !== next) texture?.dispose();
  else if (texture) stage.setTexture(texture);
}

function wellText(session: Session): string {
  const name = session.scene?.name ?? "";
  if (session.state === SessionState.HELD) return `The session is held: ${session.holdReason}`;
  const paused = session.state === SessionState.PAUSED ? ", which is paused" : "";
  return `Connected to ${name}${paused}.${recoveredText(session)}`;
}

/** How often the tissue recovered and why it did the last time; nothing if it never did. */
function recoveredText({ recoveryCount, recoveries }: Session): string {
  const newest = recoveries.at(-1);
  if (!newest) return "";
  const times = recoveryCount === 1n ? "once" : `${recoveryCount} times`;
  const end = newest.pausedUntilStep;
  const pause = end === undefined ? "" : ` Tools that acted are paused until step ${end}.`;
  return ` The tissue recovered ${times}, the last time because after step ${newest.step} ${newest.reason}.${pause}`;
}

function trouble(failure: Failure, waitMs: number): void {
  if (failure.isGone) return over("The session has ended.");
  status.lose();
  status.say(`Connection lost (${failure.text}). Trying again in ${(waitMs / 1000).toFixed(1)} s.`);
}

/** Handles the session's status. */
function heard(session: Session): void {
  if (session.sessionId !== visit?.session.sessionId) return;
  visit.session = session;
  tissue.show(session);
  holding();
}

function holding(): void {
  if (!visit) return;
  const mine = visit.hand.holds;
  const others = visit.session.heldTools.filter((tool) => !mine || tool.tool !== 0);
  const names = others.map((tool) => `${tool.holder || "Somebody"} holds ${tool.tool === 0 ? "the tool" : `tool ${tool.tool}`}`);
  part("holder", HTMLElement).textContent = mine ? `You (${holder}) hold the tool` : names.join(", ") || "Nobody touches: press to begin";
  part("release", HTMLButtonElement).disabled = !mine;
}

/** Shows the tools and the forces on them. */
function felt(of: Visit): void {
  if (of !== visit) return;
  const { spacingM, mostN } = of.reach;
  const shown = of.samples.tools.map(({ point, forceN }) => {
    const restM: [number, number] = [(point?.x ?? 0) * spacingM, (point?.y ?? 0) * spacingM];
    return { restM, forceN };
  });
  stage.setTools(shown, mostN);
}

function tellControls(): void {
  if (!visit) return;
  const { hand, reach } = visit;
  const text = hand.mode === "pull" ? "as you drag" : quantity(hand.strength * reach.mostN, "N");
  part("strength-value", HTMLOutputElement).value = text;
  part("strength", HTMLInputElement).setAttribute("aria-valuetext", text);
  part("refinement-value", HTMLOutputElement).value = String(visit.refinement);
  const range = quantity(reach.spacingM, "m");
  part("meaning", HTMLElement).textContent =
    "Strength is the push in the middle of the tool. It fades out over about " +
    `${range}. What pushes back is the mean over the tissue around, weighted as the push is. The push is strongest in the ` +
    "middle, so that mean is less than the strength while nothing moves. While the tissue moves it may be more.";
}

function chosenMode(): Mode {
  const chosen = document.querySelector<HTMLInputElement>("input[name=mode]:checked");
  return (chosen?.value ?? "push") as Mode;
}

part("mode", HTMLElement).addEventListener("change", () => {
  if (!visit) return;
  visit.hand.lift();
  visit.hand.mode = chosenMode();
  tellControls();
});
part("strength", HTMLInputElement).addEventListener("input", (event) => {
  if (visit) visit.hand.strength = Number((event.target as HTMLInputElement).value);
  tellControls();
});
part("release", HTMLButtonElement).addEventListener("click", () => void visit?.hand.letGo());
part("wireframe", HTMLInputElement).addEventListener("change", (event) => {
  stage.setWireframe((event.target as HTMLInputElement).checked);
});
part("refinement", HTMLInputElement).addEventListener("input", (event) => {
  if (!visit) return;
  const surface = visit.refine(Number((event.target as HTMLInputElement).value));
  stage.show(surface, visit.extentM, true);
  tellControls();
});
part("scene", HTMLSelectElement).addEventListener("change", (event) => {
  void open(undefined, (event.target as HTMLSelectElement).value);
});
part("share", HTMLButtonElement).addEventListener("click", () => {
  // Browsers offer the clipboard only to pages from a secure origin or from this machine.
  const failed = () => notice("The link could not be copied. Copy the address of this page instead.");
  if (!isSecureContext) return failed();
  const copied = () => notice("Link copied. Anyone who opens it sees this session.");
  void navigator.clipboard.writeText(location.href).then(copied, failed);
});
part("play", HTMLButtonElement).addEventListener("click", () => void play());

async function play(): Promise<void> {
  const button = part("play", HTMLButtonElement);
  if (playing) return playing.abort();
  if (!visit) return;
  const own = (playing = new AbortController());
  const { sessionId } = visit.session;
  button.textContent = "Stop";
  try {
    // A script takes the tools itself.
    await visit.hand.letGo();
    const name = part("script", HTMLSelectElement).value;
    const warnings = await playScript(sessionId, name, visit.rateHz, `${holder}, ${name}`, own.signal, (done) => {
      button.textContent = `Stop (${Math.round(100 * done)} %)`;
    });
    if (warnings.length > 0) notice(warnings.join(" "));
  } catch (error) {
    if (!own.signal.aborted) notice(`The script was not played: ${describe(error)}`);
  } finally {
    playing = undefined;
    button.textContent = "Play";
  }
}

/** The visit in which the user was warned. */
let warnedIn: Visit | undefined;
/** Warns once if the tissue moved farther than it is long: then a unit is probably wrong. */
function warnIfFar(of: Visit): void {
  if (of === warnedIn || of.surface.largestM() <= Math.max(...of.extentM, of.reach.spacingM)) return;
  warnedIn = of;
  notice("The tissue moved farther than its longest side. Look at the forces and the stiffness: a unit may be wrong.", 15);
}

stage.onDrawn = () => {
  latency.drawn();
  overlay.drawn();
};

// A hidden window releases its connections for visible ones.
document.addEventListener("visibilitychange", () => (document.hidden ? visit?.lookAway() : visit?.look()));
addEventListener("pagehide", () => void visit?.hand.letGo());
addEventListener("popstate", () => {
  const sessionId = new URLSearchParams(location.search).get("session") ?? undefined;
  if (sessionId !== visit?.session.sessionId) void open(sessionId, undefined);
});

// Ten times a second for values read as they change, once a second for figures.
setInterval(() => {
  if (!visit || document.hidden) return;
  const { samples, reach } = visit;
  plots.draw(samples.history, samples.newest?.simulationTimeS ?? 0, 0.4 * reach.spacingM, 0.1 * reach.mostN);
  const tool = samples.tools[0];
  overlay.tell(tool);
  part("felt", HTMLElement).textContent = tool
    ? `${depthText(tool.displacementM)}, pushes back ${quantity(norm(tool.forceN), "N")}`
    : "Nothing touches the tissue.";
}, 100);
setInterval(() => {
  if (!visit || document.hidden) return;
  warnIfFar(visit);
  const { session, samples, frames } = visit;
  const { newest } = samples;
  const audited = session.audit?.newestError;
  status.show({
    roundTripMs: visit.roundTripMs,
    networkMs: visit.hand.networkMs,
    frameAgeMs: frameAgeMs(),
    isStill: isStill(visit),
    silentMs: performance.now() - visit.heardMs,
    framesTaken: frames.taken,
    framesDrawn: stage.drawn,
    framesSkipped: frames.skipped,
    picture: stage.describe(),
    overruns: newest?.overrunCount ?? session.overrunCount,
    dilation: newest?.timeDilation ?? session.timeDilation,
    awakePoints: newest?.awakePoints,
    isAsleep: newest?.asleep ?? session.resting,
    auditedError: audited && Math.max(audited.displacement, audited.force),
    tolerance: session.scene?.stepping?.tolerance,
  });
}, 1000);

/** Fills the list of scripts with those that are made for the session's scene. */
async function listScripts(sessionId: string): Promise<void> {
  for (let failures = 0; visit?.session.sessionId === sessionId; failures++) {
    try {
      const { scriptNames } = await sessions.listScripts({ sessionId }, { timeoutMs: PATIENCE_MS });
      part("script", HTMLSelectElement).replaceChildren(...scriptNames.map((name) => new Option(name)));
      return;
    } catch {
      await sleep(backoffMs(failures));
    }
  }
}

async function lists(): Promise<void> {
  for (let failures = 0; ; failures++) {
    try {
      const { sceneNames } = await sessions.listScenes({}, { timeoutMs: PATIENCE_MS });
      part("scene", HTMLSelectElement).replaceChildren(...sceneNames.map((name) => new Option(name)));
      part("scene", HTMLSelectElement).value = visit?.session.scene?.name ?? asked.get("scene") ?? DEFAULT_SCENE;
      return;
    } catch {
      await sleep(backoffMs(failures));
    }
  }
}

/** Age of the newest frame here. */
function frameAgeMs(): number | undefined {
  const [now, newest] = [visit?.nowS(), visit?.frames.newest];
  return now === undefined || !newest ? undefined : Math.max(0, 1000 * (now - newest.timeS));
}

/** Whether no frame is due: the server sends none while nothing moves, and samples go on. */
function isStill({ frames, samples, session }: Visit): boolean {
  const { newest } = samples;
  if (newest?.asleep ?? session.resting) return true;
  return newest !== undefined && frames.newest !== undefined && newest.simulationTimeS - frames.newest.timeS > STILL_S;
}

/** The page's state as numbers, for tests and measurements. */
const inside = {
  get frames() {
    const { taken, skipped, newest } = visit?.frames ?? { taken: 0, skipped: 0n };
    return { taken, skipped: Number(skipped), drawn: stage.drawn, timeS: newest?.timeS ?? 0 };
  },
  get received() {
    return received.bytes;
  },
  get ageMs() {
    return frameAgeMs();
  },
  get picture() {
    return stage.describe();
  },
  get largestM() {
    return visit?.surface.largestM() ?? 0;
  },
  get forceN() {
    return visit?.samples.tools.map((tool) => norm(tool.forceN)) ?? [];
  },
  /** Largest displacement of the control point within the length of the plots. */
  get deepestM() {
    return Math.max(0, ...(visit?.samples.history.map((moment) => norm(moment.displacementM)) ?? []));
  },
  get holds() {
    return visit?.hand.holds ?? false;
  },
  /** The least room between a tool and the tissue as drawn, of the width of the tissue; undefined without a tool. */
  get clear() {
    const { clearM } = stage;
    return clearM === undefined || !visit ? undefined : clearM / visit.extentM[0];
  },
  /** Whether the first picture of the tissue was drawn, and had a texture; and whether it has one now. */
  get drawing() {
    return { ...stage.began, hasTexture: stage.isTextured };
  },
  /** The camera's height above the table and the tissue beneath it, of the width of the tissue. */
  get cameraHeight() {
    return visit ? stage.heightM / visit.extentM[0] : 0;
  },
  /** Width of the tissue, m. */
  get widthM() {
    return visit?.extentM[0] ?? 0;
  },
  /** The window point of the tissue at (x, y), in fractions of the sheet. */
  at(x: number, y: number): [number, number] | undefined {
    if (!visit) return undefined;
    const placeM = [x * visit.extentM[0], y * visit.extentM[1]] as const;
    const [dx, dy, dz] = visit.surface.displacementAtM(...placeM);
    return stage.inWindow([placeM[0] + dx, placeM[1] + dy, dz]);
  },
  pixelAfterPress: (x: number, y: number) => latency.next(x, y),
};
Object.assign(window, { palpate: inside });

const wireframe = part("wireframe", HTMLInputElement);
wireframe.checked = asked.get("wireframe") === "1";
stage.setWireframe(wireframe.checked);
const mode = asked.get("tool");
for (const choice of document.querySelectorAll<HTMLInputElement>("input[name=mode]")) {
  if (choice.value === mode) choice.checked = true;
}
void open(asked.get("session") ?? undefined, asked.get("scene") ?? undefined);
void lists();
