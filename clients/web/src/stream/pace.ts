// How fast frames are drawn, how old they are then, and their cost to this page.

const RATE_WINDOW_MS = 2000;
/** Number of frames whose costs are kept. */
const COSTS_KEPT = 300;

/** Cost of a frame to this page [ms]. */
export interface Costs {
  readonly atMs: number;
  readonly bytes: number;
  readonly decodeMs: number;
  readonly prepareMs: number;
  readonly renderMs: number;
}

export class Pace {
  readonly costs: Costs[] = [];
  #drawn: { atMs: number; ageMs: number | null }[] = [];

  /** Takes a frame that was drawn. @param ageMs Its age then; null if unknown. */
  add(costs: Costs, ageMs: number | null): void {
    this.costs.push(costs);
    this.costs.splice(0, this.costs.length - COSTS_KEPT);
    this.#drawn.push({ atMs: costs.atMs, ageMs });
    this.#forget(costs.atMs);
  }

  /** Frames drawn per second, over the last two seconds. */
  rateHz(nowMs: number): number {
    this.#forget(nowMs);
    return this.#drawn.length / (RATE_WINDOW_MS / 1000);
  }

  /** Median age of a frame when it was drawn, over the last two seconds; null: no age is known. */
  ageMs(nowMs: number): number | null {
    this.#forget(nowMs);
    const ages = this.#drawn.flatMap(({ ageMs }) => ageMs ?? []).sort((a, b) => a - b);
    return ages[Math.floor(ages.length / 2)] ?? null;
  }

  #forget(nowMs: number): void {
    this.#drawn = this.#drawn.filter(({ atMs }) => atMs > nowMs - RATE_WINDOW_MS);
  }
}
