// A sheet as drawn: positions and normals of all vertices, or of every second or fourth one per side, and around it
// the flank of the tissue, down to the height of the drawn body.

import { Box3, BufferAttribute, BufferGeometry, DynamicDrawUsage, Plane, type Ray, Vector3 } from "three";
import { Field, type Rectangle, type Vec3 } from "palpate";
import { SheetEdge } from "./sheet-edge";
import type { Scene } from "palpate/v1";
import type { Felt } from "./samples";
import type { Centre, Place, Point, Push, Surface } from "./surface";
import { ShownWound, type WoundedSurface } from "./wound";

/** A sheet with fewer vertices than this would look coarse. */
const MIN_VERTICES = 6000;
/** Radius of the neighbourhood that affects the light in a dent, in spacings of mass points. */
const WIDEST = 4;
/** Distance beside the sheet at which a press still counts as on its edge, as a fraction of the sheet's size. */
const BESIDE = 0.01;
/** Number of points of a shaft that must be outside the tissue. */
const CHECKED = 16;

/**
 * Returns the numbers of points along the sides of a scene's grid and their distance, m; undefined if its points are
 * arranged in another way.
 */
export function gridOf(scene: Scene | undefined): { points: [number, number]; spacingM: number | undefined } | undefined {
  const { pointsX = 1, pointsY = 1, spacingM } = scene?.sheet ?? {};
  return scene?.sheet && { points: [pointsX, pointsY], spacingM };
}

export class Sheet implements Surface, WoundedSurface {
  readonly field: Field;
  /** Geometry of the triangles. */
  readonly geometry = new BufferGeometry();
  /** Geometry of the lines between mass points. */
  readonly lines = new BufferGeometry();
  readonly edge: SheetEdge;
  readonly wound = new ShownWound(this);
  /** Whether a part is hidden: then mass points are drawn, whatever else is left out. */
  private hasHidden = false;
  readonly box: Box3;
  readonly sizeM: number;
  readonly isOpen = false;
  /** One in `every` vertices per side is drawn, and always the last one. */
  every = 0;
  /** Rows of the drawn vertices: row i is row `rows[i]` of all. */
  private rows = new Uint32Array();
  private columns = new Uint32Array();
  private position = new BufferAttribute(new Float32Array(), 3);
  private normal = this.position;
  /** Fraction of ambient light that reaches each vertex: less in a dent. */
  private open = this.position;
  /** How burnt each drawn vertex is, and each of all; none is before the first burn. */
  private burn = this.position;
  private burns: Float32Array = new Float32Array();
  private readonly found = new Vector3();
  private readonly spanM: readonly [number, number];
  /** The largest movement of a drawn vertex along an axis since `takeMoved`, m, if each refresh adds its largest. */
  private movedM = 0;

  /**
   * Vertex (a, b) rests at (a, b, 0)·spacing, and has the texture coordinates (a/(nx − 1), b/(ny − 1)). `GetMesh`
   * would return the same values in megabytes of data. Every `pointEvery`-th vertex is a mass point.
   */
  constructor(
    nx: number,
    ny: number,
    private readonly spacingM: number,
    private readonly pointEvery: number,
  ) {
    this.field = new Field(nx, ny);
    this.spanM = [(nx - 1) * spacingM, (ny - 1) * spacingM];
    this.box = new Box3(new Vector3(), new Vector3(...this.spanM, 0));
    this.sizeM = Math.hypot(...this.spanM);
    this.edge = new SheetEdge(...this.spanM);
    this.drawEvery(1);
  }

  /** Draws one in `wanted` vertices per side, or more if those would be too few. Returns true if the number changed. */
  drawEvery(wanted: number): boolean {
    const { nx, ny } = this.field;
    let every = wanted;
    while (every > 1 && (nx * ny < MIN_VERTICES * every * every || (this.hasHidden && this.pointEvery % every !== 0))) every /= 2;
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
    this.burn = new BufferAttribute(new Float32Array(mx * my), 1).setUsage(DynamicDrawUsage);
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
    this.geometry.setAttribute("burn", this.burn);
    this.geometry.setAttribute("uv", new BufferAttribute(uv, 2));
    this.geometry.setIndex(new BufferAttribute(triangles, 1).setUsage(DynamicDrawUsage));
    this.lines.setAttribute("position", this.position);
    this.lines.setIndex(new BufferAttribute(gridLines(rows, columns, this.pointEvery), 1));
    this.edge.begin(this.position, this.normal, mx, my);
    this.dressBurns();
    this.work({ a0: 0, a1: mx - 1, b0: 0, b1: my - 1 });
    this.wound.rebuild();
    return true;
  }

  get vertexCount(): number {
    return this.field.nx * this.field.ny;
  }

