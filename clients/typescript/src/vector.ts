// Vectors as three numbers.

import type { Vector3 } from "./gen/palpate/v1/geometry_pb.js";

export type Vec3 = [number, number, number];

export function vec(v: Vector3 | undefined): Vec3 {
  return v ? [v.x, v.y, v.z] : [0, 0, 0];
}

export function norm([x, y, z]: Vec3): number {
  return Math.hypot(x, y, z);
}
