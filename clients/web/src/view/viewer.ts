// The picture of one scene. Rebuilds the objects when the topology changes, and moves them with every frame.
import * as THREE from "three";

import { find, setText } from "../dom";
import type { Changes } from "../stream/changes";
import type { SceneStore } from "../stream/store";
import type { Frame, Topology, Vector } from "../stream/decode";
import type { Settings } from "../panel/settings";
import { sceneBounds } from "./bounds";
import { KINDS, displacements, fitRange, legendOf, type Legend, type Range } from "./colouring";
import { enableDrag } from "./drag";
import type { Hand } from "./hand";
import { Instruments, type ForceLabel } from "./instruments";
import { Rulers } from "./rulers";
import type { Picture, Stage } from "./stage";
import { Strands } from "./strands";
import { Studio } from "./studio";
import { Tissue } from "./tissue";

/** Time in which a tool that was removed fades out [ms]. */
const FADE_MS = 700;

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
  /** Called when the pointer comes over a tool, takes it, or leaves it; then `tool` is null. */
  onHand(hand: Hand, tool: string | null): void;
  /** Called when the colours mean something else; null: they are those of the tissue. */
  onLegend(legend: Legend | null): void;
}

export class Viewer implements Picture {
  readonly element: HTMLElement;
  readonly #labels: HTMLElement;
  readonly #rulers: Rulers;
  readonly #store: SceneStore;
  readonly #events: ViewerEvents;
  readonly #stage: Stage;
  readonly #studio: Studio;
  #tissue: Tissue | null = null;
  #strands: Strands | null = null;
  #instruments: Instruments | null = null;
  /** Tools that were removed and fade out, since when. Not in the picture yet while `sinceMs` is null. */
  #leaving: { readonly instruments: Instruments; sinceMs: number | null } | null = null;
  #forces: readonly ForceLabel[] = [];
  #revision = -1;
  /** Changes of the surface that the objects show. */
  #changes: Changes | null = null;
  #dirty = true;
  /** The frame that is prepared but not drawn yet. */
  #prepared: { serverTimeNs: bigint; ms: number } | null = null;
  #settings: Settings;
  /** Values of the vertices that are shown as colours. */
  #values = new Float32Array(0);
  #range: Range | null = null;
  /** Tissue in the first frame [m]. The clip plane moves between its ends. */
  readonly #bounds = new THREE.Box3();
  #radiusM = 1;
  /** Version of the scene that the camera was placed for; null: none. */
  #framed: bigint | null = null;
  #dragEnabled = false;

  /** @param element A tile of index.html. */
  constructor(element: HTMLElement, stage: Stage, store: SceneStore, settings: Settings, events: ViewerEvents) {
    this.element = element;
    this.#labels = find(".labels", HTMLElement, element);
    this.#rulers = new Rulers(element);
    this.#settings = settings;
    this.#store = store;
    this.#events = events;
    this.#stage = stage;
    this.#studio = new Studio(element, stage);
    this.#studio.controls.addEventListener("change", () => (this.#dirty = true));
    stage.add(this);
  }

  get scene(): THREE.Scene {
    return this.#studio.scene;
  }

  get camera(): THREE.Camera {
    return this.#studio.camera;
  }

  /** Number of springs that are drawn. */
  get strandCount(): number {
    return this.#strands?.count ?? 0;
  }

  resize(width: number, height: number): void {
    this.#studio.resize(width, height);
  }

  /** Shows the whole scene from the front. */
  resetView(): void {
    const { topology, frame } = this.#store;
    if (topology !== null && frame !== null) {
      this.#studio.frame(sceneBounds(topology, frame), topology.up);
      this.#dirty = true;
    }
  }

