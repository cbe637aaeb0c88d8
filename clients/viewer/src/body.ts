// A body as drawn and touched: the surface of any triangle mesh, closed or open. Positions follow the frames; normals
// are area-weighted sums of the triangle normals. Only what changed is recomputed: vertices and triangles are divided
// into blocks of neighbours. These blocks also speed up ray casts.

import { Box3, BufferAttribute, BufferGeometry, DynamicDrawUsage, type Ray, Triangle, Vector3 } from "three";
import { Field, type MeshData, type Vec3 } from "palpate";
import { Looks, type AmbientOcclusion } from "./ambient-occlusion";
import { edgesOf, type Lists, lists, opening, touching } from "./topology";
import type { Felt } from "./samples";
import type { Centre, Place, Point, Push, Surface } from "./surface";
import { ShownWound, type WoundedSurface } from "./wound";

/** Number of vertices in a block, as a power of 2. */
const BLOCK = 8;
/** Longest time for which ambient light is computed without a pause, ms. */
const SLICE_MS = 8;
/** How much darker a dent is, per falloff length of a push. */
const DENT = 0.28;
/**
 * The server reports the mean force within this many falloff lengths of a push, but at least and at most this many
 * edge lengths (crates/tissue/src/response/around_place.rs).
 */
const TOLD_WITHIN = { lengths: 7, least: 1.5, most: 4 };
/**
 * A texture has seams if its scale differs from the typical one by more than this factor, on more than this fraction
 * of the triangles.
 */
const SEAM = { times: 6, part: 0.001 };

/** Returns whether a texture is without seams. At a seam, neighbours in space are far apart in the image. */
function isSeamless({ uv, restM, triangles }: MeshData): boolean {
  if (uv.length === 0) return false;
  const scales = new Float64Array(triangles.length);
  for (let t = 0; t < triangles.length; t++) {
    const [a, b] = [triangles[t]!, triangles[t % 3 === 2 ? t - 2 : t + 1]!];
    const length = Math.hypot(...[0, 1, 2].map((c) => restM[3 * b + c]! - restM[3 * a + c]!));
    scales[t] = Math.hypot(uv[2 * b]! - uv[2 * a]!, uv[2 * b + 1]! - uv[2 * a + 1]!) / (length || 1);
  }
  scales.sort();
  const usual = scales[scales.length >> 1]!;
  const largest = scales[Math.floor((1 - SEAM.part) * (scales.length - 1))]!;
  return usual > 0 && largest < SEAM.times * usual;
}

export class Body implements Surface, WoundedSurface {
  readonly field: Field;
  readonly geometry = new BufferGeometry();
  readonly lines = new BufferGeometry();
  readonly edge = undefined;
  readonly wound = new ShownWound(this);
  readonly box = new Box3();
  readonly sizeM: number;
  readonly every = 1;
  readonly isOpen: boolean;
  /** Whether the texture uses the file's coordinates; otherwise it is projected from three sides. */
  readonly isMapped: boolean;
  /** Called when ambient light was computed, so that another picture is due. */
  onLight: () => void = () => {};
  private readonly count: number;
  private readonly rest: Float32Array;
  private readonly restNormal: Float32Array<ArrayBuffer>;
  private readonly position: Float32Array<ArrayBuffer>;
  private readonly normal: Float32Array<ArrayBuffer>;
  private readonly open: Float32Array<ArrayBuffer>;
  private readonly inner: Float32Array<ArrayBuffer>;
  private readonly drawn: Record<"position" | "normal" | "open" | "inner", BufferAttribute>;
  private readonly triangles: Uint32Array<ArrayBuffer>;
  private readonly face: Float32Array;
  /**
   * The triangles at each vertex; the triangles with a vertex in each block; and the triangles whose first vertex is
   * in each block.
   */
  private readonly around: Lists;
  private readonly touching: Lists;
  private readonly owned: Lists;
  /** For each block, a bounding sphere of its own triangles in their present positions. */
  private readonly balls: Float32Array;
  private readonly half = new Float64Array(3);
  private readonly blocks: number;
  private readonly byFile: Map<number, number>;
  private light: AmbientOcclusion | undefined;
  private lighting: ReturnType<typeof setTimeout> | undefined;
  private movedM = 0;
  private readonly found = new Vector3();
  private readonly known: Push & { key: string } = { key: "", sum: 1, share: 1 };

