// The page: connects the parts.
//
// It shows only data from frames and samples. A worker receives frames and acknowledges them (four in flight), so a
// page that draws slowly still gets all of them. Positions and normals are computed once for each picture, for the
// vertices that are drawn; picking and figures use all vertices. Commands are sent in batches of one with at most two
// in flight, always the newest position; each push has a time to live, and each lease lasts four seconds. While a
// tool is held, another worker carries poses and samples by datagram, if possible. Without TLS a browser speaks
// HTTP/1.1 with six connections: hence one stream of frames, one of samples, and one acknowledgement at a time.

import { create as message, type MessageInitShape } from "@bufbuild/protobuf";
import { norm, type Vec3 } from "palpate";
import { type CreateSessionRequestSchema, SceneSchema, type Session, SessionState } from "palpate/v1";
import { Choices } from "./choices";
import { Comparison } from "./comparison";
import { ExercisePanel } from "./exercise";
import type { Mode } from "./hand";
import { HAND_NAMES, type Hands } from "./hands";
import { Input } from "./input";
import type { JournalName } from "./journal";
import { Latency } from "./latency";
import { Lumps } from "./lumps";
import { cutText, feltText, isDeep, isLess, meaningText, refusedText, sentence, strengthText, undoText, wayText, wellText } from "./messages";
import { Overlay, type ToolLabel } from "./overlay";
import { addressed, asked, askedNumber, holderName, part, seekAt, withSession, writeAddress, writeMoment } from "./page";
import { pageState } from "./page-state";
import { keepPicture } from "./pictures";
import { BACK_S, discard, type Opened, Player } from "./player";
import { Plots } from "./plot";
import { playScript } from "./script";
import { backoffMs, describe, type Failure, isGone, isPassing, CALL_TIMEOUT_MS, reasonOf, server, sessions, sleep } from "./server";
import { Sewing, sews } from "./sewing";
import { Stage } from "./stage";
import { Status } from "./status";
import { excerpt } from "./text";
import { tissueTexture } from "./texture";
import { TissueValues } from "./tissue";
import { TokenForm } from "./token-form";
import { FileOpener } from "./upload";
import { ShownSession } from "./session";

/**
 * A session is deleted after this time without a request, because its pages are closed. Browsers let a hidden page
 * send a request once a minute.
 */
const IDLE_S = 180;

/** Delay from the arrival of a tissue's texture until its picture for the list is taken. */
const PICTURE_MS = 1500;

/**
 * If the newest samples are newer than the newest frame by this time, nothing moves: frames come 60 times a second.
 */
const STILL_S = 0.25;

/** Maximum number of scripts in the list. */
const MAX_SCRIPTS = 1000;

/** Maximum number of warnings, and of tool holders, that are shown. */
const MAX_TOLD = 16;

/**
 * A server of a fleet that has not answered for this time may be gone: another one takes its sessions over within 4
 * s.
 */
const GONE_MS = 3000;

const canvas = part("tissue", HTMLCanvasElement);
const stage = new Stage(canvas, asked.get("quality") === "high");
const overlay = new Overlay(stage);
const latency = new Latency(stage);
const status = new Status(
  part("light", HTMLElement),
  part("connection", HTMLElement),
  part("figures", HTMLElement),
  part("details", HTMLButtonElement),
  part("try-now", HTMLButtonElement),
);
const tokenForm = new TokenForm(() => {
  status.say("Connecting …");
  part("arriving", HTMLElement).hidden = false;
  void open(refused);
  void choices.fill();
});
const plots = new Plots(part("plot-displacement", HTMLCanvasElement), part("plot-force", HTMLCanvasElement));
const tissue = new TissueValues(heard, notice);
part("try-now", HTMLButtonElement).addEventListener("click", () => tryNow());
addEventListener("online", () => tryNow());
const holder = holderName();
let shownSession: ShownSession | undefined;
let playing: AbortController | undefined;

const choices = new Choices((choice) => {
  if (choice.kind === "scene") void open({ source: named(choice.scene), isNew: true });
  else if (choice.kind === "exercise") void open({ source: forExercise(choice.exercise), isNew: true });
  else if (choice.kind === "live") void open({ sessionId: choice.sessionId, isNew: true });
  else void open({ moment: choice, isNew: true });
});
const player = new Player({
  present: () => shownSession,
  exchange: (session, step) => show(session, { keeps: true, step }),
  goLive: async (session) => {
    if (await show(session, { keeps: true, isNew: true })) canvas.focus({ preventScroll: true });
  },
  notice,
  over,
});

