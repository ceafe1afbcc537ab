import { expect, it } from "vitest";

import { niceBound } from "../src/panel/plots";

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
