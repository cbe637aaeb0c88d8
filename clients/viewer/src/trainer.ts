// The trainer's page: the trainees whose exercises were created in this browser, with time, score and figures, and what the trainer tells
// each of them. It asks one session after the other, so that one connection is enough for any number of trainees.

import { type Session, SessionState, type WatchExerciseResponse } from "palpate/v1";
import { figureRow, timeText } from "./figure-text";
import { element, part, withSession } from "./page";
import { CALL_TIMEOUT_MS, describe, exerciseNow, exercises, isGone, sessions, sleep } from "./server";
import { excerpt } from "./text";

/** Where this browser keeps the list. */
const KEPT = "palpate-trainees";
/** Maximum number of trainees in the list. */
const MAX_TRAINEES = 40;
/** Interval between two rounds of requests. */
const ASK_MS = 1000;
/** The same while the page is hidden. */
const HIDDEN_MS = 60_000;
/** A session ends after this time without requests: this page asks, also while it is hidden, so a trainee may open the link later. */
const IDLE_S = 900;
/** The measures that are shown beside the score, if the exercise has them. */
const SHOWN = ["peak_force_n", "mean_force_n", "coverage_share", "path_length_m", "hits", "false_alarms"];

/** A trainee, as this browser remembers it. */
interface Trainee {
  name: string;
  title: string;
  sessionId: string;
  traineeId: string;
}

/** Returns the list that was kept. Only what has the right form counts. */
function kept(): Trainee[] {
  try {
    const found: unknown = JSON.parse(localStorage.getItem(KEPT) ?? "[]");
    const isTrainee = (each: unknown): each is Trainee =>
      typeof each === "object" && each !== null && ["name", "title", "sessionId", "traineeId"].every((key) => typeof (each as Record<string, unknown>)[key] === "string");
    return Array.isArray(found) ? found.filter(isTrainee).slice(0, MAX_TRAINEES) : [];
  } catch {
    return [];
  }
}

let trainees = kept();
const rows = new Map<string, Row>();

function keep(): void {
  try {
    localStorage.setItem(KEPT, JSON.stringify(trainees));
  } catch {
    say("This browser keeps nothing: the list is gone once the page is closed.");
  }
  part("empty", HTMLElement).hidden = trainees.length > 0;
}

function say(text: string): void {
  part("said", HTMLElement).textContent = excerpt(text);
}

/** A trainee in the list. */
class Row {
  readonly item = element("li");
  isOver = false;
  private readonly state = element("span", { className: "state", textContent: "Asking …" });
  private readonly score = element("b");
  private readonly figures = element("p", { className: "figures" });
  private readonly another = element("button", { type: "button", textContent: "Another lump", hidden: true, title: "Hides one more in the tissue, which the trainee is not told" });
  private readonly hint = element("input", { type: "text", maxLength: 200, placeholder: "A hint for the trainee" });