// A recording can only be watched.
const input = new Input(canvas, stage, latency, () => (shownSession?.session.playback ? undefined : shownSession));
input.onPoint = (place) => overlay.point(place, shownSession?.reach.lengthM);

const sewing = new Sewing(stage, { present: () => shownSession, onChange: () => {} });
input.sewing = sewing;

const lumps = new Lumps(stage, input, {
  present: () => shownSession,
  scene: () => (made?.case === "scene" && !shownSession?.session.playback ? message(SceneSchema, made.value) : undefined),
  exchange: async (scene) => {
    const of = shownSession;
    const source: Source = { case: "scene", value: scene };
    const { session } = await sessions.createSession({ source, idleTimeoutS: IDLE_S }, { timeoutMs: CALL_TIMEOUT_MS });
    if (!of || !session || shownSession !== of) return;
    made = source;
    await show(session, { isNew: true, keeps: true });
    discard(of.session);
  },
  notice,
});

const exercise = new ExercisePanel(stage, input, {
  present: () => shownSession,
  again: () => {
    const name = shownSession?.session.exercise?.exercise?.name;
    if (name !== undefined) void open({ source: forExercise(name), isNew: true });
  },
  reveal: (hidden) => lumps.reveal(hidden),
  share: (traineeId) => copy(withSession(traineeId), "Link copied. Who opens it does the exercise, and gets nothing that it hides."),
  notice,
});

let noticed: ReturnType<typeof setTimeout> | undefined;
/** Shows a message for `seconds`; permanently if 0. */
function notice(text: string, seconds = 5): void {
  const line = part("notice", HTMLElement);
  clearTimeout(noticed);
  line.textContent = excerpt(text);
  line.hidden = text === "";
  if (seconds > 0) noticed = setTimeout(() => (line.hidden = true), 1000 * seconds);
}

/** What a new session is created from: the source of the last one, if the user wants another. */
type Source = NonNullable<MessageInitShape<typeof CreateSessionRequestSchema>["source"]>;
let made: Source | undefined;

const named = (value: string): Source => ({ case: "sceneName", value });
const forExercise = (value: string): Source => ({ case: "exercise", value: { source: { case: "name", value } } });

/**
 * What to open: an existing session, a new one, or a recording from a step on. `isNew`: the user chose it on this
 * page.
 */
type Target = { isNew?: boolean } & ({ sessionId: string } | { source?: Source } | { moment: JournalName & { step?: number } });
/** The last target. */
let refused: Target = {};
/** Ends the wait for the next attempt to open a target. */
let hurry = new AbortController();

/** How often the shown session was left. If this changes, a pending request to show something is obsolete. */
let left = 0;
/** Leaves the shown session. */
function leave(): void {
  left += 1;
  shownSession?.leave();
  shownSession = undefined;
  playing?.abort();
  player.close();
}

/** Opens a session. */
async function open(target: Target): Promise<void> {
  leave();
  const begun = left;
  if ("source" in target && target.source) made = target.source;
  refused = target;
  const moment = "moment" in target ? target.moment : undefined;
  let sessionId = "sessionId" in target ? target.sessionId : undefined;
  for (let failures = 0; begun === left; failures++) {
    try {
      if (moment) {
        const opened = await player.begin(moment, (of) => moment.step ?? of.begin);
        if (begun === left) await showOpened(opened, { isNew: target.isNew });
        else discard(opened.session);
        return;
      }
      const session = sessionId
        ? (await sessions.getSession({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS })).session
        : await create((made ??= named(await choices.first())));
      if (!session) throw new RangeError("it tells of no session");
      // Playback of another window: this window gets its own.
      if (session.playback) return await open({ moment: { ...session.playback, step: Number(session.step) } });
      const isNew = target.isNew ?? sessionId === undefined;
      // Even if the next steps fail, the session exists.
      sessionId = session.sessionId;
      if (begun === left) await show(session, { isNew });
      return;
    } catch (error) {
      if (begun !== left) return;
      if (isGone(error)) return over(moment ? "There is no such recording." : "This session no longer exists.");
      if (tokenForm.stops(error)) return status.end("barred", "");
      if (error instanceof RangeError) return over(`What the server says can't be shown: ${error.message}.`);
      if (!isPassing(error)) return over(`${sentence(describe(error))}.`);
      const waitMs = backoffMs(failures);
      status.lose(waitMs);
      // A busy server reports that itself.
      if (reasonOf(error) !== "") notice(`${sentence(describe(error))}.`, waitMs / 1000);
      hurry = new AbortController();
      await sleep(waitMs, hurry.signal);
    }
  }
}

