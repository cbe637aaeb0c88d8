// The arrow of the force on a tool.

import { ConeGeometry, CylinderGeometry, Group, Mesh, MeshBasicMaterial, Vector3 } from "three";
import { norm, type Vec3 } from "palpate";
import type { Surface } from "./surface";

/** Maximum length relative to the tissue's size and to the available room. */
const ARROW = { size: 0.26, room: 0.9 };
/** Below this fraction of the strongest push no force is drawn. */
const MIN_PART = 1e-3;
const UP = new Vector3(0, 0, 1);

export class ForceArrow {
  readonly group = new Group();
  private readonly rod: Mesh;
  private readonly head: Mesh;
  private readonly force = new Vector3();

  constructor() {
    const green = new MeshBasicMaterial({ color: 0x35d0ba, depthTest: false, transparent: true });
    this.rod = new Mesh(new CylinderGeometry(0.2, 0.2, 1, 12).rotateX(Math.PI / 2).translate(0, 0, 0.5), green);
    this.head = new Mesh(new ConeGeometry(0.62, 1.7, 20).rotateX(Math.PI / 2).translate(0, 0, -0.85), green);
    for (const part of [this.rod, this.head]) part.renderOrder = 3;
    this.group.add(this.rod, this.head);
  }

  /**
   * Draws a force that is `part` of the strongest push, from `fromM` on. `r` is the radius of the tool's tip, `size` that
   * of the tissue, of which less is seen from close by.
   */
  show(fromM: Vector3, forceN: Vec3, part: number, surface: Surface, r: number, size: number): void {
    const strength = norm(forceN);
    this.group.visible = part > MIN_PART && strength > 0;
    if (!this.group.visible) return;
    this.force.set(...forceN).divideScalar(strength);
    let long = Math.min(part, 1.2) * ARROW.size * size + 2.4 * r;
    // Inside a tube it ends before the wall.
    if (!surface.edge) long = Math.max(ARROW.room * (long + Math.min(0, surface.room(fromM, this.force, long, r, 0))), 3 * r);
    this.group.position.copy(fromM);
    this.group.quaternion.setFromUnitVectors(UP, this.force);
    this.rod.scale.set(r, r, long - 1.5 * r);
    this.head.position.z = long;
    this.head.scale.setScalar(r);
  }
}
