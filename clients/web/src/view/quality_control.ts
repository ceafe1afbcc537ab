// The level of quality on show: the one that the user fixed, or the governor's. Says which it is, and why.
import { Governor, type Limits } from "./governor";
import { LEVELS, placeOf, type Level, type Quality } from "./quality";

/** Pictures are counted over so long. */
const RATE_WINDOW_MS = 2000;

/** With a GPU everything is tried. In software the levels above `low` take seconds to start. */
const WITH_GPU: Limits = { start: 0, best: 0, cheapest: LEVELS.length - 1 };
const IN_SOFTWARE: Limits = { ...WITH_GPU, start: placeOf("simple"), best: placeOf("low") };

export class QualityControl {
  readonly #software: boolean;
  readonly #apply: (level: Level) => void;
  readonly #governor: Governor;
  #choice: Quality;
  #held = false;
  #drawnMs: number[] = [];

  /**
   * @param software Whether the browser draws without a GPU.
   * @param choice What the user fixed, or "automatic".
   * @param apply Called with each other level, which must be drawn from now on.
   */
  constructor(software: boolean, choice: Quality, apply: (level: Level) => void) {
    this.#software = software;
    this.#choice = choice;
    this.#apply = apply;
    this.#governor = new Governor(software ? IN_SOFTWARE : WITH_GPU);
  }

  get choice(): Quality {
    return this.#choice;
  }

  get level(): Level {
    return LEVELS[this.#choice === "automatic" ? this.#governor.place : placeOf(this.#choice)]!;
  }

  /** Takes the user's choice. */
  choose(choice: Quality): void {
    const before = this.level;
    this.#choice = choice;
    this.interrupt();
    if (this.level !== before) {
      this.#apply(this.level);
    }
  }

  /** Keeps the level while something needs pictures of one size. */
  hold(held: boolean): void {
    this.#held = held;
    this.interrupt();
  }

  /** Takes that the page was hidden or shown, which changes how often it draws. */
  interrupt(): void {
    this.#governor.interrupt();
    this.#drawnMs = [];
  }

  /** Takes a turn of the browser's drawing loop. @param drew Whether it drew a picture. */
  turn(nowMs: number, drew: boolean): void {
    this.#drawnMs = this.#drawnMs.filter((atMs) => atMs > nowMs - RATE_WINDOW_MS);
    if (drew) {
      this.#drawnMs.push(nowMs);
    }
    if (this.#choice === "automatic" && !this.#held && this.#governor.turn(nowMs, drew)) {
      this.#apply(this.level);
    }
  }

  /** Pictures a second over the last two seconds of the drawing loop; fewer if fewer changed. */
  get picturesPerSecond(): number {
    return (1000 * this.#drawnMs.length) / RATE_WINDOW_MS;
  }

  /** Names the level on show and the reason for it. */
  note(): string {
    const { name } = this.level;
    if (this.#choice !== "automatic") {
      return `Fixed at ${name}.`;
    }
    const { place } = this.#governor;
    for (let better = place - 1; better >= 0; better -= 1) {
      const rateHz = this.#governor.failedAtHz(better);
      if (rateHz !== null) {
        return `Now ${name}: ${LEVELS[better]!.name} drew ${rateHz.toFixed(0)} pictures a second here.`;
      }
    }
    return this.#software ? `Now ${name}: this browser draws without a GPU.` : `Now ${name}.`;
  }
}