/** Creates a session. Who chooses an exercise does it: the page goes on with the trainee's ID. */
async function create(source: Source): Promise<Session | undefined> {
  const isExercise = source.case === "exercise";
  const { session } = await sessions.createSession({ source, paused: isExercise, idleTimeoutS: IDLE_S }, {});
  const traineeId = session?.exercise?.traineeId;
  if (!traineeId) return session;
  return (await sessions.getSession({ sessionId: traineeId }, { timeoutMs: CALL_TIMEOUT_MS })).session;
}

/** Asks at once whether a lost server is back. */
function tryNow(): void {
  hurry.abort();
  shownSession?.askNow();
}

/** The server no longer permits this caller an action. */
function barred(reason: string): void {
  // With another token, the page returns to the same session.
  if (shownSession && !shownSession.session.playback) refused = { sessionId: shownSession.session.sessionId };
  leave();
  status.end("barred", "");
  tokenForm.show(reason);
}

/** A session has ended. The user decides what to do. */
function over(why: string): void {
  leave();
  part("what-was-that", HTMLButtonElement).hidden = true;
  part("arriving", HTMLElement).hidden = true;
  document.body.classList.toggle("empty", showing === 0);
  status.end("ended", "");
  notice(`${why} `, 0);
  const again = document.createElement("button");
  again.textContent = "Start a new session";
  again.addEventListener("click", () => {
    notice("", 0);
    void open({ source: made, isNew: true });
  });
  part("notice", HTMLElement).append(again);
}

/** Number of sessions that were opened: if several are requested in a row, the last one counts. */
let opening = 0;
/** Number of tissues that were shown so far. */
let showing = 0;

/** How a session is shown. */
interface Showing {
  /** Whether to keep the previous address of the page in the history. */
  isNew?: boolean;
  /** Replaces the present session, which has the same tissue: surface, camera and texture are kept. */
  keeps?: boolean;
  /** The step from which the recording is played. */
  step?: number;
}

/** Shows a playback that was just created. */
async function showOpened(opened: Opened, how: Showing): Promise<void> {
  if (await show(opened.session, { ...how, step: opened.step })) player.attach(opened);
  else discard(opened.session);
}

