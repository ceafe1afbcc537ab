// The panel that changes a running scene: gravity, and stiffness and damping of each body.
import type { MessageInitShape } from "@bufbuild/protobuf";

import { find } from "../dom";
import type { BodyAdjustmentSchema, SceneAdjustmentsSchema } from "../generated/tensormass/v1/adjustment_pb";
import type { Reason } from "./controls";

/** Values of a scene, or those of them that change. */
export type Adjustments = MessageInitShape<typeof SceneAdjustmentsSchema>;
type BodyAdjustment = MessageInitShape<typeof BodyAdjustmentSchema>;

interface Point {
  readonly x: number;
  readonly y: number;
  readonly z: number;
}

/** What a slider changes: how its position, 0 to 1, becomes a value, and how the value is written. */
interface Scale {
  readonly label: string;
  readonly hint: string;
  readonly valueAt: (position: number) => number;
  readonly positionOf: (value: number) => number;
  readonly text: (value: number) => string;
}

const clamp = (share: number): number => Math.min(1, Math.max(0, share));

/** Factors from a tenth to ten, so that the middle is 1. */
export const STIFFNESS: Scale = {
  label: "Stiffness",
  hint: "Factor of every modulus of the body, as it was loaded",
  valueAt: (position) => 10 ** (2 * position - 1),
  positionOf: (value) => clamp((Math.log10(value) + 1) / 2),
  text: (value) => `× ${value.toPrecision(2)}`,
};

/** The square of the position, because small damping needs finer steps. */
function dampingScale(label: string, hint: string, most: number, unit: string): Scale {
  return {
    label,
    hint,
    valueAt: (position) => most * position ** 2,
    positionOf: (value) => clamp(Math.sqrt(value / most)),
    text: (value) => `${Number(value.toPrecision(2)).toString()} ${unit}`,
  };
}

export const SLOW_DAMPING = dampingScale("Damping α", "Rayleigh damping by mass: slows every motion", 50, "1/s");
export const FAST_DAMPING = dampingScale("Damping β", "Rayleigh damping by stiffness: calms vibrations", 0.1, "s");

export const GRAVITY: Scale = {
  label: "Gravity",
  hint: "Along the scene's gravity; downwards if it has none",
  valueAt: (position) => 20 * position,
  positionOf: (value) => clamp(value / 20),
  text: (value) => `${value.toFixed(1)} m/s²`,
};

/** Scales `gravity` to a length [m/s²]. Keeps a direction to scale again later; without any it is -y. */
export function gravityOfLength(direction: Point, lengthMPerS2: number): Point {
  const { x, y, z } = direction;
  const present = Math.hypot(x, y, z);
  const scale = present > 0 ? lengthMPerS2 / present : 0;
  return present > 0 ? { x: scale * x, y: scale * y, z: scale * z } : { x: 0, y: -lengthMPerS2, z: 0 };
}

/** Returns the changes of both; of two for the same value the later one. */
export function merged(first: Adjustments, later: Adjustments): Adjustments {
  const bodies = new Map<string, BodyAdjustment>();
  for (const change of [...(first.bodies ?? []), ...(later.bodies ?? [])]) {
    const body = change.body ?? "";
    bodies.set(body, { ...bodies.get(body), ...change } as BodyAdjustment);
  }
  return { gravityMPerS2: later.gravityMPerS2 ?? first.gravityMPerS2, bodies: [...bodies.values()] };
}

/** Changes a scene and returns all values after it. Fails with the reason. */
export type Adjust = (changes: Adjustments) => Promise<Adjustments>;

/** Sends the changes of one scene one after another. Those that wait for an answer are merged. */
export class Changes {
  readonly #adjust: Adjust;
  readonly #onValues: (values: Adjustments) => void;
  readonly #onError: (text: string) => void;
  #waiting: Adjustments | null = null;
  #asking = false;

  /** @param onValues Called with the scene's values when no change waits any more. */
  constructor(adjust: Adjust, onValues: (values: Adjustments) => void, onError: (text: string) => void) {
    this.#adjust = adjust;
    this.#onValues = onValues;
    this.#onError = onError;
  }

  send(changes: Adjustments): void {
    this.#waiting = merged(this.#waiting ?? {}, changes);
    if (!this.#asking) {
      void this.#ask();
    }
  }

