// Lumps: the stiff places of a scene, shown to an instructor; and lumps that one puts into a mesh of one's own.

import { create } from "@bufbuild/protobuf";
import type { Vec3 } from "palpate";
import { type Inclusion, InclusionSchema, type Scene } from "palpate/v1";
import type { Place } from "./surface";

/** A ball in the tissue. */
export interface Lump {
  centreM: Vec3;
  radiusM: number;
}

/** Radius of a lump that is put in, of the size of the tissue: 9 mm in a liver; and how it lies beneath the surface, of its radius. */
const RADIUS = 0.04;
const BENEATH = 0.4;
/** Over this part of its radius a lump becomes tissue. */
const EDGE = 0.4;
/** How much stiffer it is, and what is beneath it: as in the scene `liver-organ`. */
const STIFFER = { springs: 1.5, support: 5 };

/** The lumps of a scene. What is stiff by a group of the mesh has no shape of its own. */
export function lumpsOf(scene: Scene | undefined): Lump[] {
  return (scene?.inclusions ?? []).flatMap(({ centreM, radiusM }) =>
    centreM ? [{ centreM: [centreM.x, centreM.y, centreM.z] as Vec3, radiusM: radiusM ?? 0 }] : [],
  );
}

/** A lump beneath a place of a tissue. */
export function lumpAt({ restM, outward }: Place, sizeM: number, edgeM: number): Inclusion {
  // Some vertices have to be in it.
  const radiusM = Math.max(RADIUS * sizeM, 1.5 * edgeM);
  const [x, y, z] = restM.map((v, c) => v - BENEATH * radiusM * outward[c]!) as Vec3;
  return create(InclusionSchema, {
    centreM: { x, y, z },
    radiusM,
    edgeM: EDGE * radiusM,
    stiffnessFactor: STIFFER.springs,
    virtualStiffnessFactor: STIFFER.support,
  });
}
