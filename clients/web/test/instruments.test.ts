import { expect, it } from "vitest";

import { arrowLength } from "../src/view/instruments";

it("draws a longer arrow for a larger force, and none that leaves the screen", () => {
  const lengths = [0.01, 1, 10, 1e6, Infinity].map(arrowLength);
  expect(lengths).toEqual([...lengths].sort((a, b) => a - b));
  expect(lengths.at(-1)).toBeLessThan(1);
  expect(arrowLength(0)).toBe(0);
});
