import * as THREE from "three";
import { expect, it } from "vitest";

import { decodeFrame, decodeTopology } from "../src/stream/decode";
import { sceneBounds } from "../src/view/bounds";
import { f32, frameBytes, topologyBytes } from "./messages";

const bodies = [{ name: "liver", firstVertex: 0, vertexCount: 2 }];
const positions = f32(0, 0, 0, 1, 1, 1);
const topology = decodeTopology(
  topologyBytes({ bodies, tools: [{ name: "probe", radiusM: 0.25, tipOffsetM: { x: 0, y: 0, z: -1 } }] }),
);

function bounds(positionM: { x: number; y: number; z: number }, orientation = { w: 1, x: 0, y: 0, z: 0 }): THREE.Box3 {
  const tools = [{ tool: "probe", positionM, orientation }];
  return sceneBounds(topology, decodeFrame(frameBytes({ positions, tools })));
}

it("contains the tissue and the tool's sphere in any orientation of the tool", () => {
  expect(bounds({ x: 0.5, y: 0.5, z: 3 })).toEqual(
    new THREE.Box3(new THREE.Vector3(0, 0, 0), new THREE.Vector3(1, 1, 2.25)),
  );
  // Upside down, the tip is above the tool's origin.
  expect(bounds({ x: 0.5, y: 0.5, z: 1 }, { w: 0, x: 1, y: 0, z: 0 }).max.z).toBeCloseTo(2.25);
});

it("leaves out a tool far away", () => {
  expect(bounds({ x: 0, y: 0, z: 100 }).max.z).toBe(1);
  // The tissue's radius is 0.87, its centre (0.5, 0.5, 0.5), and the tip is 1 below the tool's origin.
  expect(bounds({ x: 0.5, y: 0.5, z: 1.5 + 4.2 }).max.z).toBeCloseTo(0.5 + 4.2 + 0.25);
  expect(bounds({ x: 0.5, y: 0.5, z: 1.5 + 4.5 }).max.z).toBe(1);
});
