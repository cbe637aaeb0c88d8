// Upload of a mesh file: dropped on the page or chosen, sent in parts, checked by the server, and made into a session
// that can be touched.
//
// Mesh files do not state their unit, so the page asks the user. The page does not read the file. The server reads
// it, at first with metres as the unit; from the size that it reports, the page computes the size in every other
// unit.

import type { MessageInitShape } from "@bufbuild/protobuf";
import { MAX_VERTICES, sceneOf, solidOf } from "./coefficients";
import { isTable } from "./comparison";
import type { MeshProblem, MeshReport, SceneSchema, Session } from "palpate/v1";
import { element, part } from "./page";
import { describe, fieldOf, CALL_TIMEOUT_MS, sessions } from "./server";
import { excerpt } from "./text";

/** Size of a part, bytes. */
const PART_BYTES = 1 << 20;
/** Timeout after the last part: reading and checking a large mesh takes a while. */
const READING_MS = 120_000;
/** Maximum number of problems that are shown. */
const TOLD = 12;
/** Typical length of the longest side of an organ, m, used to guess the unit. */
const USUAL_M = 0.15;

const UNITS = [
  { unit: "mm", name: "millimetres", metres: 1e-3 },
  { unit: "cm", name: "centimetres", metres: 1e-2 },
  { unit: "m", name: "metres", metres: 1 },
] as const;

/** What a mesh becomes: its surface on springs, or a solid that fills it. */
type Kind = "surface" | "solid";

type Scene = MessageInitShape<typeof SceneSchema>;

/** How the server reads a file: the length of 1 in it, empty for that of a label map, its label, and whether it mends it. */
interface ReadAs {
  unit: string;
  label?: number;
  repair?: boolean;
}

/** A mesh that the server has received, with its report. */
interface Sent {
  meshId: string;
  report: MeshReport;
  /** Describes what the server keeps of it for longer than the session; empty if nothing. */
  kept: string;
}

/** Formats the dimensions of a box. */
export function sidesText(sidesM: readonly number[]): string {
  const most = Math.max(...sidesM);
  const [factor, unit] = most >= 1 ? [1, "m"] : most >= 1e-3 || most === 0 ? [1e3, "mm"] : [1e6, "µm"];
  return `${sidesM.map((side) => Number((side * factor).toPrecision(3))).join(" × ")} ${unit}`;
}

/** Returns the unit in which the size of a file is most like that of an organ, judged by its longest side. */
export function likelyUnit(longest: number): (typeof UNITS)[number]["unit"] {
  const far = ({ metres }: { metres: number }) => Math.abs(Math.log(Math.max(longest * metres, 1e-30) / USUAL_M));
  return UNITS.reduce((best, unit) => (far(unit) < far(best) ? unit : best)).unit;
}

/** Describes a problem and its position, in the unit of the file. */
function problemText({ what, element, placeM }: MeshProblem, { unit, metres }: (typeof UNITS)[number]): string {
  // What is an option on the command line is a button here.
  const words = what.replace(/[;,:] --vertices N [^;]*/, "").replace(/--repair/g, "“Mend it”");
  const place = placeM && [placeM.x, placeM.y, placeM.z].map((v) => Number((v / metres).toPrecision(3))).join(", ");
  const at = place ? ` at (${place}) ${unit}` : "";
  return element ? `${element}${at}: ${words}` : `${words}${at}`;
}

function reportText(report: MeshReport): string {
  const { vertices, triangles, components, holes, volumeM3 } = report;
  const parts = [
    sidesText(sidesOf(report)),
    `${vertices.toLocaleString("en")} vertices`,
    `${triangles.toLocaleString("en")} triangles`,
    components > 1 ? `${components} separate pieces` : "",
    holes > 0 ? `open, ${holes} ${holes === 1 ? "border" : "borders"}` : "closed",
    volumeM3 !== undefined && volumeM3 > 0 ? `${Number((1e6 * volumeM3).toPrecision(3)).toLocaleString("en")} ml` : "",
  ];
  return parts.filter((text) => text !== "").join(", ");
}

