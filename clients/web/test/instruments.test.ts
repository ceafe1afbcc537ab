import * as THREE from "three";
import { expect, it } from "vitest";

import { decodeFrame, decodeTopology } from "../src/stream/decode";
import { Instruments, arrowLength } from "../src/view/instruments";
import { LEVELS, placeOf } from "../src/view/quality";
import { frameBytes, topologyBytes } from "./messages";

const LOW = LEVELS[placeOf("low")]!;

it("draws a longer arrow for a larger force, within a bound", () => {
  const lengths = [0.01, 1, 10, 1e6, Infinity].map(arrowLength);
  expect(lengths).toEqual([...lengths].sort((a, b) => a - b));
  expect(lengths.at(-1)).toBeLessThan(1);
  expect(arrowLength(0)).toBe(0);
});

/** Instruments with a tool at (1, 2, 3) whose sphere is 0.1 below it, in a scene of radius 2 [m]. */
function update(forceN: { x: number; y: number; z: number }, orientation = { w: 1, x: 0, y: 0, z: 0 }) {
  const topology = decodeTopology(topologyBytes());
  const instruments = new Instruments(topology, 2, LOW);
  const tools = [{ tool: "probe", positionM: { x: 1, y: 2, z: 3 }, orientation, forceN }];
  const labels = instruments.update(decodeFrame(frameBytes({ tools })));
  instruments.group.updateMatrixWorld(true);
  return { instruments, labels };
}

const close = (...values: number[]): unknown[] => values.map((value) => expect.closeTo(value, 6) as unknown);
/** Within 0.05 mm: spheres are drawn as polyhedra. */
const near = (...values: number[]): unknown[] => values.map((value) => expect.closeTo(value, 4) as unknown);

it("places the sphere with the position and orientation of the tool", () => {
  // A quarter turn about x.
  const { instruments } = update({ x: 0, y: 0, z: 0 }, { w: 1, x: 1, y: 0, z: 0 });
  const [sphere] = instruments.shapes();
  expect(sphere?.name).toBe("probe");
  expect(sphere?.getWorldPosition(new THREE.Vector3()).toArray()).toEqual(close(1, 2.1, 3));
});

it("draws a tool that touches nothing as a ghost", () => {
  const topology = decodeTopology(topologyBytes());
  const instruments = new Instruments(topology, 2, LOW);
  const opacity = (retired: boolean): number => {
    const tools = [{ tool: "probe", positionM: { x: 1, y: 2, z: 3 }, forceN: { x: 0, y: 0, z: 0 }, retired }];
    instruments.update(decodeFrame(frameBytes({ tools })));
    return ((instruments.shapes()[0] as THREE.Mesh).material as THREE.Material).opacity;
  };
  expect(opacity(true)).toBeLessThan(0.5);
  expect(opacity(false)).toBe(1);
});

it("draws a capsule from its tip along the tool's z axis", () => {
  const capsule = { kind: { case: "capsule" as const, value: { radiusM: 0.005, lengthM: 0.2 } } };
  const tool = { name: "probe", radiusM: 0.005, tipOffsetM: { x: 0, y: 0, z: -0.1 }, tool: capsule };
  const instruments = new Instruments(decodeTopology(topologyBytes({ tools: [tool] })), 2, LOW);
  const box = new THREE.Box3().setFromObject(instruments.shapes()[0]!);
  expect(box.min.toArray()).toEqual(close(-0.005, -0.005, -0.105));
  expect(box.max.toArray()).toEqual(close(0.005, 0.005, 0.105));
});

it("draws the edge of a scalpel from its tip, as thick as its blade", () => {
  const value = { lengthM: 0.02, thicknessM: 0.001, spacingM: 0.001 };
  const tool = { name: "probe", radiusM: 0.0005, tool: { kind: { case: "scalpel" as const, value } } };
  const instruments = new Instruments(decodeTopology(topologyBytes({ tools: [tool] })), 2, LOW);
  const box = new THREE.Box3().setFromObject(instruments.shapes()[0]!);
  expect(box.min.toArray()).toEqual(close(-0.0005, -0.0005, -0.0005));
  expect(box.max.toArray()).toEqual(close(0.0005, 0.0005, 0.0205));
});

it("draws a retractor from its toe along the blade, and up its shaft", () => {
  const value = { radiusM: 0.005, bladeLengthM: 0.04, shaftLengthM: 0.2 };
  const tool = { name: "probe", radiusM: 0.005, tool: { kind: { case: "retractor" as const, value } } };
  const instruments = new Instruments(decodeTopology(topologyBytes({ tools: [tool] })), 2, LOW);
  const box = new THREE.Box3().setFromObject(instruments.shapes()[0]!);
  expect(box.min.toArray()).toEqual(close(-0.005, -0.005, -0.005));
  expect(box.max.toArray()).toEqual(close(0.045, 0.005, 0.205));
});

it("draws the blades of scissors as far open as they are", () => {
  const value = { radiusM: 0.002, bladeLengthM: 0.04, thicknessM: 0.0005, spacingM: 0.002, edgeOffsetM: 0.001 };
  const tool = { name: "probe", radiusM: 0.002, tool: { kind: { case: "scissors" as const, value } } };
  const instruments = new Instruments(decodeTopology(topologyBytes({ tools: [tool] })), 2, LOW);
  instruments.update(decodeFrame(frameBytes({ tools: [{ tool: "probe", jointValues: [1] }] })));
  const box = new THREE.Box3().setFromObject(instruments.shapes()[0]!);
  const aside = 0.002 + 0.04 * Math.sin(0.5);
  expect(box.min.toArray()).toEqual(near(-aside, -0.002, 0.04 * (1 - Math.cos(0.5)) - 0.002));
  expect(box.max.toArray()).toEqual(near(aside, 0.002, 0.042));
});

