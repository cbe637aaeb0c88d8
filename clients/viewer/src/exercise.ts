// The exercise that the shown session is made for: briefing, time, figures, answers and advice, for a trainee and for the trainer.
//
// The page asks for the figures once in a while, with a stream that it ends after the first message: without TLS a browser has six
// connections, and the page's other streams need them (main.ts).

import { vec } from "palpate";
import { type Advice, type ExerciseResult, ExerciseRole, type SessionExercise, SessionState, type WatchExerciseResponse } from "palpate/v1";
import { Debriefing, hiddenIn, markedIn } from "./debriefing";
import { figureRow, listed, timeText } from "./figure-text";
import type { Input } from "./input";
import type { Lump } from "./lumps";
import { part } from "./page";
import { quantity } from "./plot";
import { CALL_TIMEOUT_MS, describe, exerciseNow, exercises, isGone, sessions, sleep } from "./server";
import type { ShownSession } from "./session";
import type { Stage } from "./stage";
import type { Place } from "./surface";
import { excerpt } from "./text";

/** Interval between two requests for the figures. */
const ASK_MS = 500;
/** Radius of a marker of the trainer, as a part of the tissue's size. */
const MARKER = 0.03;

/** What this module needs of the page. */
export interface ExerciseHost {
  present: () => ShownSession | undefined;
  /** The trainee wants to do the exercise again. */
  again: () => void;
  /** Copies the address with which a trainee opens the session. */
  share: (traineeId: string) => void;
  /** Shows what was hidden. */
  reveal: (lumps: readonly Lump[]) => void;
  notice: (text: string, seconds?: number) => void;
}

export class ExercisePanel {
  private readonly briefing = part("briefing", HTMLDialogElement);
  private readonly mark = part("mark-here", HTMLButtonElement);
  private readonly size = part("answer-size", HTMLInputElement);
  private readonly hint = part("hint-text", HTMLInputElement);
  private readonly pointOut = part("point-out", HTMLButtonElement);
  private readonly debriefing: Debriefing;
  private of: ShownSession | undefined;
  private ended = new AbortController();
  private answers: Lump[] = [];
  private markers: Lump[] = [];
  /** The number of the newest advice that was shown. */
  private advised = 0;
  private result: ExerciseResult | undefined;
  /** The phase that goes on, from 1; 0 for an exercise of one piece. */
  private phase = 0;

  constructor(
    private readonly stage: Stage,
    private readonly input: Input,
    private readonly host: ExerciseHost,
  ) {
    this.debriefing = new Debriefing(() => host.again());
    part("begin-exercise", HTMLButtonElement).addEventListener("click", () => void this.begin());
    this.mark.addEventListener("click", () => this.take(this.mark, (place) => void this.answer(place), "Press where you feel it."));
    part("finish-exercise", HTMLButtonElement).addEventListener("click", () => void this.finish(0));
    part("next-phase", HTMLButtonElement).addEventListener("click", () => void this.finish(this.phase));
    part("show-result", HTMLButtonElement).addEventListener("click", () => this.tellResult());
    part("trainee-link", HTMLButtonElement).addEventListener("click", () => this.exercise && this.host.share(this.exercise.traineeId));
    this.pointOut.addEventListener("click", () => this.take(this.pointOut, (place) => void this.advise(place), "Press where the trainee is to look."));
    part("hint-form", HTMLFormElement).addEventListener("submit", (event) => {
      event.preventDefault();
      void this.advise();
    });
    this.size.addEventListener("input", () => this.tellSize());
  }

  private get exercise(): SessionExercise | undefined {
    return this.of?.session.exercise;
  }

  private get isTrainee(): boolean {
    return this.exercise?.role === ExerciseRole.TRAINEE;
  }

  /** The state, for tests. */
  get state() {
    return {
      isShown: !part("exercise", HTMLElement).hidden,
      isTrainee: this.isTrainee,
      isBriefing: this.briefing.open,
      isDebriefing: this.debriefing.isOpen,
      answers: this.answers.length,
      phase: this.phase,
      advised: this.advised,
      finished: this.result !== undefined,
      lumpsTold: this.result?.lumps.length ?? 0,
      scorePercent: this.result?.scorePercent,
    };
  }

