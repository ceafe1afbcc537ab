// Draws the pictures of all tiles on one canvas below them: each in the box of its own element.
//
// One WebGL context serves all tiles, so shaders, environment and backdrop exist once. A change in one tile draws all of
// them, because the browser keeps nothing of the canvas between two pictures.
import * as THREE from "three";

import type { Level } from "./quality";
import { softboxes } from "./surroundings";

/** A saved picture has at most so many pixels along a CSS pixel. */
const COPY_PIXEL_RATIO = 2;
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
  /** Draws as the stage's level says from now on. */
  setLevel(): void;
  /** Prepares the next picture. Returns whether it differs from the one before. */
  update(): boolean;
  /** Called when it was drawn. @param renderMs Time of the calls to WebGL. The GPU draws after them. */
  drawn(renderMs: number): void;
}

type Box = Pick<DOMRect, "left" | "top" | "width" | "height">;

export class Stage {
  #level: Level;
  #environment: THREE.Texture | null = null;
  #canvas: HTMLCanvasElement;
  #renderer: THREE.WebGLRenderer;
  readonly #boxes = new Map<Picture, Box>();
  #size = "";
  #dirty = true;

  /**
   * Throws if the browser has no WebGL 2.
   *
   * @param onTurn Called in each turn of the browser's drawing loop: its time, and whether it drew a picture.
   */
  constructor(canvas: HTMLCanvasElement, level: Level, onTurn: (nowMs: number, drew: boolean) => void) {
    this.#canvas = canvas;
    this.#level = level;
    this.#renderer = this.#open(canvas);
    const loop = (nowMs: number) => {
      onTurn(nowMs, this.#update());
      requestAnimationFrame(loop);
    };
    requestAnimationFrame(loop);
  }

  /** What the pictures show. */
  get level(): Level {
    return this.#level;
  }

  /** The canvas with all pictures. A change of the level may replace it. */
  get canvas(): HTMLCanvasElement {
    return this.#canvas;
  }

  /** Reflections of the room; null at levels without them. Its first use takes a while. */
  get environment(): THREE.Texture | null {
    this.#environment ??= this.#level.reflections ? softboxes(this.#renderer) : null;
    return this.#level.reflections ? this.#environment : null;
  }

  /** Draws all pictures at another level from now on. */
  setLevel(level: Level): void {
    const before = this.#level;
    this.#level = level;
    if (level.antialias !== before.antialias) {
      this.#reopen();
    }
    this.#renderer.shadowMap.enabled = level.shadows;
    this.#canvas.style.imageRendering = imageRendering(level);
    for (const picture of this.#boxes.keys()) {
      picture.setLevel();
    }
    this.#dirty = true;
  }

  add(picture: Picture): void {
    this.#boxes.set(picture, { left: 0, top: 0, width: 0, height: 0 });
  }

  remove(picture: Picture): void {
    this.#boxes.delete(picture);
    this.#dirty = true;
  }

  /** Returns one picture at the resolution of the screen. */
  copyOf(picture: Picture): HTMLCanvasElement {
    const ratio = Math.min(window.devicePixelRatio, COPY_PIXEL_RATIO);
    this.#fit(ratio);
    this.#draw();
    const { left, top, width, height } = scaled(this.#boxes.get(picture)!, ratio);
    const copy = document.createElement("canvas");
    copy.width = width;
    copy.height = height;
    copy.getContext("2d")!.drawImage(this.#canvas, left, top, width, height, 0, 0, width, height);
    this.#dirty = true;
    return copy;
  }

  get #pixelRatio(): number {
    return Math.min(window.devicePixelRatio, this.#level.pixelRatio);
  }

  #open(canvas: HTMLCanvasElement): THREE.WebGLRenderer {
    const { antialias, shadows } = this.#level;
    const renderer = new THREE.WebGLRenderer({ canvas, antialias, powerPreference: "high-performance" });
    renderer.toneMapping = THREE.ACESFilmicToneMapping;
    renderer.toneMappingExposure = 1.0;
    renderer.localClippingEnabled = true;
    renderer.shadowMap.enabled = shadows;
    renderer.shadowMap.type = THREE.VSMShadowMap;
    renderer.setClearColor(GAP_COLOUR);
    // Once for all pictures. Each has its own backdrop.
    renderer.autoClear = false;
    canvas.style.imageRendering = imageRendering(this.#level);
    canvas.addEventListener("webglcontextrestored", () => (this.#dirty = true));
    return renderer;
  }

  /** Starts WebGL again, which fixes its multisampling for each canvas. */
  #reopen(): void {
    const [canvas, renderer] = [this.#canvas, this.#renderer];
    this.#canvas = canvas.cloneNode() as HTMLCanvasElement;
    this.#renderer = this.#open(this.#canvas);
    this.#size = "";
    canvas.replaceWith(this.#canvas);
    this.#environment?.dispose();
    this.#environment = null;
    renderer.dispose();
    renderer.forceContextLoss();
  }

  /** Returns whether it drew. */
  #update(): boolean {
    let changed = this.#fit(this.#pixelRatio) || this.#dirty;
    for (const picture of this.#boxes.keys()) {
      changed = picture.update() || changed;
    }
    if (changed) {
      this.#dirty = false;
      this.#draw();
    }
    return changed;
  }

  /** Follows the sizes of canvas and boxes. Returns whether one has changed. */
  #fit(ratio: number): boolean {
    const { clientWidth: width, clientHeight: height } = this.#canvas;
    const size = `${width} ${height} ${ratio}`;
    let changed = size !== this.#size;
    if (changed && width > 0 && height > 0) {
      this.#size = size;
      this.#renderer.setPixelRatio(ratio);
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
}

function imageRendering({ smooth }: Level): string {
  return smooth ? "auto" : "pixelated";
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
