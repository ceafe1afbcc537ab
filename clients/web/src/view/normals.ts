/**
 * Computes smooth vertex normals: the normalised sum of the adjacent triangles' normals, weighted by area. The cross
 * product of two edges is this weighted normal. Runs for every frame, so it does not allocate.
 *
 * @param positions [vertex_count, 3] m
 * @param triangles [triangle_count, 3] vertex indices, counter-clockwise seen from outside
 * @param normals [vertex_count, 3], overwritten with unit vectors; zero where a vertex has no triangle with an area
 */
export function vertexNormals(positions: Float32Array, triangles: Uint32Array, normals: Float32Array): void {
  normals.fill(0);
  for (let t = 0; t < triangles.length; t += 3) {
    const a = 3 * triangles[t]!;
    const b = 3 * triangles[t + 1]!;
    const c = 3 * triangles[t + 2]!;
    const ax = positions[a]!;
    const ay = positions[a + 1]!;
    const az = positions[a + 2]!;
    const ux = positions[b]! - ax;
    const uy = positions[b + 1]! - ay;
    const uz = positions[b + 2]! - az;
    const vx = positions[c]! - ax;
    const vy = positions[c + 1]! - ay;
    const vz = positions[c + 2]! - az;
    const nx = uy * vz - uz * vy;
    const ny = uz * vx - ux * vz;
    const nz = ux * vy - uy * vx;
    normals[a]! += nx;
    normals[a + 1]! += ny;
    normals[a + 2]! += nz;
    normals[b]! += nx;
    normals[b + 1]! += ny;
    normals[b + 2]! += nz;
    normals[c]! += nx;
    normals[c + 1]! += ny;
    normals[c + 2]! += nz;
  }
  for (let v = 0; v < normals.length; v += 3) {
    const x = normals[v]!;
    const y = normals[v + 1]!;
    const z = normals[v + 2]!;
    const length = Math.sqrt(x * x + y * y + z * z);
    const scale = length > 0 ? 1 / length : 0;
    normals[v] = x * scale;
    normals[v + 1] = y * scale;
    normals[v + 2] = z * scale;
  }
}

/** Size of a unit normal as the gateway sends it. */
const PACKED_UNIT = 127;

/** Reads normals of the gateway. @param packed [vertex_count, 3] @param normals [vertex_count, 3], overwritten */
export function unpackNormals(packed: Int8Array, normals: Float32Array): void {
  for (let i = 0; i < normals.length; i += 1) {
    normals[i] = packed[i]! / PACKED_UNIT;
  }
}
