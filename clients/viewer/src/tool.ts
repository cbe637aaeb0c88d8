// A tool as drawn: a probe whose tip rests on the tissue, its depth below the surface at rest, and the force on it.

import {
  CylinderGeometry,
  Group,
  Mesh,
  MeshBasicMaterial,
  RingGeometry,
  SphereGeometry,
  Vector3,
} from "three";
import { light, SHADOWS, Steel } from "./material";
import type { Vec3 } from "palpate";
import { ForceArrow } from "./force-arrow";
import type { Place, Surface } from "./surface";

/** A tool in the state of the server's sample. */
export interface ShownTool {
  /** Its number. */
  tool: number;
  /** The control point. */
  place: Place;
  /** Force of the tissue on the tool. */
  forceN: Vec3;
  /** Magnitude of the force, as a fraction of the strongest push. */
  part: number;
}

/** The view: position of the eye, and the direction to the right. */
export interface Seen {
  eye: Vector3;
  right: Vector3;
}

/** Radius of the shaft relative to the tip, and length of the shaft relative to the tissue's size. */
const SHAFT = 0.42;
const LENGTH = 0.75;
/**
 * A tool that is closer to the eye than this fraction of the tissue's size is drawn smaller, down to the given
 * fraction of its own size.
 */
const NEAR = 0.9;
const MIN_SCALE = 0.25;
/** Direction of the shaft if there is enough room. */
const LEAN = new Vector3(0.5, 0.28, 0.82).normalize();
/** The depth gauge is not drawn if the view is along it: above this cosine of the angle. */
const END_ON = 0.9;
/**
 * Directions of a shaft in a tube: it points past the eye, sideways and ahead, in units of its length. The tissue
 * leaves room there.
 */
const BESIDE_EYE = [[0.25, 0], [-0.25, 0], [0, 0.25], [0, -0.25], [0.1, 0], [-0.1, 0]] as const;
/** Number of other directions out of the tissue that are tried in a tube. */
const AROUND = 16;
/** Where the dark part of a shaft begins and ends, in radii of the tip. In a tube it ends before the wall. */
const HANDLE = { from: 6, to: 66 };
/** Part of the available room that the shaft takes. */
const ROOM = 0.9;
const UP = new Vector3(0, 0, 1);

export class ToolMark {
  readonly group = new Group();
  /** Centre of the tip, and direction of the shaft. */
  readonly tipM = new Vector3();
  private readonly axis = new Vector3(0, 0, 1);
  private readonly probe = new Group();
  private readonly arrow = new ForceArrow();
  private readonly handle: Mesh;
  private readonly gauge: Mesh;
  private readonly foot: Mesh;
  private readonly level: Mesh;
  private readonly tried = new Vector3();
  /** The direction out of the tissue at the tool, and two perpendicular directions. */
  private readonly out = new Vector3(0, 0, 1);
  private readonly across = new Vector3();
  private readonly aside = new Vector3();
  private isNew = true;
  private readonly moved = new Vector3();
  private radiusM = 0;
  private lengthM = 0;
  private roomM = Infinity;

  constructor() {
    const steel = new Steel(0xd5d9de);
    this.probe.add(
      new Mesh(new SphereGeometry(1, 28, 20), steel),
      new Mesh(new CylinderGeometry(SHAFT, SHAFT, 7, 20).rotateX(Math.PI / 2).translate(0, 0, 4), steel),
    );
    const long = HANDLE.to - HANDLE.from;
    const handle = new CylinderGeometry(1.25 * SHAFT, 1.25 * SHAFT, long, 20).rotateX(Math.PI / 2).translate(0, 0, long / 2);
    this.handle = new Mesh(handle, new Steel(0x40464f));
    this.handle.position.z = HANDLE.from;
    this.probe.add(this.handle);
    const white = new MeshBasicMaterial({ color: 0xffffff, depthTest: false, transparent: true, opacity: 0.85 });
    this.gauge = new Mesh(new CylinderGeometry(0.12, 0.12, 1, 8).rotateX(Math.PI / 2).translate(0, 0, -0.5), white);
    this.level = new Mesh(new RingGeometry(1.7, 1.86, 48), white);
    this.foot = new Mesh(new SphereGeometry(0.26, 12, 8), white);
    for (const part of [this.gauge, this.foot, this.level]) part.renderOrder = 2;
    this.group.add(this.probe, this.arrow.group, this.gauge, this.foot, this.level);
  }

  hide(): void {
    this.group.visible = false;
    this.isNew = true;
  }

