// Threads and clips as drawn: a line over the surface from bite to bite, and a knot at each; a clip is a bar between its two. Bites that
// the user has picked for the next one are drawn through everything.

import { CylinderGeometry, DynamicDrawUsage, Group, InstancedMesh, Matrix4, MeshBasicMaterial, Quaternion, SphereGeometry, Vector3 } from "three";
import type { BufferGeometry, Material } from "three";
import type { Place, Surface } from "./surface";

/** A thread or clip in the state of the server. */
export interface ShownTie {
  isClip: boolean;
  bites: readonly Place[];
  /** The bites and places of the surface between them, in the order of the thread. */
  way: readonly Place[];
}

/** Radius of a thread, of a knot, of a clip, and of a picked bite, in sizes of the tissue. */
const RADIUS = { thread: 1 / 450, knot: 1 / 260, clip: 1 / 150, picked: 1 / 130 };
const UP = new Vector3(0, 1, 0);

/** Any number of equal shapes in one draw call. */
class Copies {
  private mesh: InstancedMesh;
  private count = 0;

  constructor(
    private readonly group: Group,
    private readonly shape: BufferGeometry,
    private readonly material: Material,
    private readonly order: number,
  ) {
    this.mesh = this.make(16);
  }

  private make(capacity: number): InstancedMesh {
    const mesh = new InstancedMesh(this.shape, this.material, capacity);
    mesh.instanceMatrix.setUsage(DynamicDrawUsage);
    // They move with the tissue.
    mesh.frustumCulled = false;
    mesh.renderOrder = this.order;
    this.group.add(mesh);
    return mesh;
  }

  begin(): void {
    this.count = 0;
  }

  add(matrix: Matrix4): void {
    if (this.count === this.mesh.instanceMatrix.count) {
      const former = this.mesh;
      this.mesh = this.make(2 * this.count);
      (this.mesh.instanceMatrix.array as Float32Array).set(former.instanceMatrix.array);
      this.group.remove(former);
      former.dispose();
    }
    this.mesh.setMatrixAt(this.count++, matrix);
  }

  end(): void {
    this.mesh.count = this.count;
    this.mesh.visible = this.count > 0;
    this.mesh.instanceMatrix.needsUpdate = true;
  }
}

export class TieMarks {
  readonly group = new Group();
  ties: readonly ShownTie[] = [];
  picked: readonly Place[] = [];
  private readonly threads: Copies;
  private readonly knots: Copies;
  private readonly clips: Copies;
  private readonly bites: Copies;
  private readonly matrix = new Matrix4();
  private readonly turn = new Quaternion();
  private readonly scale = new Vector3();
  private readonly middle = new Vector3();
  private readonly along = new Vector3();

  constructor() {
    const [bar, ball] = [new CylinderGeometry(1, 1, 1, 8), new SphereGeometry(1, 12, 8)];
    const blue = new MeshBasicMaterial({ color: 0x1d2f8f });
    const steel = new MeshBasicMaterial({ color: 0xc9ced6 });
    const yellow = new MeshBasicMaterial({ color: 0xffd23f, depthTest: false, transparent: true, opacity: 0.95 });
    this.threads = new Copies(this.group, bar, blue, 0);
    this.knots = new Copies(this.group, ball, blue, 0);
    this.clips = new Copies(this.group, bar, steel, 0);
    this.bites = new Copies(this.group, ball, yellow, 2);
  }

  /** Puts all on the tissue as it is drawn now. */
  place(surface: Surface): void {
    const all = [this.threads, this.knots, this.clips, this.bites];
    for (const copies of all) copies.begin();
    for (const { isClip, bites, way } of this.ties) {
      const radiusM = surface.sizeM * (isClip ? RADIUS.clip : RADIUS.thread);
      const places = way.map((place) => this.over(place, surface, radiusM));
      for (let k = 0; k + 1 < places.length; k++) this.bar(isClip ? this.clips : this.threads, places[k]!, places[k + 1]!, radiusM);
      if (!isClip) for (const bite of bites) this.ball(this.knots, this.over(bite, surface, radiusM), surface.sizeM * RADIUS.knot);
    }
    for (const bite of this.picked) this.ball(this.bites, this.over(bite, surface, 0), surface.sizeM * RADIUS.picked);
    for (const copies of all) copies.end();
  }

  /** Returns where a place is now, and `highM` out of the tissue. */
  private over(place: Place, surface: Surface, highM: number): Vector3 {
    const moved = surface.displacementAt(place);
    return new Vector3(...place.restM).add(moved).addScaledVector(this.along.set(...place.outward), highM);
  }

  private bar(copies: Copies, from: Vector3, to: Vector3, radiusM: number): void {
    const lengthM = this.along.subVectors(to, from).length();
    if (lengthM === 0) return;
    this.turn.setFromUnitVectors(UP, this.along.divideScalar(lengthM));
    this.middle.addVectors(from, to).multiplyScalar(0.5);
    // Longer by its radius at each end: bars that meet at an angle leave no gap.
    copies.add(this.matrix.compose(this.middle, this.turn, this.scale.set(radiusM, lengthM + radiusM, radiusM)));
  }

  private ball(copies: Copies, at: Vector3, radiusM: number): void {
    copies.add(this.matrix.compose(at, this.turn.identity(), this.scale.setScalar(radiusM)));
  }
}
