// The room of one scene: camera, lights, floor. Its unit is the radius of the scene and y points up, so it fits a
// gallbladder and a beam of eight metres alike. `world` transforms the scene's metres into this room.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

import type { Vector } from "../stream/decode";
import type { Stage } from "./stage";
import { backdrop, floor, lights } from "./surroundings";

const FIELD_OF_VIEW_DEG = 32;
const VIEW_DIRECTION = new THREE.Vector3(0.62, 0.6, 1).normalize();
/** The view aims this far above the scene [scene radii], so that tools and arrows above it are visible. */
const HEAD_ROOM = 0.12;
const FLOOR_GAP = 0.12;

export class Studio {
  /** Parent of all objects in the scene's frame [m]. */
  readonly world = new THREE.Group();
  readonly camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW_DEG, 1, 0.05, 60);
  readonly controls: OrbitControls;
  readonly scene = new THREE.Scene();
  readonly #floor = new THREE.Group();
  readonly #backdrop = backdrop();
  #lights: readonly THREE.Light[] = [];
  #width = 1;
  #height = 1;
  #radiusM = 1;
  /** Bounds and upward direction of the framed scene, to frame it again in a window of another size. */
  #framed: { bounds: THREE.Box3; up: Vector } | null = null;
  /** Whether the user has moved the camera since the scene was framed. */
  #moved = false;
  /** Panels cover so much of the picture from its top and from its bottom [CSS pixels]. */
  #covered = { top: 0, bottom: 0 };

  /** @param element Its pointer events move the camera. */
  constructor(element: HTMLElement, stage: Pick<Stage, "level" | "environment">) {
    this.scene.environmentIntensity = 0.55;
    this.scene.add(this.#backdrop, this.world, this.#floor);
    this.#floor.visible = false;
    this.setLevel(stage);

    this.controls = new OrbitControls(this.camera, element);
    // Damping lets the picture glide on after the hand has stopped.
    this.controls.enableDamping = !window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.controls.dampingFactor = 0.12;
    this.controls.minDistance = 0.4;
    this.controls.maxDistance = 20;
    this.camera.position.copy(VIEW_DIRECTION).multiplyScalar(5);
    this.controls.addEventListener("start", () => (this.#moved = true));
  }

  /** Takes lights, reflections and ground of another level. The camera stays. */
  setLevel({ level, environment }: Pick<Stage, "level" | "environment">): void {
    this.#clear();
    this.#lights = lights(level);
    this.scene.add(...this.#lights);
    this.scene.environment = environment;
    for (const object of floor(level)) {
      this.#floor.add(object);
    }
  }

  /** Takes the size of the picture [CSS pixels]. */
  resize(width: number, height: number): void {
    this.#width = width;
    this.#height = height;
    const reshaped = this.camera.aspect !== width / height;
    this.camera.aspect = width / height;
    this.#shiftView();
    if (reshaped) {
      this.#frameAgain();
    }
  }

  /** Keeps the scene in the part of the picture that panels leave free [CSS pixels from the top and from the bottom]. */
  cover(top: number, bottom: number): void {
    if (top !== this.#covered.top || bottom !== this.#covered.bottom) {
      this.#covered = { top, bottom };
      this.#shiftView();
      this.#frameAgain();
    }
  }

  /** Centres a scene of these bounds [m] in the room, turns `up` upwards and moves the camera in front of it. */
  frame(bounds: THREE.Box3, up: Vector): void {
    const radius = Math.max(bounds.getBoundingSphere(new THREE.Sphere()).radius, 1e-6);
    this.#radiusM = radius;
    this.#framed = { bounds: bounds.clone(), up };
    this.#moved = false;
    const rotation = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(...up), new THREE.Vector3(0, 1, 0));
    const center = bounds.getCenter(new THREE.Vector3()).applyQuaternion(rotation);
    this.world.quaternion.copy(rotation);
    this.world.scale.setScalar(1 / radius);
    this.world.position.copy(center).multiplyScalar(-1 / radius);
    this.world.updateMatrixWorld(true);
    this.#floor.position.y = bounds.clone().applyMatrix4(this.world.matrixWorld).min.y - FLOOR_GAP;
    this.#floor.visible = true;

    const fitting = 1.04 / Math.sin(THREE.MathUtils.degToRad(FIELD_OF_VIEW_DEG / 2));
    const distance = fitting * Math.max(1 / this.#freeShare(), 0.85 / this.camera.aspect);
    const target = new THREE.Vector3(0, HEAD_ROOM, 0);
    this.camera.position.copy(VIEW_DIRECTION).multiplyScalar(distance).add(target);
    this.controls.target.copy(target);
    this.controls.update();
  }

  /** Projects a point of the scene [m] to the picture [CSS pixels]; null behind the camera. */
  project(point: Vector): { x: number; y: number } | null {
    const clip = new THREE.Vector3(...point).applyMatrix4(this.world.matrixWorld).project(this.camera);
    return clip.z > 1 ? null : { x: (0.5 + 0.5 * clip.x) * this.#width, y: (0.5 - 0.5 * clip.y) * this.#height };
  }

  /** Length of a CSS pixel in the scene, at the point that the view turns around. */
  metresPerPx(): number {
    const distance = this.camera.position.distanceTo(this.controls.target);
    const height = 2 * distance * Math.tan(THREE.MathUtils.degToRad(FIELD_OF_VIEW_DEG / 2));
    return (height * this.#radiusM) / this.#height;
  }

  /** Rotation from the scene's frame to the camera's. */
  turn(): THREE.Quaternion {
    return this.camera.quaternion.clone().invert().multiply(this.world.quaternion);
  }

  dispose(): void {
    this.controls.dispose();
    this.#clear();
  }

  /** Frees what depends on the level or on the renderer. */
  #clear(): void {
    for (const light of this.#lights) {
      light.dispose();
      this.scene.remove(light);
    }
    for (const object of [...this.#floor.children]) {
      if (object instanceof THREE.Mesh || object instanceof THREE.LineSegments) {
        (object.geometry as THREE.BufferGeometry).dispose();
        (object.material as THREE.Material).dispose();
      }
    }
    this.#floor.clear();
    this.#backdrop.geometry.dispose();
    (this.#backdrop.material as THREE.Material).dispose();
  }

  #frameAgain(): void {
    if (this.#framed !== null && !this.#moved) {
      this.frame(this.#framed.bounds, this.#framed.up);
    }
  }

  /** Share of the picture's height that panels leave free. */
  #freeShare(): number {
    return Math.max(0.3, 1 - (this.#covered.top + this.#covered.bottom) / this.#height);
  }

  #shiftView(): void {
    const [width, height] = [this.#width, this.#height];
    const shift = (this.#covered.bottom - this.#covered.top) / 2;
    this.camera.setViewOffset(width, height, 0, shift, width, height);
    this.camera.updateProjectionMatrix();
  }
}
