// Small pictures for the list of scenes. Those of the shipped scenes come with the page; others are taken at the
// first visit, and stored by the browser.

import { shippedPicture, titleOf } from "./scenes";
import { excerpt } from "./text";

/** Size of a picture in pixels; it is shown at half this size. */
const SIZE = { width: 144, height: 96 };

const key = (scene: string) => `picture of ${scene}`;

/** Returns the picture of a scene, if it was visited. */
export function pictureOf(scene: string): string | undefined {
  const shipped = shippedPicture(scene);
  if (shipped) return shipped;
  try {
    return localStorage.getItem(key(scene)) ?? undefined;
  } catch {
    // Some browsers store nothing.
    return undefined;
  }
}

/** Returns a small picture of the middle of what was just drawn. */
export function pictureFrom(drawn: HTMLCanvasElement): string {
  const small = document.createElement("canvas");
  Object.assign(small, SIZE);
  const { width, height } = drawn;
  const scale = Math.min(width / SIZE.width, height / SIZE.height);
  const [w, h] = [scale * SIZE.width, scale * SIZE.height];
  small.getContext("2d")?.drawImage(drawn, (width - w) / 2, (height - h) / 2, w, h, 0, 0, SIZE.width, SIZE.height);
  return small.toDataURL("image/jpeg", 0.8);
}

/** Stores the picture of a scene. */
export function keepPicture(scene: string, drawn: HTMLCanvasElement): void {
  try {
    localStorage.setItem(key(scene), pictureFrom(drawn));
  } catch {
    // The storage is full, or the browser stores nothing.
  }
}

/** Returns an entry of the list. Browsers that support only text in lists show the name. */
export function entryOf(scene: string): HTMLOptionElement {
  const entry = new Option(excerpt(titleOf(scene)), scene);
  const picture = pictureOf(scene);
  if (picture) {
    const image = new Image(SIZE.width / 2, SIZE.height / 2);
    image.src = picture;
    image.alt = "";
    entry.prepend(image);
  }
  return entry;
}
