// What the page shows and touches: a sheet (sheet.ts) or a body, the surface of any mesh (body.ts). The rest of the page
// knows places on it, their normals, and what its geometry is; how its vertices are arranged only these two know.

import type { MessageInitShape } from "@bufbuild/protobuf";
import type { Box3, BufferGeometry, Ray, Vector3 } from "three";
import type { Field, Vec3 } from "palpate";
import type { SheetEdge } from "./sheet-edge";
import type { ForceSchema, PositionSchema } from "palpate/v1";
import type { Felt } from "./samples";

/** A place on the tissue. */
export interface Place {
  /** Where it rests, m. */
  restM: Vec3;
  /** The direction out of the tissue, on the side that is touched; of length 1. */
  outward: Vec3;
  /** Of a body: the triangle, and the weights of its vertices. */
  triangle: number;
  weights: Vec3;
}

/** How the commands of a push and of a pull name a place. */
export type Centre = NonNullable<MessageInitShape<typeof ForceSchema>["centre"]>;
export type Point = Pick<MessageInitShape<typeof PositionSchema>, "point" | "vertex">;

/** What becomes of a push. 1 and 1 on a sheet, whose pushes are told by what they are in their middle. */
export interface Push {
  /** All points together get so many times what a point in the middle gets. */
  sum: number;
  /**
   * The server tells the mean force on the tool of the points around it, by their weights. When nothing moves, so many times
   * that is the force on all of them.
   */
  share: number;
}

export interface Surface {
  /** Displacements as the server sent them. */
  readonly field: Field;
  /** Geometry of the triangles: attributes `position`, `normal`, `open`, and what its material needs besides. */
  readonly geometry: BufferGeometry;
  /** Geometry of the lines between mass points. */
  readonly lines: BufferGeometry;
  /** Around a sheet. */
  readonly edge: SheetEdge | undefined;
  /** Around the tissue at rest, without its flank, m. */
  readonly box: Box3;
  /** Length of its diagonal. */
  readonly sizeM: number;
  /** One in so many vertices per side is drawn. */
  readonly every: number;
  /** Whether both its sides can be seen. */
  readonly isOpen: boolean;

  /** Draws fewer vertices, as far as it can. Returns true if the number changed. */
  drawEvery(wanted: number): boolean;
  /** Call before each picture: updates what is drawn by what changed since the last. Returns true if anything did. */
  refresh(): void;
  /** How far vertices moved at most since the last call, m. */
  takeMoved(): number;
  /** The largest displacement of any vertex, m. */
  largestM(): number;

  /** The place that a ray from the eye meets first. */
  pick(ray: Ray): Place | undefined;
  /** The place that keys aim at first. */
  middle(): Place;
  /** The place about `way` from another. */
  beside(place: Place, way: Vector3): Place;
  /** The mass point next to a place. */
  nearest(place: Place): Place;
  /**
   * The place of a tool's control point; undefined if it has none. Its outward side is that from which the tool acts: the outer one
   * or not, if the caller knows, else by its force.
   */
  ofTool(tool: Pick<Felt, "point" | "vertex" | "appliedN">, isOuter?: boolean): Place | undefined;
  /** Whether a place is touched from the tissue's outer side. */
  isOuter(place: Place): boolean;
  /** The normal of a place at rest, on the tissue's outer side. */
  outerAt(place: Place): Vector3;
  /** Displacement of a place. The result is valid until the next call. */
  displacementAt(place: Place): Vector3;
  /** A place as forces name it, and its mass point as grasps do. */
  centre(place: Place): Centre;
  point(place: Place): Point;
  /** A push that falls off over `lengthM` around a place. */
  push(place: Place, lengthM: number): Push;

  /** Puts the middle of a ball where it rests on the tissue at a place. */
  restOn(place: Place, radiusM: number, middleM: Vector3): void;
  /**
   * The least distance of a shaft's underside from the tissue, m; negative if the shaft is in it. It begins at `tipM`,
   * `radiusM` is that of the tip, and the shaft's own is `part` of it.
   */
  room(tipM: Vector3, axis: Vector3, lengthM: number, radiusM: number, part: number): number;
  /** Height of the tissue above (x, y), where only what lies above it has to be clear of it: of a sheet. */
  heightAt(xM: number, yM: number): number | undefined;

  dispose(): void;
}
