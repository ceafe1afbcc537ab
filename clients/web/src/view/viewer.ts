// Draws what the store holds: rebuilds objects when the topology changes, moves them with every frame, and draws only
// when something moved.
import * as THREE from "three";

import type { SceneStore } from "../stream/store";
import type { Vector } from "../stream/decode";
import { enableDrag } from "./drag";
import { Instruments, type ForceLabel } from "./instruments";
import { Studio } from "./studio";
import { Tissue } from "./tissue";

/** Longer frames than this make the picture coarser, shorter ones finer [ms]. */
const SLOW_FRAME_MS = 45;
const FAST_FRAME_MS = 18;
const LEAST_PIXEL_RATIO = 0.6;

export interface ViewerEvents {
  /** A new frame is on the screen. */
  onDrawn(serverTimeNs: bigint): void;
  /** The pointer drags a tool to this place [m]. */
  onToolMoved(tool: string, positionM: Vector): void;
}

export class Viewer {
  readonly #canvas: HTMLCanvasElement;
  readonly #labels: HTMLElement;
  readonly #store: SceneStore;
  readonly #events: ViewerEvents;
  readonly #studio: Studio;
  readonly #pixelRatioLimit: number;
  #pixelRatio: number;
  #drawMs = (SLOW_FRAME_MS + FAST_FRAME_MS) / 2;
  #tissue: Tissue | null = null;
  #instruments: Instruments | null = null;
  #forces: readonly ForceLabel[] = [];
  #revision = -1;
  #dirty = true;
  #dragEnabled = false;

  constructor(canvas: HTMLCanvasElement, labels: HTMLElement, store: SceneStore, events: ViewerEvents) {
    this.#canvas = canvas;
    this.#labels = labels;
    this.#store = store;
    this.#events = events;
    this.#studio = new Studio(canvas);
    this.#pixelRatioLimit = Math.min(window.devicePixelRatio, 2);
    this.#pixelRatio = this.#pixelRatioLimit;
    this.#studio.controls.addEventListener("change", () => (this.#dirty = true));
    new ResizeObserver(() => this.#resize()).observe(canvas);
    this.#resize();
    const loop = () => {
      this.#update();
      requestAnimationFrame(loop);
    };
    requestAnimationFrame(loop);
  }

  resetView(): void {
    this.#studio.resetView();
    this.#dirty = true;
  }

  /** Where a point of the scene [m] is on the canvas [CSS pixels]; null behind the camera. */
  project(point: Vector): { x: number; y: number } | null {
    return this.#studio.project(point);
  }

  /** From now on the pointer can take tools. */
  enableDrag(): void {
    if (!this.#dragEnabled) {
      this.#dragEnabled = true;
      enableDrag(this.#canvas, this.#studio, {
        spheres: () => this.#instruments?.spheres() ?? [],
        onMove: (tool, center) => this.#events.onToolMoved(tool, center),
      });
    }
  }

  #update(): void {
    this.#studio.controls.update();
    if (this.#revision !== this.#store.topologyRevision) {
      this.#revision = this.#store.topologyRevision;
      this.#clear();
    }
    const frame = this.#store.takeFrame();
    if (frame !== null && this.#store.topology !== null) {
      if (this.#tissue === null) {
        this.#build(frame.positions);
      }
      this.#tissue?.update(frame.positions);
      this.#forces = this.#instruments?.update(frame) ?? [];
      this.#dirty = true;
    }
    if (!this.#dirty) {
      return;
    }
    this.#dirty = false;
    const begin = performance.now();
    this.#studio.render();
    this.#writeLabels();
    if (frame !== null) {
      this.#events.onDrawn(frame.serverTimeNs);
    }
    this.#adapt(performance.now() - begin);
  }

  #build(positions: Float32Array): void {
    const topology = this.#store.topology!;
    const bounds = new THREE.Box3().setFromArray(positions);
    const radiusM = Math.max(bounds.getBoundingSphere(new THREE.Sphere()).radius, 1e-6);
    this.#tissue = new Tissue(topology, positions, radiusM);
    this.#instruments = new Instruments(topology, radiusM);
    this.#studio.world.add(this.#tissue.group, this.#instruments.group);
    this.#studio.frame(bounds, topology.up);
  }

  #clear(): void {
    this.#tissue?.dispose();
    this.#instruments?.dispose();
    this.#studio.world.clear();
    this.#tissue = null;
    this.#instruments = null;
    this.#forces = [];
    this.#dirty = true;
  }

  #writeLabels(): void {
    this.#labels.replaceChildren(
      ...this.#forces.flatMap(({ tool, magnitudeN, tipM }) => {
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

  #adapt(drawMs: number): void {
    this.#drawMs += 0.1 * (drawMs - this.#drawMs);
    const factor = this.#drawMs > SLOW_FRAME_MS ? 0.8 : this.#drawMs < FAST_FRAME_MS ? 1.25 : 1;
    const ratio = Math.min(this.#pixelRatioLimit, Math.max(LEAST_PIXEL_RATIO, factor * this.#pixelRatio));
    if (ratio !== this.#pixelRatio) {
      this.#pixelRatio = ratio;
      this.#drawMs = (SLOW_FRAME_MS + FAST_FRAME_MS) / 2;
      this.#resize();
    }
  }
}