  /** A push falls off over `lengthM`. The mesh has `points` mass points: fewer than vertices if it was decimated. */
  constructor(
    private readonly data: MeshData,
    private readonly lengthM: number,
    private readonly points: number,
  ) {
    const { restM, triangles, places, uv } = data;
    const count = (this.count = restM.length / 3);
    this.field = new Field(places[0] + data.cutRows, places[1], data.cutRows);
    this.rest = restM;
    this.triangles = triangles;
    this.position = restM.slice();
    this.normal = new Float32Array(3 * count);
    this.open = new Float32Array(count).fill(1);
    this.inner = new Float32Array(count).fill(1);
    this.face = new Float32Array(triangles.length);
    this.blocks = Math.max(1, Math.ceil(count / (1 << BLOCK)));
    this.balls = new Float32Array(4 * this.blocks);
    this.byFile = new Map(Array.from(data.fileVertex, (file, i) => [file, i]));
    this.around = lists(count, triangles, (i) => Math.floor(i / 3));
    this.owned = lists(this.blocks, Array.from({ length: triangles.length / 3 }, (_, t) => triangles[3 * t]! >> BLOCK), (t) => t);
    this.touching = touching(triangles, this.blocks, BLOCK);
    // A vertex that no triangle uses may be anywhere.
    for (const vertex of triangles) this.box.expandByPoint(this.found.fromArray(restM, 3 * vertex));
    this.sizeM = this.box.getSize(this.found).length();
    const dynamic = (values: Float32Array, size: number) => new BufferAttribute(values, size).setUsage(DynamicDrawUsage);
    this.drawn = {
      position: dynamic(this.position, 3),
      normal: dynamic(this.normal, 3),
      open: dynamic(this.open, 1),
      inner: dynamic(this.inner, 1),
    };
    for (const [name, attribute] of Object.entries(this.drawn)) this.geometry.setAttribute(name, attribute);
    this.isMapped = isSeamless(data);
    this.geometry.setAttribute("uv", new BufferAttribute(this.isMapped ? uv : new Float32Array(2 * count), 2));
    this.geometry.setAttribute("rest", new BufferAttribute(restM, 3));
    this.geometry.setAttribute("burn", new BufferAttribute(new Float32Array(count), 1).setUsage(DynamicDrawUsage));
    this.geometry.setIndex(new BufferAttribute(triangles, 1));
    const { edges, isOpen } = edgesOf(triangles, count);
    this.isOpen = isOpen;
    this.lines.setAttribute("position", this.drawn.position);
    this.lines.setIndex(new BufferAttribute(edges, 1));
    const all = new Uint8Array(this.blocks).fill(1);
    this.turn(all);
    this.restNormal = this.normal.slice();
    this.geometry.setAttribute("restNormal", new BufferAttribute(this.restNormal, 3));
    this.findLight();
  }

  drawEvery(): boolean {
    return false;
  }

  get vertexCount(): number {
    return this.count;
  }

  get triangleCount(): number {
    return this.triangles.length / 3;
  }

  get pointsApartM(): number {
    return this.data.edgeM;
  }

  drawnVertex(vertex: number): number {
    return vertex;
  }

  restOf(vertex: number, c: number): number {
    return this.rest[3 * vertex + c]!;
  }

  hide(first: number, count: number): void {
    // Rays still meet what was there.
    let index = this.geometry.index!;
    if (index.array === this.triangles) {
      this.release();
      this.geometry.setIndex((index = new BufferAttribute(this.triangles.slice(), 1).setUsage(DynamicDrawUsage)));
    }
    (index.array as Uint32Array).fill(0, 3 * first, 3 * (first + count));
    index.addUpdateRange(3 * first, 3 * count);
    index.needsUpdate = true;
  }

  showAll(): void {
    this.release();
    this.geometry.setIndex(new BufferAttribute(this.triangles, 1));
  }

  /** Frees the buffers on the graphics processor, which both geometries share, before one of them gets another. */
  private release(): void {
    this.geometry.dispose();
    this.lines.dispose();
  }

