// Messages about a session and its tools for the user.

import { type Session, SessionState, TipShape } from "palpate/v1";
import { depthText, jawsText, type ToolLabel } from "./overlay";
import { quantity } from "./plot";
import { BURN_S, type Hand, type Mode } from "./hand";
import type { Told } from "./samples";
import type { ShownSession } from "./session";

/** A tip whose depth is below this fraction of its target has slipped off. */
const SLIPPED = 0.6;
/** A push is reported as reduced if less than this fraction of it is felt. */
const LESS = 0.95;

/** Capitalizes the first letter. */
export function sentence(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/** Describes a session without problems. */
export function wellText(session: Session): string {
  const name = session.scene?.name ?? "";
  if (session.playback) return `Connected to a recording of ${name}.`;
  if (session.state === SessionState.HELD) return `The session is held: ${session.holdReason}`;
  const paused = session.state === SessionState.PAUSED ? ", which is paused" : "";
  return `Connected to ${name}${paused}.${recoveredText(session)}`;
}

/** Describes how often the tissue recovered, and why it did the last time; empty if it never did. */
function recoveredText({ recoveryCount, recoveries }: Session): string {
  const newest = recoveries.at(-1);
  if (!newest) return "";
  const times = recoveryCount === 1n ? "once" : `${recoveryCount} times`;
  const end = newest.pausedUntilStep;
  const pause = end === undefined ? "" : ` Tools that acted are paused until step ${end}.`;
  return ` The tissue recovered ${times}, the last time because after step ${newest.step} ${newest.reason}.${pause}`;
}

/** Describes for the user why a touch was refused. */
export function refusedText(message: string, reason: string, { session }: ShownSession, hand: Hand): string {
  if (reason === "ROLE_MISSING") return "Your token lets you watch, not touch.";
  if (reason !== "TOOL_HELD") return `${sentence(message)}.`;
  const name = session.heldTools.find(({ tool }) => hand.tool.has(tool))?.holder || "Somebody else";
  return `${name} holds the tool. You can touch as soon as ${name} lets go.`;
}

/** Returns whether the strength of a tool is its depth. */
export function isDeep(mode: Mode): boolean {
  return mode === "tip" || mode === "blade" || mode === "cautery" || mode === "grasper";
}

/** Describes the strength of the present tool. */
export function strengthText({ hand: { mode, strength, depthM }, reach }: ShownSession): string {
  if (mode === "pull") return "as you drag";
  return isDeep(mode) ? quantity(depthM, "m") : quantity(strength * reach.mostN, "N");
}

/** Describes what the strength means, and how this differs from what is felt. */
export function meaningText({ hand, reach, surface }: ShownSession): string {
  const range = quantity(reach.lengthM, "m");
  if (hand.mode === "tip") {
    const disc = reach.tipShape === TipShape.RIGID_DISC ? "a rigid disc" : "a disc";
    return `The tip is ${disc} of ${range} radius. Depth is how far it goes below the tissue at rest; what pushes back follows from that.`;
  }
  if (hand.mode === "blade") {
    return (
      "The blade stands upright in the tissue and cuts where you drag it. Depth is how far its point goes below the tissue at rest. " +
      "What pushes back is what cutting takes, if the tissue has a toughness; a tissue with a pretension gapes."
    );
  }
  if (hand.mode === "cautery") {
    return (
      `The cautery burns what it touches: the tissue turns dark, and is severed after ${quantity(BURN_S, "s")} of contact in all. Depth is how far ` +
      "its tip goes below the tissue at rest."
    );
  }
  if (hand.mode === "grasper") {
    return (
      "The jaws open and close with the right button beside the left, with the wheel while you press, or with C. Depth is how far " +
      "they go below the tissue at rest while they are open; closed, they hold what is between them, and move with the drag."
    );
  }
  if (hand.mode === "thread" || hand.mode === "clip") return "A thread or clip stays when you let go of the tool, and belongs to the session.";
  return surface.edge
    ? "Strength is the push in the middle of the tool. It fades out over about " +
      `${range}. What pushes back is the mean over the tissue around, weighted as the push is. The push is strongest in the ` +
      "middle, so that mean is less than the strength while nothing moves. While the tissue moves it may be more."
    : `Strength is the whole push of the tool. It fades out over about ${range}. What pushes back is told for all the tissue ` +
      "that the push meets: as much as the strength while nothing moves, more or less while the tissue moves.";
}

/** Returns whether a push is felt clearly less than its strength, so that the user may wonder why. */
export function isLess({ hand: { mode, strength }, reach }: ShownSession, told: Told | undefined): boolean {
  return told !== undefined && ["push", "stroke"].includes(mode) && told.allN < LESS * strength * reach.mostN;
}

/** Describes what the tools of this page's hands feel, or else what the first tool feels. */
export function feltText({ hands, hand }: ShownSession, labels: readonly ToolLabel[]): string {
  const [label] = labels;
  if (hands.isTwo && labels.length > 1) return labels.map(({ told, title }) => `${title}: ${toldText(told, "")}`).join("\n");
  const told = label?.told;
  const { setM } = hand;
  if (setM !== undefined && (told?.deepM ?? 0) < SLIPPED * setM) {
    const now = told ? `now ${depthText(told)}, not ${quantity(setM, "m")}` : "it does not touch any more";
    return `The tip has slipped off: ${now}. Set less depth.`;
  }
  if (!label) return "Nothing touches the tissue.";
  return label.title ? `${label.title}: ${toldText(label.told, "")}` : toldText(label.told, "pushes back ");
}

/** Describes what a tool feels; `verb` is before the force, or else the word "back" after it. */
function toldText(told: Told, verb: string): string {
  const force = `${verb}${quantity(told.allN, "N")}${verb === "" ? " back" : ""}`;
  return [depthText(told), force, jawsText(told)].filter((text) => text !== "").join(", ");
}

/** Describes what blades have cut, as far as it is known here; undefined if nothing is. */
export function cutText({ session: { severed, severedAnchors, pieces, cutsExhausted }, cutters, wound }: ShownSession): string | undefined {
  if (severed === 0) return undefined;
  const anchors = severedAnchors > 0 ? ` (${severedAnchors} anchors)` : "";
  const parts = pieces > 1 ? `, in ${pieces} pieces` : "";
  const by = cutters.size > 0 ? `, by ${[...cutters].join(", ")}` : "";
  const full = cutsExhausted ? "; no room for more" : "";
  return `${severed} springs${anchors}${parts}${by}${full}${wound.staysWhole ? "; drawn whole: it has other vertices than points" : ""}`;
}

/** Says why the last cut can't be undone; empty if it can. */
export function undoText({ session: { sessionId, journal }, beforeCuts }: ShownSession): string {
  if (!journal) return "This server keeps no journal, from which a cut could be undone.";
  const before = beforeCuts.at(-1);
  if (!before) return "It was cut before this page looked on. Look for the moment in the recording, and go on from there.";
  const isDurable = before.sessionId !== sessionId || (journal.durableStep ?? -1n) >= before.step;
  return isDurable ? "" : "The moment before the cut is not in the journal yet.";
}

/** Describes the transport of a touch: datagrams belong to a lease. */
export function wayText({ hands: { holding } }: ShownSession): string {
  if (!holding) return "no tool is held";
  return holding.tool.datagrams.carries ? "datagrams" : "gRPC-web";
}
