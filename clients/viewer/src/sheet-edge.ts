// The flank of the tissue: from the edge of the sheet around and down to the table. It shows that tissue is a body,
// though the server computes only its surface.

import { BufferAttribute, BufferGeometry, DynamicDrawUsage } from "three";

/** Height of the body, and radius of its edges and corners, as fractions of the shorter side of the sheet. */
const HEIGHT = 0.2;
const ROUND = 0.075;
/** Segments of a corner. */
const CORNER = 6;
/** The angle of each row on the rounded edge; two more rows are below. */
const ANGLES = [0, 0.3, 0.65, 1.0, 1.3, Math.PI / 2];
const ROWS = ANGLES.length + 2;

export class SheetEdge {
  readonly geometry = new BufferGeometry();
  readonly heightM: number;
  readonly roundM: number;
  /** For each column: the vertex of the sheet's edge, and the direction outwards. */
  private sources = new Uint32Array();
  private outwards = new Float32Array();
  private position = new BufferAttribute(new Float32Array(), 3);
  private normal = this.position;
  private edge = this.position;
  private edgeNormal = this.position;

  constructor(
    private readonly widthM: number,
    private readonly lengthM: number,
  ) {
    const side = Math.min(widthM, lengthM) || Math.max(widthM, lengthM);
    this.heightM = HEIGHT * side;
    this.roundM = ROUND * side;
  }

  /** Creates the flank around the `mx` × `my` drawn vertices. */
  begin(edge: BufferAttribute, edgeNormal: BufferAttribute, mx: number, my: number): void {
    [this.edge, this.edgeNormal] = [edge, edgeNormal];
    const sources: number[] = [];
    const outwards: number[] = [];
    const side = (count: number, at: (i: number) => number, angle: number) => {
      for (let i = 0; i < count; i++) {
        sources.push(at(i));
        outwards.push(Math.cos(angle), Math.sin(angle));
      }
      for (let k = 1; k < CORNER; k++) {
        const turned = angle + (k / CORNER) * (Math.PI / 2);
        sources.push(at(count - 1));
        outwards.push(Math.cos(turned), Math.sin(turned));
      }
    };
    // Counterclockwise, from the near left corner.
    side(mx, (i) => i * my, -Math.PI / 2);
    side(my, (i) => (mx - 1) * my + i, 0);
    side(mx, (i) => (mx - 1 - i) * my + my - 1, Math.PI / 2);
    side(my, (i) => my - 1 - i, Math.PI);
    sources.push(sources[0]!);
    outwards.push(outwards[0]!, outwards[1]!);
    this.sources = Uint32Array.from(sources);
    this.outwards = Float32Array.from(outwards);
    const columns = sources.length;
    this.position = new BufferAttribute(new Float32Array(3 * columns * ROWS), 3).setUsage(DynamicDrawUsage);
    this.normal = new BufferAttribute(new Float32Array(3 * columns * ROWS), 3).setUsage(DynamicDrawUsage);
    const open = new Float32Array(columns * ROWS);
    const uv = new Float32Array(2 * columns * ROWS);
    const triangles: number[] = [];
    for (let row = 0; row < ROWS; row++) {
      const arcM = this.profile(row).arcM;
      for (let column = 0; column < columns; column++) {
        const i = row * columns + column;
        const at = sources[column]!;
        // The image continues over the edge, mirrored.
        uv[2 * i] = Math.floor(at / my) / Math.max(mx - 1, 1) + (outwards[2 * column]! * arcM) / (this.widthM || 1);
        uv[2 * i + 1] = (at % my) / Math.max(my - 1, 1) + (outwards[2 * column + 1]! * arcM) / (this.lengthM || 1);
        open[i] = row < ANGLES.length ? 1 : [0.85, 0.45][row - ANGLES.length]!;
        if (row > 0 && column > 0) triangles.push(i - columns - 1, i - 1, i, i - columns - 1, i, i - columns);
      }
    }
    this.geometry.setAttribute("position", this.position);
    this.geometry.setAttribute("normal", this.normal);
    this.geometry.setAttribute("open", new BufferAttribute(open, 1));
    this.geometry.setAttribute("burn", new BufferAttribute(new Float32Array(columns * ROWS), 1));
    this.geometry.setAttribute("uv", new BufferAttribute(uv, 2));
    this.geometry.setIndex(triangles);
  }

  /** For a row: distance outwards and downwards, direction of its normal, and length along the flank, m. */
  private profile(row: number): { outM: number; downM: number; angle: number; arcM: number } {
    const { roundM: r, heightM } = this;
    const angle = ANGLES[row];
    if (angle !== undefined) return { outM: r * Math.sin(angle), downM: r * (1 - Math.cos(angle)), angle, arcM: r * angle };
    const isLast = row === ROWS - 1;
    const downM = isLast ? heightM : r + 0.45 * (heightM - r);
    return { outM: isLast ? 0.8 * r : 1.0 * r, downM, angle: isLast ? 1.8 : 1.62, arcM: (Math.PI / 2 - 1) * r + downM };
  }

  /** Is as burnt as the edge of the sheet, less from row to row. `burn` has that of each drawn vertex. */
  showBurns(burn: ArrayLike<number>): void {
    const attribute = this.geometry.getAttribute("burn") as BufferAttribute;
    this.sources.forEach((source, column) => {
      for (let row = 0; row < ROWS; row++) attribute.array[row * this.sources.length + column] = (1 - row / ROWS) * burn[source]!;
    });
    attribute.needsUpdate = true;
  }

  /** Moves with the edge of the sheet. */
  follow(): void {
    const p = this.position.array as Float32Array;
    const n = this.normal.array as Float32Array;
    const { sources, outwards } = this;
    const [edge, edgeNormal] = [this.edge.array, this.edgeNormal.array];
    const columns = sources.length;
    for (let row = 0; row < ROWS; row++) {
      const { outM, downM, angle } = this.profile(row);
      const [sin, cos] = [Math.sin(angle), Math.cos(angle)];
      // The foot stays on the table.
      const isFoot = row === ROWS - 1;
      for (let column = 0, i = 3 * row * columns; column < columns; column++, i += 3) {
        const from = 3 * sources[column]!;
        const [ox, oy] = [outwards[2 * column]!, outwards[2 * column + 1]!];
        p[i] = edge[from]! + ox * outM;
        p[i + 1] = edge[from + 1]! + oy * outM;
        p[i + 2] = isFoot ? -this.heightM : Math.max(edge[from + 2]! - downM, -this.heightM);
        n[i] = row === 0 ? edgeNormal[from]! : ox * sin;
        n[i + 1] = row === 0 ? edgeNormal[from + 1]! : oy * sin;
        n[i + 2] = row === 0 ? edgeNormal[from + 2]! : cos;
      }
    }
    this.position.needsUpdate = this.normal.needsUpdate = true;
  }
}
