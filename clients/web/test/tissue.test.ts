import * as THREE from "three";
import { expect, it } from "vitest";

import { decodeFrame, decodeTopology } from "../src/stream/decode";
import { Tissue } from "../src/view/tissue";
import { f32, frameBytes, topologyBytes } from "./messages";

type Shown = THREE.Mesh<THREE.BufferGeometry, THREE.MeshStandardMaterial>;
const meshesOf = (tissue: Tissue) => tissue.group.children.filter((child): child is Shown => child instanceof THREE.Mesh);

it("gives each body its vertices from every frame", () => {
  const { positions } = decodeFrame(frameBytes());
  const tissue = new Tissue(decodeTopology(topologyBytes()), positions, 1, { level: "low", adaptive: false });
  const meshes = meshesOf(tissue);
  const array = (name: string) => meshes.map((mesh) => [...mesh.geometry.getAttribute(name).array]);
  expect(meshes.map((mesh) => mesh.name)).toEqual(["liver", "vein"]);
  expect(array("position")).toEqual([[...positions.subarray(0, 12)], [...positions.subarray(12)]]);
  expect(array("normal")[1]).toEqual([0, 0, 1, 0, 0, 1, 0, 0, 1]);

  // The triangle now lies in the plane x = 2.
  const next = new Float32Array(f32(...positions.subarray(0, 12), 2, 0, 0, 2, 1, 0, 2, 0, 1).buffer);
  tissue.update(next);
  expect(array("position")[1]).toEqual([2, 0, 0, 2, 1, 0, 2, 0, 1]);
  expect(array("normal")[1]).toEqual([1, 0, 0, 1, 0, 0, 1, 0, 0]);
});

it("paints a body in its colour, or in one of the palette", () => {
  const { positions } = decodeFrame(frameBytes());
  const tissue = new Tissue(decodeTopology(topologyBytes()), positions, 1, { level: "low", adaptive: false });
  const [liver, vein] = meshesOf(tissue).map(({ material }) => material.color);
  const srgb = vein!.getRGB({ r: 0, g: 0, b: 0 }, THREE.SRGBColorSpace);
  expect([srgb.r, srgb.g, srgb.b]).toEqual([0.1, 0.2, 0.9].map((value) => expect.closeTo(value, 4) as unknown));
  expect(liver!.equals(vein!)).toBe(false);
});