  /** Draws anew at the stage's level. The camera stays. */
  setLevel(): void {
    this.#studio.setLevel(this.#stage);
    const { topology, frame } = this.#store;
    if (this.#tissue !== null && topology !== null && frame !== null && this.#revision === this.#store.topologyRevision) {
      this.#freeObjects();
      this.#build(topology, frame);
      this.#move(frame);
    }
    this.#dirty = true;
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

  /** Keeps the scene in the part of the picture that panels leave free [CSS pixels from the top and from the bottom]. */
  cover(top: number, bottom: number): void {
    this.#studio.cover(top, bottom);
    this.#dirty = true;
  }

  /** Returns the picture at full resolution. */
  copy(): HTMLCanvasElement {
    return this.#stage.copyOf(this);
  }

  /** Projects a point of the scene [m] to the picture [CSS pixels]; null behind the camera. */
  project(point: Vector): { x: number; y: number } | null {
    return this.#studio.project(point);
  }

  /** Lets the pointer drag tools from now on. */
  enableDrag(): void {
    if (!this.#dragEnabled) {
      this.#dragEnabled = true;
      enableDrag(this.element, this.#studio, {
        shapes: () => this.#shapes(),
        onMove: (tool, center) => this.#events.onToolMoved(tool, center),
        onHand: (hand, tool) => this.#events.onHand(hand, tool),
      });
    }
  }

  update(): boolean {
    this.#studio.controls.update();
    if (this.#revision !== this.#store.topologyRevision) {
      this.#revision = this.#store.topologyRevision;
      this.#clear();
    }
    const frame = this.#store.takeFrame();
    const beganMs = performance.now();
    if (frame !== null && this.#store.topology !== null) {
      if (this.#tissue === null) {
        this.#build(this.#store.topology, frame);
      }
      this.#move(frame);
      this.#prepared = { serverTimeNs: frame.serverTimeNs, ms: performance.now() - beganMs };
      this.#dirty = true;
    }
    if (frame === null && this.#tissue !== null && this.#store.frame !== null && this.#changes !== this.#store.changes) {
      this.#move(this.#store.frame); // the scene stands still
      this.#dirty = true;
    }
    if (this.#instruments !== null) {
      this.#instruments.group.visible = this.#settings.tools;
    }
    this.#fade();
    const changed = this.#dirty;
    this.#dirty = false;
    return changed;
  }

  drawn(renderMs: number): void {
    this.#rulers.draw(this.#studio.metresPerPx(), this.#studio.turn());
    this.#writeLabels();
    if (this.#prepared !== null) {
      this.#events.onDrawn(this.#prepared.serverTimeNs, this.#prepared.ms, renderMs);
      this.#prepared = null;
    }
  }

  dispose(): void {
    this.#stage.remove(this);
    this.#clear();
    this.#dropLeaving();
    this.#studio.dispose();
  }

