// Vectors as three numbers, and rotations.

import type { Vector3 } from "./gen/palpate/v1/geometry_pb.js";

export type Vec3 = [number, number, number];

/** A rotation, of length 1. */
export interface Rotation {
  w: number;
  x: number;
  y: number;
  z: number;
}

export function vec(v: Vector3 | undefined): Vec3 {
  return v ? [v.x, v.y, v.z] : [0, 0, 0];
}

export function norm([x, y, z]: Vec3): number {
  return Math.hypot(x, y, z);
}

/** Returns a + scale·b. */
export function plus(a: Vec3, b: Vec3, scale = 1): Vec3 {
  return [a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]];
}

export function dot(a: Vec3, b: Vec3): number {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

export function cross([ax, ay, az]: Vec3, [bx, by, bz]: Vec3): Vec3 {
  return [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx];
}

/** Returns a vector of length 1 in the direction of `v`, which is not 0. */
export function unit(v: Vec3): Vec3 {
  return plus([0, 0, 0], v, 1 / norm(v));
}

/** Returns `v` after a rotation. */
export function rotated({ w, x, y, z }: Rotation, v: Vec3): Vec3 {
  const axis: Vec3 = [x, y, z];
  const twice = plus([0, 0, 0], cross(axis, v), 2);
  return plus(plus(v, twice, w), cross(axis, twice));
}

/** Returns the rotation that turns x, y and z to three vectors, which are of length 1 and at right angles. */
export function rotationTo([xx, xy, xz]: Vec3, [yx, yy, yz]: Vec3, [zx, zy, zz]: Vec3): Rotation {
  // Of the four components the largest is computed first, so that no difference of nearly equal numbers is divided by.
  const squares = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz] as const;
  const largest = squares.indexOf(Math.max(...squares));
  const half = Math.sqrt(squares[largest]!) / 2;
  const rest = 1 / (4 * half);
  const [yz_, zx_, xy_] = [yz - zy, zx - xz, xy - yx].map((v) => v * rest) as Vec3;
  const [yz2, zx2, xy2] = [yz + zy, zx + xz, xy + yx].map((v) => v * rest) as Vec3;
  if (largest === 0) return { w: half, x: yz_, y: zx_, z: xy_ };
  if (largest === 1) return { w: yz_, x: half, y: xy2, z: zx2 };
  if (largest === 2) return { w: zx_, x: xy2, y: half, z: yz2 };
  return { w: xy_, x: zx2, y: yz2, z: half };
}
