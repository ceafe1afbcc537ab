// What the page remembers about its display. Anything may stand in the browser's storage, so it is checked.
import { qualityOf, type Quality } from "../view/quality";

export const COLOURINGS = ["tissue", "displacement", "von_mises", "largest_strain", "pressure", "volume_ratio"] as const;
export type Colouring = (typeof COLOURINGS)[number];

export const CLIP_AXES = ["none", "x", "y", "z"] as const;
export type ClipAxis = (typeof CLIP_AXES)[number];

export interface Settings {
  readonly colouring: Colouring;
  readonly wireframe: boolean;
  /** Marks the nodes that are held or prescribed. */
  readonly fixedNodes: boolean;
  /** Draws the springs of attachments. */
  readonly attachments: boolean;
  readonly clipAxis: ClipAxis;
  /** Place of the clip plane, as a share of the scene's extent along its axis. */
  readonly clipShare: number;
  /** Scale bar and axes. */
  readonly rulers: boolean;
  readonly tools: boolean;
  readonly quality: Quality;
  /** null: by the size of the window. */
  readonly readings: boolean | null;
  readonly plots: boolean | null;
}

export const DEFAULTS: Settings = {
  colouring: "tissue",
  wireframe: false,
  fixedNodes: false,
  attachments: true,
  clipAxis: "none",
  clipShare: 0.5,
  rulers: false,
  tools: true,
  quality: "automatic",
  readings: null,
  plots: null,
};

const KEY = "tensormass.display";

/** Reads the settings of `text`. A value that is missing or wrong takes its default. */
export function parseSettings(text: string | null): Settings {
  let given: Record<string, unknown> = {};
  try {
    const value: unknown = JSON.parse(text ?? "{}");
    given = typeof value === "object" && value !== null ? (value as Record<string, unknown>) : {};
  } catch {
    // Not JSON: the defaults hold.
  }
  const flag = <Other>(value: unknown, other: Other) => (typeof value === "boolean" ? value : other);
  const share = given.clipShare;
  return {
    colouring: COLOURINGS.find((name) => name === given.colouring) ?? DEFAULTS.colouring,
    wireframe: flag(given.wireframe, DEFAULTS.wireframe),
    fixedNodes: flag(given.fixedNodes, DEFAULTS.fixedNodes),
    attachments: flag(given.attachments, DEFAULTS.attachments),
    clipAxis: CLIP_AXES.find((name) => name === given.clipAxis) ?? DEFAULTS.clipAxis,
    clipShare: typeof share === "number" && share >= 0 && share <= 1 ? share : DEFAULTS.clipShare,
    rulers: flag(given.rulers, DEFAULTS.rulers),
    tools: flag(given.tools, DEFAULTS.tools),
    quality: qualityOf(given.quality) ?? DEFAULTS.quality,
    readings: flag(given.readings, DEFAULTS.readings),
    plots: flag(given.plots, DEFAULTS.plots),
  };
}

/** Storage may be forbidden. The page then forgets, and works. */
export function loadSettings(): Settings {
  try {
    return parseSettings(window.localStorage.getItem(KEY));
  } catch {
    return DEFAULTS;
  }
}

export function saveSettings(settings: Settings): void {
  try {
    window.localStorage.setItem(KEY, JSON.stringify(settings));
  } catch {
    // Storage is forbidden or full.
  }
}
