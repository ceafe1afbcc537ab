// The levels of quality, from the best picture to the cheapest one, and what each of them draws.
//
// The governor walks along them (governor.ts). Costs are those of drawing in software, where they differ most: the
// pixels of a ground cost more than an organ, and a surface costs by its triangles until it fills the window.

export interface Level {
  readonly name: string;
  /** Largest number of the picture's pixels along a CSS pixel. Screens with fewer take fewer. */
  readonly pixelRatio: number;
  /** Whether the browser blends a picture with fewer pixels than the screen. It costs more than drawing them. */
  readonly smooth: boolean;
  /** Multisampling. WebGL fixes it when it starts, so a change starts it again. */
  readonly antialias: boolean;
  /** Tissue: moist with grain, plainly lit in each pixel, or lit at its vertices. */
  readonly material: "moist" | "plain" | "simple";
  readonly reflections: boolean;
  readonly shadows: boolean;
  /** Grid whose lines fade and are smooth, thin lines, or nothing. */
  readonly ground: "grid" | "lines" | "none";
  /** Share of the triangles that the gateway sends. */
  readonly detail: number;
  /** Most frames a second that the gateway sends; null: all of them. */
  readonly rateHz: number | null;
}

const PLAIN = { smooth: true, antialias: false, reflections: false, shadows: false, detail: 1, rateHz: null } as const;

export const LEVELS = [
  { ...PLAIN, name: "high", pixelRatio: 2, antialias: true, material: "moist", reflections: true, shadows: true, ground: "grid" },
  { ...PLAIN, name: "medium", pixelRatio: 1, antialias: true, material: "plain", reflections: true, ground: "grid" },
  { ...PLAIN, name: "low", pixelRatio: 1, material: "plain", ground: "grid" },
  { ...PLAIN, name: "simple", pixelRatio: 1, material: "simple", ground: "lines", rateHz: 30 },
  { ...PLAIN, name: "coarse", pixelRatio: 0.5, material: "simple", ground: "lines", detail: 0.5, rateHz: 30 },
  { ...PLAIN, name: "least", pixelRatio: 0.5, smooth: false, material: "simple", ground: "none", detail: 0.25, rateHz: 20 },
] as const satisfies readonly Level[];

export type LevelName = (typeof LEVELS)[number]["name"];

/** What the user may choose: a level, or that the page chooses. */
export const QUALITIES = ["automatic", ...LEVELS.map(({ name }) => name)] as const;
export type Quality = "automatic" | LevelName;

/** Returns the quality with this name; null for an unknown name. */
export function qualityOf(name: unknown): Quality | null {
  return QUALITIES.find((each) => each === name) ?? null;
}

export function placeOf(name: LevelName): number {
  return LEVELS.findIndex((level) => level.name === name);
}

/** Whether the browser draws without a GPU. It may hide its renderer's name, but not that WebGL is slow. */
export function drawsInSoftware(): boolean {
  const open = (attributes: WebGLContextAttributes) => document.createElement("canvas").getContext("webgl2", attributes);
  const close = (gl: WebGL2RenderingContext | null) => gl?.getExtension("WEBGL_lose_context")?.loseContext();
  const gl = open({});
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const renderer = gl && info ? String(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)) : "";
  close(gl);
  if (gl === null || /swiftshader|llvmpipe|software/i.test(renderer)) {
    return true;
  }
  const quick = open({ failIfMajorPerformanceCaveat: true });
  close(quick);
  return quick === null;
}
