// The grasper as drawn: a shaft, two jaws with teeth that turn about a hinge, and the force on it.

import { BoxGeometry, CapsuleGeometry, CylinderGeometry, Group, Mesh, SphereGeometry, Vector3 } from "three";
import type { InstrumentPose } from "palpate";
import { ForceArrow } from "./force-arrow";
import { DRAWN_RADIUS, JAW, type ShownGrasper } from "./grasper";
import { light, SHADOWS, Steel } from "./material";
import type { Surface } from "./surface";

/** Length of the shaft, relative to the tissue's size. */
const SHAFT_LENGTH = 0.8;
/** Radius of shaft and hinge, in radii of a tip. */
const SHAFT = 0.75;
const HINGE = 0.9;
const TEETH = 6;

/** Returns a jaw, in radii of a tip: along x from its hinge, with teeth towards −y. */
function jaw(steel: Steel): Group {
  const group = new Group();
  const bar = new CapsuleGeometry(DRAWN_RADIUS, JAW.length - DRAWN_RADIUS, 8, 20).rotateZ(Math.PI / 2);
  group.add(new Mesh(bar.translate((JAW.length + DRAWN_RADIUS) / 2, DRAWN_RADIUS, 0), steel));
  for (let at = 0; at < TEETH; at++) {
    const x = JAW.length * (0.35 + (0.6 * at) / (TEETH - 1));
    group.add(new Mesh(new BoxGeometry(0.22, 0.22, 0.7).rotateZ(Math.PI / 4).translate(x, 0.12, 0), steel));
  }
  return group;
}

/** Returns whether a grasper looks the same in both poses. */
export function isSamePose(a: InstrumentPose, b: InstrumentPose): boolean {
  const { w, x, y, z } = b.orientation;
  const turned = a.orientation.w === w && a.orientation.x === x && a.orientation.y === y && a.orientation.z === z;
  return turned && a.jawRad === b.jawRad && a.positionM.every((v, c) => v === b.positionM[c]);
}

export class GrasperMark {
  readonly group = new Group();
  /** Middle between the ends of the jaws. */
  readonly endsM = new Vector3();
  private readonly body = new Group();
  private readonly arrow = new ForceArrow();
  private readonly shaft: Mesh;
  private readonly jaws: Group[];
  private readonly farM = new Vector3();

  constructor() {
    const steel = new Steel(0xd5d9de);
    this.jaws = [jaw(steel), jaw(steel)];
    const hinge = new Mesh(new SphereGeometry(HINGE, 24, 16), steel);
    const rod = new CylinderGeometry(SHAFT, SHAFT, 1, 24).rotateZ(Math.PI / 2).translate(-0.5, 0, 0);
    this.shaft = new Mesh(rod, new Steel(0x40464f));
    for (const part of [hinge, this.shaft, ...this.jaws]) part.position.x = -JAW.length;
    this.body.add(hinge, this.shaft, ...this.jaws);
    this.group.add(this.body, this.arrow.group);
    this.group.visible = false;
  }

  hide(): void {
    this.group.visible = false;
  }

  /** Puts the grasper at its pose. `size` is the tissue's, m; the first tools by `index` cast shadows. */
  show({ pose, radiusM, liftM, forceN, part }: ShownGrasper, surface: Surface, size: number, index: number): void {
    this.group.visible = true;
    const { w, x, y, z } = pose.orientation;
    this.body.position.set(...pose.positionM).add(this.farM.set(...liftM));
    this.body.quaternion.set(x, y, z, w);
    this.body.scale.setScalar(radiusM);
    const long = (SHAFT_LENGTH * size) / radiusM;
    this.shaft.scale.x = long;
    // The lower jaw is the upper one, turned about its length.
    this.jaws.forEach((jaw, index) => {
      jaw.rotation.set(index * Math.PI, 0, 0);
      jaw.rotateZ(pose.jawRad / 2);
    });
    this.body.updateMatrixWorld();
    this.body.localToWorld(this.endsM.set(JAW.length * (Math.cos(pose.jawRad / 2) - 1), 0, 0));
    this.arrow.show(this.endsM, forceN, part, surface, radiusM, size);
    if (index >= SHADOWS) return;
    // Of its shadow, only the part of the shaft is the same as that of a probe.
    light.tips.value[index]!.set(this.endsM.x, this.endsM.y, this.endsM.z, radiusM);
    this.body.localToWorld(this.farM.set(-long, 0, 0));
    light.shafts.value[index]!.set(this.farM.x, this.farM.y, this.farM.z, SHAFT * radiusM);
  }
}