it("draws the jaws of a grasper as far open as they are", () => {
  const value = { radiusM: 0.005, jawLengthM: 0.04 };
  const tool = { name: "probe", radiusM: 0.005, tool: { kind: { case: "grasper" as const, value } } };
  const instruments = new Instruments(decodeTopology(topologyBytes({ tools: [tool] })), 2, LOW);
  for (const opening of [0, 1, 0.5]) {
    instruments.update(decodeFrame(frameBytes({ tools: [{ tool: "probe", jointValues: [opening] }] })));
    const box = new THREE.Box3().setFromObject(instruments.shapes()[0]!);
    const aside = 0.005 + 0.04 * Math.sin(opening / 2);
    expect(box.min.toArray()).toEqual(near(-aside, -0.005, 0.04 * (1 - Math.cos(opening / 2)) - 0.005));
    expect(box.max.toArray()).toEqual(near(aside, 0.005, 0.045));
  }
});

it("draws solids as what they are, and obstacles are not for dragging", () => {
  const positions = new Float64Array([0, 0, 0, 3, 0, 0, 0, 4, 0, 0, 0, 5]);
  const triangles = new Uint32Array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]);
  const bytes = (array: Float64Array | Uint32Array): Uint8Array<ArrayBuffer> => new Uint8Array(array.buffer as ArrayBuffer);
  const packed = { vertexPositions: bytes(positions), triangles: bytes(triangles) };
  const source = { case: "packed" as const, value: packed };
  const box = { case: "box" as const, value: { sizeXM: 0.02, sizeYM: 0.04, sizeZM: 0.06, edgeRadiusM: 0.002 } };
  const mesh = { case: "mesh" as const, value: { scale: 0.01, surface: { source } } };
  const topology = decodeTopology(
    topologyBytes({
      tools: [
        { name: "box", radiusM: 0.01, tool: { kind: box } },
        { name: "mesh", radiusM: 0.01, tool: { kind: mesh } },
        { name: "plane", radiusM: 0.01, tool: { kind: { case: "plane", value: {} }, fixed: true } },
      ],
    }),
  );
  const instruments = new Instruments(topology, 2, LOW);
  const shapes = instruments.shapes();
  expect(shapes.map((shape) => shape.name)).toEqual(["box", "mesh"]);
  expect(new THREE.Box3().setFromObject(shapes[0]!).max.toArray()).toEqual(near(0.01, 0.02, 0.03));
  expect(new THREE.Box3().setFromObject(shapes[1]!).max.toArray()).toEqual(near(0.03, 0.04, 0.05));
  expect(instruments.group.children).toHaveLength(3);
});

it("refuses a surface that names a vertex it lacks", () => {
  const packed = { vertexPositions: new Uint8Array(24), triangles: new Uint8Array(new Uint32Array([0, 0, 7]).buffer) };
  const kind = { case: "mesh" as const, value: { surface: { source: { case: "packed" as const, value: packed } } } };
  const tool = { name: "rake", radiusM: 0.01, tool: { kind } };
  expect(() => decodeTopology(topologyBytes({ tools: [tool] }))).toThrow(/tool "rake": its surface has/);
});

it("draws the arrow from the sphere along the force, and the label at its tip", () => {
  const { instruments, labels } = update({ x: 0, y: 0, z: -1.5 });
  const [label] = labels;
  expect(label).toMatchObject({ tool: "probe", magnitudeN: 1.5 });
  const [x, y, z] = label!.tipM;
  expect([x, y]).toEqual(close(1, 2));
  expect(z).toBeLessThan(2.9 - 2 * arrowLength(1.5));
  const arrow = new THREE.Box3().setFromObject(instruments.group.children[0]!.children[1]!);
  expect(arrow.min.z).toBeCloseTo(z);
  expect(arrow.max.z).toBeCloseTo(2.9);
});

it("draws no arrow for a force that is only rounding", () => {
  expect(update({ x: 0, y: 0.004, z: 0 }).labels).toEqual([]);
  expect(update({ x: 0, y: 0.006, z: 0 }).labels).toHaveLength(1);
});

it("leaves removed tools to fade, and hides the others", () => {
  const sphere = (name: string) => ({ name, radiusM: 0.1, tipOffsetM: { x: 0, y: 0, z: 0 } });
  const topology = (...names: string[]) => decodeTopology(topologyBytes({ tools: names.map(sphere) }));
  const instruments = new Instruments(topology("probe", "hook"), 2, LOW);
  const tools = ["probe", "hook"].map((tool) => ({ tool, positionM: { x: 0, y: 0, z: 0 }, forceN: { x: 0, y: 0, z: 3 } }));
  instruments.update(decodeFrame(frameBytes({ tools })));
  expect(instruments.keepRemoved(topology("probe"))).toBe(true);
  instruments.fade(0.4);
  const [probe, hook] = instruments.group.children;
  expect([probe!.visible, hook!.visible]).toEqual([false, true]);
  expect(hook!.children.map((child) => child.visible)).toEqual([true, false]); // the tool without its arrow
  const steel = (instruments.shapes()[1] as THREE.Mesh).material as THREE.Material;
  expect([steel.transparent, steel.opacity]).toEqual([true, 0.4]);
  expect(steel.version, "compiled anew, because an opaque program ignores opacity").toBe(1);
  expect(new Instruments(topology("probe"), 2, LOW).keepRemoved(topology("probe", "hook"))).toBe(false);
});