  get triangleCount(): number {
    return 2 * Math.max(this.field.nx - 1, 0) * Math.max(this.field.ny - 1, 0);
  }

  get pointsApartM(): number {
    return this.pointSpacingM;
  }

  drawnVertex(vertex: number): number {
    const { nx, ny } = this.field;
    const drawn = (at: number, n: number, among: Uint32Array) => (at === n - 1 ? among.length - 1 : Math.floor(at / this.every));
    return drawn(Math.floor(vertex / ny), nx, this.rows) * this.columns.length + drawn(vertex % ny, ny, this.columns);
  }

  restOf(vertex: number, c: number): number {
    if (c === 2) return 0;
    return this.spacingM * (c === 0 ? Math.floor(vertex / this.field.ny) : vertex % this.field.ny);
  }

  hide(first: number, count: number): void {
    if (!this.hasHidden) {
      this.hasHidden = true;
      // With fewer vertices, the cells of mass points may not be drawn as such.
      if (this.pointEvery % this.every !== 0) this.drawEvery(this.every);
    }
    const index = this.geometry.index!;
    const { every } = this;
    const [across, drawnAcross] = [this.field.ny - 1, this.columns.length - 1];
    for (let t = first; t < first + count; t++) {
      const cell = t >> 1;
      const drawn = Math.floor(Math.floor(cell / across) / every) * drawnAcross + Math.floor((cell % across) / every);
      // Of a refined sheet whole cells are hidden.
      const at = every === 1 ? 3 * t : 6 * drawn;
      const size = every === 1 ? 3 : 6;
      (index.array as Uint32Array).fill(0, at, at + size);
      index.addUpdateRange(at, size);
    }
    index.needsUpdate = true;
  }

  showAll(): void {
    this.hasHidden = false;
    const before = this.every;
    this.every = 0;
    this.drawEvery(before);
  }

  showBurns(burn: Float32Array): void {
    this.burns = burn;
    this.dressBurns();
    this.wound.showBurns();
  }

  private dressBurns(): void {
    if (this.burns.length === 0) return;
    const [to, { rows, columns, burns }, { ny }] = [this.burn.array, this, this.field];
    for (let a = 0, i = 0; a < rows.length; a++) for (const column of columns) to[i++] = burns[rows[a]! * ny + column]!;
    this.burn.needsUpdate = true;
    this.edge.showBurns(to);
  }

  /** Updates positions and normals of what changed since the last picture. Call this before each picture. */
  refresh(): boolean {
    return this.wound.refresh(this.move());
  }

  private move(): boolean {
    const changed = this.field.takeChanged();
    if (!changed) return false;
    const { nx, ny } = this.field;
    const end = (last: number, n: number, among: Uint32Array) =>
      last === n - 1 ? among.length - 1 : Math.floor(last / this.every);
    this.work({
      a0: Math.ceil(changed.a0 / this.every),
      a1: end(changed.a1, nx, this.rows),
      b0: Math.ceil(changed.b0 / this.every),
      b1: end(changed.b1, ny, this.columns),
    });
    return true;
  }

  /** Number of drawn vertices between neighbouring mass points. */
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
    if (first === 0 || left === 0 || last === mx - 1 || right === my - 1) this.edge.follow();
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

  /** Returns how far vertices moved since the last call, at most, m. */
  takeMoved(): number {
    const moved = this.movedM;
    this.movedM = 0;
    return moved;
  }

  /**
   * Computes normals: the cross product of the differences across each vertex along x and along y. The differences
   * extend to the neighbouring mass points: between these the surface is bilinear, and shorter differences would show
   * its creases.
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
        // Height of the surroundings above it, near and far.
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

  /** Returns the place at a point of the rest plane; beside the sheet, the place on its edge. */
  private placeOf(xM: number, yM: number): Place {
    const within = (v: number, most: number) => Math.min(Math.max(v, 0), most);
    const restM: [number, number, number] = [within(xM, this.spanM[0]), within(yM, this.spanM[1]), 0];
    return { restM, outward: [0, 0, 1], triangle: -1, weights: [1, 0, 0] };
  }

  /** Returns the place in the rest plane whose tissue a ray meets; undefined beside the sheet. */
  pick(ray: Ray): Place | undefined {
    const level = new Plane(new Vector3(0, 0, 1), 0);
    const hit = new Vector3();
    let moved: readonly [number, number, number] = [0, 0, 0];
    // Intersect the ray with the level of the tissue found in the last round; dents are flat enough for a few rounds.
    for (let round = 0; round < 6; round++) {
      level.constant = -moved[2];
      if (!ray.intersectPlane(level, hit)) return undefined;
      moved = this.displacementOfNearest(hit.x - moved[0], hit.y - moved[1]);
    }
    const [px, py] = [hit.x - moved[0], hit.y - moved[1]];
    const margin = BESIDE * this.sizeM;
    const inside = px > -margin && py > -margin && px < this.spanM[0] + margin && py < this.spanM[1] + margin;
    return inside ? this.placeOf(px, py) : undefined;
  }

