// The tools and their forces. Sizes are in metres, except those of arrow and handle: these are in scene radii, so that
// they are visible in every scene.
import * as THREE from "three";
import { RoundedBoxGeometry } from "three/addons/geometries/RoundedBoxGeometry.js";
import { mergeGeometries } from "three/addons/utils/BufferGeometryUtils.js";

import type { Frame, Solid, ToolShape, ToolState, Topology, Vector } from "../stream/decode";
import type { Level } from "./quality";
import { tipOf } from "./tip";

/** Limit of the arrow's length for large forces [scene radii]. HALF_FORCE_N gives half of it. */
const ARROW_LIMIT = 0.75;
const HALF_FORCE_N = 1.5;
/** Smallest force with an arrow. Below it there is no contact, only rounding. */
const LEAST_FORCE_N = 0.005;
const ARROW_WIDTH = 0.014;
const HANDLE_LENGTH = 1.1;
const RETIRED_OPACITY = 0.25;
/** Edge of the square that stands for a plane [scene radii]. */
const PLANE_SIZE = 5;

export interface ForceLabel {
  readonly tool: string;
  readonly magnitudeN: number;
  /** Tip of the arrow [m]. */
  readonly tipM: Vector;
}

export class Instruments {
  readonly group = new THREE.Group();
  readonly #tools: ReadonlyMap<string, Instrument>;

  constructor(topology: Topology, radiusM: number, level: SteelLevel) {
    this.#tools = new Map(topology.tools.map((shape) => [shape.name, new Instrument(shape, radiusM, level)]));
    for (const tool of this.#tools.values()) {
      this.group.add(tool.group);
    }
  }

