// The surface: every vertex's displacement as the server sent it, positions and normals for the picture.

import { BufferAttribute, BufferGeometry, DynamicDrawUsage } from "three";
import { Encoding, type Patch, type WatchFramesResponse } from "./gen/palpate/v1/view_pb";

/** Rows a0 … a1 and columns b0 … b1 of vertices, the last ones included. */
interface Rectangle {
  a0: number;
  a1: number;
  b0: number;
  b1: number;
}

export class Surface {
  /** Of the triangles. */
  readonly geometry = new BufferGeometry();
  /** Of the lines between mass points. */
  readonly lines = new BufferGeometry();
  private readonly position: BufferAttribute;
  private readonly normal: BufferAttribute;
  private readonly displacementM: Float32Array;

  /**
   * Vertex (a, b) has index a·ny + b, rests at (a, b, 0)·spacing, and has texture coordinates (a/(nx − 1), b/(ny − 1)):
   * what `GetMesh` would tell, at megabytes. `every` vertices is a mass point.
   */
  constructor(
    readonly nx: number,
    readonly ny: number,
    readonly spacingM: number,
    every: number,
  ) {
    const vertices = nx * ny;
    this.displacementM = new Float32Array(3 * vertices);
    this.position = new BufferAttribute(new Float32Array(3 * vertices), 3).setUsage(DynamicDrawUsage);
    this.normal = new BufferAttribute(new Float32Array(3 * vertices), 3).setUsage(DynamicDrawUsage);
    const uv = new Float32Array(2 * vertices);
    for (let a = 0, i = 0; a < nx; a++) {
      for (let b = 0; b < ny; b++, i++) {
        this.position.setXYZ(i, a * spacingM, b * spacingM, 0);
        this.normal.setXYZ(i, 0, 0, 1);
        uv[2 * i] = a / Math.max(nx - 1, 1);
        uv[2 * i + 1] = b / Math.max(ny - 1, 1);
      }
    }
    const triangles = new Uint32Array(6 * (nx - 1) * (ny - 1));
    for (let a = 0, t = 0; a + 1 < nx; a++) {
      for (let b = 0; b + 1 < ny; b++, t += 6) {
        const corner = a * ny + b;
        triangles.set([corner, corner + ny, corner + ny + 1, corner, corner + ny + 1, corner + 1], t);
      }
    }
    this.geometry.setAttribute("position", this.position);
    this.geometry.setAttribute("normal", this.normal);
    this.geometry.setAttribute("uv", new BufferAttribute(uv, 2));
    this.geometry.setIndex(new BufferAttribute(triangles, 1));
    this.lines.setAttribute("position", this.position);
    this.lines.setIndex(new BufferAttribute(gridLines(nx, ny, every), 1));
  }

  /** Writes the patches of a whole frame over what is shown. */
  apply(parts: WatchFramesResponse[]): void {
    let first = this.nx;
    let last = -1;
    const changed: Rectangle[] = [];
    for (const part of parts) {
      for (const patch of part.patches) {
        this.write(part, patch);
        const [a0, b0] = [patch.firstX, patch.firstY];
        changed.push({ a0, a1: a0 + patch.countX - 1, b0, b1: b0 + patch.countY - 1 });
      }
    }
    for (const { a0, a1, b0, b1 } of changed) {
      // The normals around a patch change as well.
      const wider = {
        a0: Math.max(a0 - 1, 0),
        a1: Math.min(a1 + 1, this.nx - 1),
        b0: Math.max(b0 - 1, 0),
        b1: Math.min(b1 + 1, this.ny - 1),
      };
      this.turn(wider);
      first = Math.min(first, wider.a0);
      last = Math.max(last, wider.a1);
    }
    if (last < first) return;
    for (const attribute of [this.position, this.normal]) {
      attribute.addUpdateRange(3 * first * this.ny, 3 * (last - first + 1) * this.ny);
      attribute.needsUpdate = true;
    }
  }

