// Position of a tool's sphere. The offset is given in the tool's frame, so it turns with the tool.
import * as THREE from "three";

import type { ToolShape, ToolState, Vector } from "../stream/decode";

type Pose = Pick<ToolState, "positionM" | "orientationWxyz">;

/** Centre of the sphere in the scene's frame [m]. */
export function tipOf(shape: ToolShape, { positionM, orientationWxyz }: Pose): THREE.Vector3 {
  return turnedOffset(shape, orientationWxyz).add(new THREE.Vector3(...positionM));
}

/** Origin of the tool [m] that brings its sphere to `centerM` with the same orientation. */
export function originFor(shape: ToolShape, { orientationWxyz }: Pose, centerM: Vector): Vector {
  const { x, y, z } = new THREE.Vector3(...centerM).sub(turnedOffset(shape, orientationWxyz));
  return [x, y, z];
}

function turnedOffset(shape: ToolShape, [w, x, y, z]: Pose["orientationWxyz"]): THREE.Vector3 {
  return new THREE.Vector3(...shape.tipOffsetM).applyQuaternion(new THREE.Quaternion(x, y, z, w));
}
