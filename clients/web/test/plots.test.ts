import { describe, expect, it } from "vitest";

import { SPAN_S, Series, niceBound } from "../src/panel/plots";

describe("Series", () => {
  it("keeps the last seconds only", () => {
    const series = new Series();
    for (let second = 0; second <= 3 * SPAN_S; second += 1) {
      series.add(second, 2 * second);
    }
    expect(series.points[0]).toEqual({ timeS: 2 * SPAN_S, value: 4 * SPAN_S });
    expect(series.points.at(-1)).toEqual({ timeS: 3 * SPAN_S, value: 6 * SPAN_S });
  });

  it("is bounded, however many values arrive", () => {
    const series = new Series();
    for (let i = 0; i < 5000; i += 1) {
      series.add(i / 1000, i);
    }
    expect(series.points.length).toBe(1200);
    expect(series.points.at(-1)!.value).toBe(4999);
  });

  it("begins again when time falls, as after a reset, and replaces a value of the same time", () => {
    const series = new Series();
    series.add(5, 1);
    series.add(6, 2);
    series.add(0, 3);
    series.add(0, 4);
    expect(series.points).toEqual([{ timeS: 0, value: 4 }]);
  });
});

it.each([
  [0, 1],
  [-1, 1],
  [NaN, 1],
  [1, 1],
  [1.01, 2],
  [4.2, 5],
  [5.1, 10],
  [0.003, 0.005],
  [0.02, 0.02],
  [73_000, 100_000],
])("bounds %s by %s", (value, bound) => {
  expect(niceBound(value)).toBeCloseTo(bound, 12);
});
