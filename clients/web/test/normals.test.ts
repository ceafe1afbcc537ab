import { expect, it } from "vitest";

import { vertexNormals } from "../src/view/normals";

it("points outwards on a sphere", () => {
  // An octahedron refined three times onto the unit sphere.
  let vertices = [
    [1, 0, 0],
    [0, 1, 0],
    [-1, 0, 0],
    [0, -1, 0],
    [0, 0, 1],
    [0, 0, -1],
  ];
  let faces = [
    [0, 1, 4],
    [1, 2, 4],
    [2, 3, 4],
    [3, 0, 4],
    [1, 0, 5],
    [2, 1, 5],
    [3, 2, 5],
    [0, 3, 5],
  ];
  for (let round = 0; round < 3; round += 1) {
    const middles = new Map<string, number>();
    const middle = (a: number, b: number) => {
      const key = a < b ? `${a},${b}` : `${b},${a}`;
      const known = middles.get(key);
      if (known !== undefined) {
        return known;
      }
      const sum = vertices[a]!.map((value, axis) => value + vertices[b]![axis]!);
      const length = Math.hypot(...sum);
      vertices = [...vertices, sum.map((value) => value / length)];
      middles.set(key, vertices.length - 1);
      return vertices.length - 1;
    };
    faces = faces.flatMap(([a, b, c]) => {
      const [ab, bc, ca] = [middle(a!, b!), middle(b!, c!), middle(c!, a!)];
      return [
        [a!, ab, ca],
        [ab, b!, bc],
        [ca, bc, c!],
        [ab, bc, ca],
      ];
    });
  }
  const positions = Float32Array.from(vertices.flat());
  const normals = new Float32Array(positions.length).fill(9);
  vertexNormals(positions, Uint32Array.from(faces.flat()), normals);
  for (let v = 0; v < positions.length; v += 3) {
    const cosine =
      positions[v]! * normals[v]! + positions[v + 1]! * normals[v + 1]! + positions[v + 2]! * normals[v + 2]!;
    expect(cosine).toBeGreaterThan(0.998); // 3.6 degrees: its facets span 11
    expect(Math.hypot(normals[v]!, normals[v + 1]!, normals[v + 2]!)).toBeCloseTo(1, 6);
  }
});

it("weights triangles by area", () => {
  // Vertex 0 belongs to a large triangle that faces z and to one of a hundredth of its area that faces x.
  const positions = Float32Array.of(0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0.1, 0, 0, 0, 0.1);
  const normals = new Float32Array(15);
  vertexNormals(positions, Uint32Array.of(0, 1, 2, 0, 3, 4), normals);
  const expected = [0.01, 0, 1].map((value) => value / Math.hypot(0.01, 1));
  for (const axis of [0, 1, 2]) {
    expect(normals[axis]).toBeCloseTo(expected[axis]!, 6);
  }
});

it("gives zero at a vertex without any area", () => {
  const normals = new Float32Array(9).fill(1);
  vertexNormals(new Float32Array(9), Uint32Array.of(0, 1, 2), normals);
  expect([...normals]).toEqual([0, 0, 0, 0, 0, 0, 0, 0, 0]);
});
