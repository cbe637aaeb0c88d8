// Connectivity of the triangles and edges of a mesh.

import { Vector3 } from "three";

/** Lists of integers, stored one after the other: list i is from `start[i]` to `start[i + 1]`. */
export interface Lists {
  start: Uint32Array;
  of: Uint32Array;
}

/** Groups values into `count` lists: list k contains all `values(i)` with `keys[i]` = k, in their order. */
export function lists(count: number, keys: ArrayLike<number>, values: (i: number) => number): Lists {
  const start = new Uint32Array(count + 1);
  for (let i = 0; i < keys.length; i++) start[keys[i]! + 1]! += 1;
  for (let i = 0; i < count; i++) start[i + 1]! += start[i]!;
  const of = new Uint32Array(keys.length);
  const at = start.slice(0, count);
  for (let i = 0; i < keys.length; i++) of[at[keys[i]!]!++] = values(i);
  return { start, of };
}

/** Returns for each block of 2^`bits` vertices the triangles with a vertex in it, without repetitions. */
export function touching(triangles: Uint32Array, blocks: number, bits: number): Lists {
  const keys: number[] = [];
  const values: number[] = [];
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [triangles[t]! >> bits, triangles[t + 1]! >> bits, triangles[t + 2]! >> bits];
    keys.push(a);
    values.push(t / 3);
    if (b !== a) {
      keys.push(b);
      values.push(t / 3);
    }
    if (c !== a && c !== b) {
      keys.push(c);
      values.push(t / 3);
    }
  }
  return lists(blocks, keys, (i) => values[i]!);
}

/** Returns keys of the edges, ascending. Equal keys belong to the same edge. */
function edgeKeys(triangles: Uint32Array, count: number): Float64Array {
  const keys = new Float64Array(triangles.length);
  for (let t = 0; t < triangles.length; t++) {
    const [a, b] = [triangles[t]!, triangles[t % 3 === 2 ? t - 2 : t + 1]!];
    keys[t] = Math.min(a, b) * count + Math.max(a, b);
  }
  return keys.sort();
}

/** Returns both ends of each edge, and whether any edge belongs to a single triangle. */
export function edgesOf(triangles: Uint32Array, count: number): { edges: Uint32Array<ArrayBuffer>; isOpen: boolean } {
  const keys = edgeKeys(triangles, count);
  const edges = new Uint32Array(2 * keys.length);
  let [at, isOpen] = [0, false];
  for (let i = 0; i < keys.length; ) {
    const key = keys[i]!;
    let same = i + 1;
    while (same < keys.length && keys[same] === key) same += 1;
    if (same === i + 1) isOpen = true;
    edges[at++] = Math.floor(key / count);
    edges[at++] = key % count;
    i = same;
  }
  return { edges: edges.slice(0, at), isOpen };
}

/** Returns the middle of the longest border. */
export function opening(triangles: Uint32Array, rest: Float32Array): Vector3 | undefined {
  const count = rest.length / 3;
  const keys = edgeKeys(triangles, count);
  const next = new Map<number, number[]>();
  for (let i = 0; i < keys.length; i++) {
    if (keys[i] === keys[i - 1] || keys[i] === keys[i + 1]) continue;
    const [a, b] = [Math.floor(keys[i]! / count), keys[i]! % count];
    for (const [from, to] of [[a, b], [b, a]] as const) {
      const ends = next.get(from);
      if (ends) ends.push(to);
      else next.set(from, [to]);
    }
  }
  let [longest, middle] = [0, new Vector3()];
  const seen = new Set<number>();
  for (const begin of next.keys()) {
    if (seen.has(begin)) continue;
    const loop = [begin];
    seen.add(begin);
    for (let k = 0; k < loop.length; k++) {
      for (const to of next.get(loop[k]!) ?? []) {
        if (seen.has(to)) continue;
        seen.add(to);
        loop.push(to);
      }
    }
    if (loop.length <= longest) continue;
    longest = loop.length;
    middle = new Vector3();
    for (const v of loop) middle.add(new Vector3(rest[3 * v], rest[3 * v + 1], rest[3 * v + 2]).divideScalar(loop.length));
  }
  return longest > 0 ? middle : undefined;
}