/** Shows a session. Returns false if another one was requested meanwhile. */
async function show(session: Session, { isNew = false, keeps = false, step }: Showing): Promise<boolean> {
  const isPlayback = session.playback !== undefined;
  const wanted = (opening += 1);
  const former = keeps ? shownSession : undefined;
  const told = {
    onSession: heard,
    onTrouble: (failure: Failure, waitMs: number) => shownSession === next && trouble(failure, waitMs),
    onWell: () => shownSession === next && status.found(wellText(next.session)),
    onBarred: (reason: string) => shownSession === next && barred(reason),
    onFrame: () => stage.drawFrame(),
    onCut: () => shownSession === next && stage.draw(),
  };
  const next = await ShownSession.to(session, holder, askedNumber("refinement", 0, 10), told, former);
  if (wanted !== opening) return false;
  const before = shownSession?.session;
  shownSession?.leave();
  shownSession = next;
  if (session.playback) writeMoment(session.playback, step ?? Number(session.step), isNew);
  else writeAddress(session.sessionId, isNew && new URLSearchParams(location.search).size > 0);
  if (!isPlayback) player.close();
  if (!isPlayback) void listScripts(session.sessionId);
  part("view", HTMLElement).classList.toggle("plays", isPlayback);
  for (const id of ["tool", "tissue-values"]) part(id, HTMLFieldSetElement).disabled = isPlayback;
  part("scripts", HTMLElement).hidden ||= isPlayback;
  if (formerHands) next.hands.follow(formerHands);
  else chooseTools(next.hands);
  formerHands = next.hands;
  next.hands.onChoice = tellControls;
  for (const hand of next.hands.both) {
    hand.onRefused = (message, reason) => notice(refusedText(message, reason, next, hand));
    hand.onChange = () => shownSession === next && holding();
    hand.onJaws = tellJaws;
  }
  next.samples.onSample = () => felt(next);
  const slider = part("refinement", HTMLInputElement);
  slider.max = String(next.mostRefinement);
  slider.value = String(next.refinement);
  const isFine = next.mostRefinement > 0;
  for (const id of ["fineness", "fineness-term", "fineness-meaning"]) part(id, HTMLElement).hidden = !isFine;
  part("look-explained", HTMLElement).textContent = isFine ? "What are net and fineness?" : "What is the net?";
  tellControls();
  sewing.begin();
  tissue.begin(session);
  const name = session.scene?.name ?? "";
  const of = session.exercise?.exercise;
  if (session.playback) choices.markRecorded(session.playback, name);
  else if (of) choices.markExercise(of.name, of.title, session.sessionId);
  else choices.markScene(name, session.sessionId);
  if (!former) {
    showing += 1;
    if (isPlayback) player.makeRoom();
    // Shows the shape at once; the texture follows when it is ready.
    stage.show(next.surface, false, player.heightPx);
    stage.setTools([]);
    overlay.point();
  }
  lumps.show(session);
  exercise.show(next);
  part("arriving", HTMLElement).hidden = true;
  document.body.classList.remove("empty");
  // Data of the previous session is no longer valid.
  if (before?.sessionId !== session.sessionId) {
    heard(session);
    // The server's warnings about the scene: what was done with its mesh, and what is doubtful.
    if (session.warnings.length > 0) notice(session.warnings.slice(0, MAX_TOLD).join(" "), 15);
  }
  next.begin();
  if (document.hidden) next.lookAway();
  if (!former || !stage.isTextured) void dress(session.sessionId);
  if (!isPlayback && !former) setTimeout(() => shownSession === next && takePicture(next), PICTURE_MS);
  return true;
}

/** Applies the session's texture to the tissue, if the session is still shown when it arrives. */
async function dress(sessionId: string): Promise<void> {
  const shown = showing;
  const texture = await tissueTexture(sessionId);
  if (shown !== showing) texture?.dispose();
  else if (texture) stage.setTexture(texture);
}

/** Plays the last seconds of the shown session. */
async function whatWasThat(): Promise<void> {
  const of = shownSession;
  const run = of?.session.journal?.run;
  if (!of || run === undefined) return;
  const button = part("what-was-that", HTMLButtonElement);
  button.disabled = true;
  try {
    void of.hands.letGo();
    const { sessionId } = of.session;
    const opened = await player.begin({ sessionId, run }, (recording) => recording.after(recording.end, -BACK_S));
    if (shownSession !== of) return discard(opened.session);
    await showOpened(opened, { keeps: true, isNew: true });
    player.focus();
  } catch (error) {
    notice(`The last ten seconds can't be shown: ${describe(error)}.`);
  } finally {
    button.disabled = false;
  }
}

/** Offers to undo the last cut, or says why that is not possible. */
function tellUndo(of: ShownSession): void {
  const button = part("undo-cut", HTMLButtonElement);
  const why = undoText(of);
  button.hidden = of.session.severed === 0 || of.session.playback !== undefined;
  button.disabled = why !== "";
  button.title = why || "A new session that goes on from before the last cut. Others stay in this one.";
}

/** Goes on in a new session from the moment before the last cut. */
async function undoCut(): Promise<void> {
  const of = shownSession;
  const before = of?.beforeCuts.at(-1);
  if (!of || !before) return;
  part("undo-cut", HTMLButtonElement).disabled = true;
  try {
    await of.hands.letGo();
    const { session } = await sessions.createSession({ source: { case: "journal", value: before }, idleTimeoutS: IDLE_S }, { timeoutMs: CALL_TIMEOUT_MS });
    if (!session) throw new RangeError("the server made no session");
    if (shownSession !== of) return discard(session);
    of.beforeCuts.pop();
    await show(session, { isNew: true, keeps: true });
  } catch (error) {
    notice(`The cut can't be undone: ${describe(error)}.`);
  }
}

