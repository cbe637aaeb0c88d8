// The wound that blades have made in a surface, as `GetWound` returns it: vertices and triangles in place of those that the cut
// crosses. Each new vertex moves as its host does, so that frames need no more than they have. Within the cut of a solid there are faces of
// their own, whose vertices are in frames.

import type { CutFace, CutTriangles, CutVertex, GetWoundResponse, LipVertex } from "./gen/palpate/v1/view_pb.js";
import { CALL_TIMEOUT_MS, type Server } from "./server.js";

/** A new vertex: at rest at h + secondPart·(s − h) + thirdPart·(t − h), of its host h and two other vertices. */
export type Lip = Pick<LipVertex, "host" | "second" | "third" | "secondPart" | "thirdPart">;

/** Triangles that are no longer shown, and the corners of those in their place. */
export type Cut = Pick<CutTriangles, "first" | "count" | "corners">;

/** A part of an answer, as far as it is used. */
type Part = Pick<GetWoundResponse, "version" | "continues" | "firstVertex" | "severed" | "pieces" | "staysWhole"> & {
  vertices: readonly Lip[];
  triangles: readonly Cut[];
  cutVertices: readonly Pick<CutVertex, "number" | "restXM" | "restYM" | "restZM">[];
  cutFaces: readonly Pick<CutFace, "number" | "corners">[];
};

/** What an answer has changed. */
export interface WoundChange {
  /** Whether the wound begins anew: what was shown of it before is no longer there. */
  isNew: boolean;
  /** Changed triangles; some may replace earlier ones with the same `first`. */
  cuts: Cut[];
  /** Whether the surface within cuts has changed. */
  hasNewCutSurface: boolean;
}

/** Maximum number of values of a wound: more than any mesh has that a browser shows. */
const MAX_NUMBERS = 12 * 1_500_000;

export class Wound {
  /** The version of the topology; 0 before anything was severed. */
  version = 0;
  /** Number of severed springs, and of parts of the tissue. */
  severed = 0;
  pieces = 1;
  /** Whether the surface is shown whole although springs are severed, because other vertices are shown than are simulated. */
  staysWhole = false;
  /** New vertices, numbered on from those of the mesh. */
  readonly vertices: Lip[] = [];
  /** Changed triangles, by the first. */
  readonly cuts = new Map<number, Cut>();

  /**
   * The surface within the cuts of a solid: x, y, z of each vertex at rest, m, of which the displacement is in the `cutRows` of a field;
   * and faces of four vertices by their numbers, counterclockwise seen from within the cut.
   */
  readonly cutRestM: number[] = [];
  readonly cutFaces = new Map<number, readonly number[]>();

  /** Of a mesh with so many vertices and triangles, and a field with room for so many vertices of the surface within cuts. */
  constructor(
    readonly vertexCount: number,
    readonly triangleCount: number,
    readonly maxCutVertices = 0,
  ) {}

  /** Takes all parts of an answer that asked for what is new since `version`. Throws if they don't fit, and changes nothing then. */
  take(parts: readonly Part[]): WoundChange {
    const [first] = parts;
    if (!first) throw new RangeError("the server tells of no wound");
    const isNew = !first.continues || this.version === 0;
    const known = isNew ? 0 : this.vertices.length;
    const vertices = parts.flatMap((part) => part.vertices);
    const cuts = parts.flatMap((part) => part.triangles);
    const isEmpty = vertices.length === 0 && cuts.length === 0;
    if (!isEmpty && first.firstVertex !== this.vertexCount + known) throw new RangeError("a wound of another surface");
    const end = this.vertexCount + known + vertices.length;
    const isPart = (value: number) => value >= -1e-6 && value <= 1 + 1e-6;
    const isLip = (lip: Lip) => Math.max(lip.host, lip.second, lip.third) < this.vertexCount && isPart(lip.secondPart) && isPart(lip.thirdPart);
    const isCut = ({ first, count, corners }: Cut) =>
      count > 0 && first + count <= this.triangleCount && corners.length % 3 === 0 && corners.every((corner) => corner < end);
    // Otherwise hiding them would have no end.
    const hidden = cuts.reduce((sum, { count }) => sum + count, 0);
    if (!vertices.every(isLip) || !cuts.every(isCut) || hidden > this.triangleCount) throw new RangeError("the server's wound is not whole");
    const cutVertices = parts.flatMap((part) => part.cutVertices);
    const faces = parts.flatMap((part) => part.cutFaces);
    this.checkCutSurface(cutVertices, faces, isNew);
    if (isNew) {
      this.vertices.length = this.cutRestM.length = 0;
      this.cuts.clear();
      this.cutFaces.clear();
    }
    for (const { number, restXM, restYM, restZM } of cutVertices) [restXM, restYM, restZM].forEach((m, c) => (this.cutRestM[3 * number + c] = m));
    for (const { number, corners } of faces) this.cutFaces.set(number, corners);
    for (const lip of vertices) this.vertices.push(lip);
    for (const cut of cuts) this.cuts.set(cut.first, cut);
    ({ version: this.version, severed: this.severed, pieces: this.pieces, staysWhole: this.staysWhole } = first);
    return { isNew, cuts, hasNewCutSurface: isNew || cutVertices.length > 0 || faces.length > 0 };
  }

