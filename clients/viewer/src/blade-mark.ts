// A blade as drawn: a scalpel that stands on its point, its edge as long as the server's.

import { BufferAttribute, BufferGeometry, CylinderGeometry, Group, Mesh, Vector3 } from "three";
import type { Vec3 } from "palpate";
import { light, SHADOWS, Steel } from "./material";

/** Width and thickness of the blade, and radius and length of its handle, in lengths of the edge. */
const WIDTH = 0.34;
const THICKNESS = 0.03;
const HANDLE = { radius: 0.11, length: 4 };
const UP = new Vector3(0, 0, 1);

/** A blade in the state of its hand. */
export interface ShownBlade {
  /** Its tool. */
  tool: number;
  /** Its point, m. */
  tipM: Vec3;
  /** The edge from there to its heel, m. */
  edgeM: Vec3;
}

/** Returns whether a blade looks the same in both places. */
export function isSameBlade(a: ShownBlade, b: ShownBlade): boolean {
  return [0, 1, 2].every((c) => a.tipM[c] === b.tipM[c] && a.edgeM[c] === b.edgeM[c]);
}

/** Returns a blade of length 1 with a straight edge along z and a curved back, thin at the edge. */
function bladeGeometry(): BufferGeometry {
  // Edge and back at several heights; the back is WIDTH away from a third of the height on.
  const rows = Array.from({ length: 9 }, (_, row) => row / 8);
  const corners = rows.flatMap((z) => {
    const back = WIDTH * Math.sqrt(Math.min(1, 3 * z));
    return [[0, 0, z], [back, THICKNESS, z], [back, -THICKNESS, z]];
  });
  const triangles: number[] = [];
  for (let row = 0; row + 1 < rows.length; row++) {
    const [a, b] = [3 * row, 3 * row + 3];
    for (const [p, q] of [[0, 1], [1, 2], [2, 0]] as const) triangles.push(a + p, b + q, a + q, a + p, b + p, b + q);
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(corners.flat()), 3));
  geometry.setIndex(triangles);
  geometry.computeVertexNormals();
  return geometry;
}

export class BladeMark {
  readonly group = new Group();
  readonly tipM = new Vector3();
  private readonly far = new Vector3();

  constructor() {
    const { radius, length } = HANDLE;
    const handle = new CylinderGeometry(radius, radius, length, 16).rotateX(Math.PI / 2).translate(WIDTH / 2, 0, 1 + length / 2);
    this.group.add(new Mesh(bladeGeometry(), new Steel(0xd5d9de)), new Mesh(handle, new Steel(0x40464f)));
    this.group.visible = false;
  }

  hide(): void {
    this.group.visible = false;
  }

  /** Stands the blade on its point; the first tools by `index` cast shadows. */
  show({ tipM, edgeM }: ShownBlade, index: number): void {
    this.group.visible = true;
    this.tipM.set(...tipM);
    this.far.set(...edgeM);
    const lengthM = this.far.length();
    this.group.position.copy(this.tipM);
    this.group.quaternion.setFromUnitVectors(UP, this.far.normalize());
    this.group.scale.setScalar(lengthM);
    if (index >= SHADOWS) return;
    const radiusM = HANDLE.radius * lengthM;
    const end = this.far.multiplyScalar((1 + HANDLE.length) * lengthM).add(this.tipM);
    light.tips.value[index]!.set(this.tipM.x, this.tipM.y, this.tipM.z, 0.2 * radiusM);
    light.shafts.value[index]!.set(end.x, end.y, end.z, radiusM);
  }
}
