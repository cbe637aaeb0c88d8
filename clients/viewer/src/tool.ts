// A tool as drawn: a probe whose tip rests on the tissue, its depth below the level of rest, and the force on it.

import {
  ConeGeometry,
  CylinderGeometry,
  Group,
  type Material,
  Mesh,
  MeshBasicMaterial,
  RingGeometry,
  SphereGeometry,
  Vector3,
} from "three";
import { light, SHADOWS, Steel } from "./material";
import { norm, type Vec3 } from "./samples";
import type { Surface } from "./surface";

/** A tool in the state of the server's sample. */
export interface ShownTool {
  /** The control point's place at rest. */
  restM: [number, number];
  /** Force of the tissue on the tool. */
  forceN: Vec3;
}

/** Radius of the shaft, of that of the tip; length of the shaft, of the size of the tissue. */
const SHAFT = 0.42;
const LENGTH = 0.75;
/** Places of the shaft that must be clear of tissue. */
const CHECKED = 16;
/** How far the shaft leans aside, as long as there is room. */
const LEAN = new Vector3(0.5, 0.28, 0.82).normalize();
const UP = new Vector3(0, 0, 1);

export class ToolMark {
  readonly group = new Group();
  /** Middle of the tip, and the direction of the shaft. */
  readonly tipM = new Vector3();
  private readonly axis = new Vector3(0, 0, 1);
  private readonly probe = new Group();
  private readonly arrow = new Group();
  private readonly rod: Mesh;
  private readonly head: Mesh;
  private readonly gauge: Mesh;
  private readonly foot: Mesh;
  private readonly level: Mesh;
  private readonly tried = new Vector3();
  private readonly force = new Vector3();
  private radiusM = 0;
  private lengthM = 0;
  private roomM = Infinity;

  constructor(private readonly index: number) {
    const steel = new Steel(0xd5d9de);
    this.probe.add(
      new Mesh(new SphereGeometry(1, 28, 20), steel),
      new Mesh(new CylinderGeometry(SHAFT, SHAFT, 7, 20).rotateX(Math.PI / 2).translate(0, 0, 4), steel),
      new Mesh(new CylinderGeometry(1.25 * SHAFT, 1.25 * SHAFT, 60, 20).rotateX(Math.PI / 2).translate(0, 0, 36), new Steel(0x40464f)),
    );
    const above = (colour: number, opacity: number): Material =>
      new MeshBasicMaterial({ color: colour, depthTest: false, transparent: true, opacity });
    const green = above(0x35d0ba, 1);
    const white = above(0xffffff, 0.85);
    this.rod = new Mesh(new CylinderGeometry(0.2, 0.2, 1, 12).rotateX(Math.PI / 2).translate(0, 0, 0.5), green);
    this.head = new Mesh(new ConeGeometry(0.62, 1.7, 20).rotateX(Math.PI / 2).translate(0, 0, -0.85), green);
    this.arrow.add(this.rod, this.head);
    this.gauge = new Mesh(new CylinderGeometry(0.12, 0.12, 1, 8).rotateX(Math.PI / 2).translate(0, 0, -0.5), white);
    this.level = new Mesh(new RingGeometry(1.7, 1.86, 48), white);
    for (const part of [this.rod, this.head]) part.renderOrder = 3;
    this.foot = new Mesh(new SphereGeometry(0.26, 12, 8), white);
    for (const part of [this.gauge, this.foot, this.level]) part.renderOrder = 2;
    this.group.add(this.probe, this.arrow, this.gauge, this.foot, this.level);
  }

  hide(): void {
    this.group.visible = false;
    if (this.index >= SHADOWS) return;
    light.tips.value[this.index]!.w = 0;
    light.rings.value[this.index]!.w = 0;
  }

