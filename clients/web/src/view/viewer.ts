// Draws the store's scene. Rebuilds the objects when the topology changes, moves them with every frame, and draws only
// if something changed.
import * as THREE from "three";

import type { SceneStore } from "../stream/store";
import type { Frame, Vector } from "../stream/decode";
import type { Settings } from "../panel/settings";
import { sceneBounds } from "./bounds";
import { KINDS, displacements, fitRange, legendOf, type Legend, type Range } from "./colouring";
import { enableDrag, type Hand } from "./drag";
import { Instruments, type ForceLabel } from "./instruments";
import type { Quality } from "./quality";
import { Rulers } from "./rulers";
import { Studio } from "./studio";
import { Tissue } from "./tissue";

/** Times between two pictures [ms]: slower than the first reduces the resolution, faster than the second raises it. */
const SLOW_PICTURE_MS = 45;
const FAST_PICTURE_MS = 20;
const LEAST_PIXEL_RATIO = 0.5;

export interface ViewerEvents {
  /**
   * Called when a new frame was drawn.
   *
   * @param prepareMs Time to copy positions, and to compute normals and colours
   * @param renderMs Time of the calls to WebGL. The GPU draws after them.
   */
  onDrawn(serverTimeNs: bigint, prepareMs: number, renderMs: number): void;
  /** Called while the pointer drags a tool: new centre of its sphere [m]. */
  onToolMoved(tool: string, positionM: Vector): void;
  /** Called when the pointer comes over a tool, takes it, or leaves it. */
  onHand(hand: Hand): void;
  /** Called when the colours mean something else; null: they are those of the tissue. */
  onLegend(legend: Legend | null): void;
}

export class Viewer {
  readonly #canvas: HTMLCanvasElement;
  readonly #labels: HTMLElement;
  readonly #store: SceneStore;
  readonly #events: ViewerEvents;
  readonly #quality: Quality;
  readonly #studio: Studio;
  readonly #pixelRatioLimit: number;
  #pixelRatio: number;
  #pictureMs = (SLOW_PICTURE_MS + FAST_PICTURE_MS) / 2;
  #lastPictureMs: number | null = null;
  #tissue: Tissue | null = null;
  #instruments: Instruments | null = null;
  #forces: readonly ForceLabel[] = [];
  #revision = -1;
  #dirty = true;
  #settings: Settings;
  readonly #rulers = new Rulers();
  /** Values of the vertices that are shown as colours. */
  #values = new Float32Array(0);
  #range: Range | null = null;
  /** Tissue in the first frame [m]. The clip plane moves between its ends. */
  readonly #bounds = new THREE.Box3();
  #dragEnabled = false;
  #holdsSize = false;

