import { expect, it } from "vitest";

import { Pace } from "../src/stream/pace";

const costs = (atMs: number) => ({ atMs, bytes: 100, decodeMs: 1, prepareMs: 2, renderMs: 3 });

it("counts frames and takes the median of their ages over two seconds", () => {
  const pace = new Pace();
  for (const [atMs, ageMs] of [[100, 900], [2500, 7], [2600, null], [2700, 5], [2800, 6]] as const) {
    pace.add(costs(atMs), ageMs);
  }
  expect(pace.rateHz(3000)).toBe(2);
  expect(pace.ageMs(3000)).toBe(6);
  expect(pace.rateHz(4650)).toBe(1);
  expect(pace.ageMs(9000)).toBeNull();
});

it("keeps the costs of the last frames only", () => {
  const pace = new Pace();
  for (let atMs = 0; atMs < 400; atMs += 1) {
    pace.add(costs(atMs), null);
  }
  expect(pace.costs).toHaveLength(300);
  expect(pace.costs[0]!.atMs).toBe(100);
});
