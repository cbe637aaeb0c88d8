// Burns that a client follows: `make test-typescript`.

import assert from "node:assert/strict";
import { test } from "node:test";
import { Burns } from "palpate";

/** @param {number} version @param {boolean} continues @param {[number, number][]} burns */
const part = (version, continues, burns) => ({ version, continues, burns: burns.map(([vertex, burn]) => ({ vertex, burn })) });

test("burns that are followed in parts are those of the last answer for each vertex", () => {
  const burns = new Burns(4);
  burns.take([part(3, true, [[0, 0.25]]), part(3, true, [[2, 0.5]])]);
  assert.deepEqual([burns.version, ...burns.burn], [3, 0.25, 0, 0.5, 0]);
  burns.take([part(5, true, [[2, 1]])]);
  assert.deepEqual([burns.version, ...burns.burn], [5, 0.25, 0, 1, 0]);
  burns.take([part(5, true, [])]);
  assert.deepEqual([...burns.burn], [0.25, 0, 1, 0]);
});

test("burns that the server has undone begin anew", () => {
  const burns = new Burns(3);
  burns.take([part(3, true, [[0, 0.25], [1, 1]])]);
  burns.take([part(7, false, [[1, 0.5]])]);
  assert.deepEqual([burns.version, ...burns.burn], [7, 0, 0.5, 0]);
});

test("burns that do not fit are refused, and change nothing", () => {
  const burns = new Burns(2);
  burns.take([part(3, true, [[0, 0.25]])]);
  for (const wrong of [[part(4, true, [[2, 0.5]])], [part(4, true, [[0, Number.NaN]])], [part(4, true, [[0, 1.5]])], [part(4, true, [[1, -0.1]])], []]) {
    assert.throws(() => burns.take(wrong), RangeError);
    assert.deepEqual([burns.version, ...burns.burn], [3, 0.25, 0]);
  }
});