/** The user has closed the dialog. */
class Ended extends Error {}

/** Maximum number of problems in a report that are shown. */
const MAX_PROBLEMS = 100;

export class FileOpener {
  private readonly dialog = part("own", HTMLDialogElement);
  private readonly said = part("own-said", HTMLElement);
  private readonly units = part("own-units", HTMLElement);
  private readonly progress = part("own-progress", HTMLProgressElement);
  private readonly problems = part("own-problems", HTMLElement);
  private readonly buttons = part("own-buttons", HTMLElement);
  /** Cancels pending requests when the dialog closes. */
  private ending = new AbortController();

  /** `onTable`: a table of curves was chosen or dropped. */
  constructor(
    private readonly onSession: (session: Session, scene: Scene) => void,
    private readonly onTable: (file: File) => void,
  ) {
    const chosen = part("own-file", HTMLInputElement);
    part("open-file", HTMLButtonElement).addEventListener("click", () => chosen.click());
    chosen.addEventListener("change", () => {
      const file = chosen.files?.[0];
      // Lets the user choose the same file again.
      chosen.value = "";
      if (file) void this.take(file);
    });
    this.dialog.addEventListener("close", () => this.ending.abort());
    this.dropping();
  }

  /** Accepts files that are dropped anywhere on the page. */
  private dropping(): void {
    const hint = part("drop-hint", HTMLElement);
    const hasFile = (event: DragEvent) => event.dataTransfer?.types.includes("Files") ?? false;
    let hiding: ReturnType<typeof setTimeout> | undefined;
    addEventListener("dragover", (event) => {
      if (!hasFile(event)) return;
      event.preventDefault();
      hint.hidden = false;
      // Browsers do not report reliably that a drag has left the page, but they repeat this event while it is there.
      clearTimeout(hiding);
      hiding = setTimeout(() => (hint.hidden = true), 400);
    });
    addEventListener("drop", (event) => {
      if (!hasFile(event)) return;
      event.preventDefault();
      hint.hidden = true;
      const file = event.dataTransfer?.files[0];
      if (file) void this.take(file);
    });
  }

  /** Processes a file from upload to session. */
  private async take(file: File): Promise<void> {
    this.ending.abort();
    if (isTable(file)) return this.onTable(file);
    this.ending = new AbortController();
    const { signal } = this.ending;
    part("own-name", HTMLElement).textContent = file.name;
    if (!this.dialog.open) this.dialog.showModal();
    try {
      await this.lead(file, signal);
    } catch (error) {
      if (signal.aborted || error instanceof Ended) return;
      this.show(`This does not work: ${describe(error).replace(/[.]$/, "")}.`);
      this.offer([], "Close");
    }
  }

  private async lead(file: File, signal: AbortSignal): Promise<void> {
    if (file.size === 0) throw new Error("the file is empty");
    const read = await this.read(file, signal);
    const { how, unit } = read;
    let sent = read.sent;
    let kind = await this.showReport(sent.report, unit, false, signal);
    if (kind === "mend") {
      sent = await this.send(file, { ...how, repair: true }, signal);
      kind = await this.showReport(sent.report, unit, true, signal);
    }
    if (kind === "mend") throw new Ended();
    this.show(kind === "solid" ? "Filling it with cells …" : "Making the tissue …");
    this.progress.hidden = false;
    this.progress.removeAttribute("value");
    const [session, scene] = await this.make(file.name, sent, kind, signal);
    this.dialog.close();
    if (session) this.onSession(session, scene);
  }