  /** Computes the light from each direction, with pauses so that the page stays responsive. */
  private findLight(): void {
    const looks = new Looks(this.rest, this.restNormal, this.triangles);
    const go = (): void => {
      const begun = performance.now();
      do {
        const light = looks.next();
        if (!light) continue;
        this.light = light;
        const all = new Uint8Array(this.blocks).fill(1);
        this.shade(all);
        this.send(all, ["open", "inner"]);
        return this.onLight();
      } while (performance.now() - begun < SLICE_MS);
      this.lighting = setTimeout(go);
    };
    // The light of a small mesh is ready for its first picture.
    go();
  }

  refresh(): boolean {
    return this.wound.refresh(this.move());
  }

  /** Moves the vertices to where the newest frame has them. Returns whether any moved. */
  private move(): boolean {
    const changed = this.field.takeChanged();
    if (!changed) return false;
    const { rest, position, count } = this;
    const u = this.field.displacementM;
    const { ny } = this.field;
    const moved = new Uint8Array(this.blocks);
    let most = 0;
    // Of the surface within cuts.
    let any = this.field.cutRows > 0 && (changed.a1 + 1) * ny > count;
    const end = 3 * Math.min((changed.a1 + 1) * ny, count);
    for (let i = 3 * changed.a0 * ny; i < end; i += 3) {
      const x = Math.fround(rest[i]! + u[i]!);
      const y = Math.fround(rest[i + 1]! + u[i + 1]!);
      const z = Math.fround(rest[i + 2]! + u[i + 2]!);
      const by = Math.max(Math.abs(x - position[i]!), Math.abs(y - position[i + 1]!), Math.abs(z - position[i + 2]!));
      if (by === 0) continue;
      if (by > most) most = by;
      any = true;
      position[i] = x;
      position[i + 1] = y;
      position[i + 2] = z;
      moved[(i / 3) >> BLOCK] = 1;
    }
    if (!any) return false;
    this.movedM += most;
    this.send(moved, ["position"]);
    this.send(this.turn(moved), ["normal", "open"]);
    return true;
  }

  /** Recomputes the normals of everything that moved, and of its neighbourhood. Returns the affected blocks. */
  private turn(moved: Uint8Array): Uint8Array {
    const { position: p, triangles, face, touching } = this;
    const turned = new Uint8Array(this.blocks);
    const owners = new Uint8Array(this.blocks);
    for (let block = 0; block < this.blocks; block++) {
      if (!moved[block]) continue;
      for (let k = touching.start[block]!; k < touching.start[block + 1]!; k++) {
        const t = 3 * touching.of[k]!;
        const va = triangles[t]!;
        const vb = triangles[t + 1]!;
        const vc = triangles[t + 2]!;
        const a = 3 * va;
        const b = 3 * vb;
        const c = 3 * vc;
        const ex = p[b]! - p[a]!;
        const ey = p[b + 1]! - p[a + 1]!;
        const ez = p[b + 2]! - p[a + 2]!;
        const fx = p[c]! - p[a]!;
        const fy = p[c + 1]! - p[a + 1]!;
        const fz = p[c + 2]! - p[a + 2]!;
        // Its length is twice the area.
        face[t] = ey * fz - ez * fy;
        face[t + 1] = ez * fx - ex * fz;
        face[t + 2] = ex * fy - ey * fx;
        owners[va >> BLOCK] = 1;
        turned[va >> BLOCK] = 1;
        turned[vb >> BLOCK] = 1;
        turned[vc >> BLOCK] = 1;
      }
    }
    const { around, normal: n, count } = this;
    for (let block = 0; block < this.blocks; block++) {
      if (owners[block]) this.surround(block);
      if (!turned[block]) continue;
      const last = Math.min((block + 1) << BLOCK, count);
      for (let v = block << BLOCK; v < last; v++) {
        let x = 0;
        let y = 0;
        let z = 0;
        const end = around.start[v + 1]!;
        for (let k = around.start[v]!; k < end; k++) {
          const t = 3 * around.of[k]!;
          x += face[t]!;
          y += face[t + 1]!;
          z += face[t + 2]!;
        }
        const length = Math.sqrt(x * x + y * y + z * z);
        const i = 3 * v;
        n[i] = x / (length || 1);
        n[i + 1] = y / (length || 1);
        n[i + 2] = length > 0 ? z / length : 1;
      }
    }
    if (this.light) this.shade(turned);
    return turned;
  }