  async #ask(): Promise<void> {
    this.#asking = true;
    while (this.#waiting !== null) {
      const changes = this.#waiting;
      this.#waiting = null;
      try {
        const values = await this.#adjust(changes);
        // A slider that was moved meanwhile must stay: its answer follows.
        if (!this.#waits) {
          this.#onValues(values);
        }
      } catch (error) {
        this.#onError(error instanceof Error ? error.message : String(error));
      }
    }
    this.#asking = false;
  }

  get #waits(): boolean {
    return this.#waiting !== null;
  }
}

export class MaterialPanel {
  readonly #onError: (text: string) => void;
  readonly #menu = find("#material", HTMLDetailsElement);
  readonly #sliders = find("#material-sliders", HTMLElement);
  readonly #note = find("#material-note", HTMLElement);
  #direction: Point = { x: 0, y: -1, z: 0 };
  #changes: Changes | null = null;

  constructor(onError: (text: string) => void) {
    this.#onError = onError;
    this.#menu.addEventListener("toggle", () => {
      if (this.#menu.open) {
        this.#changes?.send({});
      }
    });
  }

  /** reason: why the scene cannot be adjusted now. */
  show(reason: Reason): void {
    this.#note.hidden = reason === null;
    this.#note.textContent = reason ?? "";
    for (const input of this.#sliders.querySelectorAll("input")) {
      input.disabled = reason !== null;
    }
  }

  /** Closes the panel and follows another scene; null: none. Changes that wait still reach the scene before. */
  follow(adjust: Adjust | null): void {
    this.#menu.open = false;
    this.#sliders.replaceChildren();
    if (adjust === null) {
      this.#changes = null;
      return;
    }
    const changes = new Changes(
      adjust,
      (values) => this.#changes === changes && this.#build(values, changes),
      this.#onError,
    );
    this.#changes = changes;
  }

  /** Makes the sliders anew with these values. */
  #build(values: Adjustments, changes: Changes): void {
    const { x = 0, y = 0, z = 0 } = values.gravityMPerS2 ?? {};
    const gravity = { x, y, z };
    const length = Math.hypot(x, y, z);
    this.#direction = length > 0 ? gravity : this.#direction;
    const groups = (values.bodies ?? []).map(({ body = "", ...of }) => {
      const change = (field: keyof BodyAdjustment) => (value: number) => changes.send({ bodies: [{ body, [field]: value }] });
      return group(body, [
        slider(STIFFNESS, of.stiffnessFactor ?? 1, change("stiffnessFactor")),
        slider(SLOW_DAMPING, of.rayleighMassPerS ?? 0, change("rayleighMassPerS")),
        slider(FAST_DAMPING, of.rayleighStiffnessS ?? 0, change("rayleighStiffnessS")),
      ]);
    });
    const weight = slider(GRAVITY, length, (value) =>
      changes.send({ gravityMPerS2: gravityOfLength(this.#direction, value) }),
    );
    const focused = document.activeElement?.ariaLabel;
    this.#sliders.replaceChildren(...groups, weight);
    [...this.#sliders.querySelectorAll("input")].find((input) => input.ariaLabel === focused)?.focus();
  }
}

function group(name: string, sliders: HTMLElement[]): HTMLElement {
  const out = document.createElement("fieldset");
  const legend = document.createElement("legend");
  legend.textContent = name;
  out.append(legend, ...sliders);
  for (const input of out.querySelectorAll("input")) {
    input.ariaLabel = `${input.ariaLabel ?? ""} of ${name}`;
  }
  return out;
}

/** Makes a slider that shows its value while it moves and reports it when it is let go. */
function slider(scale: Scale, value: number, report: (value: number) => void): HTMLElement {
  const label = document.createElement("label");
  label.title = scale.hint;
  const input = document.createElement("input");
  const output = document.createElement("output");
  input.type = "range";
  input.min = "0";
  input.max = "1";
  input.step = "0.005";
  input.ariaLabel = scale.label;
  input.value = String(scale.positionOf(value));
  output.textContent = scale.text(value);
  input.addEventListener("input", () => (output.textContent = scale.text(scale.valueAt(Number(input.value)))));
  input.addEventListener("change", () => report(scale.valueAt(Number(input.value))));
  label.append(scale.label, input, output);
  return label;
}
