import { expect, it } from "vitest";

import { overlap } from "../src/view/stage";

it("draws the part of a tile that lies in the grid", () => {
  const grid = { left: 0, top: 60, width: 400, height: 500 };
  expect(overlap({ left: 0, top: 0, width: 400, height: 200 }, grid)).toEqual({ left: 0, top: 60, width: 400, height: 140 });
  expect(overlap({ left: 10, top: 100, width: 90, height: 90 }, grid)).toEqual({ left: 10, top: 100, width: 90, height: 90 });
  expect(overlap({ left: 0, top: 600, width: 400, height: 200 }, grid).height).toBeLessThan(0);
});