  /** Updates how much light reaches vertices: the value at rest, and less in a dent. */
  private shade(blocks: Uint8Array): void {
    const { light, restNormal: n, rest, position: p, open, inner, count } = this;
    if (!light) return;
    for (let block = 0; block < this.blocks; block++) {
      if (!blocks[block]) continue;
      const last = Math.min((block + 1) << BLOCK, count);
      for (let v = block << BLOCK, i = 3 * v; v < last; v++, i += 3) {
        const out = (p[i]! - rest[i]!) * n[i]! + (p[i + 1]! - rest[i + 1]!) * n[i + 1]! + (p[i + 2]! - rest[i + 2]!) * n[i + 2]!;
        const deep = (DENT * Math.abs(out)) / this.lengthM;
        open[v] = out < 0 ? light.outer[v]! / (1 + deep) : light.outer[v]!;
        inner[v] = out > 0 ? light.inner[v]! / (1 + deep) : light.inner[v]!;
      }
    }
  }

  /** Computes the bounding sphere of a block's own triangles. */
  private surround(block: number): void {
    const { position: p, triangles, owned, balls, half } = this;
    const [first, last] = [owned.start[block]!, owned.start[block + 1]!];
    if (first === last) return void balls.fill(0, 4 * block, 4 * block + 4);
    for (let c = 0; c < 3; c++) {
      let low = Infinity;
      let high = -Infinity;
      for (let k = first; k < last; k++) {
        const t = 3 * owned.of[k]!;
        const v = p[3 * triangles[t]! + c]!;
        const w = p[3 * triangles[t + 1]! + c]!;
        const x = p[3 * triangles[t + 2]! + c]!;
        if (v < low) low = v;
        if (w < low) low = w;
        if (x < low) low = x;
        if (v > high) high = v;
        if (w > high) high = w;
        if (x > high) high = x;
      }
      balls[4 * block + c] = (low + high) / 2;
      half[c] = (high - low) / 2;
    }
    balls[4 * block + 3] = Math.sqrt(half[0]! ** 2 + half[1]! ** 2 + half[2]! ** 2) + 1e-6 * this.sizeM;
  }

  /** Marks blocks of attributes for upload to the graphics processor. */
  private send(blocks: Uint8Array, names: (keyof Body["drawn"])[]): void {
    for (let from = 0; from < this.blocks; from++) {
      if (!blocks[from]) continue;
      let to = from;
      while (to < this.blocks && blocks[to]) to += 1;
      const [first, last] = [from << BLOCK, Math.min(to << BLOCK, this.count)];
      for (const name of names) {
        const attribute = this.drawn[name];
        attribute.addUpdateRange(attribute.itemSize * first, attribute.itemSize * (last - first));
        attribute.needsUpdate = true;
      }
      from = to;
    }
  }

  showBurns(burn: Float32Array): void {
    const attribute = this.geometry.getAttribute("burn") as BufferAttribute;
    attribute.array.set(burn.subarray(0, this.count));
    attribute.needsUpdate = true;
    this.wound.showBurns();
  }

  takeMoved(): number {
    const moved = this.movedM;
    this.movedM = 0;
    return moved;
  }

  largestM(): number {
    let most = 0;
    const d = this.field.displacementM;
    for (let i = 0; i < 3 * this.count; i += 3) most = Math.max(most, d[i]! ** 2 + d[i + 1]! ** 2 + d[i + 2]! ** 2);
    return Math.sqrt(most);
  }