  /** Shows the exercise of a session, if it is made for one. */
  show(of: ShownSession): void {
    if (of === this.of) return;
    this.ended.abort();
    [this.ended, this.of, this.result] = [new AbortController(), of, undefined];
    [this.answers, this.markers, this.advised, this.phase] = [[], [], 0, 0];
    this.drop();
    this.debriefing.close();
    this.briefing.close();
    this.stage.setMarks([]);
    for (const id of ["answers", "exercise-figures"]) part(id, HTMLElement).replaceChildren();
    part("exercise-advice", HTMLElement).hidden = true;
    part("exercise-score", HTMLElement).textContent = "none";
    const { exercise } = this;
    part("exercise", HTMLElement).hidden = exercise === undefined;
    document.body.classList.toggle("trainee", this.isTrainee);
    if (!exercise?.exercise) return;
    const { title, name, instructions, hidesTruth } = exercise.exercise;
    for (const id of ["exercise-title", "briefing-title"]) part(id, HTMLElement).textContent = excerpt(title || name);
    for (const id of ["exercise-instructions", "briefing-instructions"]) part(id, HTMLElement).textContent = excerpt(instructions);
    part("briefing-limits", HTMLElement).replaceChildren(...this.limits(exercise));
    for (const id of ["answer-part", "mark-here"]) part(id, HTMLElement).hidden = !hidesTruth || !this.isTrainee;
    part("for-trainer", HTMLElement).hidden = this.isTrainee;
    part("exercise-score-part", HTMLElement).hidden = this.isTrainee;
    this.tellSize();
    this.tellTime(0);
    this.tellPhase(exercise.exercise.phases.length > 0 ? 1 : 0, 0);
    this.heard();
    void this.follow(of, this.ended.signal);
  }

  /** Shows a new status of the session. */
  heard(): void {
    const { of, exercise } = this;
    if (!of || !exercise) return;
    const waits = of.session.state === SessionState.PAUSED && !exercise.finished;
    if (waits && this.isTrainee && !this.briefing.open) this.briefing.showModal();
    if (!waits && this.briefing.open) this.briefing.close();
    const isOver = exercise.finished || this.result !== undefined;
    const next = exercise.exercise?.phases[this.phase];
    part("next-phase", HTMLButtonElement).hidden = isOver || waits || !next;
    part("next-phase", HTMLButtonElement).textContent = next ? `Next: ${excerpt(next.title)}` : "";
    part("finish-exercise", HTMLButtonElement).classList.toggle("main", !next);
    part("finish-exercise", HTMLButtonElement).hidden = isOver || waits;
    part("show-result", HTMLButtonElement).hidden = this.result === undefined;
    this.mark.disabled = isOver;
  }

  private limits({ exercise }: SessionExercise): HTMLElement[] {
    const rows: [string, string][] = [];
    if (exercise?.timeLimitS !== undefined) rows.push(["Time", timeText(exercise.timeLimitS)]);
    for (const { title, timeLimitS } of exercise?.phases ?? []) {
      rows.push([excerpt(title), timeLimitS === undefined ? "until you go on" : `at most ${timeText(timeLimitS)}`]);
    }
    if (exercise?.forceLimitN !== undefined) rows.push(["Force", `at most ${quantity(exercise.forceLimitN, "N")}`]);
    if (exercise?.pressureLimitPa !== undefined) rows.push(["Pressure", `at most ${quantity(exercise.pressureLimitPa, "Pa")}`]);
    if (exercise?.strainLimit !== undefined) rows.push(["Strain", `at most ${Number((100 * exercise.strainLimit).toPrecision(3))} %`]);
    return listed(rows);
  }

  private async begin(): Promise<void> {
    const { of } = this;
    if (!of) return;
    try {
      await sessions.startSession({ sessionId: of.session.sessionId }, { timeoutMs: CALL_TIMEOUT_MS });
      // The next status says so too.
      of.session.state = SessionState.RUNNING;
      if (this.of === of) this.heard();
    } catch (error) {
      this.host.notice(`The exercise did not begin: ${describe(error)}.`);
    }
  }

  /** Asks for the figures until the exercise has ended. */
  private async follow(of: ShownSession, signal: AbortSignal): Promise<void> {
    const { sessionId } = of.session;
    while (!signal.aborted && this.result === undefined) {
      const { state, exercise } = of.session;
      if (!document.hidden && (state !== SessionState.PAUSED || exercise?.finished)) {
        try {
          const told = await exerciseNow(sessionId, signal);
          if (told && this.of === of) this.tell(told);
        } catch (error) {
          // The session's other calls tell what is wrong.
          if (isGone(error)) return;
        }
      }
      await sleep(ASK_MS, signal);
    }
  }

  private tell({ timeS, figures, scorePercent, advice, result, phase, phaseTimeS }: WatchExerciseResponse): void {
    this.tellTime(timeS);
    // The last message has the result, and the first one may come before any figure.
    if (phase > 0) this.tellPhase(phase, phaseTimeS);
    const rows = figures.filter(({ tool }) => tool === undefined).map(figureRow);
    part("exercise-figures", HTMLElement).replaceChildren(...listed(rows));
    part("exercise-score", HTMLElement).textContent = scorePercent === undefined ? "none" : `${Math.round(scorePercent)} %`;
    const fresh = advice.filter(({ number }) => number > this.advised);
    if (fresh.length > 0) this.tellAdvice(advice, fresh);
    if (result) this.over(result);
  }

  private tellTime(timeS: number): void {
    const limitS = this.exercise?.exercise?.timeLimitS;
    part("exercise-time", HTMLElement).textContent = timeText(timeS) + (limitS === undefined ? "" : ` of ${timeText(limitS)}`);
  }

