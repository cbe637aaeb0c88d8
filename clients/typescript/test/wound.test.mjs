// A wound that a client follows is the one that the server has (crates/session/src/surface/wound/tests.rs writes wound.json).

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { Wound } from "palpate";

/**
 * @typedef {{ number: number, restXM: number, restYM: number, restZM: number }} CutVertex
 * @typedef {{ firstVertex: number, vertices: import("palpate").Lip[], triangles: import("palpate").Cut[], cutVertices?: CutVertex[], cutFaces?: { number: number, corners: number[] }[] }} Delta
 * @typedef {{ restM: number[], triangles: number[], displacementM: number[], first: Delta, second: Delta, shownM: number[], shownTriangles: number[][] }} Known
 */

/** @type {Known} */
const known = JSON.parse(readFileSync(new URL("wound.json", import.meta.url), "utf8"));

/** @param {Delta} delta @param {number} version @param {boolean} continues */
const part = ({ cutVertices = [], cutFaces = [], ...delta }, version, continues) => ({ ...delta, cutVertices, cutFaces, version, continues, severed: 11, pieces: 2, staysWhole: false });

const begun = () => new Wound(known.restM.length / 3, known.triangles.length / 3);

/** Triangles in one order. @param {number[]} corners */
function sorted(corners) {
  const triangles = Array.from({ length: corners.length / 3 }, (_, t) => corners.slice(3 * t, 3 * t + 3));
  return triangles.sort((a, b) => a[0] - b[0] || a[1] - b[1] || a[2] - b[2]);
}

test("a wound that is followed in two parts is shown as the server computes it", () => {
  const wound = begun();
  assert.equal(wound.take([part(known.first, 3, true)]).isNew, true);
  const change = wound.take([part(known.second, 5, true)]);
  assert.equal(change.isNew, false);
  assert.deepEqual(change.cuts, known.second.triangles);
  assert.deepEqual([wound.version, wound.severed, wound.pieces], [5, 11, 2]);
  assert.deepEqual(sorted(wound.shownTriangles(known.triangles)), known.shownTriangles);
  const positionsM = wound.positionsM(known.restM, known.displacementM);
  assert.equal(positionsM.length, known.shownM.length);
  positionsM.forEach((value, i) => assert.ok(Math.abs(value - known.shownM[i]) < 1e-12, `${i}: ${value}`));
});

test("a wound that the server has undone begins anew", () => {
  const wound = begun();
  wound.take([part(known.first, 3, true)]);
  wound.take([part(known.second, 5, true)]);
  assert.equal(wound.take([part(known.first, 7, false)]).isNew, true);
  assert.equal(wound.vertices.length, known.first.vertices.length);
  const empty = { firstVertex: 0, vertices: [], triangles: [] };
  wound.take([part(empty, 9, false)]);
  assert.deepEqual(sorted(wound.shownTriangles(known.triangles)), sorted(known.triangles));
});

test("a wound that does not fit is refused, and changes nothing", () => {
  const wound = begun();
  wound.take([part(known.first, 3, true)]);
  const [lip, cut] = [known.second.vertices[0], known.second.triangles[0]];
  const wrong = [
    { ...known.second, firstVertex: 16 },
    { ...known.second, vertices: [{ ...lip, host: 16 }, ...known.second.vertices.slice(1)] },
    { ...known.second, vertices: [{ ...lip, secondPart: NaN }, ...known.second.vertices.slice(1)] },
    { ...known.second, triangles: [{ ...cut, first: 18 }] },
    { ...known.second, triangles: [{ ...cut, count: 0 }] },
    { ...known.second, triangles: [{ ...cut, corners: [0, 1, 999] }] },
    { ...known.second, triangles: [{ ...cut, corners: [0, 1] }] },
  ];
  for (const delta of wrong) assert.throws(() => wound.take([part(delta, 5, true)]), RangeError);
  assert.throws(() => wound.take([]), RangeError);
  assert.deepEqual([wound.version, wound.vertices.length], [3, known.first.vertices.length]);
});

const cutSurface = {
  firstVertex: 0,
  vertices: [],
  triangles: [],
  cutVertices: [0, 1, 2, 3].map((number) => ({ number, restXM: number, restYM: 0.5, restZM: -number })),
  cutFaces: [{ number: 0, corners: [0, 1, 2, 3] }],
};

test("the surface within cuts is followed, and what changes is replaced", () => {
  const wound = new Wound(16, 18, 6);
  assert.equal(wound.take([part(cutSurface, 3, true)]).hasNewCutSurface, true);
  const moved = { number: 1, restXM: 9, restYM: 8, restZM: 7 };
  const added = { number: 4, restXM: 4, restYM: 4, restZM: 4 };
  const later = { ...cutSurface, cutVertices: [moved, added], cutFaces: [{ number: 0, corners: [0, 1, 4, 3] }, { number: 5, corners: [4, 3, 1, 0] }] };
  wound.take([part(later, 5, true)]);
  assert.deepEqual(wound.cutRestM, [0, 0.5, -0, 9, 8, 7, 2, 0.5, -2, 3, 0.5, -3, 4, 4, 4]);
  assert.deepEqual([...wound.cutFaces], [[0, [0, 1, 4, 3]], [5, [4, 3, 1, 0]]]);
  assert.equal(wound.take([part({ ...cutSurface, cutVertices: [], cutFaces: [] }, 6, true)]).hasNewCutSurface, false);
  wound.take([part({ ...cutSurface, cutVertices: [], cutFaces: [] }, 7, false)]);
  assert.deepEqual([wound.cutRestM.length, wound.cutFaces.size], [0, 0]);
});

test("a surface within cuts that does not fit is refused, and changes nothing", () => {
  const wound = new Wound(16, 18, 6);
  wound.take([part(cutSurface, 3, true)]);
  const vertex = (/** @type {number} */ number, restXM = 0) => ({ number, restXM, restYM: 0, restZM: 0 });
  const wrong = [
    { cutVertices: [vertex(5)] },
    { cutVertices: [vertex(4), vertex(5), vertex(6)] },
    { cutVertices: [vertex(4, NaN)] },
    { cutFaces: [{ number: 1, corners: [0, 1, 2] }] },
    { cutFaces: [{ number: 1, corners: [0, 1, 2, 4] }] },
  ];
  const none = { ...cutSurface, cutVertices: [], cutFaces: [] };
  for (const delta of wrong) assert.throws(() => wound.take([part({ ...none, ...delta }, 5, true)]), RangeError);
  assert.deepEqual([wound.version, wound.cutRestM.length, wound.cutFaces.size], [3, 12, 1]);
});