  /** Places the tools. Returns the labels of their arrows. */
  update(frame: Frame): ForceLabel[] {
    return frame.tools.flatMap((state) => this.#tools.get(state.name)?.update(state) ?? []);
  }

  /** Shapes of the tools that can be moved, for picking; `name` is the tool's name. */
  shapes(): THREE.Object3D[] {
    return [...this.#tools.values()].filter((tool) => !tool.fixed).map((tool) => tool.mesh);
  }

  /** Leaves only tools that a topology does not have, where they are, without their forces. Tells whether there are any. */
  keepRemoved({ tools }: Topology): boolean {
    for (const [name, tool] of this.#tools) {
      const stays = tools.some((shape) => shape.name === name);
      tool.group.visible = !stays;
      tool.hideForce();
    }
    return [...this.#tools.values()].some(({ group }) => group.visible);
  }

  /** Draws all tools see-through. @param opacity 0 to 1 */
  fade(opacity: number): void {
    for (const tool of this.#tools.values()) {
      tool.fade(opacity);
    }
  }

  dispose(): void {
    this.group.traverse((object) => {
      if (object instanceof THREE.Mesh) {
        (object.geometry as THREE.BufferGeometry).dispose();
        (object.material as THREE.Material).dispose();
      }
    });
  }
}

type SteelLevel = Pick<Level, "material" | "reflections">;
type Steel = THREE.MeshStandardMaterial | THREE.MeshLambertMaterial;

class Instrument {
  readonly group = new THREE.Group();
  readonly mesh: THREE.Mesh;
  readonly fixed: boolean;
  readonly #shape: ToolShape;
  readonly #tool = new THREE.Group();
  readonly #steel: Steel[];
  readonly #sceneRadiusM: number;
  #jointValues: readonly number[] = [];
  readonly #arrow = new THREE.Group();
  readonly #arrowShaft: THREE.Mesh;
  readonly #arrowHead: THREE.Mesh;

  constructor(shape: ToolShape, sceneRadiusM: number, level: SteelLevel) {
    this.#shape = shape;
    this.#sceneRadiusM = sceneRadiusM;
    this.fixed = shape.fixed;

    const steel = steelOf(shape, level);
    this.mesh = new THREE.Mesh(shapeOf(shape, this.#jointValues, sceneRadiusM), steel);
    this.mesh.receiveShadow = shape.fixed;
    this.mesh.name = shape.name;
    this.mesh.position.set(...shape.tipOffsetM);
    this.#steel = [steel];
    this.#tool.add(this.mesh);
    if (shape.core.shaftM !== null) {
      // A shaft that is not simulated. It lies along the tool's z axis and shows the tool's orientation.
      const length = HANDLE_LENGTH * sceneRadiusM;
      const thickness = (shape.core.cornersM([]).length === 1 ? 0.26 : 1) * shape.radiusM;
      const handle = new THREE.Mesh(
        new THREE.CylinderGeometry(thickness, thickness, length, 24, 1, true).rotateX(Math.PI / 2).translate(0, 0, length / 2),
        steel.clone(),
      );
      this.#steel.push(handle.material);
      handle.position.set(...shape.core.shaftM).add(this.mesh.position);
      this.#tool.add(handle);
    }
    for (const mesh of this.#tool.children) {
      mesh.castShadow = shape.solid?.kind !== "plane";
      mesh.frustumCulled = false;
    }

    // Drawn over everything: the force matters most where tissue surrounds the tool.
    const amber = () => new THREE.MeshBasicMaterial({ color: "#ffc24a", depthTest: false, transparent: true, toneMapped: false });
    const width = ARROW_WIDTH * sceneRadiusM;
    this.#arrowShaft = new THREE.Mesh(new THREE.CylinderGeometry(width, width, 1, 20).translate(0, 0.5, 0), amber());
    this.#arrowHead = new THREE.Mesh(new THREE.ConeGeometry(2.9 * width, 8 * width, 28).translate(0, 4 * width, 0), amber());
    for (const mesh of [this.#arrowShaft, this.#arrowHead]) {
      mesh.frustumCulled = false;
      mesh.renderOrder = 10;
      this.#arrow.add(mesh);
    }
    this.group.add(this.#tool, this.#arrow);
  }

  update(state: ToolState): ForceLabel[] {
    const [w, x, y, z] = state.orientationWxyz;
    this.#tool.position.set(...state.positionM);
    this.#tool.quaternion.set(x, y, z, w);
    if (state.jointValues.some((value, i) => value !== this.#jointValues[i])) {
      this.#jointValues = state.jointValues;
      this.mesh.geometry.dispose();
      this.mesh.geometry = shapeOf(this.#shape, state.jointValues, this.#sceneRadiusM);
    }
    this.fade(state.retired ? RETIRED_OPACITY : 1);

    const force = new THREE.Vector3(...state.forceN);
    // hypot, because the square of a large force overflows.
    const magnitudeN = Math.hypot(...state.forceN);
    // A table carries tissue at many points, and an arrow at its origin would mean nothing.
    this.#arrow.visible = magnitudeN >= LEAST_FORCE_N && !this.fixed;
    if (!this.#arrow.visible) {
      return [];
    }
    const length = arrowLength(magnitudeN) * this.#sceneRadiusM;
    const direction = force.divideScalar(magnitudeN);
    this.#arrow.position.copy(tipOf(this.#shape, state));
    this.#arrow.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), direction);
    this.#arrowShaft.scale.set(1, length, 1);
    this.#arrowHead.position.set(0, length, 0);
    const tip = direction.multiplyScalar(length + 8 * ARROW_WIDTH * this.#sceneRadiusM).add(this.#arrow.position);
    return [{ tool: this.#shape.name, magnitudeN, tipM: [tip.x, tip.y, tip.z] }];
  }

  fade(opacity: number): void {
    for (const steel of this.#steel) {
      // A program that was compiled for an opaque material ignores its opacity.
      if (steel.transparent !== opacity < 1) {
        steel.transparent = opacity < 1;
        steel.needsUpdate = true;
      }
      steel.opacity = opacity;
    }
  }

  hideForce(): void {
    this.#arrow.visible = false;
  }
}

/** An obstacle is matte, so that it is not taken for an instrument. */
function steelOf({ fixed }: ToolShape, { material, reflections }: SteelLevel): Steel {
  const color = fixed ? "#5d6a75" : "#d5dce2";
  if (material === "simple") {
    return new THREE.MeshLambertMaterial({ color });
  }
  // Metal shows its environment. Without one it would be black.
  const polished = { metalness: reflections ? 1 : 0.2, roughness: 0.24 };
  return new THREE.MeshStandardMaterial({ color, ...(fixed ? { metalness: 0, roughness: 0.95 } : polished) });
}

/** The shape that touches tissue, in the tool's frame moved by tipOffsetM. */
function shapeOf({ radiusM, core, solid }: ToolShape, jointValues: readonly number[], sceneRadiusM: number): THREE.BufferGeometry {
  if (solid !== null) {
    return solidGeometry(solid, sceneRadiusM);
  }
  const points = core.cornersM(jointValues).map((point) => new THREE.Vector3(...point));
  const bars = points.slice(1).map((to, i) => bar(points[i]!, to, radiusM));
  return bars.length === 0 ? new THREE.SphereGeometry(radiusM, 48, 32) : mergeGeometries(bars);
}

/** A plane is a square that is seen from its free side only: from below it would hide the tissue. */
function solidGeometry(solid: Solid, sceneRadiusM: number): THREE.BufferGeometry {
  if (solid.kind === "box") {
    const [x, y, z] = solid.sizeM;
    return solid.edgeRadiusM > 0 ? new RoundedBoxGeometry(x, y, z, 4, solid.edgeRadiusM) : new THREE.BoxGeometry(x, y, z);
  }
  if (solid.kind === "plane") {
    return new THREE.PlaneGeometry(PLANE_SIZE * sceneRadiusM, PLANE_SIZE * sceneRadiusM);
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(solid.positions, 3));
  geometry.setIndex(new THREE.BufferAttribute(solid.triangles, 1));
  // Without shared vertices the edges stay sharp.
  const faceted = geometry.toNonIndexed();
  faceted.computeVertexNormals();
  return faceted;
}

/** A cylinder with round ends from one point to another. */
function bar(from: THREE.Vector3, to: THREE.Vector3, radiusM: number): THREE.BufferGeometry {
  const way = to.clone().sub(from);
  const turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 1, 0), way.clone().normalize());
  const middle = from.clone().addScaledVector(way, 0.5);
  return new THREE.CapsuleGeometry(radiusM, way.length(), 24, 48).applyQuaternion(turn).translate(middle.x, middle.y, middle.z);
}

/** Length of the arrow [scene radii]: nearly proportional for small forces, bounded so that it stays on the screen. */
export function arrowLength(magnitudeN: number): number {
  return ARROW_LIMIT / (1 + HALF_FORCE_N / magnitudeN);
}
