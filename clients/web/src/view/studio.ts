// The room: camera, lights, floor, backdrop. Its unit is the radius of the scene and y points up, so it fits a
// gallbladder and a beam of eight metres alike. `world` transforms the scene's metres into this room.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

import type { Vector } from "../stream/decode";
import type { Quality } from "./quality";

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
  readonly #renderer: THREE.WebGLRenderer;
  readonly #scene = new THREE.Scene();
  readonly #floor = new THREE.Group();
  #radiusM = 1;
  /** Bounds and upward direction of the framed scene, to frame it again in a window of another size. */
  #framed: { bounds: THREE.Box3; up: Vector } | null = null;
  /** Whether the user has moved the camera since the scene was framed. */
  #moved = false;
  /** Panels cover so much of the canvas from its top and from its bottom [CSS pixels]. */
  #covered = { top: 0, bottom: 0 };

  constructor(canvas: HTMLCanvasElement, quality: Quality) {
    const high = quality.level === "high";
    this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: high, powerPreference: "high-performance" });
    this.#renderer.toneMapping = THREE.ACESFilmicToneMapping;
    this.#renderer.toneMappingExposure = 1.0;
    this.#renderer.localClippingEnabled = true;
    this.#renderer.shadowMap.enabled = high;
    this.#renderer.shadowMap.type = THREE.VSMShadowMap;

    this.#scene.background = backdrop();
    if (high) {
      this.#scene.environment = softboxes(this.#renderer);
      this.#scene.environmentIntensity = 0.55;
    }
    this.#scene.add(this.world, this.#floor, ...lights(high ? 0.35 : 2.2));
    this.#floor.add(...floor());
    this.#floor.visible = false;

    this.controls = new OrbitControls(this.camera, canvas);
    // Damping lets the picture glide on after the hand has stopped.
    this.controls.enableDamping = !window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.controls.dampingFactor = 0.12;
    this.controls.minDistance = 0.4;
    this.controls.maxDistance = 20;
    this.camera.position.copy(VIEW_DIRECTION).multiplyScalar(5);
    this.controls.addEventListener("start", () => (this.#moved = true));
  }

  resize(width: number, height: number, pixelRatio: number): void {
    this.#renderer.setPixelRatio(pixelRatio);
    this.#renderer.setSize(width, height, false);
    const reshaped = this.camera.aspect !== width / height;
    this.camera.aspect = width / height;
    this.#shiftView(width, height);
    if (reshaped) {
      this.#frameAgain();
    }
  }

  /** Keeps the scene in the part of the canvas that panels leave free [CSS pixels from the top and from the bottom]. */
  cover(top: number, bottom: number): void {
    if (top !== this.#covered.top || bottom !== this.#covered.bottom) {
      this.#covered = { top, bottom };
      const { clientWidth, clientHeight } = this.#renderer.domElement;
      this.#shiftView(clientWidth, clientHeight);
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

  /** Projects a point of the scene [m] to the canvas [CSS pixels]; null behind the camera. */
  project(point: Vector): { x: number; y: number } | null {
    const clip = new THREE.Vector3(...point).applyMatrix4(this.world.matrixWorld).project(this.camera);
    const { clientWidth, clientHeight } = this.#renderer.domElement;
    return clip.z > 1 ? null : { x: (0.5 + 0.5 * clip.x) * clientWidth, y: (0.5 - 0.5 * clip.y) * clientHeight };
  }

  /** Length of a CSS pixel in the scene, at the point that the view turns around. */
  metresPerPx(): number {
    const distance = this.camera.position.distanceTo(this.controls.target);
    const height = 2 * distance * Math.tan(THREE.MathUtils.degToRad(FIELD_OF_VIEW_DEG / 2));
    return (height * this.#radiusM) / this.#renderer.domElement.clientHeight;
  }

  /** Rotation from the scene's frame to the camera's. */
  turn(): THREE.Quaternion {
    return this.camera.quaternion.clone().invert().multiply(this.world.quaternion);
  }

  render(): void {
    this.#renderer.render(this.#scene, this.camera);
  }

  #frameAgain(): void {
    if (this.#framed !== null && !this.#moved) {
      this.frame(this.#framed.bounds, this.#framed.up);
    }
  }

  /** Share of the canvas's height that panels leave free. */
  #freeShare(): number {
    const height = Math.max(this.#renderer.domElement.clientHeight, 1);
    return Math.max(0.3, 1 - (this.#covered.top + this.#covered.bottom) / height);
  }

  #shiftView(width: number, height: number): void {
    const shift = (this.#covered.bottom - this.#covered.top) / 2;
    this.camera.setViewOffset(width, height, 0, shift, width, height);
    this.camera.updateProjectionMatrix();
  }
}

/** An operating lamp as the key, a cool light from behind to part tissue from backdrop, and warm light from the floor. */
function lights(fillIntensity: number): THREE.Object3D[] {
  const key = new THREE.DirectionalLight("#fff1e2", 2.1);
  key.position.set(-1.6, 4.2, 2.4);
  key.castShadow = true;
  key.shadow.mapSize.setScalar(1024);
  key.shadow.radius = 7;
  key.shadow.bias = -0.0008;
  key.shadow.normalBias = 0.012;
  const extent = 1.9;
  Object.assign(key.shadow.camera, { left: -extent, right: extent, top: extent, bottom: -extent, near: 1, far: 9 });
  const rim = new THREE.DirectionalLight("#a9cdfd", 1.5);
  rim.position.set(2.6, 1.8, -3.2);
  const fill = new THREE.HemisphereLight("#cfe0ee", "#7a4a3e", fillIntensity);
  return [key, rim, fill];
}

/** Environment for reflections: three softboxes in a dim room. Its blur takes seconds without a GPU. */
function softboxes(renderer: THREE.WebGLRenderer): THREE.Texture {
  const room = new THREE.Scene();
  room.add(
    new THREE.Mesh(
      new THREE.SphereGeometry(12, 32, 16),
      new THREE.MeshBasicMaterial({ color: new THREE.Color(0.16, 0.19, 0.22), side: THREE.BackSide }),
    ),
  );
  const panel = (intensity: number, width: number, height: number, position: THREE.Vector3) => {
    const mesh = new THREE.Mesh(
      new THREE.PlaneGeometry(width, height),
      new THREE.MeshBasicMaterial({ color: new THREE.Color().setScalar(intensity), side: THREE.DoubleSide }),
    );
    mesh.position.copy(position);
    mesh.lookAt(0, 0, 0);
    room.add(mesh);
  };
  panel(9, 4.5, 4.5, new THREE.Vector3(-2, 7, 2.5));
  panel(4, 2, 6, new THREE.Vector3(7, 2.5, 1.5));
  panel(3, 6, 2, new THREE.Vector3(-3, 2, -7));
  const generator = new THREE.PMREMGenerator(renderer);
  const texture = generator.fromScene(room, 0.03).texture;
  generator.dispose();
  return texture;
}

/** A soft vignette from slate to near black, fixed to the screen. */
function backdrop(): THREE.Texture {
  const canvas = document.createElement("canvas");
  canvas.width = 256;
  canvas.height = 256;
  const context = canvas.getContext("2d")!;
  const gradient = context.createRadialGradient(128, 104, 8, 128, 128, 190);
  gradient.addColorStop(0, "#3a4a55");
  gradient.addColorStop(0.5, "#222d36");
  gradient.addColorStop(1, "#0f151a");
  context.fillStyle = gradient;
  context.fillRect(0, 0, 256, 256);
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  return texture;
}

/** The floor: fine lines that fade out, and a plane that receives the shadow. */
function floor(): THREE.Object3D[] {
  const lines = new THREE.Mesh(
    new THREE.CircleGeometry(4.5, 64).rotateX(-Math.PI / 2),
    new THREE.ShaderMaterial({
      transparent: true,
      depthWrite: false,
      vertexShader: `
        varying vec2 place;
        void main() {
          place = position.xz;
          gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
        }`,
      fragmentShader: `
        varying vec2 place;
        float lines(vec2 at, float spacing) {
          vec2 cell = at / spacing;
          vec2 distance = abs(fract(cell - 0.5) - 0.5) / fwidth(cell);
          return 1.0 - min(min(distance.x, distance.y), 1.0);
        }
        void main() {
          float fade = smoothstep(4.3, 0.6, length(place));
          float strength = 0.10 * lines(place, 0.25) + 0.16 * lines(place, 1.0);
          gl_FragColor = vec4(0.62, 0.76, 0.85, strength * fade * fade);
        }`,
    }),
  );
  const shadow = new THREE.Mesh(
    new THREE.CircleGeometry(4.5, 64).rotateX(-Math.PI / 2),
    new THREE.ShadowMaterial({ opacity: 0.42 }),
  );
  shadow.position.y = -0.001;
  shadow.receiveShadow = true;
  return [shadow, lines];
}
