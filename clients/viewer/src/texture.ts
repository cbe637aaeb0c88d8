// The image on the tissue: the server's image for the session, its default image, or one painted here.

import { CanvasTexture, type Texture, SRGBColorSpace } from "three";

/** Pixels per side of a painted image. */
const SIZE = 512;

export async function tissueTexture(session: string): Promise<Texture> {
  for (const name of [session, "default"]) {
    const picture = await fetchPicture(name);
    if (picture) return finished(new CanvasTexture(picture));
  }
  return finished(new CanvasTexture(paint()));
}

async function fetchPicture(name: string): Promise<ImageBitmap | undefined> {
  try {
    const answer = await fetch(`/textures/${encodeURIComponent(name)}.png`);
    // The server answers "No content" if it has no image.
    if (answer.status !== 200) return undefined;
    return await createImageBitmap(await answer.blob(), { imageOrientation: "flipY" });
  } catch {
    return undefined;
  }
}

function finished(texture: Texture): Texture {
  texture.colorSpace = SRGBColorSpace;
  texture.anisotropy = 4;
  return texture;
}

/** The same numbers each time, so that the tissue looks the same (mulberry32). */
function randoms(seed: number): () => number {
  let state = seed;
  return () => {
    state = (state + 0x6d2b79f5) | 0;
    let t = Math.imul(state ^ (state >>> 15), 1 | state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

/** Paints mottled mucosa with branching vessels. */
function paint(): HTMLCanvasElement {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = SIZE;
  const pen = canvas.getContext("2d");
  if (!pen) return canvas;
  const random = randoms(7);
  pen.fillStyle = "#c4625a";
  pen.fillRect(0, 0, SIZE, SIZE);
  // Lighter and darker clouds, large ones first.
  for (let i = 0; i < 420; i++) {
    const radius = SIZE * (0.18 * Math.exp(-i / 110) + 0.012) * (0.5 + random());
    const [x, y] = [random() * SIZE, random() * SIZE];
    const cloud = pen.createRadialGradient(x, y, 0, x, y, radius);
    const colour = random() < 0.5 ? "236,150,132" : "140,38,44";
    cloud.addColorStop(0, `rgba(${colour},0.13)`);
    cloud.addColorStop(1, `rgba(${colour},0)`);
    pen.fillStyle = cloud;
    pen.fillRect(x - radius, y - radius, 2 * radius, 2 * radius);
  }
  pen.lineCap = "round";
  const vessel = (x: number, y: number, heading: number, width: number) => {
    let turning = 0;
    for (let step = 0; step < 90 && width > 0.35; step++) {
      turning = 0.8 * turning + (random() - 0.5) * 0.22;
      heading += turning;
      const [toX, toY] = [x + 5 * Math.cos(heading), y + 5 * Math.sin(heading)];
      pen.strokeStyle = `rgba(112,18,34,${Math.min(0.12 + 0.1 * width, 0.5)})`;
      pen.lineWidth = width;
      pen.beginPath();
      pen.moveTo(x, y);
      pen.lineTo(toX, toY);
      pen.stroke();
      [x, y] = [toX, toY];
      width *= 0.985;
      if (random() < 0.055) vessel(x, y, heading + (random() < 0.5 ? 0.7 : -0.7), width * 0.62);
    }
  };
  for (let i = 0; i < 9; i++) vessel(random() * SIZE, random() * SIZE, random() * 2 * Math.PI, 2 + 2.4 * random());
  for (let i = 0; i < 60; i++) vessel(random() * SIZE, random() * SIZE, random() * 2 * Math.PI, 0.9);
  return canvas;
}
