// Pictures on surfaces.
import * as THREE from "three";

/** Decodes a PNG or JPEG. Rejects what the browser cannot read. */
export async function decodePicture(image: Uint8Array<ArrayBuffer>): Promise<THREE.Texture> {
  // Texture coordinates count from the lower edge. WebGL cannot turn a bitmap over, so the browser does.
  const bitmap = await createImageBitmap(new Blob([image]), { imageOrientation: "flipY" });
  const texture = new THREE.Texture(bitmap);
  texture.flipY = false;
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.wrapS = THREE.RepeatWrapping;
  texture.wrapT = THREE.RepeatWrapping;
  texture.anisotropy = 4;
  texture.needsUpdate = true;
  return texture;
}
