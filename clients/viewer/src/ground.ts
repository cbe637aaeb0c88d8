// The table that the tissue lies on, and its shadow there.

import {
  BufferAttribute,
  BufferGeometry,
  Color,
  DataTexture,
  LinearFilter,
  Mesh,
  RGFormat,
  Vector2,
  Vector3,
} from "three";
import { Body } from "./body";
import type { SheetEdge } from "./sheet-edge";
import { Table } from "./material";
import type { Surface } from "./surface";

/** Width of a body's shadow texture in pixels, and its margin, as a fraction of the body's size. */
const SIDE = 64;
const AROUND = 0.6;
/** Height of an open body above the table, as a fraction of its size: dents reach below the body. */
const GAP = 0.12;

/** Returns the height of the table beneath a body, m. */
function floorOf({ box, isOpen, sizeM }: Surface): number {
  return box.min.z - (isOpen ? GAP * sizeM : 0);
}

export class Ground {
  readonly mesh: Mesh;
  private readonly cloth: Table;
  private readonly dark: DataTexture | undefined;

  constructor(surface: Surface, colour: Color, background: Color) {
    const isBody = surface instanceof Body;
    this.cloth = new Table(isBody);
    const { middle, half_, height } = this.cloth.uniforms as Record<string, { value: unknown }>;
    const centre = surface.box.getCenter(new Vector3());
    const size = surface.box.getSize(new Vector3());
    (middle!.value as Vector2).set(centre.x, centre.y);
    if (isBody) {
      (half_!.value as Vector2).set(size.x, size.y).multiplyScalar(0.5).addScalar(AROUND * surface.sizeM);
      height!.value = surface.box.max.z - floorOf(surface);
      this.dark = shadowOf(surface, half_!.value as Vector2);
      this.cloth.uniforms.dark!.value = this.dark;
    } else if (surface.edge) {
      (half_!.value as Vector2).set(size.x, size.y).multiplyScalar(0.5).addScalar(0.6 * surface.edge.roundM);
      height!.value = surface.edge.heightM;
    }
    const geometry = surface.edge ? holed([size.x, size.y], surface.edge, 8 * surface.sizeM) : square(surface, 8 * surface.sizeM);
    this.mesh = new Mesh(geometry, this.cloth);
    this.mesh.frustumCulled = false;
    this.colours(colour, background);
  }

  colours(colour: Color, background: Color): void {
    (this.cloth.uniforms.background!.value as Color).copy(background);
    (this.cloth.uniforms.colour!.value as Color).copy(colour);
  }

  dispose(): void {
    this.mesh.geometry.dispose();
    this.cloth.dispose();
    this.dark?.dispose();
  }
}

/** Table beneath a body. */
function square(surface: Surface, farM: number): BufferGeometry {
  const { x, y } = surface.box.getCenter(new Vector3());
  const z = floorOf(surface);
  const places = [x - farM, y - farM, z, x + farM, y - farM, z, x + farM, y + farM, z, x - farM, y + farM, z];
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(places), 3));
  geometry.setIndex([0, 1, 2, 0, 2, 3]);
  return geometry;
}

/** Table with a hole beneath the tissue, because a dent may reach below the table. */
function holed([width, length]: [number, number], { roundM, heightM }: SheetEdge, farM: number): BufferGeometry {
  const places: number[] = [];
  const corners = [[0, 0], [width, 0], [width, length], [0, length]] as const;
  const segments = 8;
  for (let corner = 0; corner <= 4; corner++) {
    const [x, y] = corners[corner % 4]!;
    for (let k = 0; k <= segments; k++) {
      const angle = Math.PI + (corner % 4) * (Math.PI / 2) + (k / segments) * (Math.PI / 2);
      const [ox, oy] = [Math.cos(angle), Math.sin(angle)];
      places.push(x + 0.5 * roundM * ox, y + 0.5 * roundM * oy, -heightM, x + farM * ox, y + farM * oy, -heightM);
    }
  }
  const triangles: number[] = [];
  for (let i = 0; i + 3 < places.length / 3; i += 2) triangles.push(i, i + 1, i + 3, i, i + 3, i + 2);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(places), 3));
  geometry.setIndex(triangles);
  return geometry;
}

/**
 * Returns how dark the table is beneath a body: red where the body is close to it, green where the body is anywhere
 * above it. Each vertex adds a soft spot, which is wider the higher the vertex is.
 */
function shadowOf(body: Body, half_: Vector2): DataTexture {
  const { restM, box } = body;
  const centre = box.getCenter(new Vector3());
  const close = new Float32Array(SIDE * SIDE);
  const above = new Float32Array(SIDE * SIDE);
  const reach = 0.12 * body.sizeM;
  const floor = floorOf(body);
  for (let i = 0; i < restM.length; i += 3) {
    const x = Math.floor((0.5 + (0.5 * (restM[i]! - centre.x)) / half_.x) * SIDE);
    const y = Math.floor((0.5 + (0.5 * (restM[i + 1]! - centre.y)) / half_.y) * SIDE);
    const at = Math.min(Math.max(y, 0), SIDE - 1) * SIDE + Math.min(Math.max(x, 0), SIDE - 1);
    close[at] = Math.max(close[at]!, Math.exp(-(restM[i + 2]! - floor) / reach));
    above[at] = 1;
  }
  const soft = (values: Float32Array, rounds: number) => {
    for (let round = 0; round < rounds; round++) values = blurred(values);
    return values;
  };
  // Spots closer than a pixel leave no gaps.
  const [red, green] = [soft(close, 3), soft(above, 6)];
  const data = new Uint8Array(2 * SIDE * SIDE);
  for (let i = 0; i < SIDE * SIDE; i++) {
    data[2 * i] = 255 * Math.min(1, 1.15 * red[i]!);
    data[2 * i + 1] = 255 * Math.min(1, 1.1 * green[i]!);
  }
  const texture = new DataTexture(data, SIDE, SIDE, RGFormat);
  texture.minFilter = texture.magFilter = LinearFilter;
  // Rows of one or two bytes per pixel then need no padding.
  texture.unpackAlignment = 1;
  texture.needsUpdate = true;
  return texture;
}

/** Returns the mean over each pixel and its neighbours. The border stays clear. */
function blurred(values: Float32Array): Float32Array {
  const result = new Float32Array(values.length);
  for (let y = 1; y + 1 < SIDE; y++) {
    for (let x = 1; x + 1 < SIDE; x++) {
      let sum = 0;
      for (let dy = -1; dy <= 1; dy++) for (let dx = -1; dx <= 1; dx++) sum += values[(y + dy) * SIDE + x + dx]!;
      result[y * SIDE + x] = sum / 9;
    }
  }
  return result;
}