  /** Shapes to drag. Empty once the topology has changed, although the old objects stay until the next picture. */
  #shapes(): THREE.Object3D[] {
    const current = this.#revision === this.#store.topologyRevision;
    return current && this.#instruments !== null ? this.#instruments.shapes() : [];
  }

  #build(topology: Topology, frame: Frame): void {
    // The same scene in another detail, or with other tools or attachments, keeps its place in the picture.
    if (this.#store.sceneVersion !== this.#framed) {
      this.#dropLeaving();
      this.#framed = this.#store.sceneVersion;
      this.#bounds.setFromArray(frame.positions);
      this.#radiusM = Math.max(this.#bounds.getBoundingSphere(new THREE.Sphere()).radius, 1e-6);
      this.#studio.frame(sceneBounds(topology, frame), topology.up);
    }
    const [radiusM, { level }] = [this.#radiusM, this.#stage];
    this.#tissue = new Tissue(topology, frame.positions, radiusM, level, () => (this.#dirty = true));
    this.#instruments = new Instruments(topology, radiusM, level);
    this.#studio.world.add(this.#tissue.group, this.#instruments.group);
    this.#startLeaving(topology);
    if (topology.attachments.length > 0) {
      this.#strands = new Strands(topology, radiusM);
      this.#studio.world.add(this.#strands.mesh);
    }
    this.#decorate();
  }

  /** Moves the objects to where a frame has them. */
  #move(frame: Frame): void {
    if (this.#changes !== this.#store.changes) {
      this.#changes = this.#store.changes;
      this.#tissue?.change(this.#changes);
    }
    this.#tissue?.update(frame.positions, frame.normals);
    this.#strands?.update(frame);
    this.#colour();
    this.#forces = this.#instruments?.update(frame) ?? [];
  }

  /** Applies the display options to tissue and attachments. */
  #decorate(): void {
    this.#tissue?.showEdges(this.#settings.wireframe);
    this.#tissue?.showFixed(this.#settings.fixedNodes);
    this.#tissue?.clip(this.#clipPlane());
    this.#strands?.show(this.#settings.attachments);
    this.#strands?.clip(this.#clipPlane());
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
    const { frame, reference, topology } = this.#store;
    if (frame === null || reference === null || topology === null) {
      return null;
    }
    // Appended vertices have no place to count from.
    const count = topology.vertexCount;
    if (this.#values.length !== count) {
      this.#values = new Float32Array(count);
    }
    displacements(frame.positions.subarray(0, 3 * count), reference.positions.subarray(0, 3 * count), this.#values);
    return this.#values;
  }

  #freeObjects(): void {
    this.#tissue?.dispose();
    this.#strands?.dispose();
    this.#instruments?.dispose();
    this.#studio.world.clear();
    this.#tissue = null;
    this.#strands = null;
    this.#instruments = null;
    this.#changes = null;
  }

  /** Lets the tools that the scene has no more fade from now on, unless they fade already. */
  #startLeaving(topology: Topology): void {
    const leaving = this.#leaving;
    if (leaving === null) {
      return;
    }
    this.#studio.world.add(leaving.instruments.group);
    if (leaving.sinceMs === null) {
      if (leaving.instruments.keepRemoved(topology)) {
        leaving.sinceMs = performance.now();
      } else {
        this.#dropLeaving();
      }
    }
  }

  #fade(): void {
    const leaving = this.#leaving;
    if (leaving === null || leaving.sinceMs === null) {
      return;
    }
    const share = (performance.now() - leaving.sinceMs) / FADE_MS;
    if (share >= 1) {
      this.#dropLeaving();
    } else {
      leaving.instruments.group.visible = this.#settings.tools;
      leaving.instruments.fade(1 - share);
    }
    this.#dirty = true;
  }

  #dropLeaving(): void {
    this.#leaving?.instruments.group.removeFromParent();
    this.#leaving?.instruments.dispose();
    this.#leaving = null;
  }

  #clear(): void {
    if (this.#instruments !== null) {
      this.#dropLeaving();
      this.#leaving = { instruments: this.#instruments, sinceMs: null };
      this.#instruments = null;
    }
    this.#freeObjects();
    this.#forces = [];
    this.#range = null;
    this.#events.onLegend(null);
    this.#dirty = true;
  }

  #writeLabels(): void {
    const shown = (this.#settings.tools ? this.#forces : []).flatMap(({ tool, magnitudeN, tipM }) => {
      const at = this.#studio.project(tipM);
      return at === null ? [] : [{ tool, magnitudeN, at }];
    });
    const labels = this.#labels;
    while (labels.childElementCount > shown.length) {
      labels.lastElementChild!.remove();
    }
    shown.forEach(({ tool, magnitudeN, at }, index) => {
      // A label that only moves is not painted again.
      const label = (labels.children[index] as HTMLElement | undefined) ?? labels.appendChild(document.createElement("output"));
      label.className = "force";
      label.dataset.tool = tool;
      setText(label, `${magnitudeN.toFixed(2)} N`);
      label.style.transform = `translate(${at.x.toFixed(1)}px, ${at.y.toFixed(1)}px)`;
    });
  }
}
