import * as THREE from "three";
import { beforeEach, expect, it, vi } from "vitest";

import { enableDrag } from "../src/view/drag";
import type { Studio } from "../src/view/studio";

const canvas = () =>
  Object.assign(new EventTarget(), {
    getBoundingClientRect: () => ({ left: 10, top: 20, width: 100, height: 100 }),
    setPointerCapture: () => undefined,
  }) as unknown as HTMLCanvasElement;

/** A pointer event at `x`, `y` percent of the canvas from its left and its top. */
function pointer(type: string, x: number, y = 50, button = 0): Event {
  return Object.assign(new Event(type), { button, pointerId: 1, clientX: 10 + x, clientY: 20 + y });
}

function probe(): THREE.Object3D {
  const sphere = new THREE.Mesh(new THREE.SphereGeometry(0.5), new THREE.MeshBasicMaterial());
  sphere.name = "probe";
  sphere.updateMatrixWorld(true);
  return sphere;
}

/** A tenth of the picture at the distance of the sphere. */
const TENTH = 0.2 * 5 * Math.tan(Math.PI / 8);
const onMove = vi.fn();
const onHand = vi.fn();
const controls = { enabled: true };
let shapes: THREE.Object3D[];
let world: THREE.Group;
let target: HTMLCanvasElement;

beforeEach(() => {
  onMove.mockClear();
  onHand.mockClear();
  shapes = [probe()];
  target = canvas();
  const camera = new THREE.PerspectiveCamera(45, 1);
  camera.position.z = 5;
  camera.updateMatrixWorld(true);
  world = new THREE.Group();
  controls.enabled = true;
  const studio = { camera, controls, world } as unknown as Studio;
  enableDrag(target, studio, { shapes: () => shapes, onMove, onHand });
  target.dispatchEvent(pointer("pointerdown", 50));
});

it("moves the dragged tool until it is released", () => {
  expect(controls.enabled).toBe(false);
  target.dispatchEvent(pointer("pointermove", 60, 70));
  // A tenth of the picture to the right and two down, in the plane of the sphere's centre.
  expect(onMove).toHaveBeenCalledWith("probe", [expect.closeTo(TENTH), expect.closeTo(-2 * TENTH), expect.closeTo(0)]);
  target.dispatchEvent(pointer("pointerup", 60));
  target.dispatchEvent(pointer("pointermove", 70));
  expect(onMove).toHaveBeenCalledTimes(1);
  expect(controls.enabled).toBe(true);
});

it("reports positions in the scene's frame, also if the scene is rotated", () => {
  world.rotation.x = -Math.PI / 2;
  world.updateMatrixWorld(true);
  target.dispatchEvent(pointer("pointermove", 50, 40));
  expect(onMove).toHaveBeenCalledWith("probe", [expect.closeTo(0), expect.closeTo(0), expect.closeTo(TENTH)]);
});

it("says whether the pointer is over a tool or holds one", () => {
  const move = (x: number) => target.dispatchEvent(Object.assign(pointer("pointermove", x), { buttons: 0 }));
  target.dispatchEvent(pointer("pointerup", 50));
  move(50);
  move(51);
  move(90);
  expect(onHand.mock.calls).toEqual([["holds", "probe"], ["away", null], ["over", "probe"], ["away", null]]);
});

it("says when the pointer goes from one tool to another", () => {
  target.dispatchEvent(pointer("pointerup", 50));
  const hook = probe();
  hook.name = "hook";
  hook.position.x = 1;
  hook.updateMatrixWorld(true);
  shapes.push(hook);
  target.dispatchEvent(Object.assign(pointer("pointermove", 50), { buttons: 0 }));
  target.dispatchEvent(Object.assign(pointer("pointermove", 76), { buttons: 0 }));
  expect(onHand.mock.calls.slice(2)).toEqual([["over", "probe"], ["over", "hook"]]);
});

it("releases the tool when the pointer is cancelled", () => {
  target.dispatchEvent(pointer("pointercancel", 50));
  target.dispatchEvent(pointer("pointermove", 60));
  expect(onMove).not.toHaveBeenCalled();
  expect(controls.enabled).toBe(true);
});

it("drags a tool with the first button only, and only where its sphere is", () => {
  target.dispatchEvent(pointer("pointerup", 50));
  for (const press of [pointer("pointerdown", 50, 50, 2), pointer("pointerdown", 80)]) {
    target.dispatchEvent(press);
    target.dispatchEvent(pointer("pointermove", 60));
  }
  expect(onMove).not.toHaveBeenCalled();
  expect(controls.enabled).toBe(true);
});

it("releases a tool when its topology ends, even if the next has a tool of that name", () => {
  shapes = [probe()];
  target.dispatchEvent(pointer("pointermove", 60));
  expect(onMove).not.toHaveBeenCalled();
  expect(controls.enabled).toBe(true);
});

it("keeps the place at which a long tool was taken under the pointer", () => {
  target.dispatchEvent(pointer("pointerup", 50));
  const shaft = new THREE.Mesh(new THREE.CapsuleGeometry(0.1, 2).rotateZ(Math.PI / 2).translate(1, 0, 0), new THREE.MeshBasicMaterial());
  shaft.name = "hook";
  shaft.updateMatrixWorld(true);
  shapes = [shaft];
  target.dispatchEvent(pointer("pointerdown", 70)); // two tenths from its tip, which is in the middle of the picture
  target.dispatchEvent(pointer("pointermove", 80));
  expect(onMove).toHaveBeenCalledWith("hook", [expect.closeTo(TENTH), expect.closeTo(0), expect.closeTo(0)]);
});