/** Takes a picture of a scene that has none in the list, unless the user has touched it or turned the view. */
function takePicture(of: ShownSession): void {
  const scene = of.session.scene?.name ?? "";
  const entry = choices.withoutPicture(scene);
  if (!entry || document.hidden || of.samples.history.length > 0 || !stage.isAtHome) return;
  stage.snap((drawn) => keepPicture(scene, drawn));
  choices.refresh(entry);
}

/** Pending search for another server of the fleet. */
let seeking: Promise<void> | undefined;

function trouble(failure: Failure, waitMs: number): void {
  if (failure.isGone && player.isOpen) return player.revive();
  if (failure.isGone) return over("The session has ended.");
  status.lose(waitMs);
  const { session, heardMs } = shownSession ?? {};
  if (!session?.ownership || session.playback || performance.now() - (heardMs ?? Infinity) < GONE_MS) return;
  seeking ??= seekAt(session.ownership.others, session.sessionId).finally(() => (seeking = undefined));
}

/** Handles a new status of the session. */
function heard(session: Session): void {
  if (session.sessionId !== shownSession?.session.sessionId) return;
  shownSession.session = session;
  player.heard(session);
  lumps.heard(session);
  tissue.show(session);
  part("what-was-that", HTMLButtonElement).hidden = session.journal?.durableStep === undefined;
  tellUndo(shownSession);
  exercise.heard();
  sewing.tell();
  warnIfExhausted(shownSession);
  holding();
}

function holding(): void {
  if (!shownSession) return;
  if (shownSession.session.playback) {
    part("holder", HTMLElement).textContent = "Recorded: to touch it, go on from here";
    return;
  }
  const { hands } = shownSession;
  const mine = hands.both.filter(({ holds }) => holds);
  // Somebody who holds the tool may hold more for a grasper.
  const { heldTools } = shownSession.session;
  const isFirst = (holder: string, index: number) => holder === "" || heldTools.findIndex((tool) => tool.holder === holder) === index;
  const others = heldTools.filter(({ tool, holder }, index) => !hands.of(tool) && isFirst(holder, index));
  const names = others.slice(0, MAX_TOLD).map((tool) => `${tool.holder || "Somebody"} holds ${tool.tool === 0 ? "the tool" : `tool ${tool.tool}`}`);
  const whose = excerpt(names.join(", "));
  const own = `You (${holder}) hold ${mine.length > 1 ? "two tools" : "the tool"}`;
  part("holder", HTMLElement).textContent = mine.length > 0 ? own : whose || "Nobody touches: press to begin";
  tellHands();
}

/** Shows the tools and the forces on them. */
function felt(of: ShownSession): void {
  if (of !== shownSession) return;
  const { hands, reach, samples } = of;
  const shown = samples.tools.flatMap((tool) => {
    const place = of.placeOf(tool);
    if (!place) return [];
    const hand = of.handOf(tool);
    if (hand?.grasps || hand?.blade) return [];
    const strength = hand ? samples.tell(tool).allN / reach.mostN : norm(tool.forceN) / reach.pointN;
    return [{ tool: tool.tool, place, forceN: tool.forceN, part: strength }];
  });
  const graspers = hands.both.flatMap(({ grasps, grasper }) => {
    const forceN: Vec3 = samples.tools.find(({ tool }) => tool === grasper.tool.tool)?.forceN ?? [0, 0, 0];
    return (grasps && grasper.shown(forceN, norm(forceN) / reach.mostN)) || [];
  });
  stage.setTools(shown, graspers, hands.both.flatMap(({ blade }) => blade ?? []));
}

/** Returns what to write beside the tools of this page's hands; if there are none, beside the first tool. */
function labels({ hands, samples }: ShownSession): ToolLabel[] {
  const own = hands.both.flatMap((hand, number) => {
    const tool = hand.holds ? samples.tools.find((each) => each.tool === hand.tool.tool) : undefined;
    if (!tool) return [];
    const title = hands.isTwo ? `${HAND_NAMES[number]!}${hand.isParked ? ", parked" : ""}` : "";
    return [{ tool: tool.tool, told: samples.tell(tool), title }];
  });
  const [first] = samples.tools;
  return own.length === 0 && first ? [{ tool: first.tool, told: samples.tell(first), title: "" }] : own;
}

