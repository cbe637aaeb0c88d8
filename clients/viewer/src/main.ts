// The page: connects the parts.
//
// It shows only what frames and samples say. A worker receives frames and returns credit (four in flight), so a page that
// draws slowly is not sent less. Positions and normals are computed once for each picture, for what is drawn; picking and
// figures use all vertices. Commands go in batches of one with at most two in flight, the newest place only; each push has a
// time to live, each lease four seconds. While a tool is held, another worker carries poses and samples by datagram, if it
// can. Without TLS a browser speaks HTTP/1.1 with six connections: hence one stream of frames, one of samples, and one
// acknowledgement at a time.

import type { MessageInitShape } from "@bufbuild/protobuf";
import type { CreateSessionRequestSchema, Session } from "./gen/palpate/v1/session_pb";
import { SessionState } from "./gen/palpate/v1/session_pb";
import type { Mode } from "./hand";
import { Input } from "./input";
import { Latency } from "./latency";
import { depthText, Overlay } from "./overlay";
import { asked, askedNumber, holderName, part, writeAddress } from "./page";
import { entryOf, keepPicture, pictureOf } from "./pictures";
import { Plots, quantity } from "./plot";
import { norm, type Vec3 } from "./samples";
import { playScript } from "./script";
import { backoffMs, describe, type Failure, isGone, PATIENCE_MS, reasonOf, received, sessions, sleep } from "./server";
import { Stage } from "./stage";
import { Sheet } from "./sheet";
import { Status } from "./status";
import { tissueTexture } from "./texture";
import { TissueValues } from "./tissue";
import { FileOpener } from "./upload";
import { Visit } from "./visit";

/** The scene of a new session, if the server has it and the address names no other. */
const DEFAULT_SCENE = "liver";

/** So long after its texture has come a tissue's picture is taken for the list. */
const PICTURE_MS = 1500;

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

/** What a new session is made of: that of the last one, if somebody wants another. */
type Source = NonNullable<MessageInitShape<typeof CreateSessionRequestSchema>["source"]>;
let made: Source = { case: "sceneName", value: DEFAULT_SCENE };

const named = (value: string | undefined): Source => ({ case: "sceneName", value: value || DEFAULT_SCENE });

/** Opens a session: an existing one, or a new one. */
async function open(sessionId: string | undefined, source: Source): Promise<void> {
  visit?.leave();
  visit = undefined;
  playing?.abort();
  made = source;
  for (let failures = 0; ; failures++) {
    try {
      const session = sessionId
        ? (await sessions.getSession({ sessionId }, { timeoutMs: PATIENCE_MS })).session
        : (await sessions.createSession({ source }, {})).session;
      if (!session) continue;
      const isNew = sessionId === undefined;
      // If what follows fails, the session is there all the same.
      sessionId = session.sessionId;
      return await show(session, isNew);
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
    void open(undefined, made);
  });
  part("notice", HTMLElement).append(again);
}

/** How many sessions were opened: of several that are asked for one after the other the last counts. */
let opening = 0;

async function show(session: Session, isNew: boolean): Promise<void> {
  writeAddress(session.sessionId, isNew && new URLSearchParams(location.search).has("session"));
  const wanted = (opening += 1);
  const next = await Visit.to(session, holder, askedNumber("refinement", 0, 10), {
    onSession: heard,
    onTrouble: trouble,
    onWell: () => visit === next && status.found(wellText(next.session)),
  });
  if (wanted !== opening) return;
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
  part("fineness", HTMLElement).hidden = next.mostRefinement === 0;
  tellControls();
  tissue.begin(session);
  mark(session.scene?.name ?? "");
  // Shaded by its shape at once; the texture comes when it is painted.
  stage.show(next.surface, false);
  stage.setTools([], 1);
  part("arriving", HTMLElement).hidden = true;
  next.begin();
  if (document.hidden) next.lookAway();
  const texture = await tissueTexture(session.sessionId);
  if (visit !== next) texture?.dispose();
  else if (texture) stage.setTexture(texture);
  setTimeout(() => visit === next && takePicture(next), PICTURE_MS);
}

/** Takes a picture of a scene that has none in the list, if nobody has touched it or turned the view. */
function takePicture(of: Visit): void {
  const scene = of.session.scene?.name ?? "";
  const entry = [...part("scene", HTMLSelectElement).options].find(({ value, disabled }) => value === scene && !disabled);
  if (!entry || pictureOf(scene) || document.hidden || of.samples.history.length > 0 || !stage.isAtHome) return;
  stage.snap((drawn) => keepPicture(scene, drawn));
  const { selected } = entry;
  const pictured = entryOf(scene);
  entry.replaceWith(pictured);
  pictured.selected = selected;
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
  const { surface, hand, reach } = of;
  const shown = of.samples.tools.flatMap((tool) => {
    const found = surface.ofTool(tool);
    if (!found) return [];
    // The own hand knows which side it touches.
    const isMine = tool.tool === 0 && hand.holds;
    const place = isMine && hand.outward ? { ...found, outward: sameSide(found.outward, hand.outward) } : found;
    return [{ place, forceN: tool.forceN }];
  });
  stage.setTools(shown, reach.pointN);
}

/** A direction or its opposite: that which is more like another. */
function sameSide([x, y, z]: Vec3, [ox, oy, oz]: Vec3): Vec3 {
  return x * ox + y * oy + z * oz < 0 ? [-x, -y, -z] : [x, y, z];
}