  /** Shows the phase that goes on, with its instructions and the time that is left. */
  private tellPhase(number: number, timeS: number): void {
    const phases = this.exercise?.exercise?.phases ?? [];
    const phase = phases[number - 1];
    part("phase-part", HTMLElement).hidden = !phase;
    const isNew = number > this.phase && this.phase > 0;
    this.phase = number;
    if (!phase) return;
    const { title, instructions, timeLimitS } = phase;
    const heading = `${number} of ${phases.length}: ${excerpt(title)}`;
    // A screen reader says it again whenever it is written.
    if (part("phase-title", HTMLElement).textContent !== heading) part("phase-title", HTMLElement).textContent = heading;
    part("phase-instructions", HTMLElement).textContent = excerpt(instructions);
    const left = timeLimitS === undefined ? "" : `${timeText(Math.ceil(Math.max(0, timeLimitS - timeS)))} left`;
    part("phase-time", HTMLElement).textContent = left;
    this.heard();
    if (isNew && this.isTrainee) this.host.notice(`${heading}. ${excerpt(instructions)}`, 8);
  }

  private tellAdvice(all: readonly Advice[], fresh: readonly Advice[]): void {
    this.advised = Math.max(...fresh.map(({ number }) => number));
    // A marker without a text may have come after a hint.
    const text = fresh.filter((advice) => advice.text !== "").at(-1)?.text ?? "";
    const line = part("exercise-advice", HTMLElement);
    if (text !== "") {
      line.textContent = excerpt(text);
      line.hidden = false;
    }
    if (this.isTrainee) this.host.notice(text === "" ? "Your trainer points at a place." : `Your trainer: ${excerpt(text)}`, 10);
    const radiusM = MARKER * (this.of?.surface.sizeM ?? 0);
    this.markers = all.flatMap(({ placeM }) => (placeM ? [{ centreM: vec(placeM), radiusM }] : []));
    this.draw();
  }

  private tellSize(): void {
    part("answer-size-value", HTMLOutputElement).value = `${this.size.value} mm`;
  }

  /** With the next press on the tissue, `act` gets its place, unless the button is pressed again. */
  private take(button: HTMLButtonElement, act: (place: Place) => void, what: string): void {
    const begins = button.getAttribute("aria-pressed") !== "true";
    this.drop();
    if (!begins) return;
    button.setAttribute("aria-pressed", "true");
    this.input.onPlace = (place) => {
      this.drop();
      act(place);
    };
    part("view", HTMLElement).scrollIntoView({ block: "nearest" });
    this.host.notice(what, 0);
  }

  /** Presses touch again. */
  private drop(): void {
    for (const button of [this.mark, this.pointOut]) {
      if (button.getAttribute("aria-pressed") !== "true") continue;
      button.setAttribute("aria-pressed", "false");
      this.input.onPlace = undefined;
      this.host.notice("", 0);
    }
  }

  private async answer({ restM }: Place): Promise<void> {
    const { of } = this;
    if (!of) return;
    const [x, y, z] = restM;
    const diameterM = Number(this.size.value) / 1000;
    if (!(await of.hand.tool.mark({ placeM: { x, y, z }, diameterM })) || this.of !== of) return;
    this.answers = [...this.answers, { centreM: restM, radiusM: diameterM / 2 }];
    part("answers", HTMLElement).textContent = `${this.answers.length} marked`;
    this.draw();
  }

  private async advise(place?: Place): Promise<void> {
    const { of } = this;
    const text = this.hint.value.trim();
    if (!of || (text === "" && !place)) return;
    const [x, y, z] = place?.restM ?? [0, 0, 0];
    try {
      await exercises.adviseTrainee({ sessionId: of.session.sessionId, text, placeM: place && { x, y, z } }, { timeoutMs: CALL_TIMEOUT_MS });
      this.hint.value = "";
    } catch (error) {
      this.host.notice(`It was not sent: ${describe(error)}.`);
    }
  }

  /** Ends a phase (from 1), or the whole exercise (0). */
  private async finish(phase: number): Promise<void> {
    const { of } = this;
    if (!of) return;
    this.drop();
    try {
      await of.hands.letGo();
      const { result } = await exercises.finishExercise({ sessionId: of.session.sessionId, phase }, { timeoutMs: CALL_TIMEOUT_MS });
      if (this.of !== of) return;
      if (result) this.over(result);
      else this.tellPhase(phase + 1, 0);
    } catch (error) {
      this.host.notice(`${phase > 0 ? "The phase" : "The exercise"} did not end: ${describe(error)}.`);
    }
  }

  private over(result: ExerciseResult): void {
    if (this.result) return;
    this.result = result;
    this.drop();
    const hidden = hiddenIn(result);
    if (hidden.length > 0) this.host.reveal(hidden);
    this.draw();
    this.heard();
    this.tellResult();
  }

  private tellResult(): void {
    const { exercise } = this.exercise ?? {};
    if (this.result) this.debriefing.show(excerpt(exercise?.title || exercise?.name || ""), this.result, exercise?.phases ?? []);
  }

  /** Draws answers and markers on the tissue. */
  private draw(): void {
    const { result } = this;
    this.stage.setMarks([...(result?.isTold ? markedIn(result) : this.answers), ...this.markers]);
  }
}
