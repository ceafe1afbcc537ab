// Decides which scenes get a tile, and how the tiles are laid out.
import type { DaemonState } from "../generated/tensormass/v1/gateway_pb";

/** Largest number of tiles. Each one is a connection to the gateway, which admits 16 unless --max-browsers says more. */
export const MAX_TILES = 9;
/** A window up to this width has one column [CSS pixels]. */
export const NARROW_PX = 760;
/** A tile that is wider than this multiple of its height gains nothing from more width. */
const WIDEST = 1.2;

export interface Plan {
  /** Scenes of the tiles, at least one. null: a tile without a scene. */
  readonly scenes: readonly (string | null)[];
  /** Scene of the selected tile: one of `scenes`. */
  readonly selected: string | null;
}

/**
 * Plans the tiles.
 *
 * @param wanted Scene that the user or the address chose; null: none. Alone, it keeps its tile while the daemon lacks it.
 * @param kept Scene of the selected tile, which stays selected if nothing else is wanted.
 */
export function planTiles(daemon: DaemonState, wanted: string | null, kept: string | null, grid: boolean): Plan {
  const { scenes, recording } = daemon;
  const known = (name: string | null) => scenes.find((scene) => scene === name);
  const fallback = known(kept) ?? scenes[0] ?? null;
  // A recording has one scene, so a name that is left in the address means nothing.
  if (recording !== undefined) {
    return { scenes: [fallback], selected: fallback };
  }
  if (!grid || scenes.length === 0) {
    const selected = wanted ?? fallback;
    return { scenes: [selected], selected };
  }
  const selected = known(wanted) ?? fallback;
  const shown = scenes.slice(0, MAX_TILES);
  if (!shown.some((scene) => scene === selected)) {
    shown[MAX_TILES - 1] = selected!;
  }
  return { scenes: shown, selected };
}

/** Number of columns with which the tiles are largest. */
export function columnsFor(count: number, width: number, height: number): number {
  let best = 1;
  let largest = 0;
  for (let columns = 1; columns <= count && width > NARROW_PX / 2; columns += 1) {
    const size = Math.min(width / columns, (WIDEST * height) / Math.ceil(count / columns));
    if (size > largest) {
      [best, largest] = [columns, size];
    }
  }
  return best;
}

export interface Edges {
  readonly left: number;
  readonly top: number;
  readonly right: number;
  readonly bottom: number;
}

/** Folded readings are at most so many buttons higher than the buttons. */
const FOLDED = 4;
const MARGIN = 14;
const SIDE = 22;

/**
 * Area for the grid that panels leave free [CSS pixels].
 *
 * @param readings Box of the panel at the bottom left. A tall one stands beside the grid, a folded one below it.
 * @param buttons Box of the buttons at the bottom right, in a narrow window above the readings.
 */
export function freeArea(window: { width: number; height: number }, header: Edges, readings: Edges, buttons: Edges): Edges {
  const top = header.bottom + MARGIN;
  const right = window.width - SIDE;
  const lowest = Math.min(readings.top, buttons.top) - MARGIN;
  // Folded readings have a line or two more than the buttons, for refused messages.
  const beside = window.width > NARROW_PX && readings.top < buttons.top - FOLDED * (buttons.bottom - buttons.top);
  if (beside) {
    return { left: readings.right + MARGIN, top, right, bottom: buttons.top - MARGIN };
  }
  return { left: SIDE, top, right, bottom: Math.max(lowest, top + (window.height - top) / 2) };
}
