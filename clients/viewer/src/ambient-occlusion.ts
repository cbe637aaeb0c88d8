// Ambient occlusion: the fraction of ambient light that reaches each vertex, on its outer and on its inner side.
// Creases, folds and the inside of a tube are darker than open areas.

/** Number of light directions, and width of the depth buffer of each direction in pixels. */
const DIRECTIONS = 28;
const SIDE = 112;
/** A vertex that is more than this many pixels behind the foremost surface counts as hidden. */
const BIAS = 2.2;

export interface AmbientOcclusion {
  outer: Float32Array<ArrayBuffer>;
  inner: Float32Array<ArrayBuffer>;
}

/**
 * Views a surface from each direction in turn. Each call of `next` processes one direction; the last one returns the
 * result.
 */
export class Looks {
  private readonly outer: Float32Array;
  private readonly inner: Float32Array;
  private readonly outerOf: Float32Array;
  private readonly innerOf: Float32Array;
  private readonly across: Float32Array;
  private readonly depths = new Float32Array(SIDE * SIDE);
  private readonly middle: [number, number, number];
  private readonly pixel: number;
  private done = 0;

  constructor(
    private readonly position: Float32Array,
    private readonly normal: Float32Array,
    private readonly triangles: Uint32Array,
  ) {
    const count = position.length / 3;
    this.outer = new Float32Array(count);
    this.inner = new Float32Array(count);
    this.outerOf = new Float32Array(count);
    this.innerOf = new Float32Array(count);
    this.across = new Float32Array(3 * count);
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (const vertex of triangles) {
      for (let c = 0; c < 3; c++) {
        low[c] = Math.min(low[c]!, position[3 * vertex + c]!);
        high[c] = Math.max(high[c]!, position[3 * vertex + c]!);
      }
    }
    this.middle = [0, 1, 2].map((c) => (low[c]! + high[c]!) / 2) as [number, number, number];
    const radius = Math.hypot(...[0, 1, 2].map((c) => (high[c]! - low[c]!) / 2)) || 1;
    this.pixel = (2.02 * radius) / SIDE;
  }

  next(): AmbientOcclusion | undefined {
    // Equal-area spiral on the sphere.
    const z = 1 - (2 * this.done + 1) / DIRECTIONS;
    const angle = this.done * Math.PI * (3 - Math.sqrt(5));
    const flat = Math.sqrt(1 - z * z);
    this.look(flat * Math.cos(angle), flat * Math.sin(angle), z);
    this.done += 1;
    if (this.done < DIRECTIONS) return undefined;
    const share = (seen: Float32Array, of: Float32Array) => seen.map((value, i) => (of[i]! > 0 ? value / of[i]! : 1));
    return {
      outer: share(this.outer, this.outerOf),
      inner: share(this.inner, this.innerOf),
    };
  }

  private look(dx: number, dy: number, dz: number): void {
    const { position: p, normal: n, across: q, depths, triangles, pixel } = this;
    const [mx, my, mz] = this.middle;
    // Two perpendicular directions.
    const [ux, uy, uz] = Math.abs(dz) < 0.9 ? unit(-dy, dx, 0) : unit(0, -dz, dy);
    const [vx, vy, vz] = [dy * uz - dz * uy, dz * ux - dx * uz, dx * uy - dy * ux];
    for (let i = 0; i < p.length; i += 3) {
      const x = p[i]! - mx;
      const y = p[i + 1]! - my;
      const z = p[i + 2]! - mz;
      q[i] = (x * ux + y * uy + z * uz) / pixel + SIDE / 2;
      q[i + 1] = (x * vx + y * vy + z * vz) / pixel + SIDE / 2;
      q[i + 2] = (x * dx + y * dy + z * dz) / pixel;
    }
    depths.fill(-Infinity);
    for (let t = 0; t < triangles.length; t += 3) this.cover(3 * triangles[t]!, 3 * triangles[t + 1]!, 3 * triangles[t + 2]!);
    for (let i = 0, k = 0; i < p.length; i += 3, k++) {
      const facing = n[i]! * dx + n[i + 1]! * dy + n[i + 2]! * dz;
      const at = Math.min(SIDE - 1, Math.max(0, q[i + 1]! | 0)) * SIDE + Math.min(SIDE - 1, Math.max(0, q[i]! | 0));
      // On a surface that is seen from the side, depths vary within a pixel.
      const slack = BIAS + 1.2 / Math.max(Math.abs(facing), 0.25);
      const seen = Math.min(1, Math.max(0, 1 - (depths[at]! - q[i + 2]! - slack) / 2));
      if (facing > 0) {
        this.outer[k]! += facing * seen;
        this.outerOf[k]! += facing;
      } else {
        this.inner[k]! -= facing * seen;
        this.innerOf[k]! -= facing;
      }
    }
  }

  /** Draws a triangle into the depth buffer. */
  private cover(a: number, b: number, c: number): void {
    const { across: q, depths } = this;
    const ax = q[a]!;
    const ay = q[a + 1]!;
    const az = q[a + 2]!;
    const bx = q[b]!;
    const by = q[b + 1]!;
    const bz = q[b + 2]!;
    const cx = q[c]!;
    const cy = q[c + 1]!;
    const cz = q[c + 2]!;
    const area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
    if (Math.abs(area) < 1e-6) return;
    const left = Math.max(0, Math.ceil(Math.min(ax, bx, cx) - 0.5));
    const right = Math.min(SIDE - 1, Math.floor(Math.max(ax, bx, cx) - 0.5));
    const top = Math.max(0, Math.ceil(Math.min(ay, by, cy) - 0.5));
    const bottom = Math.min(SIDE - 1, Math.floor(Math.max(ay, by, cy) - 0.5));
    for (let y = top; y <= bottom; y++) {
      for (let x = left; x <= right; x++) {
        const px = x + 0.5 - ax;
        const py = y + 0.5 - ay;
        const wb = (px * (cy - ay) - py * (cx - ax)) / area;
        const wc = ((bx - ax) * py - (by - ay) * px) / area;
        if (wb < 0 || wc < 0 || wb + wc > 1) continue;
        const depth = az + wb * (bz - az) + wc * (cz - az);
        if (depth > depths[y * SIDE + x]!) depths[y * SIDE + x] = depth;
      }
    }
  }
}

function unit(x: number, y: number, z: number): [number, number, number] {
  const length = Math.hypot(x, y, z) || 1;
  return [x / length, y / length, z / length];
}
