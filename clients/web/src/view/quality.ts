/** Cost of the picture. "low" is for machines without a GPU: no coat, grain, shadows or reflections. */
export interface Quality {
  readonly level: "high" | "low";
  /** Whether slow drawing reduces the number of pixels. */
  readonly adaptive: boolean;
}

/** Uses `wanted` (from the address) if it is a level, and then does not adapt. Otherwise asks for the GPU. */
export function chooseQuality(wanted: string | null): Quality {
  if (wanted === "high" || wanted === "low") {
    return { level: wanted, adaptive: false };
  }
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const renderer = gl && info ? String(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return { level: /swiftshader|llvmpipe|software/i.test(renderer) ? "low" : "high", adaptive: true };
}
