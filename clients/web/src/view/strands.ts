// The springs of attachments: a strand of tissue each, until it breaks.
import * as THREE from "three";

import { isBroken, type Frame, type Topology } from "../stream/decode";

/** Radius of a strand at its waist, and how much wider its ends are [scene radii]. */
const WAIST = 0.006;
const FLARE = 1.2;
/** Colours of a strand without tension, and of one that is about to break. */
const SLACK = new THREE.Color("#e3bfa0");
const TIGHT = new THREE.Color("#e2321f");

/** Numbers of an instance: its matrix, column by column, and its colour. */
const MATRIX = 16;
const COLOUR = 3;

export class Strands {
  readonly mesh: THREE.InstancedMesh<THREE.BufferGeometry, THREE.MeshStandardMaterial>;
  readonly #topology: Topology;
  readonly #waistM: number;
  readonly #colours: THREE.InstancedBufferAttribute;

  constructor(topology: Topology, radiusM: number) {
    const springCount = topology.attachments.reduce((count, { springs }) => count + springs.length / 2, 0);
    this.#topology = topology;
    this.#waistM = WAIST * radiusM;
    this.mesh = new THREE.InstancedMesh(profile(), new THREE.MeshStandardMaterial({ roughness: 0.5 }), springCount);
    this.mesh.instanceMatrix.setUsage(THREE.DynamicDrawUsage);
    this.#colours = new THREE.InstancedBufferAttribute(new Float32Array(COLOUR * springCount), COLOUR);
    this.#colours.setUsage(THREE.DynamicDrawUsage);
    this.mesh.instanceColor = this.#colours;
    this.mesh.name = "attachments";
    this.mesh.castShadow = true;
    this.mesh.receiveShadow = true;
    // The bounds change with every frame.
    this.mesh.frustumCulled = false;
    this.mesh.count = 0;
  }

  /** Number of springs that are drawn. */
  get count(): number {
    return this.mesh.visible ? this.mesh.count : 0;
  }

  /** Takes a frame of the same topology. */
  update(frame: Frame): void {
    this.mesh.count = placeStrands(
      this.#topology,
      frame,
      this.#waistM,
      this.mesh.instanceMatrix.array as Float32Array,
      this.#colours.array as Float32Array,
    );
    this.mesh.instanceMatrix.needsUpdate = true;
    this.#colours.needsUpdate = true;
  }

  show(shown: boolean): void {
    this.mesh.visible = shown;
  }

  /** Hides everything behind `plane`, in the room's frame. null: shows everything. */
  clip(plane: THREE.Plane | null): void {
    this.mesh.material.clippingPlanes = plane === null ? null : [plane];
    // A cut strand shows its inner side.
    this.mesh.material.side = plane === null ? THREE.FrontSide : THREE.DoubleSide;
  }

  dispose(): void {
    this.mesh.geometry.dispose();
    this.mesh.material.dispose();
    this.mesh.dispose();
  }
}

/**
 * Places a strand on each spring that is whole. Returns how many there are.
 *
 * @param topology That of the frame.
 * @param waistM Radius of a strand.
 * @param matrices [spring_count, 16], written: the first end is at y = 0 of the strand, the second one at y = 1
 * @param colours [spring_count, 3], written
 */
export function placeStrands(
  topology: Topology,
  frame: Frame,
  waistM: number,
  matrices: Float32Array,
  colours: Float32Array,
): number {
  const points = frame.attachmentPoints;
  const colour = new THREE.Color();
  let number = 0;
  let placed = 0;
  for (const { springs, restLengthsM, stiffnessNPerM, breakingForceN } of topology.attachments) {
    for (let i = 0; i < restLengthsM.length; ++i, ++number) {
      if (isBroken(frame, number)) {
        continue;
      }
      const a = 3 * springs[2 * i]!;
      const b = 3 * springs[2 * i + 1]!;
      const [x, y, z] = [points[b]! - points[a]!, points[b + 1]! - points[a + 1]!, points[b + 2]! - points[a + 2]!];
      const lengthM = Math.hypot(x, y, z);
      if (lengthM === 0) {
        continue;
      }
      place(matrices, MATRIX * placed, points, a, x, y, z, lengthM, waistM);
      const tensionN = stiffnessNPerM * Math.max(lengthM - restLengthsM[i]!, 0);
      // A spring that never breaks is never about to.
      const share = breakingForceN === null ? 0 : Math.min(tensionN / breakingForceN, 1);
      colour.lerpColors(SLACK, TIGHT, share).toArray(colours, COLOUR * placed);
      placed += 1;
    }
  }
  return placed;
}

/** Writes the matrix of a strand along (x, y, z) from a point. */
function place(
  matrices: Float32Array,
  at: number,
  points: Float32Array,
  from: number,
  x: number,
  y: number,
  z: number,
  lengthM: number,
  waistM: number,
): void {
  // Duff et al., "Building an orthonormal basis, revisited": two unit vectors across a unit vector.
  const [u, v, w] = [x / lengthM, y / lengthM, z / lengthM];
  const sign = w < 0 ? -1 : 1;
  const a = -1 / (sign + w);
  const b = u * v * a;
  const across = [1 + sign * u * u * a, sign * b, -sign * u];
  const other = [b, sign + v * v * a, -v];
  for (let c = 0; c < 3; ++c) {
    // (other, along, across) is right-handed, so that the strand's outside stays outside.
    matrices[at + c] = waistM * other[c]!;
    matrices[at + 8 + c] = waistM * across[c]!;
    matrices[at + 12 + c] = points[from + c]!;
  }
  matrices[at + 3] = matrices[at + 7] = matrices[at + 11] = 0;
  matrices[at + 4] = x;
  matrices[at + 5] = y;
  matrices[at + 6] = z;
  matrices[at + 15] = 1;
}

/** A closed strand from y = 0 to 1 with a waist of radius 1. */
function profile(): THREE.BufferGeometry {
  const radii = [FLARE, 1.07, 1, 1.07, FLARE];
  const side = radii.map((radius, i) => new THREE.Vector2(radius, i / (radii.length - 1)));
  return new THREE.LatheGeometry([new THREE.Vector2(0, 0), ...side, new THREE.Vector2(0, 1)], 10);
}
