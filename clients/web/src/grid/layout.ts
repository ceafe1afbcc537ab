// Puts the tiles where the panels leave room: in a grid, or one over the whole window.
import { find } from "../dom";
import type { Grid } from "./grid";
import { NARROW_PX, columnsFor, freeArea } from "./plan";
import type { Tile } from "./tile";

/** Height of a tile's name and state [CSS pixels]. */
const CAPTION_PX = 30;
/** Height of the header in a narrow window [CSS pixels]. */
const HEADER_PX = 64;

export function layOut(grid: Grid<Tile>): void {
  const { tiles, on } = grid;
  const parent = find("#tiles", HTMLElement);
  const button = find("#grid", HTMLButtonElement);
  document.body.toggleAttribute("data-grid", on);
  button.ariaPressed = String(on);
  button.title = on ? "Show the selected scene alone (G)" : "Show all scenes in a grid (G)";
  tiles.forEach(({ element }, index) => {
    if (parent.children[index] !== element) {
      parent.insertBefore(element, parent.children[index] ?? null);
    }
  });
  const [width, height] = [window.innerWidth, window.innerHeight];
  const box = (selector: string) => find(selector, HTMLElement).getBoundingClientRect();
  if (on) {
    const { left, top, right, bottom } = freeArea({ width, height }, box("header"), box("aside"), box("footer"));
    parent.style.inset = `${top}px ${width - right}px ${height - bottom}px ${left}px`;
    parent.style.setProperty("--columns", String(columnsFor(tiles.length, right - left, bottom - top)));
    tiles.forEach(({ viewer }) => viewer.cover(CAPTION_PX, 0));
    return;
  }
  parent.style.inset = "";
  // The organ must not lie under the panels of a narrow window.
  const narrow = width <= NARROW_PX;
  const { top } = box(narrow ? "#bottom" : "#timeline");
  // A time line that is hidden has no place.
  const covered = top > 0 ? Math.min(height - top, height / 2) : 0;
  tiles.forEach(({ viewer }) => viewer.cover(narrow ? HEADER_PX : 0, covered));
}
