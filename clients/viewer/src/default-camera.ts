// Initial position of the camera, so that the whole tissue fills the picture.

import { type PerspectiveCamera, Vector3 } from "three";
import type { Body } from "./body";
import type { Surface } from "./surface";

/** The tissue fills the picture up to these margins, in pixels: the text at the top and the bottom stays free. */
const MARGIN = { top: 48, bottom: 46, side: 12 };

/** Margins around a body, which is completely visible, with its tool. */
const AROUND = { top: 26, bottom: 52, side: 24 };

/** Size of the picture, and of the part that is covered at its bottom, in pixels. */
interface Size {
  width: number;
  height: number;
  coveredPx: number;
}

/**
 * Finds the distance from which all `places` around `target` are in the picture, and places the camera there in the
 * direction `away`.
 */
function fit(camera: PerspectiveCamera, target: Vector3, away: Vector3, places: Vector3[], around: typeof MARGIN, size: Size): void {
  const { width, height } = size;
  const margin = { ...around, bottom: around.bottom + size.coveredPx };
  const tangent = Math.tan(((camera.fov / 2) * Math.PI) / 180);
  const part = { x: 1 - (2 * margin.side) / width, y: 1 - (margin.top + margin.bottom) / height };
  const right = new Vector3().crossVectors(camera.up, away).normalize();
  const upwards = new Vector3().crossVectors(away, right);
  const seen = places.map((place) => {
    const from = place.clone().sub(target);
    return [from.dot(right), from.dot(upwards), from.dot(away)] as const;
  });
  let distance = 3 * Math.max(...seen.map(([x, y, z]) => Math.hypot(x, y, z)));
  let [low, high, left, most] = [0, 0, 0, 0];
  for (let round = 0; round < 16; round++) {
    [low, high, left, most] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const [x, y, z] of seen) {
      const depth = Math.max(distance - z, 0.05 * distance);
      low = Math.min(low, y / depth / tangent);
      high = Math.max(high, y / depth / tangent);
      left = Math.min(left, (x / depth / tangent) * (height / width));
      most = Math.max(most, (x / depth / tangent) * (height / width));
    }
    distance *= Math.max((most - left) / 2 / part.x, (high - low) / 2 / part.y);
  }
  camera.position.copy(target).addScaledVector(away, distance);
  // Moves the middle of the visible part to the middle of the free area.
  const lift = (margin.bottom - margin.top) / 2 - ((low + high) / 2) * (height / 2);
  const aside = ((left + most) / 2) * (width / 2);
  camera.setViewOffset(width, height, aside, lift, width, height);
  camera.updateProjectionMatrix();
}

/** Camera for a sheet: lower in a wide picture, higher in a narrow one. */
export function defaultCameraOfSheet({ box, edge }: Surface, camera: PerspectiveCamera, target: Vector3, size: Size): void {
  const { x: w, y: l } = box.max;
  const { roundM, heightM } = edge ?? { roundM: 0, heightM: 0 };
  const aspect = (size.width - 2 * MARGIN.side) / Math.max(size.height - MARGIN.top - MARGIN.bottom - size.coveredPx, 1);
  const elevation = Math.asin(Math.min(Math.max((0.98 * w) / Math.max(l, 1e-9) / aspect, 0.64), 0.9));
  target.set(w / 2, l / 2, 0);
  const places: Vector3[] = [];
  for (const x of [-roundM, w + roundM]) {
    places.push(new Vector3(x, -roundM, -roundM), new Vector3(x, -roundM, -heightM), new Vector3(x, l + roundM, 0));
  }
  fit(camera, target, new Vector3(0, -Math.cos(elevation), Math.sin(elevation)), places, MARGIN, size);
}

/**
 * Camera for a body: in front and above, with its longest sides across the picture; for an open body, so that one can
 * look in.
 */
export function defaultCameraOfBody(body: Body, camera: PerspectiveCamera, target: Vector3, size: Size): void {
  body.box.getCenter(target);
  const { facing, opening } = body.views();
  const extent = body.box.getSize(new Vector3());
  const away = new Vector3();
  if (facing.length() > 0.4) {
    // A piece of a surface: from its front, tilted.
    away.copy(facing).normalize();
    if (away.z > 0.7) away.add(new Vector3(0, -0.75, 0));
  } else if (opening) {
    // A tube: into its opening, slightly from the side.
    away.copy(opening).sub(target).normalize();
    const side = new Vector3(0, 0, 1).cross(away);
    if (side.lengthSq() < 0.01) side.set(1, 0, 0);
    away.addScaledVector(side.normalize(), -0.34).add(new Vector3(0, 0, 0.24));
    // When zooming in, the camera enters the tube.
    target.lerp(opening, 0.75);
  } else {
    // The flatter the body lies, the higher the camera.
    const high = 0.36 + 0.9 * Math.max(0, 1 - extent.z / Math.min(extent.x, extent.y));
    if (extent.x >= 0.8 * extent.y) away.set(0.25, -1, high);
    else away.set(1, 0.25, high);
  }
  away.normalize();
  // Seen straight from above, it would be unclear which direction is up.
  if (Math.abs(away.z) > 0.97) away.add(new Vector3(0, -0.3, 0)).normalize();
  const places: Vector3[] = [];
  const { restM } = body;
  // With many vertices, a sample of them is enough: the difference is invisible.
  const every = 3 * Math.max(1, Math.floor(restM.length / 3 / 4000));
  for (let i = 0; i < restM.length; i += every) places.push(new Vector3(restM[i], restM[i + 1], restM[i + 2]));
  fit(camera, target, away, places, AROUND, size);
}
