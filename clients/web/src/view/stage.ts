// Draws the pictures of all tiles on one canvas below them: each in the box of its own element.
//
// One WebGL context serves all tiles, so shaders, environment and backdrop exist once. A change in one tile draws all of
// them, because the browser keeps nothing of the canvas between two pictures.
import * as THREE from "three";

import type { Quality } from "./quality";
import { backdrop, softboxes } from "./surroundings";

/** Times between two pictures [ms]: slower than the first reduces the resolution, faster than the second raises it. */
const SLOW_PICTURE_MS = 45;
const FAST_PICTURE_MS = 20;
const LEAST_PIXEL_RATIO = 0.5;
/** Colour between the tiles. */
const GAP_COLOUR = "#0b1014";

/** The picture of one scene. */
export interface Picture {
  /** The picture fills the box of this element. */
  readonly element: HTMLElement;
  readonly scene: THREE.Scene;
  readonly camera: THREE.Camera;
  /** Takes the size of the box [CSS pixels]. */
  resize(width: number, height: number): void;
  /** Prepares the next picture. Returns whether it differs from the one before. */
  update(): boolean;
  /** Called when it was drawn. @param renderMs Time of the calls to WebGL. The GPU draws after them. */
  drawn(renderMs: number): void;
}

type Box = Pick<DOMRect, "left" | "top" | "width" | "height">;

export class Stage {
  readonly quality: Quality;
  readonly backdrop = backdrop();
  /** Reflections of the room; null at low quality. */
  readonly environment: THREE.Texture | null;
  readonly #canvas: HTMLCanvasElement;
  readonly #renderer: THREE.WebGLRenderer;
  readonly #boxes = new Map<Picture, Box>();
  readonly #pixelRatioLimit = Math.min(window.devicePixelRatio, 2);
  #pixelRatio = this.#pixelRatioLimit;
  #size = "";
  #dirty = true;
  #pictureMs = (SLOW_PICTURE_MS + FAST_PICTURE_MS) / 2;
  #lastPictureMs: number | null = null;
  #holdsSize = false;

