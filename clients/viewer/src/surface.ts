// What the page shows and touches: a sheet (sheet.ts), or a body, which is the surface of any mesh (body.ts). The
// rest of the page uses places on it, their normals, and its geometry; only these two modules know how its vertices
// are arranged.

import type { MessageInitShape } from "@bufbuild/protobuf";
import type { Box3, BufferGeometry, Ray, Vector3 } from "three";
import type { Field, Vec3 } from "palpate";
import type { SheetEdge } from "./sheet-edge";
import type { ForceSchema, PositionSchema } from "palpate/v1";
import type { Felt } from "./samples";
import type { ShownWound, WoundedSurface } from "./wound";

/** A place on the tissue. */
export interface Place {
  /** Position at rest, m. */
  restM: Vec3;
  /** Unit vector out of the tissue, on the side that is touched. */
  outward: Vec3;
  /** For a body: the triangle, and the barycentric coordinates in it. */
  triangle: number;
  weights: Vec3;
}

/** How the commands of a push and of a pull identify a place. */
export type Centre = NonNullable<MessageInitShape<typeof ForceSchema>["centre"]>;
export type Point = Pick<MessageInitShape<typeof PositionSchema>, "point" | "vertex">;

/** Effect of a push. Both values are 1 on a sheet, where the strength of a push is the force at its centre. */
export interface Push {
  /** Ratio of the total force on all points to that on a point at the centre. */
  sum: number;
  /**
   * The server reports the mean force on the tool of the points around it, weighted. If nothing moves, the force on
   * all points is this multiple of it.
   */
  share: number;
}

export interface Surface extends WoundedSurface {
  /** Displacements as the server sent them. */
  readonly field: Field;
  /**
   * Geometry of the triangles: the attributes `position`, `normal`, `open` and `burn`, and others that its material needs.
   */
  readonly geometry: BufferGeometry;
  /** Geometry of the lines between mass points. */
  readonly lines: BufferGeometry;
  /** What blades have cut. */
  readonly wound: ShownWound;
  /** The flank around a sheet. */
  readonly edge: SheetEdge | undefined;
  /** Bounding box of the tissue at rest, without its flank, m. */
  readonly box: Box3;
  /** Length of its diagonal, m. */
  readonly sizeM: number;
  /** One in this many vertices per side is drawn. */
  readonly every: number;
  /** Whether both its sides may be visible. */
  readonly isOpen: boolean;

  /** Draws fewer vertices, as far as possible. Returns true if the number changed. */
  drawEvery(wanted: number): boolean;
  /**
   * Updates what is drawn to the changes since the last picture. Call this before each picture. Returns whether a part of a large wound
   * is left for the next one.
   */
  refresh(): boolean;
  /** Shows how burnt each vertex of the mesh is, 0 to 1. */
  showBurns(burn: Float32Array): void;
  /** Returns how far vertices moved since the last call, at most, m. */
  takeMoved(): number;
  /** Returns the largest displacement of any vertex, m. */
  largestM(): number;

  /** Returns the place that a ray from the eye meets first. */
  pick(ray: Ray): Place | undefined;
  /** Returns the initial target of the keys. */
  middle(): Place;
  /** Returns the place approximately at the offset `way` from another. */
  beside(place: Place, way: Vector3): Place;
  /** Returns the place nearest to a point at rest, on the outer side. */
  at(restM: Vec3): Place;
  /** Returns the mass point nearest to a place. */
  nearest(place: Place): Place;
  /**
   * Returns the place of a tool's control point; undefined if it has none. Its outward direction is on the side from
   * which the tool acts: given by `isOuter` if the caller knows it, otherwise by the tool's force.
   */
  ofTool(tool: Pick<Felt, "point" | "vertex" | "appliedN">, isOuter?: boolean): Place | undefined;
  /** Returns whether a place is touched from the tissue's outer side. */
  isOuter(place: Place): boolean;
  /** Returns the normal of a place at rest, on the tissue's outer side. */
  outerAt(place: Place): Vector3;
  /** Returns the displacement of a place. The result is valid until the next call. */
  displacementAt(place: Place): Vector3;
  /** Returns a place in the form that forces use; its mass point is in the form that grasps use. */
  centre(place: Place): Centre;
  point(place: Place): Point;
  /** Returns the effect of a push that falls off over `lengthM` around a place. */
  push(place: Place, lengthM: number): Push;

  /** Sets `middleM` to the centre of a ball that rests on the tissue at a place. */
  restOn(place: Place, radiusM: number, middleM: Vector3): void;
  /**
   * Returns the smallest distance of a shaft's underside from the tissue, m; negative if the shaft is in the tissue.
   * The shaft begins at `tipM`; `radiusM` is the radius of the tip, and the shaft's radius is `part` of it.
   */
  room(tipM: Vector3, axis: Vector3, lengthM: number, radiusM: number, part: number): number;
  /**
   * Returns the height of the tissue at (x, y) if what is above this height is certainly outside the tissue, as for a
   * sheet.
   */
  heightAt(xM: number, yM: number): number | undefined;

  dispose(): void;
}
