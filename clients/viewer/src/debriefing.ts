// What a trainee sees after an exercise: the score, what earned it, all figures, and on the tissue what was hidden beside what was marked.

import { vec } from "palpate";
import { type EarnedCriterion, type ExerciseResult, type Figure } from "palpate/v1";
import { figureRow, measureTitle, timeText, valueText } from "./figure-text";
import type { Lump } from "./lumps";
import { element, part } from "./page";

/** Radius of an answer that has no size, m. */
const MARK_M = 0.003;

/** Returns a table with a heading and rows of cells. */
function table(heading: readonly string[], rows: readonly (readonly string[])[]): HTMLTableElement {
  const made = element("table");
  const head = made.createTHead().insertRow();
  for (const title of heading) head.append(element("th", { scope: "col", textContent: title }));
  const body = made.createTBody();
  for (const cells of rows) {
    const row = body.insertRow();
    for (const text of cells) row.insertCell().textContent = text;
  }
  return made;
}

/** Returns a row of the table of criteria: the value, and what it earned of the weight. */
function criterionRow({ measure, weight, value, earned }: EarnedCriterion, figures: readonly Figure[]): string[] {
  const unit = figures.find((figure) => figure.measure === measure)?.unit ?? "";
  const text = value === undefined ? "none" : valueText(measure, value, unit);
  return [measureTitle(measure), text, `${(earned * weight).toFixed(1)} of ${weight.toFixed(1)}`];
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
  show(title: string, result: ExerciseResult): void {
    part("debriefing-title", HTMLElement).textContent = title;
    const { isTold, scorePercent, criteria, figures, lumps, answers, timeS } = result;
    const score = scorePercent === undefined ? "" : `${Math.round(scorePercent)} %`;
    part("debriefing-score", HTMLElement).textContent = isTold ? score : "";
    const told = isTold ? `It took ${timeText(timeS)}.` : `It took ${timeText(timeS)}. Your trainer has the result.`;
    const found = lumps.length > 0 ? ` ${lumps.length} ${lumps.length === 1 ? "lump was" : "lumps were"} hidden, ${answers.length} marked.` : "";
    part("debriefing-said", HTMLElement).textContent = told + found;
    part("debriefing-legend", HTMLElement).hidden = lumps.length + answers.length === 0;
    const all = figures.filter(({ tool }) => tool === undefined).map(figureRow);
    const tables = [];
    if (criteria.length > 0) tables.push(table(["Criterion", "Value", "Points"], criteria.map((each) => criterionRow(each, figures))));
    if (all.length > 0) {
      const more = element("details");
      more.append(element("summary", { textContent: "All figures" }), table(["Measure", "Value"], all));
      tables.push(more);
    }
    part("debriefing-tables", HTMLElement).replaceChildren(...tables);
    if (!this.dialog.open) this.dialog.showModal();
  }
}
