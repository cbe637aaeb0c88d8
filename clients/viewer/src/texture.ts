// The image on the tissue: the server's image for the session. Without one the tissue has a single colour.

import { CanvasTexture, MirroredRepeatWrapping, SRGBColorSpace, type Texture } from "three";

export async function tissueTexture(session: string): Promise<Texture | undefined> {
  const picture = await fetchPicture(session);
  if (!picture) return undefined;
  const texture = new CanvasTexture(picture);
  texture.colorSpace = SRGBColorSpace;
  // The image continues on the flank, mirrored.
  texture.wrapS = texture.wrapT = MirroredRepeatWrapping;
  return texture;
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
