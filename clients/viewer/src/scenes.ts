// How the list presents the scenes that come with the server: a title, a group, and a picture (`make
// scene-pictures`).

/** Groups, in the order of the list. Scenes that do not come with the server are in the last one. */
export const GROUPS = ["Organs", "Slabs of tissue", "From the paper", "Other scenes"] as const;
type Group = (typeof GROUPS)[number];

const KNOWN: Record<string, [title: string, group: Group]> = {
  "liver-organ": ["Liver with two lumps", "Organs"],
  "liver-solid": ["Liver with an inside", "Organs"],
  kidney: ["Kidney with an inside", "Organs"],
  prostate: ["Prostate with two nodules", "Organs"],
  colon: ["Colon", "Organs"],
  gallbladder: ["Gallbladder", "Organs"],
  "gallbladder-bed": ["Gallbladder in its bed", "Organs"],
  liver: ["Liver", "Slabs of tissue"],
  fibrotic: ["Scarred liver", "Slabs of tissue"],
  stomach: ["Stomach wall", "Slabs of tissue"],
  phantom: ["Silicone with a lump", "Slabs of tissue"],
  paper: ["Sheet of the paper", "From the paper"],
};

/** The scene of a new session, if the server has it and the address names no other. */
export const DEFAULT_SCENE = "liver-organ";

const PICTURES = import.meta.glob<string>("./scenes/*.jpg", { eager: true, import: "default", query: "?url" });

export function titleOf(scene: string): string {
  return KNOWN[scene]?.[0] ?? scene;
}

export function groupOf(scene: string): Group {
  return KNOWN[scene]?.[1] ?? "Other scenes";
}

/** Orders scenes, the organs first. */
export function inOrder(scenes: readonly string[]): string[] {
  const known = Object.keys(KNOWN);
  const place = (scene: string) => (known.includes(scene) ? known.indexOf(scene) : known.length);
  return [...scenes].sort((a, b) => place(a) - place(b));
}

/** Returns the picture that comes with the page. */
export function shippedPicture(scene: string): string | undefined {
  return PICTURES[`./scenes/${scene}.jpg`];
}