  /** Sends a file, and asks the user for what it does not say: its unit, or which of its labels. */
  private async read(file: File, signal: AbortSignal): Promise<{ sent: Sent; how: ReadAs; unit: (typeof UNITS)[number] }> {
    let sent: Sent;
    try {
      sent = await this.send(file, { unit: "m" }, signal);
    } catch (error) {
      if (fieldOf(error) !== "label") throw error;
      // A label map says how large it is.
      const how = { unit: "", label: await this.askLabel(describe(error), signal) };
      return { sent: await this.send(file, how, signal), how, unit: UNITS[0] };
    }
    const unit = await this.askUnit(sidesOf(sent.report), sent.kept, signal);
    const how = { unit: unit.unit };
    return { sent: unit.unit === "m" ? sent : await this.send(file, how, signal), how, unit };
  }

  /** Asks for one of the labels of a label map, which `said` lists. */
  private async askLabel(said: string, signal: AbortSignal): Promise<number> {
    // What is an option on the command line is a field here.
    this.show(`${excerpt(said).replace(/ \(label = N[^)]*\)/, "")}.`);
    const label = element("label", { textContent: "Label " });
    const chosen = element("input", { type: "number", required: true, min: "1", max: "4294967295", step: "1", value: /labels (\d+)/.exec(said)?.[1] ?? "1" });
    label.append(chosen);
    this.units.replaceChildren(label);
    this.units.hidden = false;
    do await this.ask([["use", "Go on"]], signal);
    while (!chosen.reportValidity());
    return chosen.valueAsNumber;
  }

  /** Sends a file in parts, one after the other. */
  private async send(file: File, how: ReadAs, signal: AbortSignal): Promise<Sent> {
    this.show(`Sending ${(file.size / 1e6).toFixed(1)} MB …`);
    this.progress.hidden = false;
    this.progress.value = 0;
    let meshId = "";
    for (let offset = 0; ; offset += PART_BYTES) {
      const bytes = new Uint8Array(await file.slice(offset, offset + PART_BYTES).arrayBuffer());
      const last = offset + PART_BYTES >= file.size;
      if (last) this.said.textContent = how.repair ? "The server mends the mesh …" : "The server reads the mesh …";
      const request = { meshId, fileName: file.name, offset: BigInt(offset), part: bytes, last, ...how };
      const answer = await sessions.uploadMesh(request, { signal, timeoutMs: last ? READING_MS : CALL_TIMEOUT_MS });
      meshId = answer.meshId;
      this.progress.value = Math.min(1, (offset + bytes.length) / file.size);
      if (!last) continue;
      if (!answer.report) throw new Error("the server has not reported on the mesh");
      return { meshId, report: answer.report, kept: answer.kept };
    }
  }

  /**
   * Asks for the unit of the file, and shows the resulting size for each unit. The file is kept only if the user
   * continues, so this is said first.
   */
  private async askUnit(raw: number[], kept: string, signal: AbortSignal): Promise<(typeof UNITS)[number]> {
    this.show("Mesh files do not say in which unit they are. How large is it?", kept ? [kept] : []);
    const likely = likelyUnit(Math.max(...raw));
    const choices = UNITS.map(({ unit, name, metres }) => {
      const label = document.createElement("label");
      const choice = document.createElement("input");
      Object.assign(choice, { type: "radio", name: "unit", value: unit, checked: unit === likely });
      const size = document.createElement("b");
      size.textContent = sidesText(raw.map((side) => side * metres));
      label.append(choice, size, ` in ${name}`);
      return label;
    });
    this.units.replaceChildren(...choices);
    this.units.hidden = false;
    await this.ask([["use", "Go on"]], signal);
    const chosen = this.units.querySelector<HTMLInputElement>("input:checked")?.value;
    return UNITS.find(({ unit }) => unit === chosen) ?? UNITS[0];
  }