  /**
   * Returns the first triangle that a ray from `o` in the unit direction `d` meets within `mostM`: its index and
   * barycentric coordinates. Undefined if there is none.
   */
  private meet(o: Vector3, d: Vector3, mostM: number): { triangle: number; weights: Vec3; atM: number } | undefined {
    const { position: p, triangles, owned, balls } = this;
    let best = mostM;
    let triangle = -1;
    let wb = 0;
    let wc = 0;
    const { x: dx, y: dy, z: dz } = d;
    const { x: ox, y: oy, z: oz } = o;
    for (let block = 0; block < this.blocks; block++) {
      const mx = balls[4 * block]! - ox;
      const my = balls[4 * block + 1]! - oy;
      const mz = balls[4 * block + 2]! - oz;
      const radius = balls[4 * block + 3]!;
      const along = mx * dx + my * dy + mz * dz;
      if (along < -radius || along - radius > best || mx * mx + my * my + mz * mz - along * along > radius * radius) continue;
      const end = owned.start[block + 1]!;
      for (let k = owned.start[block]!; k < end; k++) {
        const t = 3 * owned.of[k]!;
        const a = 3 * triangles[t]!;
        const b = 3 * triangles[t + 1]!;
        const c = 3 * triangles[t + 2]!;
        const ax = p[a]!;
        const ay = p[a + 1]!;
        const az = p[a + 2]!;
        const ex = p[b]! - ax;
        const ey = p[b + 1]! - ay;
        const ez = p[b + 2]! - az;
        const fx = p[c]! - ax;
        const fy = p[c + 1]! - ay;
        const fz = p[c + 2]! - az;
        // Möller–Trumbore algorithm.
        const qx = dy * fz - dz * fy;
        const qy = dz * fx - dx * fz;
        const qz = dx * fy - dy * fx;
        const det = ex * qx + ey * qy + ez * qz;
        if (det === 0) continue;
        const sx = ox - ax;
        const sy = oy - ay;
        const sz = oz - az;
        const u = (sx * qx + sy * qy + sz * qz) / det;
        if (u < 0 || u > 1) continue;
        const rx = sy * ez - sz * ey;
        const ry = sz * ex - sx * ez;
        const rz = sx * ey - sy * ex;
        const v = (dx * rx + dy * ry + dz * rz) / det;
        if (v < 0 || u + v > 1) continue;
        const at = (fx * rx + fy * ry + fz * rz) / det;
        if (at <= 0 || at >= best) continue;
        best = at;
        triangle = t / 3;
        wb = u;
        wc = v;
      }
    }
    return triangle < 0 ? undefined : { triangle, weights: [1 - wb - wc, wb, wc], atM: best };
  }

  /** Interpolates a vertex attribute of three numbers in a triangle. */
  private mix(values: Float32Array, triangle: number, weights: Vec3): Vec3 {
    const mixed: Vec3 = [0, 0, 0];
    for (let corner = 0; corner < 3; corner++) {
      const i = 3 * this.triangles[3 * triangle + corner]!;
      for (let c = 0; c < 3; c++) mixed[c]! += weights[corner]! * values[i + c]!;
    }
    return mixed;
  }

  /** Returns a place on a triangle, seen in the direction `along`: it is touched from the visible side. */
  private place(triangle: number, weights: Vec3, along: Vector3): Place {
    const t = 3 * triangle;
    const isOuter = this.face[t]! * along.x + this.face[t + 1]! * along.y + this.face[t + 2]! * along.z <= 0;
    const [x, y, z] = this.mix(this.restNormal, triangle, weights);
    const length = (isOuter ? 1 : -1) * (Math.hypot(x, y, z) || 1);
    return { restM: this.mix(this.rest, triangle, weights), outward: [x / length, y / length, z / length], triangle, weights };
  }

  pick(ray: Ray): Place | undefined {
    const hit = this.meet(ray.origin, ray.direction, Infinity);
    return hit && this.place(hit.triangle, hit.weights, ray.direction);
  }

  /** Returns the place at a vertex, on its outer or inner side. */
  private atVertex(vertex: number, isOuter: boolean): Place {
    const [i, triangle] = [3 * vertex, this.around.of[this.around.start[vertex]!]];
    const side = isOuter ? 1 : -1;
    const restM: Vec3 = [this.rest[i]!, this.rest[i + 1]!, this.rest[i + 2]!];
    const n = this.restNormal;
    const outward: Vec3 = [side * n[i]!, side * n[i + 1]!, side * n[i + 2]!];
    const weights = [0, 1, 2].map((corner) => (triangle !== undefined && this.triangles[3 * triangle + corner] === vertex ? 1 : 0));
    return { restM, outward, triangle: triangle ?? 0, weights: weights as Vec3 };
  }