  /** Puts the tool on the tissue as it is drawn. `size` is the tissue's, m; the first tools by `index` cast shadows. */
  show(tool: ShownTool, surface: Surface, size: number, { right, eye }: Seen, index: number): void {
    this.group.visible = true;
    const { place } = tool;
    const moved = this.moved.copy(surface.displacementAt(place));
    // Inside a body the view is from close by.
    const apart = this.tipM.set(...place.restM).add(moved).distanceTo(eye);
    const near = surface.edge ? 1 : Math.min(1, Math.max(apart / (NEAR * size), MIN_SCALE));
    const r = (this.radiusM = (near * size) / 64);
    this.lengthM = LENGTH * size;
    surface.restOn(place, r, this.tipM);
    this.turn(place, right);
    this.direct(surface, eye);
    // The tip rests on the tissue, so its distance is 0.
    this.roomM = Math.min(0, this.roomOf(surface, this.axis));
    this.probe.position.copy(this.tipM);
    this.probe.scale.setScalar(r);
    this.probe.quaternion.setFromUnitVectors(UP, this.axis);
    const whole = HANDLE.to * r;
    const free = surface.edge ? whole : whole + Math.min(0, surface.room(this.tipM, this.axis, whole, r, 0));
    this.lengthM = Math.min(this.lengthM, free);
    this.handle.scale.z = Math.max((ROOM * free) / r - HANDLE.from, 0.01) / (HANDLE.to - HANDLE.from);
    this.arrow.show(this.tipM, tool.forceN, tool.part, surface, r, near * size);
    const out = moved.dot(this.out);
    const deep = Math.abs(out) > 0.8 * r;
    this.level.visible = deep;
    // Seen along its direction, its length is not visible.
    const along = Math.abs(this.tried.copy(eye).sub(this.tipM).normalize().dot(this.out));
    this.gauge.visible = this.foot.visible = deep && along < END_ON;
    if (deep) {
      this.level.position.set(...place.restM).add(moved).addScaledVector(this.out, -out);
      // Down to the underside of the drawn tip, which on a curved surface is not at the height of the tissue beside
      // it.
      const high = out > 0 ? out : this.tried.copy(this.tipM).sub(this.level.position).dot(this.out) - r;
      this.level.scale.setScalar(r);
      this.level.quaternion.setFromUnitVectors(UP, this.out);
      // Beside the arrow, from the level of the surface at rest to the tissue.
      this.tried.copy(right).addScaledVector(this.out, -right.dot(this.out)).normalize();
      this.gauge.position.copy(this.level.position).addScaledVector(this.tried, -1.78 * r);
      this.gauge.quaternion.copy(this.level.quaternion);
      this.gauge.scale.set(r, r, -high);
      this.foot.position.copy(this.gauge.position).addScaledVector(this.out, high);
      this.foot.scale.setScalar(r);
    }
    if (index >= SHADOWS) return;
    light.tips.value[index]!.set(this.tipM.x, this.tipM.y, this.tipM.z, r);
    const end = this.tried.copy(this.tipM).addScaledVector(this.axis, this.lengthM);
    light.shafts.value[index]!.set(end.x, end.y, end.z, 1.2 * SHAFT * r);
    // In a dent of a body there would be several rings, where its walls intersect the sphere.
    light.rings.value[index]!.copy(light.tips.value[index]!).setW(deep && !surface.edge ? 0 : 2.1 * r);
  }

  /** Updates the directions at the place. A shaft keeps its tilt while it stays there. */
  private turn(place: Place, right: Vector3): void {
    const before = this.tried.copy(this.out);
    this.out.set(...place.outward);
    if (!this.isNew && before.distanceToSquared(this.out) < 1e-12) return;
    if (this.isNew || before.dot(this.out) < -0.9) {
      // On a sheet along its sides, so that the shaft does not turn with the view.
      if (this.out.z > 0.9999) this.across.set(1, 0, 0);
      else this.across.copy(right);
    }
    this.across.addScaledVector(this.out, -this.across.dot(this.out));
    if (this.across.lengthSq() < 1e-6) this.across.set(0, 0, 1).addScaledVector(this.out, -this.out.z);
    this.across.normalize();
    this.aside.crossVectors(this.out, this.across);
    this.isNew = false;
  }

  /** Returns a vector in the directions of the place: to the right, ahead, and out. */
  private along(x: number, y: number, z: number): Vector3 {
    return this.tried.set(0, 0, 0).addScaledVector(this.across, x).addScaledVector(this.aside, y).addScaledVector(this.out, z).normalize();
  }

  /**
   * Tilts the shaft as far as the tissue leaves room; otherwise it is upright, or points to where the tissue came
   * from or to the eye.
   */
  private direct(surface: Surface, eye: Vector3): void {
    let best = -Infinity;
    const [dx, dy] = [this.moved.dot(this.across), this.moved.dot(this.aside)];
    const back = Math.hypot(dx, dy) / this.radiusM;
    for (let k = 0; k < 8 + (surface.edge ? 0 : BESIDE_EYE.length + AROUND); k++) {
      const part = (0.3 * (k - 4)) / (this.radiusM * Math.max(back, 1));
      if (k < 5) this.along(LEAN.x * (1 - k / 4), LEAN.y * (1 - k / 4), LEAN.z * (1 - k / 4) + k / 4);
      else if (k < 8) this.along(-dx * part, -dy * part, 1);
      else if (k >= 8 + BESIDE_EYE.length) {
        // Spiral on the hemisphere that points out of the tissue.
        const z = 1 - (k - 8 - BESIDE_EYE.length + 0.5) / AROUND;
        this.along(Math.sqrt(1 - z * z) * Math.cos(2.4 * k), Math.sqrt(1 - z * z) * Math.sin(2.4 * k), z);
      } else {
        const [across, ahead] = BESIDE_EYE[k - 8]!;
        this.tried.copy(eye).addScaledVector(this.across, across * this.lengthM).addScaledVector(this.aside, ahead * this.lengthM);
        this.tried.sub(this.tipM).normalize();
      }
      const room = this.roomOf(surface, this.tried);
      if (room > best) {
        best = room;
        this.axis.copy(this.tried);
      }
      if (room >= 0) return;
    }
  }

  private roomOf(surface: Surface, axis: Vector3): number {
    return surface.room(this.tipM, axis, this.lengthM, this.radiusM, 1.25 * SHAFT);
  }

  /**
   * Smallest distance between tip or shaft and the tissue when the tool was placed on it, m. Later changes are not
   * drawn.
   */
  get clearM(): number {
    return this.roomM;
  }
}