  /** Throws if the browser has no WebGL 2. */
  constructor(canvas: HTMLCanvasElement, quality: Quality) {
    const high = quality.level === "high";
    this.quality = quality;
    this.#canvas = canvas;
    this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: high, powerPreference: "high-performance" });
    this.#renderer.toneMapping = THREE.ACESFilmicToneMapping;
    this.#renderer.toneMappingExposure = 1.0;
    this.#renderer.localClippingEnabled = true;
    this.#renderer.shadowMap.enabled = high;
    this.#renderer.shadowMap.type = THREE.VSMShadowMap;
    this.#renderer.setClearColor(GAP_COLOUR);
    this.environment = high ? softboxes(this.#renderer) : null;
    canvas.addEventListener("webglcontextrestored", () => (this.#dirty = true));
    const loop = (nowMs: number) => {
      this.#update(nowMs);
      requestAnimationFrame(loop);
    };
    requestAnimationFrame(loop);
  }

  add(picture: Picture): void {
    this.#boxes.set(picture, { left: 0, top: 0, width: 0, height: 0 });
  }

  remove(picture: Picture): void {
    this.#boxes.delete(picture);
    this.#dirty = true;
  }

  /** Returns one picture at full resolution. */
  copyOf(picture: Picture): HTMLCanvasElement {
    const ratio = this.#pixelRatio;
    this.#pixelRatio = this.#pixelRatioLimit;
    this.#fit();
    this.#draw();
    const { left, top, width, height } = scaled(this.#boxes.get(picture)!, this.#pixelRatio);
    const copy = document.createElement("canvas");
    copy.width = width;
    copy.height = height;
    copy.getContext("2d")!.drawImage(this.#canvas, left, top, width, height, 0, 0, width, height);
    this.#pixelRatio = ratio;
    this.#dirty = true;
    return copy;
  }

  /** Keeps the resolution while a film runs, because some players show only its first size. */
  holdSize(holds: boolean): void {
    this.#holdsSize = holds;
  }

  #update(nowMs: number): void {
    let changed = this.#fit() || this.#dirty;
    for (const picture of this.#boxes.keys()) {
      changed = picture.update() || changed;
    }
    if (!changed) {
      this.#lastPictureMs = null;
      return;
    }
    this.#dirty = false;
    this.#adapt(nowMs);
    this.#draw();
  }

  /** Follows the sizes of canvas and boxes. Returns whether one has changed. */
  #fit(): boolean {
    const { clientWidth: width, clientHeight: height } = this.#canvas;
    const size = `${width} ${height} ${this.#pixelRatio}`;
    let changed = size !== this.#size;
    if (changed && width > 0 && height > 0) {
      this.#size = size;
      this.#renderer.setPixelRatio(this.#pixelRatio);
      this.#renderer.setSize(width, height, false);
    }
    for (const [picture, before] of this.#boxes) {
      const box = picture.element.getBoundingClientRect();
      const resized = box.width !== before.width || box.height !== before.height;
      if (resized || box.left !== before.left || box.top !== before.top) {
        changed = true;
        this.#boxes.set(picture, box);
      }
      if (resized && box.width > 0 && box.height > 0) {
        picture.resize(box.width, box.height);
      }
    }
    return changed;
  }

  #draw(): void {
    const renderer = this.#renderer;
    const height = this.#canvas.clientHeight;
    renderer.setScissorTest(false);
    renderer.clear();
    renderer.setScissorTest(true);
    for (const [picture, box] of this.#boxes) {
      const seen = overlap(box, picture.element.parentElement!.getBoundingClientRect());
      if (seen.width > 0 && seen.height > 0) {
        const beganMs = performance.now();
        // WebGL counts from the lower edge.
        renderer.setViewport(box.left, height - box.top - box.height, box.width, box.height);
        renderer.setScissor(seen.left, height - seen.top - seen.height, seen.width, seen.height);
        renderer.render(picture.scene, picture.camera);
        picture.drawn(performance.now() - beganMs);
      }
    }
  }

  /**
   * Adapts the resolution to the cost of a picture. The GPU draws after `render` returns, so only the interval of
   * consecutive pictures shows that cost.
   */
  #adapt(nowMs: number): void {
    const last = this.#lastPictureMs;
    this.#lastPictureMs = nowMs;
    if (last === null || !this.quality.adaptive || this.#holdsSize) {
      return;
    }
    this.#pictureMs += 0.1 * (nowMs - last - this.#pictureMs);
    const factor = this.#pictureMs > SLOW_PICTURE_MS ? 0.8 : this.#pictureMs < FAST_PICTURE_MS ? 1.25 : 1;
    const ratio = Math.min(this.#pixelRatioLimit, Math.max(LEAST_PIXEL_RATIO, factor * this.#pixelRatio));
    if (ratio !== this.#pixelRatio) {
      this.#pixelRatio = ratio;
      this.#pictureMs = (SLOW_PICTURE_MS + FAST_PICTURE_MS) / 2;
      this.#fit();
    }
  }
}

/** Returns the intersection of two boxes. Boxes that do not touch give a negative width or height. */
export function overlap(a: Box, b: Box): Box {
  const left = Math.max(a.left, b.left);
  const top = Math.max(a.top, b.top);
  const width = Math.min(a.left + a.width, b.left + b.width) - left;
  const height = Math.min(a.top + a.height, b.top + b.height) - top;
  return { left, top, width, height };
}

function scaled({ left, top, width, height }: Box, ratio: number): Box {
  const [x, y] = [Math.round(ratio * left), Math.round(ratio * top)];
  return { left: x, top: y, width: Math.round(ratio * width), height: Math.round(ratio * height) };
}
