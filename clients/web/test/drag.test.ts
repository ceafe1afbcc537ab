import * as THREE from "three";
import { beforeEach, expect, it, vi } from "vitest";

import { enableDrag } from "../src/view/drag";
import type { Studio } from "../src/view/studio";

const canvas = () =>
  Object.assign(new EventTarget(), {
    getBoundingClientRect: () => ({ left: 0, top: 0, width: 100, height: 100 }),
    setPointerCapture: () => undefined,
  }) as unknown as HTMLCanvasElement;

function pointer(type: string, clientX: number): Event {
  return Object.assign(new Event(type), { button: 0, pointerId: 1, clientX, clientY: 50 });
}

function probe(): THREE.Object3D {
  const sphere = new THREE.Mesh(new THREE.SphereGeometry(0.5), new THREE.MeshBasicMaterial());
  sphere.name = "probe";
  sphere.updateMatrixWorld(true);
  return sphere;
}

const onMove = vi.fn();
const controls = { enabled: true };
let spheres: THREE.Object3D[];
let target: HTMLCanvasElement;

beforeEach(() => {
  onMove.mockClear();
  spheres = [probe()];
  target = canvas();
  const camera = new THREE.PerspectiveCamera(45, 1);
  camera.position.z = 5;
  camera.updateMatrixWorld(true);
  const studio = { camera, controls, world: new THREE.Group() } as unknown as Studio;
  enableDrag(target, studio, { spheres: () => spheres, onMove });
  target.dispatchEvent(pointer("pointerdown", 50));
});

it("moves the tool that was taken, until it is released", () => {
  expect(controls.enabled).toBe(false);
  target.dispatchEvent(pointer("pointermove", 60));
  // A tenth of the picture, in the plane of the sphere's centre.
  const x = 0.2 * 5 * Math.tan(Math.PI / 8);
  expect(onMove).toHaveBeenCalledWith("probe", [expect.closeTo(x), expect.closeTo(0), expect.closeTo(0)]);
  target.dispatchEvent(pointer("pointerup", 60));
  target.dispatchEvent(pointer("pointermove", 70));
  expect(onMove).toHaveBeenCalledTimes(1);
  expect(controls.enabled).toBe(true);
});

it("lets go of a tool with its topology, even if the next has one of that name", () => {
  spheres = [probe()];
  target.dispatchEvent(pointer("pointermove", 60));
  expect(onMove).not.toHaveBeenCalled();
  expect(controls.enabled).toBe(true);
});