function tellControls(): void {
  if (!shownSession) return;
  const text = strengthText(shownSession);
  part("strength-name", HTMLElement).textContent = isDeep(shownSession.hand.mode) ? "Depth" : "Strength";
  part("strength-value", HTMLOutputElement).value = text;
  part("strength", HTMLInputElement).setAttribute("aria-valuetext", text);
  part("refinement-value", HTMLOutputElement).value = String(shownSession.refinement);
  part("meaning", HTMLElement).textContent = meaningText(shownSession);
  for (const choice of modeChoices()) choice.checked = choice.value === shownSession.hand.mode;
  part("strength", HTMLInputElement).value = String(shownSession.hand.strength);
  part("strength-part", HTMLElement).hidden = sews(shownSession.hand.mode);
  part("view", HTMLElement).classList.toggle("sews", sews(shownSession.hand.mode));
  tellJaws();
  tellHands();
}

/** Shows which hand the controls set, and whether its tool stays where it is. */
function tellHands(): void {
  if (!shownSession) return;
  const { hands, hand } = shownSession;
  part("two-hands", HTMLInputElement).checked = hands.isTwo;
  part("hands", HTMLElement).hidden = !hands.isTwo;
  part("view", HTMLElement).classList.toggle("two", hands.isTwo);
  for (const choice of handChoices()) choice.checked = Number(choice.value) === hands.number;
  hands.both.forEach(({ isParked }, number) => {
    part(`hand-${number}`, HTMLElement).textContent = `${HAND_NAMES[number]!}${isParked ? ", parked" : ""}`;
  });
  part("release", HTMLButtonElement).disabled = !hand.holds;
  for (const id of ["park", "park-here"]) {
    const button = part(id, HTMLButtonElement);
    button.disabled = !hand.touches;
    button.setAttribute("aria-pressed", String(hand.isParked));
  }
}

function tellJaws(): void {
  if (!shownSession) return;
  const { hand } = shownSession;
  part("jaws-part", HTMLElement).hidden = hand.mode !== "grasper";
  part("view", HTMLElement).classList.toggle("grasps", hand.mode === "grasper");
  part("jaws", HTMLInputElement).value = String(hand.grasper.opening);
  part("jaws-value", HTMLOutputElement).value = hand.grasper.openingText;
  const button = part("jaws-here", HTMLButtonElement);
  button.hidden = hand.mode !== "grasper";
  button.textContent = hand.grasper.grips ? "Open jaws" : "Close jaws";
}

const modeChoices = () => document.querySelectorAll<HTMLInputElement>("input[name=mode]");
const handChoices = () => document.querySelectorAll<HTMLInputElement>("input[name=hand]");

function chosenMode(): Mode {
  return ([...modeChoices()].find(({ checked }) => checked)?.value ?? "push") as Mode;
}

/** The hands of the session that was shown last. */
let formerHands: Hands | undefined;
/** Sets the tools of the first session's hands: by the address, or by the controls. */
function chooseTools(hands: Hands): void {
  const [first, second] = (asked.get("tool") ?? "").split(",");
  const isMode = (mode: string | undefined): mode is Mode => [...modeChoices()].some(({ value }) => value === mode);
  const [hand, other] = hands.both;
  hand.mode = isMode(first) ? first : chosenMode();
  hand.strength = Number(part("strength", HTMLInputElement).value);
  if (!isMode(second)) return;
  hands.isTwo = true;
  other.mode = second;
}

part("mode", HTMLElement).addEventListener("change", () => {
  if (!shownSession) return;
  shownSession.hand.mode = chosenMode();
  tellControls();
  if (!sewing.drop()) sewing.tell();
});
part("strength", HTMLInputElement).addEventListener("input", (event) => {
  if (shownSession) shownSession.hand.strength = Number((event.target as HTMLInputElement).value);
  tellControls();
});
part("jaws", HTMLInputElement).addEventListener("input", (event) => {
  input.moveJaws(Number((event.target as HTMLInputElement).value));
});
part("release", HTMLButtonElement).addEventListener("click", () => void shownSession?.hand.letGo());
part("two-hands", HTMLInputElement).addEventListener("change", (event) => {
  if (shownSession) shownSession.hands.isTwo = (event.target as HTMLInputElement).checked;
});
part("hands", HTMLElement).addEventListener("change", (event) => {
  shownSession?.hands.choose(Number((event.target as HTMLInputElement).value) === 1 ? 1 : 0);
});
part("park", HTMLButtonElement).addEventListener("click", () => input.park());
onTap("park-here", () => input.park());
onTap("jaws-here", () => input.turnJaws());

