// The surface as drawn: positions and normals of all vertices, or of every second or fourth one per side; and around it the
// flank of the tissue, as high as the body that is drawn.

import { BufferAttribute, BufferGeometry, DynamicDrawUsage, Vector3 } from "three";
import { Field, type Rectangle } from "./field";
import { Flank } from "./flank";

/** With fewer vertices than this, a sheet shows its coarse drawing. */
const LEAST_VERTICES = 6000;
/** How many spacings of mass points away the surroundings count for the light in a dent. */
const WIDEST = 4;

export class Surface {
  readonly field: Field;
  /** Geometry of the triangles. */
  readonly geometry = new BufferGeometry();
  /** Geometry of the lines between mass points. */
  readonly lines = new BufferGeometry();
  readonly flank: Flank;
  /** One in `every` vertices per side is drawn, and always the last one. */
  every = 0;
  /** Rows of the drawn vertices: row i is row `rows[i]` of all. */
  private rows = new Uint32Array();
  private columns = new Uint32Array();
  private position = new BufferAttribute(new Float32Array(), 3);
  private normal = this.position;
  /** The fraction of light from around that reaches each vertex: less in a dent. */
  private open = this.position;
  private readonly found = new Vector3();
  /** The largest movement of a drawn vertex along an axis since `takeMoved`, m, if each refresh adds its largest. */
  private movedM = 0;

  /**
   * Vertex (a, b) rests at (a, b, 0)·spacing, and has texture coordinates (a/(nx − 1), b/(ny − 1)). `GetMesh` would
   * return the same, in megabytes. Every `pointEvery`-th vertex is a mass point.
   */
  constructor(
    nx: number,
    ny: number,
    private readonly spacingM: number,
    private readonly pointEvery: number,
  ) {
    this.field = new Field(nx, ny);
    this.flank = new Flank((nx - 1) * spacingM, (ny - 1) * spacingM);
    this.drawEvery(1);
  }

  /** Draws one in `wanted` vertices per side, or more if those would be too few. Returns true if the number changed. */
  drawEvery(wanted: number): boolean {
    const { nx, ny } = this.field;
    let every = wanted;
    while (every > 1 && nx * ny < LEAST_VERTICES * every * every) every /= 2;
    if (every === this.every) return false;
    this.every = every;
    const among = (n: number) => Uint32Array.from({ length: Math.ceil((n - 1) / every) + 1 }, (_, i) => Math.min(i * every, n - 1));
    const [rows, columns] = [among(nx), among(ny)];
    [this.rows, this.columns] = [rows, columns];
    // Free the buffers of the old vertices on the graphics processor.
    this.dispose();
    const [mx, my] = [rows.length, columns.length];
    this.position = new BufferAttribute(new Float32Array(3 * mx * my), 3).setUsage(DynamicDrawUsage);
    this.normal = new BufferAttribute(new Float32Array(3 * mx * my), 3).setUsage(DynamicDrawUsage);
    this.open = new BufferAttribute(new Float32Array(mx * my), 1).setUsage(DynamicDrawUsage);
    const uv = new Float32Array(2 * mx * my);
    for (let a = 0, i = 0; a < mx; a++) {
      for (let b = 0; b < my; b++, i++) {
        uv[2 * i] = rows[a]! / Math.max(nx - 1, 1);
        uv[2 * i + 1] = columns[b]! / Math.max(ny - 1, 1);
      }
    }
    const triangles = new Uint32Array(6 * (mx - 1) * (my - 1));
    for (let a = 0, t = 0; a + 1 < mx; a++) {
      for (let b = 0; b + 1 < my; b++, t += 6) {
        const corner = a * my + b;
        triangles.set([corner, corner + my, corner + my + 1, corner, corner + my + 1, corner + 1], t);
      }
    }
    this.geometry.setAttribute("position", this.position);
    this.geometry.setAttribute("normal", this.normal);
    this.geometry.setAttribute("open", this.open);
    this.geometry.setAttribute("uv", new BufferAttribute(uv, 2));
    this.geometry.setIndex(new BufferAttribute(triangles, 1));
    this.lines.setAttribute("position", this.position);
    this.lines.setIndex(new BufferAttribute(gridLines(rows, columns, this.pointEvery), 1));
    this.flank.begin(this.position, this.normal, mx, my);
    this.work({ a0: 0, a1: mx - 1, b0: 0, b1: my - 1 });
    return true;
  }

