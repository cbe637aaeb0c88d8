// The mesh of a session, as `GetMesh` returns it: the data that does not change while the tissue moves.

import type { GetMeshResponse } from "./gen/palpate/v1/view_pb.js";
import { CALL_TIMEOUT_MS, type Server } from "./server.js";

export interface MeshData {
  /** Number of vertices of a frame along x and along y. The last ones may be unused. */
  places: [number, number];
  /** x, y, z of each vertex at rest, m. */
  restM: Float32Array<ArrayBuffer>;
  /** u, v of each vertex; empty if the mesh has no texture coordinates. */
  uv: Float32Array<ArrayBuffer>;
  /** Three vertex indices for each triangle, counterclockwise seen from outside. */
  triangles: Uint32Array<ArrayBuffer>;
  /** Index of each vertex in the mesh file, as forces and samples use it. */
  fileVertex: Uint32Array<ArrayBuffer>;
  /** Typical edge length, m. */
  edgeM: number;
  /** Number of further rows of a frame, for the vertices of the surface within the cuts of a solid. */
  cutRows: number;
}

/** Concatenates the parts of an array. */
function joined<A extends Float32Array<ArrayBuffer> | Uint32Array<ArrayBuffer>>(parts: number[][], make: (length: number) => A): A {
  const whole = make(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}

/** The fields of a part that are used. */
type Part = Pick<
  GetMeshResponse,
  "restPositionM" | "textureCoordinates" | "triangles" | "fileVertex" | "verticesX" | "verticesY" | "vertexSpacingM" | "cutRows"
>;

/** Combines the parts to a mesh. Throws if a triangle refers to a vertex that does not exist. */
export function meshOf(parts: Part[]): MeshData {
  const floats = (length: number) => new Float32Array(length);
  const whole = (length: number) => new Uint32Array(length);
  const restM = joined(parts.map((part) => part.restPositionM), floats);
  const count = restM.length / 3;
  const uv = joined(parts.map((part) => part.textureCoordinates), floats);
  const triangles = joined(parts.map((part) => part.triangles), whole);
  const named = joined(parts.map((part) => part.fileVertex), whole);
  const first = parts[0];
  const isWhole = Number.isInteger(count) && triangles.length % 3 === 0 && triangles.every((vertex) => vertex < count);
  if (!first || !isWhole || !restM.every(Number.isFinite)) throw new RangeError("the server's mesh is not whole");
  // The last vertices of a frame may be unused, but fewer than a row.
  const places = first.verticesX * first.verticesY;
  if (places < count || places >= count + Math.max(first.verticesX, first.verticesY)) {
    throw new RangeError(`a mesh of ${count} vertices has no frames of ${first.verticesX} × ${first.verticesY}`);
  }
  return {
    places: [first.verticesX, first.verticesY],
    restM,
    uv: uv.length === 2 * count ? uv : floats(0),
    triangles,
    fileVertex: named.length === count ? named : Uint32Array.from({ length: count }, (_, i) => i),
    edgeM: first.vertexSpacingM,
    cutRows: first.cutRows,
  };
}

/**
 * Maximum number of values of a mesh: those of one and a half million vertices. With more, browsers are slow on any
 * machine.
 */
const MAX_NUMBERS = 12 * 1_500_000;

/** Requests the mesh of a session. */
export async function fetchMesh(server: Server, sessionId: string): Promise<MeshData> {
  const parts: GetMeshResponse[] = [];
  let numbers = 0;
  for await (const part of server.views.getMesh({ sessionId }, { timeoutMs: CALL_TIMEOUT_MS })) {
    numbers += part.restPositionM.length + part.textureCoordinates.length + part.triangles.length + part.fileVertex.length + 1;
    if (numbers > MAX_NUMBERS) throw new RangeError("the server's mesh has no end");
    parts.push(part);
    if (part.last) break;
  }
  return meshOf(parts);
}