/** Calls `act` for a button that a finger may tap while others touch the tissue: browsers make no click of that. */
function onTap(id: string, act: () => void): void {
  const button = part(id, HTMLButtonElement);
  button.addEventListener("click", act);
  button.addEventListener("touchstart", (event) => {
    // Of a single finger there would be a click as well.
    if (event.cancelable) event.preventDefault();
    if (!button.disabled) act();
  });
}
part("wireframe", HTMLInputElement).addEventListener("change", (event) => {
  stage.setWireframe((event.target as HTMLInputElement).checked);
});
part("refinement", HTMLInputElement).addEventListener("input", (event) => {
  if (!shownSession) return;
  const surface = shownSession.refine(Number((event.target as HTMLInputElement).value));
  stage.show(surface, true);
  tellControls();
  sewing.tell();
});
part("what-was-that", HTMLButtonElement).addEventListener("click", () => void whatWasThat());
part("undo-cut", HTMLButtonElement).addEventListener("click", () => void undoCut());
part("reset-view", HTMLButtonElement).addEventListener("click", () => stage.resetView());
const fullScreen = part("full-screen", HTMLButtonElement);
fullScreen.hidden = !document.fullscreenEnabled;
fullScreen.addEventListener("click", () => {
  if (document.fullscreenElement) void document.exitFullscreen();
  else part("view", HTMLElement).requestFullscreen().catch(() => notice("This browser has no full screen for pages."));
});
document.addEventListener("fullscreenchange", () => {
  fullScreen.textContent = document.fullscreenElement ? "Leave full screen" : "Full screen";
});
part("share", HTMLButtonElement).addEventListener("click", () => {
  if (player.moment) writeMoment(player.moment, player.moment.step, false);
  copy(location.href, `Link copied. Anyone who opens it sees this ${player.isOpen ? "recording" : "session"}.`);
});

/** Copies a link. Browsers offer the clipboard only to pages from a secure origin or from this machine. */
function copy(link: string, done: string): void {
  const failed = () => notice(link === location.href ? "The link could not be copied. Copy the address of this page instead." : link, 0);
  if (!isSecureContext) return failed();
  void navigator.clipboard.writeText(link).then(() => notice(done), failed);
}
part("play", HTMLButtonElement).addEventListener("click", () => void play());
const comparison = new Comparison(() => shownSession?.session.sessionId);
new FileOpener(
  (session, scene) => {
    leave();
    made = { case: "scene", value: scene };
    show(session, { isNew: true }).catch((error: unknown) => over(`${describe(error)}.`));
  },
  (file) => void comparison.take(file),
);

