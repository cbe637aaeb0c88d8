// The field: the displacement of every vertex as the server sent it, and where it changed. The worker that receives
// frames has one, and the page keeps a copy that follows it.

import { Encoding, type Patch, type WatchFramesResponse } from "./gen/palpate/v1/view_pb.js";

/** Rows a0 … a1 and columns b0 … b1 of vertices, inclusive. */
export interface Rectangle {
  a0: number;
  a1: number;
  b0: number;
  b1: number;
}

/** Limit for plausible displacements, m. */
const FARTHEST_M = 1e6;

/** Maximum number of vertices of a surface. */
export const MAX_VERTICES = 1 << 24;

/** Returns whether an encoding contains integers, with origin and scale, rather than floating-point numbers. */
function hasIntegers(encoding: Encoding): boolean {
  switch (encoding) {
    case Encoding.UNSPECIFIED:
    case Encoding.F32:
      return false;
    case Encoding.I16:
      return true;
    default:
      // From a newer server.
      throw new RangeError(`unknown encoding ${String(encoding)}`);
  }
}

export class Field {
  /** The three components of vertex (a, b) begin at index 3·(a·ny + b). */
  readonly displacementM: Float32Array<ArrayBuffer>;
  /** Bounds of all changes since the last `takeChanged`. */
  private changed: Rectangle | undefined;

  /** `cutRows` of the nx rows are for the vertices of the surface within cuts (`MeshData.cutRows`). */
  constructor(
    readonly nx: number,
    readonly ny: number,
    readonly cutRows = 0,
  ) {
    const isWhole = [nx, ny, cutRows, nx - cutRows].every((count) => Number.isInteger(count) && count >= 0);
    if (!isWhole || nx * ny > MAX_VERTICES) throw new RangeError(`a surface of ${nx} × ${ny} vertices can't be shown`);
    this.displacementM = new Float32Array(3 * nx * ny);
  }

  /** Applies a patch of a frame. */
  write(part: WatchFramesResponse, patch: Patch): void {
    const { displacement: bytes, firstX, firstY, countX, countY } = patch;
    const isWhole = hasIntegers(part.encoding);
    const size = 3 * countX * countY;
    if (bytes.byteLength !== size * (isWhole ? 2 : 4) || firstX + countX > this.nx || firstY + countY > this.ny) {
      throw new RangeError("a patch is not of this surface");
    }
    // Numbers in a message may be unaligned; the copy is aligned. Browsers run on little-endian machines, like the wire
    // format.
    const own = bytes.slice().buffer;
    const q = isWhole ? new Int16Array(own) : new Float32Array(own);
    const [o, s] = [part.originM, part.scaleM];
    const [ox, oy, oz] = [o?.x ?? 0, o?.y ?? 0, o?.z ?? 0];
    const [sx, sy, sz] = isWhole ? [s?.x ?? 0, s?.y ?? 0, s?.z ?? 0] : [1, 1, 1];
    const isNear = (value: number) => Math.abs(value) <= FARTHEST_M;
    if (![ox, oy, oz, sx, sy, sz].every(isNear) || !(isWhole || q.every(isNear))) {
      throw new RangeError("a patch has displacements that are none");
    }
    const d = this.displacementM;
    for (let a = firstX, k = 0; a < firstX + countX; a++) {
      for (let b = 0, i = 3 * (a * this.ny + firstY); b < countY; b++, i += 3, k += 3) {
        d[i] = ox + sx * q[k]!;
        d[i + 1] = oy + sy * q[k + 1]!;
        d[i + 2] = oz + sz * q[k + 2]!;
      }
    }
    if (size > 0) this.touch({ a0: firstX, a1: firstX + countX - 1, b0: firstY, b1: firstY + countY - 1 });
  }

  private touch({ a0, a1, b0, b1 }: Rectangle): void {
    const c = this.changed ?? { a0, a1, b0, b1 };
    this.changed = {
      a0: Math.min(a0, c.a0),
      a1: Math.max(a1, c.a1),
      b0: Math.min(b0, c.b0),
      b1: Math.max(b1, c.b1),
    };
  }

  /** Returns the bounds of the changes since the last call. */
  takeChanged(): Rectangle | undefined {
    const changed = this.changed;
    this.changed = undefined;
    return changed;
  }

  /** Copies a rectangle's displacements to consecutive places in `values`. */
  copyTo(values: Float32Array, { a0, a1, b0, b1 }: Rectangle): void {
    const width = 3 * (b1 + 1 - b0);
    for (let a = a0, at = 0; a <= a1; a++, at += width) {
      const from = 3 * (a * this.ny + b0);
      values.set(this.displacementM.subarray(from, from + width), at);
    }
  }

  /** Copies consecutive `values` into a rectangle. */
  copyFrom(values: Float32Array, rectangle: Rectangle): void {
    const { a0, a1, b0, b1 } = rectangle;
    const width = 3 * (b1 + 1 - b0);
    for (let a = a0, at = 0; a <= a1; a++, at += width) {
      this.displacementM.set(values.subarray(at, at + width), 3 * (a * this.ny + b0));
    }
    this.touch(rectangle);
  }
}
