// The box that a view of the whole scene must contain.
import * as THREE from "three";

import type { Frame, Topology } from "../stream/decode";
import { tipOf } from "./tip";

/** Largest distance of a tool in use [radii of the tissue]. A farther tool would shrink the tissue to a speck. */
const REACH = 5;

/** Box around the tissue and the spheres of the tools within REACH [m]. */
export function sceneBounds(topology: Topology, frame: Frame): THREE.Box3 {
  const bounds = new THREE.Box3().setFromArray(frame.positions);
  const tissue = bounds.getBoundingSphere(new THREE.Sphere());
  for (const tool of frame.tools) {
    const shape = topology.tools.find(({ name }) => name === tool.name);
    if (shape === undefined) {
      continue;
    }
    const center = tipOf(shape, tool);
    if (center.distanceTo(tissue.center) < REACH * tissue.radius) {
      bounds.union(new THREE.Sphere(center, shape.radiusM).getBoundingBox(new THREE.Box3()));
    }
  }
  return bounds;
}
