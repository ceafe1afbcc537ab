// The colour of coagulated tissue, over the pattern that the tissue has when it is raw.
import * as THREE from "three";

export const COAGULATED = new THREE.Color("#b3947f");

/**
 * Writes vertex colours, by which a material multiplies its colour, so that coagulated vertices show COAGULATED.
 *
 * @param raw [vertices, 3]: those of raw tissue
 * @param base The material's colour
 * @param coagulation [vertices or more]: 0 to 255; empty: all are raw
 */
export function tint(raw: Float32Array, base: THREE.Color, coagulation: Uint8Array, out: Float32Array): void {
  out.set(raw);
  // A channel that the material lacks cannot be lit.
  const pale = [base.r, base.g, base.b].map((channel, c) => COAGULATED.toArray()[c]! / Math.max(channel, 1e-3));
  for (let vertex = 0; 3 * vertex < raw.length; vertex += 1) {
    const share = (coagulation[vertex] ?? 0) / 255;
    for (let c = 0; share > 0 && c < 3; c += 1) {
      out[3 * vertex + c] = (1 - share) * raw[3 * vertex + c]! + share * pale[c]!;
    }
  }
}