  /** Puts the tool on the tissue as it is drawn. `size` is the tissue's, m; `right` is to the right as seen. */
  show(tool: ShownTool, surface: Surface, size: number, mostN: number, right: Vector3): void {
    this.group.visible = true;
    const [x, y] = tool.restM;
    const moved = surface.displacementAt(x, y);
    const [dx, dy, dz] = [moved.x, moved.y, moved.z];
    const r = (this.radiusM = size / 64);
    this.lengthM = LENGTH * size;
    this.tipM.set(x + dx, y + dy, 0);
    this.tipM.z = surface.restOn(this.tipM.x, this.tipM.y, r);
    this.direct(surface, dx, dy);
    this.roomM = Math.min(this.tipM.z - surface.restOn(this.tipM.x, this.tipM.y, r), this.room(surface, this.axis));
    this.probe.position.copy(this.tipM);
    this.probe.scale.setScalar(r);
    this.probe.quaternion.setFromUnitVectors(UP, this.axis);
    const strength = norm(tool.forceN);
    const acts = strength > 1e-3 * mostN;
    this.arrow.visible = acts;
    if (acts) {
      this.force.set(...tool.forceN).divideScalar(strength);
      const long = Math.min(strength / mostN, 1.2) * 0.26 * size + 2.4 * r;
      this.arrow.position.copy(this.tipM);
      this.arrow.quaternion.setFromUnitVectors(UP, this.force);
      this.rod.scale.set(r, r, long - 1.5 * r);
      this.head.position.z = long;
      this.head.scale.setScalar(r);
    }
    const deep = Math.abs(dz) > 0.8 * r;
    this.gauge.visible = this.foot.visible = this.level.visible = deep;
    if (deep) {
      this.level.position.set(x + dx, y + dy, 0);
      this.level.scale.setScalar(r);
      // Beside the arrow, from the level of rest to the tissue.
      this.gauge.position.copy(this.level.position).addScaledVector(right, -1.78 * r);
      this.gauge.scale.set(r, r, -dz);
      this.foot.position.copy(this.gauge.position);
      this.foot.position.z = dz;
      this.foot.scale.setScalar(r);
    }
    if (this.index >= SHADOWS) return;
    light.tips.value[this.index]!.set(this.tipM.x, this.tipM.y, this.tipM.z, r);
    const end = this.tried.copy(this.tipM).addScaledVector(this.axis, this.lengthM);
    light.shafts.value[this.index]!.set(end.x, end.y, end.z, 1.2 * SHAFT * r);
    light.rings.value[this.index]!.copy(light.tips.value[this.index]!).setW(2.1 * r);
  }

  /** Turns the shaft as far aside as the tissue leaves room; else upright, or towards where the tissue came from. */
  private direct(surface: Surface, dx: number, dy: number): void {
    let best = -Infinity;
    const back = Math.hypot(dx, dy) / this.radiusM;
    for (let k = 0; k < 8; k++) {
      if (k < 5) this.tried.copy(LEAN).lerp(UP, k / 4).normalize();
      else this.tried.set(-dx, -dy, 0).multiplyScalar((0.3 * (k - 4)) / (this.radiusM * Math.max(back, 1))).add(UP).normalize();
      const room = this.room(surface, this.tried);
      if (room > best) {
        best = room;
        this.axis.copy(this.tried);
      }
      if (room >= 0) return;
    }
  }

  /** The least distance of the shaft's underside above the tissue, m; negative if the shaft is in it. */
  private room(surface: Surface, axis: Vector3): number {
    let least = Infinity;
    for (let k = 1; k <= CHECKED; k++) {
      const t = this.radiusM + (this.lengthM - this.radiusM) * (k / CHECKED) ** 2;
      const z = this.tipM.z + t * axis.z;
      const below = surface.heightAt(this.tipM.x + t * axis.x, this.tipM.y + t * axis.y);
      least = Math.min(least, z - below - (1.25 * SHAFT * this.radiusM) / Math.max(axis.z, 0.4));
    }
    return least;
  }

  /** The least room between tip or shaft and the tissue when the tool was placed on it, m: what came since is not drawn. */
  get clearM(): number {
    return this.roomM;
  }
}