  constructor(readonly trainee: Trainee) {
    const { name, title, sessionId, traineeId } = trainee;
    const heading = element("h2", { textContent: `${excerpt(name)}: ${excerpt(title)}` });
    const send = element("form", { className: "row" });
    send.append(this.hint, element("button", { type: "submit", textContent: "Send" }));
    send.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.advise();
    });
    const watch = element("a", { href: withSession(sessionId).replace("/trainer.html", "/"), target: "_blank", textContent: "Look on" });
    const link = element("a", { href: withSession(traineeId).replace("/trainer.html", "/"), target: "_blank", textContent: "The trainee's link" });
    const finish = element("button", { type: "button", textContent: "Finish" });
    finish.addEventListener("click", () => void this.finish());
    this.another.addEventListener("click", () => void this.hideLump());
    const drop = element("button", { type: "button", textContent: "Remove", title: "Takes it off this list; the session goes on" });
    drop.addEventListener("click", () => remove(this));
    this.hint.setAttribute("aria-label", `A hint for ${excerpt(name)}`);
    const told = element("p");
    told.append(this.state, " ", this.score);
    const buttons = element("div", { className: "row" });
    buttons.append(link, watch, this.another, finish, drop);
    this.item.append(heading, told, this.figures, send, buttons);
  }

  /** Asks for the state of the exercise. */
  async ask(): Promise<void> {
    const { sessionId } = this.trainee;
    try {
      const { session } = await sessions.getSession({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
      if (!session) return;
      this.isOver = session.exercise?.finished ?? false;
      this.another.hidden = this.isOver || !(session.exercise?.exercise?.hidesTruth ?? false);
      if (session.state === SessionState.PAUSED && !this.isOver) return this.tell(session);
      const told = await exerciseNow(sessionId);
      if (told) this.tell(session, told);
    } catch (error) {
      this.state.textContent = isGone(error) ? "The session has ended" : `${describe(error)}`;
      this.isOver = isGone(error);
    }
  }

  private tell({ exercise, state, heldTools }: Session, told?: WatchExerciseResponse): void {
    const limitS = exercise?.exercise?.timeLimitS;
    const timeS = told?.result?.timeS ?? told?.timeS ?? 0;
    const phase = exercise?.exercise?.phases[(told?.phase ?? 0) - 1];
    const time = timeText(timeS) + (limitS === undefined ? "" : ` of ${timeText(limitS)}`) + (phase ? `, ${excerpt(phase.title)}` : "");
    const waits = state === SessionState.PAUSED ? "Has not begun" : heldTools.length > 0 ? `Touches, ${time}` : time;
    this.state.textContent = told?.result ? `Finished after ${timeText(timeS)}` : waits;
    const percent = told?.result?.scorePercent ?? told?.scorePercent;
    this.score.textContent = percent === undefined ? "" : `${Math.round(percent)} %`;
    const figures = (told?.result?.figures ?? told?.figures ?? []).filter(({ tool, measure }) => tool === undefined && SHOWN.includes(measure));
    this.figures.textContent = figures.map((figure) => figureRow(figure).join(" ")).join(" · ");
  }

  private async advise(): Promise<void> {
    const text = this.hint.value.trim();
    if (text === "") return;
    try {
      await exercises.adviseTrainee({ sessionId: this.trainee.sessionId, text }, { timeoutMs: CALL_TIMEOUT_MS });
      this.hint.value = "";
      say(`Sent to ${this.trainee.name}.`);
    } catch (error) {
      say(`Not sent: ${describe(error)}.`);
    }
  }

  private async hideLump(): Promise<void> {
    try {
      const { lump } = await exercises.hideLump({ sessionId: this.trainee.sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
      say(`${this.trainee.name} has another lump${lump ? `, ${Math.round(2000 * lump.radiusM)} mm wide` : ""}.`);
    } catch (error) {
      say(`No lump was hidden: ${describe(error)}.`);
    }
  }

  private async finish(): Promise<void> {
    try {
      await exercises.finishExercise({ sessionId: this.trainee.sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
      await this.ask();
    } catch (error) {
      say(`It did not end: ${describe(error)}.`);
    }
  }
}

function remove(row: Row): void {
  trainees = trainees.filter((each) => each !== row.trainee);
  rows.delete(row.trainee.sessionId);
  row.item.remove();
  keep();
}

function show(trainee: Trainee): Row {
  const row = new Row(trainee);
  rows.set(trainee.sessionId, row);
  part("trainees", HTMLUListElement).append(row.item);
  return row;
}

/** Creates a session for a trainee. It waits until the trainee begins. */
async function add(): Promise<void> {
  const chosen = part("exercise", HTMLSelectElement);
  const name = part("trainee", HTMLInputElement);
  if (trainees.length >= MAX_TRAINEES) return say(`The list has ${MAX_TRAINEES} trainees, which is the most: remove one first.`);
  try {
    const source = { case: "exercise" as const, value: { source: { case: "name" as const, value: chosen.value } } };
    const { session } = await sessions.createSession({ source, paused: true, idleTimeoutS: IDLE_S }, { timeoutMs: CALL_TIMEOUT_MS });
    const { traineeId, exercise } = session?.exercise ?? {};
    if (!session || !traineeId) return say("The server made no session.");
    const trainee = { name: name.value.trim() || `Trainee ${trainees.length + 1}`, title: exercise?.title ?? chosen.value, sessionId: session.sessionId, traineeId };
    trainees = [...trainees, trainee];
    keep();
    name.value = "";
    say("");
    await show(trainee).ask();
  } catch (error) {
    say(`Nobody was added: ${describe(error)}.`);
  }
}

part("add", HTMLFormElement).addEventListener("submit", (event) => {
  event.preventDefault();
  void add();
});

/** Ends the wait for the next round when the page is hidden, or seen again. */
let wake = new AbortController();
document.addEventListener("visibilitychange", () => {
  wake.abort();
  wake = new AbortController();
});

/** Fills the list of exercises. */
async function list(): Promise<void> {
  try {
    const listed = await exercises.listExercises({}, { timeoutMs: CALL_TIMEOUT_MS });
    part("exercise", HTMLSelectElement).replaceChildren(...listed.exercises.map(({ name, title }) => new Option(excerpt(title || name), name)));
  } catch (error) {
    say(`The exercises can't be listed: ${describe(error)}.`);
  }
}

for (const trainee of trainees) show(trainee);
keep();
await list();
for (;;) {
  for (const row of [...rows.values()].filter(({ isOver }) => !isOver)) await row.ask();
  await sleep(document.hidden ? HIDDEN_MS : ASK_MS, wake.signal);
}
