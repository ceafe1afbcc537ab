// Where a tool's sphere is: its offset is given in the tool's own frame, so it turns with the tool.
import * as THREE from "three";

import type { ToolShape, ToolState, Vector } from "../stream/decode";

type Pose = Pick<ToolState, "positionM" | "orientationWxyz">;

/** The sphere's centre [m]. */
export function tipOf(shape: ToolShape, { positionM, orientationWxyz }: Pose): THREE.Vector3 {
  return turnedOffset(shape, orientationWxyz).add(new THREE.Vector3(...positionM));
}

/** The tool's origin [m] that brings its sphere to `centerM`, turned as it is. */
export function originFor(shape: ToolShape, { orientationWxyz }: Pose, centerM: Vector): Vector {
  const { x, y, z } = new THREE.Vector3(...centerM).sub(turnedOffset(shape, orientationWxyz));
  return [x, y, z];
}

function turnedOffset(shape: ToolShape, [w, x, y, z]: Pose["orientationWxyz"]): THREE.Vector3 {
  return new THREE.Vector3(...shape.tipOffsetM).applyQuaternion(new THREE.Quaternion(x, y, z, w));
}