async function play(): Promise<void> {
  const button = part("play", HTMLButtonElement);
  if (playing) return playing.abort();
  if (!shownSession) return;
  const own = (playing = new AbortController());
  const { sessionId } = shownSession.session;
  button.textContent = "Stop";
  try {
    // A script takes the tools itself.
    await shownSession.hands.letGo();
    const name = part("script", HTMLSelectElement).value;
    const warnings = await playScript(sessionId, name, shownSession.rateHz, `${holder}, ${name}`, own.signal, (done) => {
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

/** The session in which the user was warned. */
let warnedIn: ShownSession | undefined;
/** Warns once if the tissue moved farther than its own length: a unit is then probably wrong. */
function warnIfFar(of: ShownSession): void {
  if (of === warnedIn || of.surface.largestM() <= Math.max(of.surface.sizeM, of.reach.lengthM)) return;
  warnedIn = of;
  notice("The tissue moved farther than its longest side. Look at the forces and the stiffness: a unit may be wrong.", 15);
}

/** The session in which the user was told that there is no room for further cuts. */
let exhaustedIn: ShownSession | undefined;
function warnIfExhausted(of: ShownSession): void {
  if (of === exhaustedIn || !of.session.cutsExhausted || of.session.severed === 0) return;
  exhaustedIn = of;
  notice("This solid has no room for further cuts: from now on a blade only pushes, and a cautery severs nothing.", 15);
}

stage.onDrawn = () => {
  latency.drawn();
  overlay.drawn();
  part("reset-view", HTMLButtonElement).hidden = stage.isAtHome;
};

// A hidden window releases its connections for visible ones.
document.addEventListener("visibilitychange", () => {
  player.look(!document.hidden);
  if (document.hidden) {
    shownSession?.lookAway();
    // Timers of a hidden window are too rare to lead a tool.
    void shownSession?.hands.letGo();
  } else shownSession?.look();
});
addEventListener("pagehide", () => {
  server.leave();
  void shownSession?.hands.letGo();
  player.close();
});
// A page restored from the browser's cache no longer has a session of its own.
addEventListener("pageshow", ({ persisted }) => persisted && location.reload());
addEventListener("popstate", () => {
  const { sessionId, moment } = addressed();
  if (moment) void open({ moment });
  else if (sessionId === undefined) void open({});
  else if (sessionId !== shownSession?.session.sessionId) void open({ sessionId });
});

// Ten times a second for values that the user follows as they change, once a second for figures.
setInterval(() => {
  if (!shownSession || document.hidden) return;
  const { samples, reach } = shownSession;
  plots.draw(samples.history, samples.newest?.simulationTimeS ?? 0, 0.4 * reach.lengthM, 0.1 * reach.mostN);
  const tool = samples.tools[0];
  const told = tool && samples.tell(tool);
  const labelled = labels(shownSession);
  overlay.tell(labelled);
  part("felt", HTMLElement).textContent = feltText(shownSession, labelled);
  tellHands();
  part("why", HTMLElement).classList.toggle("none", !isLess(shownSession, told));
}, 100);
setInterval(() => {
  status.count();
  if (!shownSession || document.hidden) return;
  warnIfFar(shownSession);
  const { session, samples, frames } = shownSession;
  const { newest } = samples;
  const audited = session.audit?.newestError;
  status.show({
    roundTripMs: shownSession.roundTripMs,
    networkMs: (shownSession.hands.holding ?? shownSession.hand).tool.networkMs,
    way: wayText(shownSession),
    frameAgeMs: shownSession.frameAgeMs,
    isStill: isStill(shownSession),
    silentMs: performance.now() - shownSession.heardMs,
    framesTaken: frames.taken,
    framesDrawn: stage.drawn,
    framesSkipped: frames.skipped,
    picture: stage.describe(),
    speed: shownSession.speed,
    overruns: newest?.overrunCount ?? session.overrunCount,
    dilation: newest?.timeDilation ?? session.timeDilation,
    awakePoints: newest?.awakePoints,
    isAsleep: newest?.asleep ?? session.resting,
    auditedError: audited && Math.max(audited.displacement, audited.force),
    tolerance: session.scene?.stepping?.tolerance,
    cellsError: session.meshErrorEstimate?.relative,
    cut: cutText(shownSession),
  });
}, 1000);

/** Fills the list with the scripts that were written for the session's scene. */
async function listScripts(sessionId: string): Promise<void> {
  for (let failures = 0; shownSession?.session.sessionId === sessionId; failures++) {
    try {
      const { scriptNames } = await sessions.listScripts({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
      part("script", HTMLSelectElement).replaceChildren(...scriptNames.slice(0, MAX_SCRIPTS).map((name) => new Option(excerpt(name), name)));
      part("scripts", HTMLElement).hidden = scriptNames.length === 0;
      return;
    } catch {
      await sleep(backoffMs(failures));
    }
  }
}

/** Returns whether no frame is due: the server sends none while nothing moves, but continues to send samples. */
function isStill({ frames, samples, session, speed }: ShownSession): boolean {
  const { newest } = samples;
  if (session.state !== SessionState.RUNNING) return true;
  if (newest?.asleep ?? session.resting) return true;
  return newest !== undefined && frames.newest !== undefined && newest.simulationTimeS - frames.newest.timeS > STILL_S * speed;
}

Object.assign(window, { palpate: pageState(() => shownSession, { stage, player, latency, sewing, exercise, comparison }) });

const wireframe = part("wireframe", HTMLInputElement);
wireframe.checked = asked.get("wireframe") === "1";
stage.setWireframe(wireframe.checked);
const first = addressed();
const asksFor = asked.get("scene");
const asksForExercise = asked.get("exercise");
choices.markScene(asksFor ?? "");
if (first.moment) void open({ moment: first.moment });
else if (first.sessionId) void open({ sessionId: first.sessionId });
else if (asksForExercise) void open({ source: forExercise(asksForExercise) });
else void open(asksFor ? { source: named(asksFor) } : {});
void choices.fill();
