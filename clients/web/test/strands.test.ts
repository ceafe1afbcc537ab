import * as THREE from "three";
import { expect, it } from "vitest";

import { decodeFrame, decodeTopology } from "../src/stream/decode";
import { Strands, placeStrands } from "../src/view/strands";
import { ATTACHED, f32, frameBytes, topologyBytes } from "./messages";

const topology = decodeTopology(topologyBytes(ATTACHED.topology));
const frameWith = (brokenSprings: number[]) =>
  decodeFrame(frameBytes({ ...ATTACHED.frame, brokenSprings: Uint8Array.from(brokenSprings) }));

function placed(brokenSprings: number[]): { count: number; matrices: THREE.Matrix4[]; colours: THREE.Color[] } {
  const matrices = new Float32Array(16 * 3);
  const colours = new Float32Array(3 * 3);
  const count = placeStrands(topology, frameWith(brokenSprings), 0.01, matrices, colours);
  const each = Array.from({ length: count }, (_, i) => i);
  return {
    count,
    matrices: each.map((i) => new THREE.Matrix4().fromArray(matrices, 16 * i)),
    colours: each.map((i) => new THREE.Color().fromArray(colours, 3 * i)),
  };
}

const close = (values: readonly number[]): unknown[] => values.map((value) => expect.closeTo(value, 6) as unknown);

it("lays a strand from one end of each spring to the other", () => {
  const { count, matrices } = placed([]);
  expect(count).toBe(3);
  const ends = matrices.map((matrix) => [0, 1].map((y) => new THREE.Vector3(0, y, 0).applyMatrix4(matrix).toArray()));
  expect(ends).toEqual([
    [close([0, 0, 0]), close([0, 0, 2])],
    [close([0, 0, 0]), close([3, 4, 0])],
    [close([1, 0, 0]), close([0, 0, -1])],
  ]);
});

it("keeps strands round, and their outside outside", () => {
  for (const matrix of placed([]).matrices) {
    const [x, y, z] = [0, 1, 2].map((column) => new THREE.Vector3().setFromMatrixColumn(matrix, column));
    expect([x!.length(), z!.length()]).toEqual(close([0.01, 0.01]));
    expect([x!.dot(y!), x!.dot(z!), y!.dot(z!)]).toEqual(close([0, 0, 0]));
    expect(matrix.determinant()).toBeGreaterThan(0);
  }
});

it("shows the tension as a share of the force at which a spring breaks", () => {
  // The first spring is slack, the second one pulls with 10 N/m · 2 m of 40 N, the third one never breaks.
  const [slack, half, steadfast] = placed([]).colours;
  const between = new THREE.Color("#e3bfa0").lerp(new THREE.Color("#e2321f"), 0.5);
  expect(steadfast!.toArray()).toEqual(close(slack!.toArray()));
  expect(half!.toArray()).toEqual(close(between.toArray()));
});

it("leaves out springs that are broken, and those without a length", () => {
  const whole = placed([]).matrices;
  expect(placed([0b010]).matrices).toEqual([whole[0], whole[2]]);
  expect(placed([0b111]).count).toBe(0);
  const points = f32(0, 0, 0, 0, 0, 0, 3, 4, 0, 1, 0, 0, 1, 0, 0);
  const frame = decodeFrame(frameBytes({ ...ATTACHED.frame, attachmentPoints: points }));
  expect(placeStrands(topology, frame, 0.01, new Float32Array(48), new Float32Array(9))).toBe(1);
});

it("draws as many strands as there are, or none if they are hidden", () => {
  const strands = new Strands(topology, 1);
  expect(strands.count).toBe(0);
  strands.update(frameWith([]));
  expect(strands.count).toBe(3);
  strands.update(frameWith([0b101]));
  expect(strands.count).toBe(1);
  strands.show(false);
  expect([strands.count, strands.mesh.visible]).toEqual([0, false]);
  strands.show(true);
  expect(strands.count).toBe(1);
  const plane = new THREE.Plane(new THREE.Vector3(-1, 0, 0), 0.5);
  strands.clip(plane);
  expect(strands.mesh.material.clippingPlanes).toEqual([plane]);
  strands.clip(null);
  expect(strands.mesh.material.clippingPlanes).toBeNull();
});
