import { expect, it } from "vitest";

import { fillCopies, splitSeams } from "../src/view/seams";

/** Two triangles on the edge 1-2. Vertex 2 has another place in the second one. */
const TRIANGLES = Uint32Array.of(0, 1, 2, 2, 1, 3);
const CORNERS = Float32Array.of(0, 0, 0.5, 0, 0, 1, /* second */ 1, 1, 0.5, 0, 0.25, 0.75);

it("copies a vertex for each further place in the picture", () => {
  const split = splitSeams(TRIANGLES, CORNERS, 5);
  expect([...split.triangles]).toEqual([0, 1, 2, 5, 1, 3]);
  expect([...split.copies]).toEqual([2]);
  expect([...split.coordinates]).toEqual([0, 0, 0.5, 0, 0, 1, 0.25, 0.75, 0, 0, 1, 1]);
});

it("copies a vertex once for each place, however many triangles have it", () => {
  const split = splitSeams(
    Uint32Array.of(0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2),
    Float32Array.of(0, 0, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 2, 2, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0),
    3,
  );
  expect([...split.copies]).toEqual([0, 0]);
  expect([...split.triangles]).toEqual([0, 1, 2, 3, 1, 2, 4, 1, 2, 3, 1, 2]);
});

it("fills copies with the values of their vertices", () => {
  const values = Float32Array.of(1, 2, 3, 4, 0, 0);
  fillCopies(values, Uint32Array.of(1), 2, 2);
  expect([...values]).toEqual([1, 2, 3, 4, 3, 4]);
});