  /** Returns the vertex nearest to a point, in the present shape of the tissue. */
  private vertexNear({ x, y, z }: Vector3): number {
    const p = this.position;
    let best = Infinity;
    let vertex = 0;
    for (let i = 0; i < p.length; i += 3) {
      const far = (p[i]! - x) ** 2 + (p[i + 1]! - y) ** 2 + (p[i + 2]! - z) ** 2;
      if (far >= best) continue;
      best = far;
      vertex = i / 3;
    }
    return vertex;
  }

  middle(): Place {
    return this.atVertex(this.vertexNear(this.box.getCenter(new Vector3())), true);
  }

  beside(place: Place, way: Vector3): Place {
    const n = new Vector3(...place.outward);
    const across = way.clone().addScaledVector(n, -way.dot(n));
    const high = 1.5 * way.length();
    // From above the present surface down to it.
    const from = new Vector3(...place.restM).add(this.displacementAt(place)).add(across).addScaledVector(n, high);
    const hit = this.meet(from, n.negate(), 3 * high);
    if (hit) return this.place(hit.triangle, hit.weights, n);
    const isOuter = this.isOuter(place);
    return this.atVertex(this.vertexNear(from.addScaledVector(n, high)), isOuter);
  }

  at(restM: Vec3): Place {
    const point = new Vector3(...restM);
    const corner = (vertex: number) => new Vector3(...this.rest.subarray(3 * vertex, 3 * vertex + 3));
    let [nearest, leastM2] = [0, Infinity];
    for (let vertex = 0; vertex < this.vertexCount; vertex++) {
      const farM2 = [0, 1, 2].reduce((sum, c) => sum + (this.rest[3 * vertex + c]! - restM[c]!) ** 2, 0);
      if (farM2 < leastM2) [nearest, leastM2] = [vertex, farM2];
    }
    // In one of the triangles around the nearest vertex.
    const { start, of } = this.around;
    let best: { triangle: number; weights: Vec3; farM: number } | undefined;
    for (let k = start[nearest]!; k < start[nearest + 1]!; k++) {
      const triangle = of[k]!;
      const [a, b, c] = [0, 1, 2].map((at) => corner(this.triangles[3 * triangle + at]!)) as [Vector3, Vector3, Vector3];
      const flat = new Triangle(a, b, c);
      const at = flat.closestPointToPoint(point, new Vector3());
      const weights = flat.getBarycoord(at, new Vector3());
      const farM = at.distanceTo(point);
      if (weights && farM < (best?.farM ?? Infinity)) best = { triangle, weights: weights.toArray(), farM };
    }
    if (!best) return this.atVertex(nearest, true);
    return this.place(best.triangle, best.weights, this.outerAt({ restM, outward: [0, 0, 0], ...best }).negate());
  }

  nearest(place: Place): Place {
    const corner = place.weights.indexOf(Math.max(...place.weights));
    const vertex = this.triangles[3 * place.triangle + corner]!;
    return this.atVertex(vertex, this.isOuter(place));
  }

  outerAt({ triangle, weights }: Place): Vector3 {
    return new Vector3(...this.mix(this.restNormal, triangle, weights)).normalize();
  }

  isOuter(place: Place): boolean {
    return this.outerAt(place).dot(new Vector3(...place.outward)) >= 0;
  }

  ofTool({ vertex, appliedN: [x, y, z] }: Pick<Felt, "vertex" | "appliedN">, isOuter?: boolean): Place | undefined {
    const index = vertex === undefined ? undefined : this.byFile.get(vertex);
    if (index === undefined) return undefined;
    const [nx, ny, nz] = [this.restNormal[3 * index]!, this.restNormal[3 * index + 1]!, this.restNormal[3 * index + 2]!];
    // A closed body is touched from outside, an open one from the side from which the tool pushes.
    return this.atVertex(index, isOuter ?? (!this.isOpen || x * nx + y * ny + z * nz <= 0));
  }

  displacementAt({ triangle, weights }: Place): Vector3 {
    return this.found.set(...this.mix(this.field.displacementM, triangle, weights));
  }

