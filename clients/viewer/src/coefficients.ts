// The tissue that the page makes from an uploaded mesh. The coefficients depend on its size, so that an organ of any
// size and with any number of vertices feels alike under a finger.

import type { MessageInitShape } from "@bufbuild/protobuf";
import type { MeshReport, SceneSchema } from "palpate/v1";

/**
 * Falloff length of a finger's push, as a fraction of the tissue's size (the diagonal of its bounding box); 5 mm on a
 * liver.
 */
const FINGER = 0.02;
/**
 * A push of this many newtons makes a dent of the given fraction of the tissue's size: 1 N and nearly 4 mm on a
 * liver.
 */
const PUSH_N = 1;
const DENT = 0.015;
/** Density of soft tissue. */
const DENSITY_KG_PER_M3 = 1060;
/** Depth of tissue that moves along with the surface, as a fraction of its size: 30 mm in a liver. */
const DEPTH = 0.12;
/** Fraction of critical damping. */
const DAMPING_RATIO = 0.5;
/** If there are more vertices than this, the server is asked to simulate only so many. Frames show all of them. */
export const MAX_VERTICES = 12_000;

/** A solid: usual soft tissue, in so many cells that one core steps it in real time. */
const SOLID = { youngsModulusPa: 8000, poissonsRatio: 0.45, densityKgPerM3: DENSITY_KG_PER_M3, dampingPerS: 60, cells: 2500 };
/** The error of such cells is larger. */
const SOLID_TOLERANCE = 1e-2;
/** The lowest part of a solid, as a fraction of its height, does not move, as if it lay on a table. */
const HELD = 0.03;

/** Returns the falloff length of a push: a finger's, but not less than an edge. */
export function fingerM(sizeM: number, edgeM: number): number {
  return Math.max(FINGER * sizeM, edgeM) || 1;
}

/** Returns the diagonal of the bounding box in a report, m. */
export function sizeOf({ extent }: MeshReport): number {
  const [a, b] = [extent?.leastM, extent?.mostM];
  return a && b ? Math.hypot(b.x - a.x, b.y - a.y, b.z - a.z) : 0;
}

/**
 * A scene of a mesh that was sent. With n vertices, edges of the usual length L, T triangles, and ℓ the length over which a
 * push falls off:
 *
 * - The area is about T·(√3/4)·L², of one vertex A = that / n.
 * - A push F in the middle is F·exp(−r/ℓ) at a distance r: together F·Σexp(−r/ℓ) ≈ F·2πℓ²/A. Borne by the anchor springs
 *   alone, it dents the middle by d = F/K″. For a dent d₀ under a push of 1 N altogether, K″ = 1 N·A/(2πℓ²·d₀).
 * - A dent as deep as it is wide stretches the net of springs as well, which draws each vertex back with about
 *   2k·(L/ℓ)²·d. It shall bear as much as the anchor springs: k = K″·(ℓ/L)²/2.
 * - A third of what lies beneath moves along (docs/scenes.md, "Tissue"): m = ρ·H·A/3.
 * - C = 2ζ·√(K″·m).
 *
 * A and K″ shrink alike with more vertices, so the dent does not depend on how fine the mesh is.
 */
export function sceneOf(name: string, meshId: string, report: MeshReport, vertices: number): MessageInitShape<typeof SceneSchema> {
  const sizeM = sizeOf(report) || 1;
  // The edges of a decimated mesh are longer, with the same total area.
  const edgeM = (report.edgeM || sizeM) * Math.sqrt(report.vertices / vertices);
  const areaM2 = (report.triangles * Math.sqrt(3) * (report.edgeM || sizeM) ** 2) / 4 / vertices;
  const lengthM = fingerM(sizeM, edgeM);
  const anchor = (PUSH_N * areaM2) / (2 * Math.PI * lengthM ** 2 * DENT * sizeM);
  const mass = (DENSITY_KG_PER_M3 * DEPTH * sizeM * areaM2) / 3;
  return {
    name,
    mesh: { meshId, pointMassKg: mass, ...(vertices < report.vertices ? { vertices } : {}) },
    springs: { stiffnessNPerM: (anchor * (lengthM / edgeM) ** 2) / 2, bendingFactor: 0.2 },
    anchorSprings: { stiffnessNPerM: anchor },
    damping: { coefficientNSPerM: 2 * DAMPING_RATIO * Math.sqrt(anchor * mass) },
    stepping: { tolerance: 1e-3 },
  };
}

/** A scene of a solid that fills a mesh that was sent, held at the bottom. */
export function solidOf(name: string, meshId: string, { extent }: MeshReport): MessageInitShape<typeof SceneSchema> {
  const [least, most] = [extent?.leastM?.z ?? 0, extent?.mostM?.z ?? 0];
  const plane = { planeM: { x: 0, y: 0, z: least }, normal: { x: 0, y: 0, z: 1 }, withinM: HELD * (most - least) };
  return { name, solid: { meshId, ...SOLID, fixed: [{ part: { case: "plane", value: plane } }] }, stepping: { tolerance: SOLID_TOLERANCE } };
}
