// The list of what can be opened: the server's scenes, and recordings, with those of live sessions in a group of
// their own.

import { type JournalName, lengthText, type Listed, listJournals, whenText } from "./journal";
import { part } from "./page";
import { entryOf, pictureOf } from "./pictures";
import { DEFAULT_SCENE, groupOf, GROUPS, inOrder, titleOf } from "./scenes";
import { backoffMs, exercises, isPassing, CALL_TIMEOUT_MS, sessions, sleep } from "./server";
import { excerpt } from "./text";

/** What the user chose. */
export type Choice = { kind: "scene"; scene: string } | { kind: "exercise"; exercise: string } | ({ kind: "live" | "recorded" } & JournalName);

/** Maximum number of scenes in the list. */
const MAX_SCENES = 1000;
/** Maximum number of exercises in the list. */
const MAX_EXERCISES = 200;
/** Maximum number of entries in each group of recordings; the newest are listed. */
const MAX_LISTED = 40;
/** A list older than this is requested again when the user opens it. */
const OLD_MS = 3000;

const keyOf = ({ sessionId, run }: JournalName, kind: "live" | "recorded") => `${kind} ${sessionId} ${run}`;

const exerciseKey = (name: string) => `exercise ${name}`;

export class Choices {
  private readonly list = part("scene", HTMLSelectElement);
  private readonly scenes = GROUPS.map(group);
  private readonly exercises = group("Exercises");
  private readonly live = group("Live");
  private readonly recorded = group("Recorded");
  private readonly choices = new Map<HTMLOptionElement, Choice>();
  private marked = { value: "", name: "" };
  /** The session that the page shows, which is not offered. */
  private present = "";
  private askedMs = -Infinity;

  constructor(onChoice: (choice: Choice) => void) {
    this.list.addEventListener("change", () => {
      const chosen = this.list.selectedOptions[0];
      if (!chosen) return;
      const exercise = chosen.parentElement === this.exercises ? chosen.value.slice(exerciseKey("").length) : undefined;
      if (exercise !== undefined) onChoice({ kind: "exercise", exercise });
      else onChoice(this.choices.get(chosen) ?? { kind: "scene", scene: chosen.value });
    });
    for (const turn of ["pointerenter", "focus"] as const) {
      this.list.addEventListener(turn, () => {
        if (performance.now() - this.askedMs > OLD_MS) void this.ask();
      });
    }
  }

  /** Returns the scene that the page begins with: the default, or the first scene of the server. */
  async first(): Promise<string> {
    const { sceneNames } = await sessions.listScenes({}, { timeoutMs: CALL_TIMEOUT_MS });
    return sceneNames.includes(DEFAULT_SCENE) ? DEFAULT_SCENE : (sceneNames[0] ?? DEFAULT_SCENE);
  }

  /** Fills the list, however long the server takes to start. Stops if the server refuses this caller. */
  async fill(): Promise<void> {
    for (let failures = 0; ; failures++) {
      try {
        const { sceneNames } = await sessions.listScenes({}, { timeoutMs: CALL_TIMEOUT_MS });
        this.scenes.forEach((group, index) => {
          const within = inOrder(sceneNames.slice(0, MAX_SCENES).filter((scene) => groupOf(scene) === GROUPS[index]));
          group.replaceChildren(...within.map(entryOf));
          group.hidden = within.length === 0;
        });
        this.list.replaceChildren(...this.scenes, this.exercises, this.live, this.recorded);
        this.mark(this.marked.value, this.marked.name);
        break;
      } catch (error) {
        if (!isPassing(error)) return;
        await sleep(backoffMs(failures));
      }
    }
    await this.fillExercises();
    await this.ask();
  }

  /** Fills the group of exercises, if the server has any. */
  private async fillExercises(): Promise<void> {
    try {
      const listed = (await exercises.listExercises({}, { timeoutMs: CALL_TIMEOUT_MS })).exercises;
      const entries = listed.slice(0, MAX_EXERCISES).map(({ name, title }) => new Option(excerpt(title || name), exerciseKey(name)));
      this.exercises.replaceChildren(...entries);
      this.exercises.hidden = entries.length === 0;
      part("trainees-link", HTMLAnchorElement).hidden = entries.length === 0;
      this.mark(this.marked.value, this.marked.name);
    } catch {
      // A server without exercises, or one that allows this caller none.
      this.exercises.hidden = true;
    }
  }

  /** Requests the recordings. Call this when they may have changed. */
  async ask(): Promise<void> {
    this.askedMs = performance.now();
    const listed = await listJournals();
    this.choices.clear();
    const groups = [
      [this.live, listed.filter(({ isLive, sessionId }) => isLive && sessionId !== this.present), "live"],
      [this.recorded, listed.filter(({ isLive }) => !isLive), "recorded"],
    ] as const;
    for (const [group, journals, kind] of groups) {
      group.replaceChildren(...journals.slice(0, MAX_LISTED).map((journal) => this.entry(journal, kind)));
      group.hidden = journals.length === 0;
    }
    this.mark(this.marked.value, this.marked.name);
  }

  private entry(journal: Listed, kind: "live" | "recorded"): HTMLOptionElement {
    const { sceneName, begun, lengthS, sessionId, run } = journal;
    const entry = new Option(`${excerpt(sceneName)}, ${whenText(begun)}, ${lengthText(lengthS)}`, keyOf(journal, kind));
    this.choices.set(entry, { kind, sessionId, run });
    return entry;
  }

  /** The page shows a live session. */
  markScene(scene: string, sessionId = "", title = scene): void {
    const isOther = sessionId !== this.present;
    this.present = sessionId;
    this.mark(scene, title);
    if (isOther && this.askedMs > 0) void this.ask();
  }

  /** The page shows the session of an exercise. */
  markExercise(name: string, title: string, sessionId: string): void {
    this.markScene(exerciseKey(name), sessionId, title);
  }

  /** The page shows a recording. */
  markRecorded(journal: JournalName, sceneName: string): void {
    const value = keyOf(journal, "recorded");
    const isOther = value !== this.marked.value;
    this.present = "";
    this.mark(value, `${titleOf(sceneName)}, recorded`);
    if (isOther && this.askedMs > 0) void this.ask();
  }

  /** Selects an entry. One that the list does not have, such as the user's own file, is added. */
  private mark(value: string, name: string): void {
    this.marked = { value, name };
    for (const option of [...this.list.options]) if (option.disabled) option.remove();
    this.list.value = value;
    if (value !== "" && this.list.value === value) return;
    const own = new Option(excerpt(name) || "Choose …", value);
    own.disabled = true;
    this.list.prepend(own);
    this.list.value = value;
  }

  /** Returns the entry of a scene that has no picture. */
  withoutPicture(scene: string): HTMLOptionElement | undefined {
    if (pictureOf(scene)) return undefined;
    return [...this.list.options].find(({ value, disabled }) => value === scene && !disabled);
  }

  /** Updates the picture of a scene. */
  refresh(entry: HTMLOptionElement): void {
    const { selected } = entry;
    const pictured = entryOf(entry.value);
    entry.replaceWith(pictured);
    pictured.selected = selected;
  }
}

function group(label: string): HTMLOptGroupElement {
  const made = document.createElement("optgroup");
  made.label = label;
  made.hidden = true;
  return made;
}
