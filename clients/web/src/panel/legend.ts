// The legend of the colours, and short messages to the user.
import { find, setText } from "../dom";
import { cssGradient, type Legend } from "../view/colouring";

const TOAST_MS = 8000;

export class LegendPanel {
  readonly #block: HTMLElement;
  readonly #title: HTMLElement;
  readonly #ticks: readonly Element[];

  /** @param tile A tile of index.html. */
  constructor(tile: Element) {
    this.#block = find(".legend", HTMLElement, tile);
    this.#title = find(".legend-title", HTMLElement, tile);
    this.#ticks = [...tile.querySelectorAll(".legend-ticks span")];
    find(".legend-colours", HTMLElement, tile).style.background = cssGradient();
  }

  show(legend: Legend | null): void {
    this.#block.hidden = legend === null;
    if (legend !== null) {
      setText(this.#title, legend.title);
      this.#ticks.forEach((tick, index) => setText(tick, legend.ticks[index] ?? ""));
    }
  }
}

export class Toast {
  readonly #line = find("#toast", HTMLElement);
  #timer: ReturnType<typeof setTimeout> | undefined;

  /** Shows a message until the next one, or for a while. */
  show(text: string, tone: "quiet" | "bad"): void {
    this.#line.textContent = text;
    this.#line.dataset.tone = tone;
    this.#line.hidden = false;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.hide(), TOAST_MS);
  }

  hide(): void {
    clearTimeout(this.#timer);
    this.#line.hidden = true;
  }
}