  /** Throws unless these vertices continue those that are known, without gaps, and the faces have vertices. */
  private checkCutSurface(vertices: Part["cutVertices"], faces: Part["cutFaces"], isNew: boolean): void {
    let count = isNew ? 0 : this.cutRestM.length / 3;
    for (const { number, restXM, restYM, restZM } of vertices) {
      if (number > count || number >= this.maxCutVertices || ![restXM, restYM, restZM].every(Number.isFinite)) {
        throw new RangeError("the server's surface within cuts is not whole");
      }
      count = Math.max(count, number + 1);
    }
    const isFace = ({ corners }: Pick<CutFace, "corners">) => corners.length === 4 && corners.every((corner) => corner < count);
    if (!faces.every(isFace)) throw new RangeError("the server's surface within cuts has vertices that it lacks");
  }

  /** Returns the triangles that are shown in place of those of the mesh. */
  shownTriangles(triangles: ArrayLike<number>): number[] {
    const shown: number[] = [];
    const hidden = new Set<number>();
    for (const { first, count, corners } of this.cuts.values()) {
      for (let t = first; t < first + count; t++) hidden.add(t);
      for (const corner of corners) shown.push(corner);
    }
    for (let t = 0; t < triangles.length / 3; t++) {
      if (!hidden.has(t)) shown.push(triangles[3 * t]!, triangles[3 * t + 1]!, triangles[3 * t + 2]!);
    }
    return shown;
  }

  /** Returns x, y and z of all vertices, m: those of the mesh and the new ones. `restM` and `displacementM` are of the mesh. */
  positionsM(restM: ArrayLike<number>, displacementM: ArrayLike<number>): Float64Array {
    const { vertexCount, vertices } = this;
    const positionsM = new Float64Array(3 * (vertexCount + vertices.length));
    for (let i = 0; i < 3 * vertexCount; i++) positionsM[i] = restM[i]! + displacementM[i]!;
    vertices.forEach((lip, index) => {
      for (let c = 0; c < 3; c++) {
        positionsM[3 * (vertexCount + index) + c] = mixed(lip, restM, 3, c) + displacementM[3 * lip.host + c]!;
      }
    });
    return positionsM;
  }
}

/** Returns what a new vertex has of a value that each vertex of the mesh has: component `c` of `size`. */
export function mixed({ host, second, third, secondPart, thirdPart }: Lip, values: ArrayLike<number>, size: number, c: number): number {
  const own = values[size * host + c]!;
  return own + secondPart * (values[size * second + c]! - own) + thirdPart * (values[size * third + c]! - own);
}

/** Requests what is new of a wound at a refinement, and takes it. `wound` is of that refinement's mesh. */
export async function followWound(server: Server, sessionId: string, refinement: number, wound: Wound, signal?: AbortSignal): Promise<WoundChange> {
  const parts: GetWoundResponse[] = [];
  let numbers = 0;
  const request = { sessionId, refinement, sinceVersion: wound.version, cutSurface: wound.maxCutVertices > 0 };
  for await (const part of server.views.getWound(request, { signal, timeoutMs: CALL_TIMEOUT_MS })) {
    numbers += 1 + part.vertices.length + part.triangles.reduce((sum, { corners }) => sum + 1 + corners.length, 0);
    numbers += part.cutVertices.length + part.cutFaces.reduce((sum, { corners }) => sum + 1 + corners.length, 0);
    if (numbers > MAX_NUMBERS) throw new RangeError("the server's wound has no end");
    parts.push(part);
    if (part.last) break;
  }
  return wound.take(parts);
}
