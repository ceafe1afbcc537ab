/** How much the picture may cost. "low" is for machines that draw without a GPU: no coat, grain, shadows, mirror. */
export interface Quality {
  readonly level: "high" | "low";
  /** Fewer pixels while drawing is slow. */
  readonly adaptive: boolean;
}

/** `wanted` (from the address) if it is a level, kept whatever it costs; else what the machine can do. */
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