  constructor(
    canvas: HTMLCanvasElement,
    labels: HTMLElement,
    store: SceneStore,
    quality: Quality,
    settings: Settings,
    events: ViewerEvents,
  ) {
    this.#settings = settings;
    this.#canvas = canvas;
    this.#labels = labels;
    this.#store = store;
    this.#events = events;
    this.#quality = quality;
    this.#studio = new Studio(canvas, quality);
    this.#pixelRatioLimit = Math.min(window.devicePixelRatio, 2);
    this.#pixelRatio = this.#pixelRatioLimit;
    this.#studio.controls.addEventListener("change", () => (this.#dirty = true));
    canvas.addEventListener("webglcontextrestored", () => (this.#dirty = true));
    new ResizeObserver(() => this.#resize()).observe(canvas);
    this.#resize();
    const loop = (nowMs: number) => {
      this.#update(nowMs);
      requestAnimationFrame(loop);
    };
    requestAnimationFrame(loop);
  }

  /** Shows the whole scene from the front. */
  resetView(): void {
    const { topology, frame } = this.#store;
    if (topology !== null && frame !== null) {
      this.#studio.frame(sceneBounds(topology, frame), topology.up);
      this.#dirty = true;
    }
  }

  /** Takes changed display options. */
  setDisplay(settings: Settings): void {
    if (settings.colouring !== this.#settings.colouring) {
      this.#range = null;
    }
    this.#settings = settings;
    this.#rulers.show(settings.rulers);
    this.#decorate();
    this.#dirty = true;
  }

  /** Colours again, after the values or their reference have changed. */
  recolour(): void {
    this.#range = null;
    this.#colour();
    this.#dirty = true;
  }

  /** Keeps the scene in the part of the canvas that panels leave free [CSS pixels from the top and from the bottom]. */
  cover(top: number, bottom: number): void {
    this.#studio.cover(top, bottom);
    this.#dirty = true;
  }

  /** Draws at full resolution and returns the canvas, which is valid until the next picture. */
  drawForPicture(): HTMLCanvasElement {
    const ratio = this.#pixelRatio;
    this.#pixelRatio = this.#pixelRatioLimit;
    this.#resize();
    this.#studio.render();
    this.#pixelRatio = ratio;
    const copy = document.createElement("canvas");
    copy.width = this.#canvas.width;
    copy.height = this.#canvas.height;
    copy.getContext("2d")!.drawImage(this.#canvas, 0, 0);
    this.#resize();
    return copy;
  }

  /** Keeps the resolution while a film runs, because some players show only its first size. */
  holdSize(holds: boolean): void {
    this.#holdsSize = holds;
  }

  /** Projects a point of the scene [m] to the canvas [CSS pixels]; null behind the camera. */
  project(point: Vector): { x: number; y: number } | null {
    return this.#studio.project(point);
  }

  /** Lets the pointer drag tools from now on. */
  enableDrag(): void {
    if (!this.#dragEnabled) {
      this.#dragEnabled = true;
      enableDrag(this.#canvas, this.#studio, {
        shapes: () => this.#shapes(),
        onMove: (tool, center) => this.#events.onToolMoved(tool, center),
        onHand: (hand) => this.#events.onHand(hand),
      });
    }
  }

  /** Shapes to drag. Empty once the topology has changed, although the old objects stay until the next picture. */
  #shapes(): THREE.Object3D[] {
    const current = this.#revision === this.#store.topologyRevision;
    return current && this.#instruments !== null ? this.#instruments.shapes() : [];
  }

  #update(nowMs: number): void {
    this.#studio.controls.update();
    if (this.#revision !== this.#store.topologyRevision) {
      this.#revision = this.#store.topologyRevision;
      this.#clear();
    }
    const frame = this.#store.takeFrame();
    const beganMs = performance.now();
    if (frame !== null && this.#store.topology !== null) {
      if (this.#tissue === null) {
        this.#build(frame);
      }
      this.#tissue?.update(frame.positions, frame.normals);
      this.#colour();
      this.#forces = this.#instruments?.update(frame) ?? [];
      this.#dirty = true;
    }
    if (!this.#dirty) {
      this.#lastPictureMs = null;
      return;
    }
    this.#dirty = false;
    const preparedMs = performance.now();
    this.#adapt(nowMs);
    if (this.#instruments !== null) {
      this.#instruments.group.visible = this.#settings.tools;
    }
    this.#studio.render();
    const renderedMs = performance.now();
    this.#rulers.draw(this.#studio.metresPerPx(), this.#studio.turn());
    this.#writeLabels();
    if (frame !== null) {
      this.#events.onDrawn(frame.serverTimeNs, preparedMs - beganMs, renderedMs - preparedMs);
    }
  }

  #build(frame: Frame): void {
    const topology = this.#store.topology!;
    const tissue = new THREE.Box3().setFromArray(frame.positions);
    const radiusM = Math.max(tissue.getBoundingSphere(new THREE.Sphere()).radius, 1e-6);
    this.#tissue = new Tissue(topology, frame.positions, radiusM, this.#quality);
    this.#instruments = new Instruments(topology, radiusM, this.#quality);
    this.#studio.world.add(this.#tissue.group, this.#instruments.group);
    this.#studio.frame(sceneBounds(topology, frame), topology.up);
    this.#bounds.copy(tissue);
    this.#decorate();
  }