  /** Call before each picture: updates positions and normals of what changed since the last. */
  refresh(): void {
    const changed = this.field.takeChanged();
    if (!changed) return;
    const { nx, ny } = this.field;
    const end = (last: number, n: number, among: Uint32Array) =>
      last === n - 1 ? among.length - 1 : Math.floor(last / this.every);
    this.work({
      a0: Math.ceil(changed.a0 / this.every),
      a1: end(changed.a1, nx, this.rows),
      b0: Math.ceil(changed.b0 / this.every),
      b1: end(changed.b1, ny, this.columns),
    });
  }

  /** Drawn vertices between neighbouring mass points. */
  private get stride(): number {
    return Math.max(1, Math.round(this.pointEvery / this.every));
  }

  private work({ a0, a1, b0, b1 }: Rectangle): void {
    if (a1 < a0 || b1 < b0) return;
    this.place({ a0, a1, b0, b1 });
    // Normals and openness around the changed part change as well.
    const [mx, my] = [this.rows.length, this.columns.length];
    const far = WIDEST * this.stride;
    const [first, last] = [Math.max(a0 - far, 0), Math.min(a1 + far, mx - 1)];
    const [left, right] = [Math.max(b0 - far, 0), Math.min(b1 + far, my - 1)];
    this.turn(first, last, left, right);
    for (const attribute of [this.position, this.normal, this.open]) {
      attribute.addUpdateRange(attribute.itemSize * first * my, attribute.itemSize * (last - first + 1) * my);
      attribute.needsUpdate = true;
    }
    if (first === 0 || left === 0 || last === mx - 1 || right === my - 1) this.flank.follow();
  }

  private place({ a0, a1, b0, b1 }: Rectangle): void {
    const { rows, columns, spacingM } = this;
    const { ny, displacementM: d } = this.field;
    const p = this.position.array as Float32Array;
    let most = 0;
    for (let a = a0; a <= a1; a++) {
      const row = rows[a]!;
      for (let b = b0, i = 3 * (a * columns.length + b0); b <= b1; b++, i += 3) {
        const column = columns[b]!;
        const k = 3 * (row * ny + column);
        const [x, y, z] = [row * spacingM + d[k]!, column * spacingM + d[k + 1]!, d[k + 2]!];
        most = Math.max(most, Math.abs(x - p[i]!), Math.abs(y - p[i + 1]!), Math.abs(z - p[i + 2]!));
        p[i] = x;
        p[i + 1] = y;
        p[i + 2] = z;
      }
    }
    this.movedM += most;
  }

  /** How far vertices moved at most since the last call, m. */
  takeMoved(): number {
    const moved = this.movedM;
    this.movedM = 0;
    return moved;
  }

  /**
   * Normals: the cross product of the differences across each vertex along x and along y. They reach to the neighbouring
   * mass points: between these the surface is bilinear, and narrower ones would show its creases.
   */
  private turn(a0: number, a1: number, b0: number, b1: number): void {
    const p = this.position.array as Float32Array;
    const n = this.normal.array as Float32Array;
    const o = this.open.array as Float32Array;
    const [nx, ny] = [this.rows.length, this.columns.length];
    const reach = this.stride;
    const wide = WIDEST * reach;
    const spanM = WIDEST * this.pointEvery * this.spacingM;
    for (let a = a0; a <= a1; a++) {
      const before = -3 * ny * Math.min(reach, a);
      const after = 3 * ny * Math.min(reach, nx - 1 - a);
      const [far, near] = [3 * ny * Math.min(wide, nx - 1 - a), -3 * ny * Math.min(wide, a)];
      for (let b = b0, i = 3 * (a * ny + b0); b <= b1; b++, i += 3) {
        const [l, r] = [i + before, i + after];
        const d = i - 3 * Math.min(reach, b);
        const u = i + 3 * Math.min(reach, ny - 1 - b);
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
        // How far the surroundings rise above it, near and far.
        const height = p[i + 2]!;
        const close = (p[l + 2]! + p[r + 2]! + p[d + 2]! + p[u + 2]!) / 4 - height;
        const across = 3 * Math.min(wide, ny - 1 - b);
        const along = -3 * Math.min(wide, b);
        const around = (p[i + far + 2]! + p[i + near + 2]! + p[i + across + 2]! + p[i + along + 2]!) / 4 - height;
        const slopes = (WIDEST * Math.max(close, 0) + Math.max(around, 0)) / spanM;
        o[i / 3] = 1 / (1 + 0.55 * slopes);
      }
    }
  }

