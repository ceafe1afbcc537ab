// The last seconds of a scene: the force on each tool, the time of a step and the rate.
import type { Frame, Status, Topology } from "./decode";

/** Time that a series keeps [s]. */
export const SPAN_S = 20;
/** Points that a series keeps. More arrive only if frames are faster than 60 Hz. */
const MAX_POINTS = 1200;
/** Tools with a series of their own. */
export const MAX_TOOLS = 6;

/** Values over rising time; the oldest are dropped. */
export class Series {
  readonly #points: { timeS: number; value: number }[] = [];

  get points(): readonly { readonly timeS: number; readonly value: number }[] {
    return this.#points;
  }

  /** Adds a value. A time that falls drops what lay after it: a recording went back, or the scene was reset. */
  add(timeS: number, value: number): void {
    while (this.#points.length > 0 && this.#points.at(-1)!.timeS >= timeS) {
      this.#points.pop();
    }
    this.#points.push({ timeS, value });
    const old = this.#points.findIndex((point) => point.timeS >= timeS - SPAN_S);
    this.#points.splice(0, Math.max(old, this.#points.length - MAX_POINTS));
  }

  clear(): void {
    this.#points.length = 0;
  }
}

export class History {
  /** Magnitude of the force [N] by tool, over simulated time. */
  readonly forces = new Map<string, Series>();
  /** Median time of a step [ms], over time on the server's clock. */
  readonly stepTime = new Series();
  /** Reached rate [Hz], over time on the server's clock. */
  readonly rate = new Series();

  /** Takes the forces on the tools that move. */
  addFrame(frame: Frame, topology: Topology): void {
    const names = new Set(frame.tools.map((tool) => tool.name));
    for (const gone of [...this.forces.keys()].filter((name) => !names.has(name))) {
      this.forces.delete(gone);
    }
    const moving = new Set(topology.tools.filter((tool) => !tool.fixed).map((tool) => tool.name));
    for (const { name, forceN } of frame.tools.filter((tool) => moving.has(tool.name)).slice(0, MAX_TOOLS)) {
      let series = this.forces.get(name);
      if (series === undefined) {
        this.forces.set(name, (series = new Series()));
      }
      series.add(frame.simulatedTimeS, Math.hypot(...forceN));
    }
  }

  addStatus({ serverTimeNs, stepTimeP50S, reachedRateHz }: Status): void {
    const timeS = Number(serverTimeNs) / 1e9;
    this.stepTime.add(timeS, 1e3 * stepTimeP50S);
    this.rate.add(timeS, reachedRateHz);
  }

  clear(): void {
    this.forces.clear();
    this.stepTime.clear();
    this.rate.clear();
  }
}