  /**
   * Shows a report, with what is wrong, and asks what the mesh shall become. An open mesh has no inside; one whose
   * triangles form no surface may have one.
   */
  private async showReport(
    report: MeshReport,
    unit: (typeof UNITS)[number],
    isMended: boolean,
    signal: AbortSignal,
  ): Promise<Kind | "mend"> {
    const { problems, refused, solidOnly, holes } = report;
    const told = problems.slice(0, TOLD).map((problem) => problemText(problem, unit));
    if (problems.length > TOLD) told.push(`and ${problems.length - TOLD} more`);
    const mendable = "It can't be used as it is. “Mend it” lets the server repair what can be repaired:";
    const beyond = "It can't be used, and the server could not mend all of it. A program that edits meshes may:";
    const usable = told.length === 0 ? "What shall it be?" : isMended ? "Mended:" : "It can be used. Worth knowing:";
    const filled = "It can be a solid; it is no surface for springs:";
    const verdict = !refused ? usable : solidOnly ? filled : isMended ? beyond : mendable;
    const answers = [
      ...(refused ? [] : [["surface", "Touch its surface"] as const]),
      ...((refused ? solidOnly : holes === 0) ? [["solid", "Touch it as a solid"] as const] : []),
      ...(isMended || problems.length === 0 ? [] : [["mend", "Mend it"] as const]),
    ];
    const [only, ...others] = answers;
    if (only && problems.length === 0 && others.length === 0) return only[0];
    this.show(`${reportText(report)}. ${verdict}`, told);
    return await this.ask(answers, signal);
  }

  /** Creates a session of a solid, or of a surface. */
  private async make(fileName: string, { meshId, report }: Sent, kind: Kind, signal: AbortSignal): Promise<[Session | undefined, Scene]> {
    const name = fileName.replace(/\.[^.]*$/, "") || fileName;
    const call = { signal, timeoutMs: READING_MS };
    const create = async (value: Scene) => (await sessions.createSession({ source: { case: "scene", value } }, call)).session;
    if (kind === "solid") {
      const solid = solidOf(name, meshId, report);
      return [await create(solid), solid];
    }
    // A surface has fewer points than vertices if there are many and the server can decimate.
    const fewer = Math.min(report.vertices, MAX_VERTICES);
    const scene = sceneOf(name, meshId, report, fewer);
    const session = await create(scene);
    if (!session || session.points <= 1.5 * fewer) return [session, scene];
    // A server that can't decimate simulates all vertices, which need other coefficients.
    await sessions.deleteSession({ sessionId: session.sessionId }, call);
    const whole = sceneOf(name, meshId, report, session.points);
    return [await create(whole), whole];
  }

  private show(text: string, problems: string[] = []): void {
    this.said.textContent = excerpt(text);
    this.progress.hidden = true;
    this.units.hidden = true;
    this.problems.replaceChildren(
      ...problems.slice(0, MAX_PROBLEMS).map((problem) => {
        const line = document.createElement("li");
        line.textContent = excerpt(problem);
        return line;
      }),
    );
    this.problems.hidden = problems.length === 0;
    this.offer([]);
  }

  /** Offers buttons; there is always one to cancel. */
  private offer(choices: HTMLButtonElement[], cancelText = "Cancel"): void {
    const cancel = document.createElement("button");
    cancel.textContent = cancelText;
    cancel.type = "button";
    cancel.addEventListener("click", () => this.dialog.close());
    this.buttons.replaceChildren(...choices, cancel);
  }

  /** Waits for one of several answers. */
  private ask<T extends string>(answers: readonly (readonly [T, string])[], signal: AbortSignal): Promise<T> {
    return new Promise((answer, end) => {
      const made = answers.map(([value, text]) => {
        const button = document.createElement("button");
        button.type = "button";
        button.textContent = text;
        button.addEventListener("click", () => answer(value));
        return button;
      });
      made[0]?.classList.add("main");
      this.offer(made);
      made[0]?.focus();
      signal.addEventListener("abort", () => end(new Ended()));
    });
  }
}

/** Returns the dimensions in a report, m. */
function sidesOf({ extent }: MeshReport): number[] {
  const [a, b] = [extent?.leastM, extent?.mostM];
  if (!a || !b) throw new Error("there is no vertex in it");
  return [b.x - a.x, b.y - a.y, b.z - a.z];
}