  middle(): Place {
    return this.placeOf(this.spanM[0] / 2, this.spanM[1] / 2);
  }

  beside({ restM: [x, y] }: Place, way: Vector3): Place {
    return this.placeOf(x + way.x, y + way.y);
  }

  at([x, y]: Vec3): Place {
    return this.placeOf(x, y);
  }

  private get pointSpacingM(): number {
    return this.spacingM * this.pointEvery;
  }

  nearest({ restM: [x, y] }: Place): Place {
    const h = this.pointSpacingM;
    return this.placeOf(h * Math.round(x / h), h * Math.round(y / h));
  }

  ofTool({ point }: Pick<Felt, "point">): Place | undefined {
    return point && this.placeOf(point.x * this.pointSpacingM, point.y * this.pointSpacingM);
  }

  centre({ restM: [x, y] }: Place): Centre {
    return { case: "centreM", value: { x, y } };
  }

  point({ restM: [x, y] }: Place): Point {
    return { point: { x: Math.round(x / this.pointSpacingM), y: Math.round(y / this.pointSpacingM) } };
  }

  isOuter(): boolean {
    return true;
  }

  outerAt(): Vector3 {
    return new Vector3(0, 0, 1);
  }

  push(): Push {
    return { sum: 1, share: 1 };
  }

  /** Returns the displacement at a place, interpolated between vertices. The result is valid until the next call. */
  displacementAt({ restM }: Place): Vector3 {
    return this.displacementAtM(restM[0], restM[1]);
  }

  private displacementAtM(xM: number, yM: number): Vector3 {
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

  /** Returns the height of the tissue above or below a place; beside the tissue, that of its edge. */
  heightAt(xM: number, yM: number): number {
    let [u, v] = [xM, yM];
    for (let round = 0; round < 4; round++) {
      const moved = this.displacementAtM(u, v);
      [u, v] = [xM - moved.x, yM - moved.y];
    }
    return this.displacementAtM(u, v).z;
  }

  /** Places the ball above the present position of the place, as high as the tissue around lifts it. */
  restOn(place: Place, radiusM: number, middleM: Vector3): void {
    const moved = this.displacementAt(place);
    const [xM, yM] = [place.restM[0] + moved.x, place.restM[1] + moved.y];
    let height = this.heightAt(xM, yM) + radiusM;
    for (let ring = 1; ring <= 4; ring++) {
      const out = (ring / 4.2) * radiusM;
      const over = Math.sqrt(radiusM * radiusM - out * out);
      for (let k = 0; k < 8; k++) {
        const angle = (k + 0.5 * (ring % 2)) * (Math.PI / 4);
        height = Math.max(height, this.heightAt(xM + out * Math.cos(angle), yM + out * Math.sin(angle)) + over);
      }
    }
    middleM.set(xM, yM, height);
  }

  room(tipM: Vector3, axis: Vector3, lengthM: number, radiusM: number, part: number): number {
    let least = Infinity;
    for (let k = 1; k <= CHECKED; k++) {
      const t = radiusM + (lengthM - radiusM) * (k / CHECKED) ** 2;
      const z = tipM.z + t * axis.z;
      const below = this.heightAt(tipM.x + t * axis.x, tipM.y + t * axis.y);
      least = Math.min(least, z - below - (part * radiusM) / Math.max(axis.z, 0.4));
    }
    return least;
  }

  /** Returns the displacement of the vertex nearest to a point of the rest plane. */
  private displacementOfNearest(xM: number, yM: number): [number, number, number] {
    const { nx, ny, displacementM: d } = this.field;
    const near = (at: number, count: number) => Math.min(Math.max(Math.round(at / this.spacingM), 0), count - 1);
    const i = 3 * (near(xM, nx) * ny + near(yM, ny));
    return [d[i]!, d[i + 1]!, d[i + 2]!];
  }

  /** Returns the place at (x, y), as fractions of the sheet's sides. */
  placeAt(x: number, y: number): Place {
    return this.placeOf(x * this.spanM[0], y * this.spanM[1]);
  }

  /** Returns the largest displacement of any vertex, m. */
  largestM(): number {
    let most = 0;
    const d = this.field.displacementM;
    for (let i = 0; i < d.length; i += 3) most = Math.max(most, d[i]! ** 2 + d[i + 1]! ** 2 + d[i + 2]! ** 2);
    return Math.sqrt(most);
  }

  dispose(): void {
    this.geometry.dispose();
    this.lines.dispose();
    this.edge.geometry.dispose();
    this.wound.dispose();
  }
}

/** Returns lines along rows and columns of mass points, through the drawn vertices between them. */
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
