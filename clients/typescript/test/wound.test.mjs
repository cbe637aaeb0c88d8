// A wound that a client follows is the one that the server has (crates/session/src/surface/wound/tests.rs writes wound.json).

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { Wound } from "palpate";

/**
 * @typedef {{ firstVertex: number, vertices: import("palpate").Lip[], triangles: import("palpate").Cut[] }} Delta
 * @typedef {{ restM: number[], triangles: number[], displacementM: number[], first: Delta, second: Delta, shownM: number[], shownTriangles: number[][] }} Known
 */

/** @type {Known} */
const known = JSON.parse(readFileSync(new URL("wound.json", import.meta.url), "utf8"));

/** @param {Delta} delta @param {number} version @param {boolean} continues */
const part = (delta, version, continues) => ({ ...delta, version, continues, severed: 11, pieces: 2, staysWhole: false });

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