/** What the strength is of the present tool. */
function strengthText({ hand: { mode, strength }, reach }: Visit): string {
  if (mode === "pull") return "as you drag";
  return mode === "tip" ? quantity(strength * reach.depthM, "m") : quantity(strength * reach.mostN, "N");
}

function tellControls(): void {
  if (!visit) return;
  const text = strengthText(visit);
  part("strength-value", HTMLOutputElement).value = text;
  part("strength", HTMLInputElement).setAttribute("aria-valuetext", text);
  part("refinement-value", HTMLOutputElement).value = String(visit.refinement);
  part("meaning", HTMLElement).textContent = meaningText(visit);
}

function meaningText({ hand, reach, surface }: Visit): string {
  const range = quantity(reach.lengthM, "m");
  if (hand.mode === "tip") {
    return `The tip is a disc of ${range} radius. Strength is its depth below the tissue at rest; what pushes back follows from that.`;
  }
  return surface.flank
    ? "Strength is the push in the middle of the tool. It fades out over about " +
      `${range}. What pushes back is the mean over the tissue around, weighted as the push is. The push is strongest in the ` +
      "middle, so that mean is less than the strength while nothing moves. While the tissue moves it may be more."
    : `Strength is the whole push of the tool. It fades out over about ${range}. What pushes back is told for all the tissue ` +
      "that the push meets: as much as the strength while nothing moves, more or less while the tissue moves.";
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
  stage.show(surface, true);
  tellControls();
});
part("scene", HTMLSelectElement).addEventListener("change", (event) => {
  void open(undefined, named((event.target as HTMLSelectElement).value));
});
part("share", HTMLButtonElement).addEventListener("click", () => {
  // Browsers offer the clipboard only to pages from a secure origin or from this machine.
  const failed = () => notice("The link could not be copied. Copy the address of this page instead.");
  if (!isSecureContext) return failed();
  const copied = () => notice("Link copied. Anyone who opens it sees this session.");
  void navigator.clipboard.writeText(location.href).then(copied, failed);
});
part("play", HTMLButtonElement).addEventListener("click", () => void play());
new FileOpener((session, scene) => {
  visit?.leave();
  visit = undefined;
  playing?.abort();
  made = { case: "scene", value: scene };
  show(session, true).catch((error: unknown) => over(`${describe(error)}.`));
});

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
  if (of === warnedIn || of.surface.largestM() <= Math.max(of.surface.sizeM, of.reach.lengthM)) return;
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
  if (sessionId !== visit?.session.sessionId) void open(sessionId, made);
});

// Ten times a second for values read as they change, once a second for figures.
setInterval(() => {
  if (!visit || document.hidden) return;
  const { samples, reach } = visit;
  plots.draw(samples.history, samples.newest?.simulationTimeS ?? 0, 0.4 * reach.lengthM, 0.1 * reach.mostN);
  const tool = samples.tools[0];
  const told = tool && samples.tell(tool);
  overlay.tell(told);
  part("felt", HTMLElement).textContent = told
    ? `${depthText(told)}, pushes back ${quantity(told.allN, "N")}`
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
    way: wayText(visit),
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
      part("scripts", HTMLElement).hidden = scriptNames.length === 0;
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
      part("scene", HTMLSelectElement).replaceChildren(...sceneNames.map(entryOf));
      mark(visit?.session.scene?.name ?? asked.get("scene") ?? DEFAULT_SCENE);
      return;
    } catch {
      await sleep(backoffMs(failures));
    }
  }
}

/** Selects a scene in the list; one that the server does not have, such as a file of one's own, joins the list. */
function mark(scene: string): void {
  const list = part("scene", HTMLSelectElement);
  for (const option of [...list.options]) if (option.disabled) option.remove();
  list.value = scene;
  if (list.value === scene) return;
  const own = new Option(scene, scene);
  own.disabled = true;
  list.add(own);
  list.value = scene;
}

/** Datagrams belong to a lease. */
function wayText({ hand }: Visit): string {
  if (!hand.holds) return "no tool is held";
  return hand.datagrams.carries ? "datagrams" : "gRPC-web";
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
  /** Whether datagrams get through, and how many were sent and came in this session; poses and samples in them. */
  get datagrams() {
    const { carries, counts } = visit?.hand.datagrams ?? {};
    return { carries: carries ?? false, sent: 0, came: 0, poses: 0, samples: 0, fellBack: 0, ...counts };
  },
  /** The least room between a tool and the tissue as drawn, of the width of the tissue; undefined without a tool. */
  get clear() {
    const { clearM } = stage;
    return clearM === undefined || !visit ? undefined : clearM / visit.widthM;
  },
  /** Whether the first picture of the tissue was drawn, and had a texture; and whether it has one now. */
  get drawing() {
    return { ...stage.began, hasTexture: stage.isTextured };
  },
  /** The camera's height above the table and the tissue beneath it, of the width of the tissue. */
  get cameraHeight() {
    return visit ? stage.heightM / visit.widthM : 0;
  },
  /** Width of the tissue, m. */
  get widthM() {
    return visit?.widthM ?? 0;
  },
  /** The window point of the tissue at (x, y): in fractions of a sheet; of a body near there in the picture. */
  at(x: number, y: number): [number, number] | undefined {
    if (!visit) return undefined;
    const { surface } = visit;
    const place = surface instanceof Sheet ? surface.placeAt(x, y) : stage.pickNear(x, 1 - y);
    return place && stage.placeInWindow(place);
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
void open(asked.get("session") ?? undefined, named(asked.get("scene") ?? undefined));
void lists();
