// WebGL has one place in a picture for each vertex. A vertex on a seam of the picture has several, so it is copied.

export interface SplitSurface {
  /** [triangle_count, 3]: vertices as before; copies follow them. */
  readonly triangles: Uint32Array;
  /** [vertex_count + copy_count, 2]: place of each vertex in the picture; zero for a vertex without a triangle. */
  readonly coordinates: Float32Array;
  /** The vertex that each copy repeats, [copy_count]. */
  readonly copies: Uint32Array;
}

/**
 * Copies vertices until each has one place in the picture.
 *
 * @param triangles [triangle_count, 3]
 * @param corners Place of each corner, [triangle_count, 3, 2]
 */
export function splitSeams(triangles: Uint32Array, corners: Float32Array, vertexCount: number): SplitSurface {
  const split = new Uint32Array(triangles.length);
  const coordinates: number[] = new Array<number>(2 * vertexCount).fill(0);
  const used = new Uint8Array(vertexCount);
  const copies: number[] = [];
  /** Index of the next copy of the same vertex, or 0 after the last copy. Vertex 0 is never a copy. */
  const next: number[] = new Array<number>(vertexCount).fill(0);
  for (let corner = 0; corner < triangles.length; ++corner) {
    const vertex = triangles[corner]!;
    const u = corners[2 * corner]!;
    const v = corners[2 * corner + 1]!;
    if (used[vertex] === 0) {
      used[vertex] = 1;
      coordinates[2 * vertex] = u;
      coordinates[2 * vertex + 1] = v;
    }
    let at = vertex;
    while ((coordinates[2 * at] !== u || coordinates[2 * at + 1] !== v) && next[at] !== 0) {
      at = next[at]!;
    }
    if (coordinates[2 * at] !== u || coordinates[2 * at + 1] !== v) {
      next[at] = vertexCount + copies.length;
      at = next[at]!;
      copies.push(vertex);
      coordinates.push(u, v);
      next.push(0);
    }
    split[corner] = at;
  }
  return { triangles: split, coordinates: Float32Array.from(coordinates), copies: Uint32Array.from(copies) };
}

/** Repeats the values of copied vertices. @param values [vertex_count + copy_count, width], set up to vertex_count. */
export function fillCopies(values: { [index: number]: number }, copies: Uint32Array, vertexCount: number, width: number): void {
  for (let copy = 0; copy < copies.length; ++copy) {
    const from = width * copies[copy]!;
    const to = width * (vertexCount + copy);
    for (let i = 0; i < width; ++i) {
      values[to + i] = values[from + i]!;
    }
  }
}