  /** Displacement at a place in the rest plane, between vertices as well. The result is valid until the next call. */
  displacementAt(xM: number, yM: number): Vector3 {
    const { nx, ny, displacementM: d } = this.field;
    const u = Math.min(Math.max(xM / this.spacingM, 0), nx - 1);
    const v = Math.min(Math.max(yM / this.spacingM, 0), ny - 1);
    const a = Math.min(Math.floor(u), Math.max(nx - 2, 0));
    const b = Math.min(Math.floor(v), Math.max(ny - 2, 0));
    const [s, t] = [u - a, v - b];
    const i = 3 * (a * ny + b);
    const [right, up] = [a + 1 < nx ? 3 * ny : 0, b + 1 < ny ? 3 : 0];
    const of = (c: number) =>
      (1 - s) * ((1 - t) * d[i + c]! + t * d[i + up + c]!) + s * ((1 - t) * d[i + right + c]! + t * d[i + right + up + c]!);
    return this.found.set(of(0), of(1), of(2));
  }

  /** Height of the tissue above or below a place; beside the tissue, that of its edge. */
  heightAt(xM: number, yM: number): number {
    let [u, v] = [xM, yM];
    for (let round = 0; round < 4; round++) {
      const moved = this.displacementAt(u, v);
      [u, v] = [xM - moved.x, yM - moved.y];
    }
    return this.displacementAt(u, v).z;
  }

  /** Height of the middle of a ball above (x, y) that rests on the tissue. */
  restOn(xM: number, yM: number, radiusM: number): number {
    let height = this.heightAt(xM, yM) + radiusM;
    for (let ring = 1; ring <= 4; ring++) {
      const out = (ring / 4.2) * radiusM;
      const over = Math.sqrt(radiusM * radiusM - out * out);
      for (let k = 0; k < 8; k++) {
        const angle = (k + 0.5 * (ring % 2)) * (Math.PI / 4);
        height = Math.max(height, this.heightAt(xM + out * Math.cos(angle), yM + out * Math.sin(angle)) + over);
      }
    }
    return height;
  }

  /** Displacement of the vertex nearest to a place in the rest plane. */
  displacementAtM(xM: number, yM: number): [number, number, number] {
    const { nx, ny, displacementM: d } = this.field;
    const near = (at: number, count: number) => Math.min(Math.max(Math.round(at / this.spacingM), 0), count - 1);
    const i = 3 * (near(xM, nx) * ny + near(yM, ny));
    return [d[i]!, d[i + 1]!, d[i + 2]!];
  }

  /** The largest displacement of any vertex, m. */
  largestM(): number {
    let most = 0;
    const d = this.field.displacementM;
    for (let i = 0; i < d.length; i += 3) most = Math.max(most, d[i]! ** 2 + d[i + 1]! ** 2 + d[i + 2]! ** 2);
    return Math.sqrt(most);
  }

  dispose(): void {
    this.geometry.dispose();
    this.lines.dispose();
    this.flank.geometry.dispose();
  }
}

/** Lines along rows and columns of mass points, through the drawn vertices between them. */
function gridLines(rows: Uint32Array, columns: Uint32Array, pointEvery: number): Uint32Array {
  const ends: number[] = [];
  rows.forEach((row, a) => {
    columns.forEach((column, b) => {
      const i = a * columns.length + b;
      if (row % pointEvery === 0 && b + 1 < columns.length) ends.push(i, i + 1);
      if (column % pointEvery === 0 && a + 1 < rows.length) ends.push(i, i + columns.length);
    });
  });
  return new Uint32Array(ends);
}