  centre({ restM: [x, y, z] }: Place): Centre {
    return { case: "atM", value: { x, y, z } };
  }

  point(place: Place): Point {
    const corner = place.weights.indexOf(Math.max(...place.weights));
    return { vertex: this.data.fileVertex[this.triangles[3 * place.triangle + corner]!]! };
  }

  push({ restM: [x, y, z] }: Place, lengthM: number): Push {
    const key = `${x} ${y} ${z} ${lengthM}`;
    if (this.known.key === key) return this.known;
    const { rest } = this;
    const radius = Math.min(Math.max(TOLD_WITHIN.lengths * lengthM, TOLD_WITHIN.least * this.data.edgeM), TOLD_WITHIN.most * this.data.edgeM);
    let sum = 0;
    let told = 0;
    let squares = 0;
    for (let i = 0; i < rest.length; i += 3) {
      const apart = Math.sqrt((rest[i]! - x) ** 2 + (rest[i + 1]! - y) ** 2 + (rest[i + 2]! - z) ** 2);
      if (apart > 12 * lengthM) continue;
      const weight = Math.exp(-apart / lengthM);
      sum += weight;
      const taper = Math.max(0, 1 - (apart / radius) ** 2) ** 2;
      told += weight * taper;
      squares += weight * weight * taper;
    }
    // In proportion to the vertices, but at least one mass point carries it.
    const whole = Math.max(1, (this.points / this.count) * sum);
    return Object.assign(this.known, { key, sum: whole, share: squares > 0 ? (whole * told) / squares : 1 });
  }

  /** Places the ball along the present normal, as far out as the vertices around lift it. */
  restOn(place: Place, radiusM: number, middleM: Vector3): void {
    const { position: p, balls, count } = this;
    const [x, y, z] = this.mix(p, place.triangle, place.weights);
    let [nx, ny, nz] = this.mix(this.normal, place.triangle, place.weights);
    const length = (this.isOuter(place) ? 1 : -1) * (Math.hypot(nx, ny, nz) || 1);
    [nx, ny, nz] = [nx / length, ny / length, nz / length];
    let out = radiusM;
    for (let block = 0; block < this.blocks; block++) {
      const far = Math.hypot(balls[4 * block]! - x, balls[4 * block + 1]! - y, balls[4 * block + 2]! - z);
      if (far > balls[4 * block + 3]! + 3 * radiusM) continue;
      const last = 3 * Math.min((block + 1) << BLOCK, count);
      for (let i = 3 * (block << BLOCK); i < last; i += 3) {
        const dx = p[i]! - x;
        const dy = p[i + 1]! - y;
        const dz = p[i + 2]! - z;
        const high = dx * nx + dy * ny + dz * nz;
        const aside = dx * dx + dy * dy + dz * dz - high * high;
        if (aside < radiusM * radiusM && high < 2 * radiusM) out = Math.max(out, high + Math.sqrt(radiusM * radiusM - aside));
      }
    }
    middleM.set(x + out * nx, y + out * ny, z + out * nz);
  }

  room(tipM: Vector3, axis: Vector3, lengthM: number): number {
    const hit = this.meet(tipM, axis, lengthM);
    return hit ? hit.atM - lengthM : lengthM;
  }

  heightAt(): undefined {
    return undefined;
  }

  /** x, y, z of each vertex at rest. */
  get restM(): Float32Array {
    return this.rest;
  }

  /**
   * Returns the area-weighted sum of the triangle normals, and the middle of an opening if there is one, through
   * which the camera can look in.
   */
  views(): { facing: Vector3; opening: Vector3 | undefined } {
    const facing = new Vector3();
    let all = 0;
    for (let t = 0; t < this.face.length; t += 3) {
      facing.x += this.face[t]!;
      facing.y += this.face[t + 1]!;
      facing.z += this.face[t + 2]!;
      all += Math.hypot(this.face[t]!, this.face[t + 1]!, this.face[t + 2]!);
    }
    return { facing: facing.divideScalar(all || 1), opening: this.isOpen ? opening(this.triangles, this.rest) : undefined };
  }

  dispose(): void {
    clearTimeout(this.lighting);
    this.geometry.dispose();
    this.lines.dispose();
    this.wound.dispose();
  }
}