  /** Applies the display options to the tissue. */
  #decorate(): void {
    this.#tissue?.showEdges(this.#settings.wireframe);
    this.#tissue?.showFixed(this.#settings.fixedNodes);
    this.#tissue?.clip(this.#clipPlane());
    this.#colour();
  }

  /** The plane that hides what lies beyond it, in the room's frame; null: nothing is hidden. */
  #clipPlane(): THREE.Plane | null {
    const { clipAxis, clipShare } = this.#settings;
    if (clipAxis === "none") {
      return null;
    }
    const normal = new THREE.Vector3();
    normal[clipAxis] = -1;
    // A little wider than the tissue at the start, so that both ends of the slider show all and nothing.
    const bounds = this.#bounds.clone().expandByScalar(0.02 * this.#bounds.getSize(new THREE.Vector3()).length());
    const place = bounds.min[clipAxis] + clipShare * (bounds.max[clipAxis] - bounds.min[clipAxis]);
    return new THREE.Plane(normal, place).applyMatrix4(this.#studio.world.matrixWorld);
  }

  /** Shows the chosen values as colours. Without values the tissue keeps its own. */
  #colour(): void {
    const { colouring } = this.#settings;
    const { frame, reference } = this.#store;
    if (this.#tissue === null) {
      return;
    }
    const values = colouring === "displacement" ? this.#displacements() : colouring === "tissue" ? null : this.#store.fieldValues(colouring);
    if (colouring === "tissue" || values === null || frame === null) {
      this.#tissue.colour(null, 0, 1);
      this.#events.onLegend(null);
      return;
    }
    this.#range = fitRange(values, KINDS[colouring].center, this.#range);
    this.#tissue.colour(values, this.#range.least, this.#range.most);
    const since = colouring === "displacement" ? (reference?.since ?? "") : "";
    this.#events.onLegend(legendOf(colouring, this.#range, since));
  }

  #displacements(): Float32Array | null {
    const { frame, reference } = this.#store;
    if (frame?.positions.length !== reference?.positions.length || frame === null || reference === null) {
      return null;
    }
    if (3 * this.#values.length !== frame.positions.length) {
      this.#values = new Float32Array(frame.positions.length / 3);
    }
    displacements(frame.positions, reference.positions, this.#values);
    return this.#values;
  }

  #clear(): void {
    this.#tissue?.dispose();
    this.#instruments?.dispose();
    this.#studio.world.clear();
    this.#tissue = null;
    this.#instruments = null;
    this.#forces = [];
    this.#range = null;
    this.#events.onLegend(null);
    this.#dirty = true;
  }

  #writeLabels(): void {
    this.#labels.replaceChildren(
      ...(this.#settings.tools ? this.#forces : []).flatMap(({ tool, magnitudeN, tipM }) => {
        const at = this.#studio.project(tipM);
        if (at === null) {
          return [];
        }
        const label = document.createElement("output");
        label.className = "force";
        label.dataset.tool = tool;
        label.textContent = `${magnitudeN.toFixed(2)} N`;
        label.style.transform = `translate(${at.x.toFixed(1)}px, ${at.y.toFixed(1)}px)`;
        return [label];
      }),
    );
  }

  #resize(): void {
    const { clientWidth, clientHeight } = this.#canvas;
    if (clientWidth > 0 && clientHeight > 0) {
      this.#studio.resize(clientWidth, clientHeight, this.#pixelRatio);
      this.#dirty = true;
    }
  }

  /**
   * Adapts the resolution to the cost of a picture. The GPU draws after `render` returns, so only the interval of
   * consecutive pictures shows that cost.
   */
  #adapt(nowMs: number): void {
    const last = this.#lastPictureMs;
    this.#lastPictureMs = nowMs;
    if (last === null || !this.#quality.adaptive || this.#holdsSize) {
      return;
    }
    this.#pictureMs += 0.1 * (nowMs - last - this.#pictureMs);
    const factor = this.#pictureMs > SLOW_PICTURE_MS ? 0.8 : this.#pictureMs < FAST_PICTURE_MS ? 1.25 : 1;
    const ratio = Math.min(this.#pixelRatioLimit, Math.max(LEAST_PIXEL_RATIO, factor * this.#pixelRatio));
    if (ratio !== this.#pixelRatio) {
      this.#pixelRatio = ratio;
      this.#pictureMs = (SLOW_PICTURE_MS + FAST_PICTURE_MS) / 2;
      this.#resize();
    }
  }
}