  private write(part: WatchFramesResponse, patch: Patch): void {
    const { displacement: bytes, firstX, firstY, countX, countY } = patch;
    const isWhole = part.encoding === Encoding.I16;
    const size = 3 * countX * countY;
    if (bytes.byteLength !== size * (isWhole ? 2 : 4) || firstX + countX > this.nx || firstY + countY > this.ny) {
      throw new RangeError("a patch is not of this surface");
    }
    // Numbers lie anywhere in a message: copied, they are aligned. Browsers' machines are little-endian, as the wire is.
    const own = bytes.slice().buffer;
    const q = isWhole ? new Int16Array(own) : new Float32Array(own);
    const [o, s] = [part.originM, part.scaleM];
    const origin = [o?.x ?? 0, o?.y ?? 0, o?.z ?? 0] as const;
    const scale = isWhole ? ([s?.x ?? 0, s?.y ?? 0, s?.z ?? 0] as const) : ([1, 1, 1] as const);
    const positions = this.position.array as Float32Array;
    for (let a = firstX, k = 0; a < firstX + countX; a++) {
      for (let b = firstY, i = 3 * (a * this.ny + firstY); b < firstY + countY; b++, i += 3, k += 3) {
        const x = origin[0] + scale[0] * q[k]!;
        const y = origin[1] + scale[1] * q[k + 1]!;
        const z = origin[2] + scale[2] * q[k + 2]!;
        this.displacementM[i] = x;
        this.displacementM[i + 1] = y;
        this.displacementM[i + 2] = z;
        positions[i] = a * this.spacingM + x;
        positions[i + 1] = b * this.spacingM + y;
        positions[i + 2] = z;
      }
    }
  }

  /** Normals: the cross product of the differences across each vertex along x and along y. */
  private turn({ a0, a1, b0, b1 }: Rectangle): void {
    const p = this.position.array as Float32Array;
    const n = this.normal.array as Float32Array;
    const [nx, ny] = [this.nx, this.ny];
    for (let a = a0; a <= a1; a++) {
      const before = a > 0 ? -3 * ny : 0;
      const after = a + 1 < nx ? 3 * ny : 0;
      for (let b = b0, i = 3 * (a * ny + b0); b <= b1; b++, i += 3) {
        const [l, r] = [i + before, i + after];
        const d = b > 0 ? i - 3 : i;
        const u = b + 1 < ny ? i + 3 : i;
        const ex = p[r]! - p[l]!;
        const ey = p[r + 1]! - p[l + 1]!;
        const ez = p[r + 2]! - p[l + 2]!;
        const fx = p[u]! - p[d]!;
        const fy = p[u + 1]! - p[d + 1]!;
        const fz = p[u + 2]! - p[d + 2]!;
        const x = ey * fz - ez * fy;
        const y = ez * fx - ex * fz;
        const z = ex * fy - ey * fx;
        const length = Math.sqrt(x * x + y * y + z * z) || 1;
        n[i] = x / length;
        n[i + 1] = y / length;
        n[i + 2] = z / length;
      }
    }
  }

  /** Displacement of the vertex nearest to a place of the rest plane. */
  displacementAtM(xM: number, yM: number): [number, number, number] {
    const near = (at: number, count: number) => Math.min(Math.max(Math.round(at / this.spacingM), 0), count - 1);
    const i = 3 * (near(xM, this.nx) * this.ny + near(yM, this.ny));
    const d = this.displacementM;
    return [d[i]!, d[i + 1]!, d[i + 2]!];
  }

  /** The largest displacement of any vertex, m. */
  largestM(): number {
    let most = 0;
    const d = this.displacementM;
    for (let i = 0; i < d.length; i += 3) most = Math.max(most, d[i]! ** 2 + d[i + 1]! ** 2 + d[i + 2]! ** 2);
    return Math.sqrt(most);
  }

  dispose(): void {
    this.geometry.dispose();
    this.lines.dispose();
  }
}

/** Lines along the rows and columns of mass points, through the vertices between them. */
function gridLines(nx: number, ny: number, every: number): Uint32Array {
  const ends: number[] = [];
  for (let a = 0; a < nx; a++) {
    for (let b = 0; b < ny; b++) {
      const i = a * ny + b;
      if (a % every === 0 && b + 1 < ny) ends.push(i, i + 1);
      if (b % every === 0 && a + 1 < nx) ends.push(i, i + ny);
    }
  }
  return new Uint32Array(ends);
}
