// What a trainee sees after an exercise: the score, what earned it, all figures, and on the tissue what was hidden beside what was marked.

import { vec } from "palpate";
import { type EarnedCriterion, type ExercisePhase, type ExerciseResult, type Figure } from "palpate/v1";
import { figureRow, measureTitle, timeText, valueText } from "./figure-text";
import type { Lump } from "./lumps";
import { element, part, table } from "./page";
import { excerpt } from "./text";

/** Radius of an answer that has no size, m. */
const MARK_M = 0.003;

/** Returns a row of the table of criteria: the value, and what it earned of the weight. */
function criterionRow({ measure, phase, weight, value, earned }: EarnedCriterion, figures: readonly Figure[]): string[] {
  const unit = figures.find((figure) => figure.measure === measure)?.unit ?? "";
  const text = value === undefined ? "none" : valueText(measure, value, unit);
  const title = measureTitle(measure) + (phase > 0 ? `, phase ${phase}` : "");
  return [title, text, `${(earned * weight).toFixed(1)} of ${weight.toFixed(1)}`];
}

/** Returns a part that opens to a table of figures of all tools together. */
function figureTable(summary: string, figures: readonly Figure[]): HTMLDetailsElement {
  const made = element("details");
  const rows = figures.filter(({ tool }) => tool === undefined).map(figureRow);
  made.append(element("summary", { textContent: summary }), table(["Measure", "Value"], rows));
  return made;
}

/** Returns what was hidden. */
export function hiddenIn({ lumps }: ExerciseResult): Lump[] {
  return lumps.map(({ centreM, radiusM }) => ({ centreM: vec(centreM), radiusM }));
}

/** Returns what was marked. */
export function markedIn({ answers }: ExerciseResult): Lump[] {
  return answers.map(({ placeM, diameterM }) => ({
    centreM: vec(placeM),
    radiusM: diameterM === undefined ? MARK_M : diameterM / 2,
  }));
}

export class Debriefing {
  private readonly dialog = part("debriefing", HTMLDialogElement);

  /** `onAgain`: the trainee wants to do the exercise again. */
  constructor(onAgain: () => void) {
    part("debriefing-again", HTMLButtonElement).addEventListener("click", () => {
      this.dialog.close();
      onAgain();
    });
    part("debriefing-look", HTMLButtonElement).addEventListener("click", () => this.dialog.close());
  }

  get isOpen(): boolean {
    return this.dialog.open;
  }

  close(): void {
    this.dialog.close();
  }

  /** Shows a result. */
  show(title: string, result: ExerciseResult, phases: readonly ExercisePhase[]): void {
    part("debriefing-title", HTMLElement).textContent = title;
    const { isTold, scorePercent, criteria, figures, lumps, answers, timeS } = result;
    const score = scorePercent === undefined ? "" : `${Math.round(scorePercent)} %`;
    part("debriefing-score", HTMLElement).textContent = isTold ? score : "";
    const told = isTold ? `It took ${timeText(timeS)}.` : `It took ${timeText(timeS)}. Your trainer has the result.`;
    const found = lumps.length > 0 ? ` ${lumps.length} ${lumps.length === 1 ? "lump was" : "lumps were"} hidden, ${answers.length} marked.` : "";
    part("debriefing-said", HTMLElement).textContent = told + found;
    part("debriefing-legend", HTMLElement).hidden = lumps.length + answers.length === 0;
    const tables: HTMLElement[] = [];
    const every = [...figures, ...result.phases.flatMap((phase) => phase.figures)];
    if (criteria.length > 0) tables.push(table(["Criterion", "Value", "Points"], criteria.map((each) => criterionRow(each, every))));
    if (figures.length > 0) tables.push(figureTable("All figures", figures));
    for (const [index, phase] of result.phases.entries()) {
      tables.push(figureTable(`${excerpt(phases[index]?.title ?? `Phase ${index + 1}`)}, ${timeText(phase.timeS)}`, phase.figures));
    }
    part("debriefing-tables", HTMLElement).replaceChildren(...tables);
    if (!this.dialog.open) this.dialog.showModal();
  }
}
