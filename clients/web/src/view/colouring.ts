// Colours of values on the surface: which values there are, their unit, their range and the legend's text.
import type { Colouring } from "../panel/settings";
import { niceBound } from "../panel/plots";

/** Corners of the colour map "viridis" (sRGB, 0 to 255). Its lightness rises evenly, also for colour-blind readers. */
const VIRIDIS: readonly (readonly [number, number, number])[] = [
  [68, 1, 84],
  [71, 44, 122],
  [59, 81, 139],
  [44, 113, 142],
  [33, 144, 141],
  [39, 173, 129],
  [92, 200, 99],
  [170, 220, 50],
  [253, 231, 37],
];
const TABLE_SIZE = 256;
/** The range shrinks only if the values use less than this share of it, so that colours do not flicker. */
const SHRINK_BELOW = 0.35;

/** Colours from the lowest to the highest value: RGBA bytes, TABLE_SIZE of them. */
export function colourTable(): Uint8Array {
  const table = new Uint8Array(4 * TABLE_SIZE);
  for (let i = 0; i < TABLE_SIZE; i += 1) {
    const at = (i / (TABLE_SIZE - 1)) * (VIRIDIS.length - 1);
    const below = Math.min(Math.floor(at), VIRIDIS.length - 2);
    for (let channel = 0; channel < 3; channel += 1) {
      const low = VIRIDIS[below]![channel]!;
      table[4 * i + channel] = Math.round(low + (at - below) * (VIRIDIS[below + 1]![channel]! - low));
    }
    table[4 * i + 3] = 255;
  }
  return table;
}

/** The same colours for a legend. */
export function cssGradient(): string {
  return `linear-gradient(to right, ${VIRIDIS.map((rgb) => `rgb(${rgb.join(" ")})`).join(", ")})`;
}

export interface Range {
  readonly least: number;
  readonly most: number;
}

/** Range of the colours for these values. Magnitudes start at zero; signed values lie around `center`. */
export function fitRange(values: Float32Array, center: number | null, before: Range | null): Range {
  let most = 0;
  for (const value of values) {
    most = Math.max(most, Math.abs(value - (center ?? 0)));
  }
  const old = before === null ? 0 : before.most - (center ?? 0);
  const bound = most > old || most < SHRINK_BELOW * old || old === 0 ? niceBound(most) : old;
  return center === null ? { least: 0, most: bound } : { least: center - bound, most: center + bound };
}

/** Distances of vertices from their reference [m]. */
export function displacements(positions: Float32Array, reference: Float32Array, values: Float32Array): void {
  for (let v = 0; v < values.length; v += 1) {
    const at = 3 * v;
    values[v] = Math.hypot(
      positions[at]! - reference[at]!,
      positions[at + 1]! - reference[at + 1]!,
      positions[at + 2]! - reference[at + 2]!,
    );
  }
}

interface Kind {
  readonly title: string;
  readonly unit: string;
  /** Value in the middle of the colours; null: magnitudes from zero on. */
  readonly center: number | null;
}

export const KINDS: Readonly<Record<Exclude<Colouring, "tissue">, Kind>> = {
  displacement: { title: "Displacement", unit: "m", center: null },
  von_mises: { title: "Von Mises stress", unit: "Pa", center: null },
  largest_strain: { title: "Largest strain", unit: "", center: null },
  pressure: { title: "Pressure", unit: "Pa", center: 0 },
  volume_ratio: { title: "Volume ratio", unit: "", center: 1 },
};

export interface Legend {
  readonly title: string;
  /** Texts at the lower end, in the middle and at the upper end of the colours. */
  readonly ticks: readonly [string, string, string];
}

/** @param since From where a displacement counts, in words; empty for other values. */
export function legendOf(kind: Exclude<Colouring, "tissue">, { least, most }: Range, since: string): Legend {
  const { title, unit } = KINDS[kind];
  const { factor, prefix } = unit === "" ? { factor: 1, prefix: "" } : prefixFor(Math.max(Math.abs(least), Math.abs(most)));
  const text = (value: number) => `${Number((value * factor).toPrecision(3))}`;
  const middle = (least + most) / 2;
  return {
    title: since === "" ? title : `${title} ${since}`,
    ticks: [text(least), text(middle), `${text(most)}${unit === "" ? "" : ` ${prefix}${unit}`}`],
  };
}

/** SI prefix with which `value` has one to three digits before the point. */
export function prefixFor(value: number): { factor: number; prefix: string } {
  const prefixes: readonly (readonly [number, string])[] = [
    [1e9, "G"],
    [1e6, "M"],
    [1e3, "k"],
    [1, ""],
    [1e-3, "m"],
    [1e-6, "µ"],
    [1e-9, "n"],
  ];
  const [unit, prefix] = prefixes.find(([size]) => value >= size * (1 - 1e-9)) ?? [1, ""];
  return { factor: 1 / unit, prefix };
}
