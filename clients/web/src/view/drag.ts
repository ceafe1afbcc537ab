// Moves tools with the pointer, if the gateway allows it. A tool follows the pointer in the plane through its tip that
// faces the camera.
import * as THREE from "three";

import type { Vector } from "../stream/decode";
import type { Hand } from "./hand";
import type { Studio } from "./studio";

export interface DragTarget {
  /** Shapes that can be dragged; `name` is the tool's name. A dragged shape that is no longer listed is released. */
  shapes(): THREE.Object3D[];
  /** Called for each move with the new centre of the sphere at the tip [m]. */
  onMove(tool: string, centerM: Vector): void;
  /** Called when the pointer comes over a tool, takes it, or leaves it; then `tool` is null. */
  onHand(hand: Hand, tool: string | null): void;
}

/** Listens to the element of a picture from now on. */
export function enableDrag(element: HTMLElement, studio: Studio, target: DragTarget): void {
  const caster = new THREE.Raycaster();
  const plane = new THREE.Plane();
  const hit = new THREE.Vector3();
  /** From the pointer to the tip, in the plane. A capsule that is taken at its far end must not jump to the pointer. */
  const grip = new THREE.Vector3();
  let held: THREE.Object3D | null = null;
  let shown: Hand = "away";
  let shownTool: string | null = null;
  const show = (hand: Hand, tool: string | null) => {
    if (hand !== shown || tool !== shownTool) {
      [shown, shownTool] = [hand, tool];
      target.onHand(hand, tool);
    }
  };

  const aim = (event: PointerEvent) => {
    const box = element.getBoundingClientRect();
    const x = (2 * (event.clientX - box.left)) / box.width - 1;
    const y = 1 - (2 * (event.clientY - box.top)) / box.height;
    caster.setFromCamera(new THREE.Vector2(x, y), studio.camera);
  };

  element.addEventListener(
    "pointerdown",
    (event) => {
      aim(event);
      const taken = event.button === 0 ? caster.intersectObjects(target.shapes(), false)[0] : undefined;
      if (taken !== undefined) {
        held = taken.object;
        taken.object.getWorldPosition(grip);
        plane.setFromNormalAndCoplanarPoint(studio.camera.getWorldDirection(new THREE.Vector3()), grip);
        grip.sub(caster.ray.intersectPlane(plane, hit) ?? grip);
        studio.controls.enabled = false;
        element.setPointerCapture(event.pointerId);
        show("holds", taken.object.name);
      }
    },
    // Handled before the orbit controls.
    { capture: true },
  );
  const release = () => {
    held = null;
    studio.controls.enabled = true;
    show("away", null);
  };
  const hover = (event: PointerEvent) => {
    aim(event);
    const below = caster.intersectObjects(target.shapes(), false)[0]?.object.name ?? null;
    show(below === null ? "away" : "over", below);
  };
  element.addEventListener("pointermove", (event) => {
    if (held === null && event.buttons === 0) {
      hover(event);
    }
    if (held !== null && !target.shapes().includes(held)) {
      release();
    }
    if (held !== null) {
      aim(event);
      if (caster.ray.intersectPlane(plane, hit) !== null) {
        const { x, y, z } = studio.world.worldToLocal(hit.clone().add(grip));
        target.onMove(held.name, [x, y, z]);
      }
    }
  });
  element.addEventListener("pointerup", release);
  element.addEventListener("pointercancel", release);
}
