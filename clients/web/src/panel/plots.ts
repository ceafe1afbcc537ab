// Small plots over time: the force on each tool, the time of a step and the rate.
import { find } from "../dom";
import { SPAN_S, type History, type Series } from "../stream/history";

const COLOURS = ["#ffc24a", "#6fd6a8", "#8fb8ff", "#ff9d8a", "#d7a8ff", "#e6e07a"];

/** Smallest of 1, 2 and 5 times a power of ten that is not below `value`; 1 for zero. */
export function niceBound(value: number): number {
  if (!(value > 0)) {
    return 1;
  }
  const power = 10 ** Math.floor(Math.log10(value));
  const factor = [1, 2, 5, 10].find((each) => each * power >= value * (1 - 1e-9)) ?? 10;
  return factor * power;
}

interface Line {
  readonly label: string;
  readonly series: Series;
}

class Plot {
  readonly #canvas: HTMLCanvasElement;
  readonly #bound: HTMLElement;
  readonly #unit: string;

  constructor(id: string, unit: string) {
    this.#canvas = find(`#${id} canvas`, HTMLCanvasElement);
    this.#bound = find(`#${id} small`, HTMLElement);
    this.#unit = unit;
  }

  draw(lines: readonly Line[]): void {
    const canvas = this.#canvas;
    const ratio = window.devicePixelRatio;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (width === 0 || height === 0) {
      return;
    }
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const context = canvas.getContext("2d")!;
    context.scale(ratio, ratio);
    const points = lines.flatMap(({ series }) => series.points);
    const bound = niceBound(points.reduce((most, { value }) => Math.max(most, value), 0));
    const nowS = points.reduce((last, { timeS }) => Math.max(last, timeS), -Infinity);
    this.#bound.textContent = points.length === 0 ? "" : `${Number(bound.toPrecision(1))} ${this.#unit}`;
    context.strokeStyle = "rgb(255 255 255 / 14%)";
    context.strokeRect(0.5, 0.5, width - 1, height - 1);
    context.lineWidth = 1.4;
    lines.forEach(({ series }, index) => {
      context.strokeStyle = COLOURS[index % COLOURS.length]!;
      context.beginPath();
      for (const { timeS, value } of series.points) {
        context.lineTo(width * (1 - (nowS - timeS) / SPAN_S), (height - 2) * (1 - value / bound) + 1);
      }
      context.stroke();
    });
  }
}

/** The plots of index.html. */
export class Plots {
  readonly #force = new Plot("plot-force", "N");
  readonly #step = new Plot("plot-step", "ms");
  readonly #rate = new Plot("plot-rate", "Hz");
  readonly #legend = find("#plot-force .lines", HTMLElement);

  draw(history: History): void {
    const forces = [...history.forces].map(([label, series]) => ({ label, series }));
    this.#force.draw(forces);
    this.#step.draw([{ label: "step", series: history.stepTime }]);
    this.#rate.draw([{ label: "rate", series: history.rate }]);
    const names = forces.length > 1 ? forces.map(({ label }) => label) : [];
    if ([...this.#legend.children].map((item) => item.textContent).join() !== names.join()) {
      this.#legend.replaceChildren(
        ...names.map((name, index) => {
          const item = document.createElement("span");
          item.textContent = name;
          item.style.color = COLOURS[index % COLOURS.length]!;
          return item;
        }),
      );
    }
  }
}
