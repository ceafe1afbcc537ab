import * as THREE from "three";
import { expect, it } from "vitest";

import { decodeFrame, decodeTopology } from "../src/stream/decode";
import { LEVELS, placeOf } from "../src/view/quality";
import { Tissue } from "../src/view/tissue";
import { f32, frameBytes, topologyBytes } from "./messages";

const LOW = LEVELS[placeOf("low")]!;

type Shown = THREE.Mesh<THREE.BufferGeometry, THREE.MeshStandardMaterial>;
const meshesOf = (tissue: Tissue) => tissue.group.children.filter((child): child is Shown => child instanceof THREE.Mesh);

it("gives each body its vertices from every frame", () => {
  const { positions } = decodeFrame(frameBytes());
  const tissue = new Tissue(decodeTopology(topologyBytes()), positions, 1, LOW);
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
  const tissue = new Tissue(decodeTopology(topologyBytes()), positions, 1, LOW);
  const [liver, vein] = meshesOf(tissue).map(({ material }) => material.color);
  const srgb = vein!.getRGB({ r: 0, g: 0, b: 0 }, THREE.SRGBColorSpace);
  expect([srgb.r, srgb.g, srgb.b]).toEqual([0.1, 0.2, 0.9].map((value) => expect.closeTo(value, 4) as unknown));
  expect(liver!.equals(vein!)).toBe(false);
});

it("marks fixed vertices, which move with the surface", () => {
  const { positions } = decodeFrame(frameBytes());
  const tissue = new Tissue(decodeTopology(topologyBytes()), positions, 1, LOW);
  const points = meshesOf(tissue).map((mesh) => mesh.children[1] as THREE.Points);
  const shown = () => points.map(({ visible }) => visible);
  expect(shown()).toEqual([false, false]);
  tissue.showFixed(true);
  expect(shown()).toEqual([true, true]);
  expect(points.map(({ geometry }) => [...geometry.getIndex()!.array])).toEqual([[1, 3], []]);
  tissue.update(new Float32Array(positions.length).fill(2));
  expect([...points[0]!.geometry.getAttribute("position").array.subarray(3, 6)]).toEqual([2, 2, 2]);
});

it("shows values as colours, edges and a cut, and takes them back", () => {
  const { positions } = decodeFrame(frameBytes());
  const tissue = new Tissue(decodeTopology(topologyBytes()), positions, 1, LOW);
  const meshes = meshesOf(tissue);
  const looks = meshes.map(({ material }) => material);
  tissue.colour(Float32Array.of(0, 1, 2, 3, 4, 5, 6), 0, 5);
  expect(meshes.map((mesh) => [...mesh.geometry.getAttribute("value").array])).toEqual([
    [0, 1, 2, 3],
    [4, 5, 6],
  ]);
  for (const { material } of meshes as unknown as THREE.Mesh<THREE.BufferGeometry, THREE.ShaderMaterial>[]) {
    expect([material.uniforms.least!.value, material.uniforms.most!.value]).toEqual([0, 5]);
  }
  const plane = new THREE.Plane(new THREE.Vector3(-1, 0, 0), 0.5);
  tissue.clip(plane);
  expect(meshes.map(({ material }) => material.clippingPlanes)).toEqual([[plane], [plane]]);
  expect(meshes.map(({ material }) => material.side)).toEqual([THREE.DoubleSide, THREE.DoubleSide]);
  tissue.showEdges(true);
  expect(meshes.map((mesh) => mesh.children[0]!.visible)).toEqual([true, true]);

  tissue.colour(null, 0, 1);
  tissue.clip(null);
  tissue.showEdges(false);
  expect(meshes.map(({ material }) => material)).toEqual(looks);
  expect(meshes.map(({ material }) => material.clippingPlanes)).toEqual([null, null]);
  expect(meshes.map((mesh) => mesh.children[0]!.visible)).toEqual([false, false]);
});

it("moves the copies of vertices on a seam of a picture with them", () => {
  const { positions } = decodeFrame(frameBytes());
  const given = decodeTopology(topologyBytes());
  const [liver, vein] = given.bodies;
  // Each corner of the tetrahedron has a place of its own.
  const coordinates = Float32Array.from({ length: 24 }, (_, i) => i / 24);
  const textured = { ...liver!, texture: { image: Uint8Array.of(1), coordinates } };
  const tissue = new Tissue({ ...given, bodies: [textured, vein!] }, positions, 1, LOW);
  const { geometry } = meshesOf(tissue)[0]!;
  const array = (name: string) => [...geometry.getAttribute(name).array];
  expect(array("uv").length).toBe(24);
  const corners = (name: string, width: number) => [...geometry.getIndex()!.array].map((v) => array(name).slice(width * v, width * v + width));
  expect(corners("uv", 2).flat()).toEqual([...coordinates]);
  const moved = positions.map((coordinate) => 2 * coordinate + 1);
  tissue.update(moved);
  tissue.colour(Float32Array.of(0, 1, 2, 3, 4, 5, 6), 0, 5);
  const vertices = [...liver!.triangles];
  expect(corners("position", 3)).toEqual(vertices.map((v) => [...moved.subarray(3 * v, 3 * v + 3)]));
  expect(corners("value", 1).flat()).toEqual(vertices);
  const normals = corners("normal", 3);
  for (const [i, v] of vertices.entries()) {
    expect(normals[i], "both sides of a seam have one normal").toEqual(normals[vertices.indexOf(v)]);
  }
});
