// A tile of the page: one scene with its connection, its picture and its elements.
import type { Address } from "../address";
import { find, setText } from "../dom";
import { LegendPanel } from "../panel/legend";
import { savePicture } from "../panel/picture";
import type { Settings } from "../panel/settings";
import type { Vector } from "../stream/decode";
import { Session } from "../stream/session";
import { colourTable } from "../view/colouring";
import { hintOf, type Hand } from "../view/hand";
import type { Stage } from "../view/stage";
import { originFor } from "../view/tip";
import { Viewer } from "../view/viewer";

export interface TileEvents {
  onDaemon(tile: Tile): void;
  onChange(tile: Tile): void;
  onFrame(tile: Tile): void;
  /** Called when the pointer or Enter picks the tile. */
  onPick(tile: Tile): void;
  /** Called when a double-click asks for the tile alone. */
  onOpen(tile: Tile): void;
  /** Called when the pointer comes over a tool, takes it, or leaves it. */
  onHand(tile: Tile): void;
}

/** Well below the time for which the gateway lets a pose with power hold. */
const PEDAL_INTERVAL_MS = 100;

export class Tile {
  readonly element: HTMLElement;
  readonly session: Session;
  readonly viewer: Viewer;
  readonly #name: HTMLElement;
  readonly #recovery: HTMLElement;
  readonly #pill: HTMLElement;
  #hand: { readonly hand: Hand; readonly tool: string | null } = { hand: "away", tool: null };
  /** The tool that was moved last, and where to. */
  #moved: { readonly tool: string; readonly centerM: Vector } | null = null;
  /** The timer that repeats poses while the pedal is down; null: it is up. */
  #pedal: ReturnType<typeof setInterval> | null = null;

  constructor(stage: Stage, address: Address, settings: Settings, events: TileEvents) {
    const template = find("#tile", HTMLTemplateElement).content;
    this.element = find(".tile", HTMLElement, document.importNode(template, true));
    this.#name = find(".name", HTMLElement, this.element);
    this.#recovery = find(".recovery", HTMLElement, this.element);
    this.#pill = find(".state", HTMLElement, this.element);
    find("#tiles", HTMLElement).append(this.element);
    const legend = new LegendPanel(this.element);
    this.session = new Session({
      url: address.stream,
      diagnose: () => address.diagnose(),
      events: {
        onDaemon: () => {
          if (this.session.daemon?.posesAllowed === true) {
            this.viewer.enableDrag();
          }
          events.onDaemon(this);
        },
        onChange: () => events.onChange(this),
        onFrame: () => events.onFrame(this),
        onValues: () => this.viewer.recolour(),
      },
    });
    this.viewer = new Viewer(this.element, stage, this.session.store, settings, {
      onDrawn: (serverTimeNs, prepareMs, renderMs) => this.session.drawn(serverTimeNs, prepareMs, renderMs),
      onToolMoved: (tool, centerM) => {
        this.#moved = { tool, centerM };
        this.#sendPose();
      },
      onHand: (hand, tool) => {
        this.element.dataset.hand = hand;
        this.#hand = { hand, tool };
        events.onHand(this);
      },
      onLegend: (meaning) => legend.show(meaning),
    });
    this.setDisplay(settings);
    this.element.addEventListener("pointerdown", () => events.onPick(this), { capture: true });
    this.element.addEventListener("dblclick", () => events.onOpen(this));
    this.element.addEventListener("keydown", ({ key }) => key === "Enter" && events.onPick(this));
  }

  /** Shows name, state and selection. @param inGrid Whether the tile is one of a grid, which the keyboard can reach. */
  show(selected: boolean, inGrid: boolean): void {
    const { tone, text, hint, notice } = this.session.situation;
    const name = this.session.scene ?? "";
    setText(this.#name, name);
    this.element.ariaLabel = `Scene ${name}. Drag to orbit, right-drag to pan, wheel to zoom.`;
    setText(this.#pill, text);
    this.#pill.dataset.tone = tone;
    this.#pill.title = hint ?? notice?.detail ?? "";
    this.#recovery.hidden = !this.session.recovering;
    this.element.tabIndex = inGrid ? 0 : -1;
    this.element.ariaCurrent = String(inGrid && selected);
  }

  /** The words for what the pointer does with a tool of this tile; null: nothing. */
  get handHint(): string | null {
    const state = this.session.store.frame?.tools.find(({ name }) => name === this.#hand.tool);
    return state === undefined ? null : hintOf(this.#hand.hand, state.claimedBy);
  }

  setDisplay(settings: Settings): void {
    const { colouring } = settings;
    this.viewer.setDisplay(settings);
    this.session.showField(colouring === "tissue" || colouring === "displacement" ? null : colouring);
  }

  /** Saves the picture as a file named after the scene and its time. */
  takePicture(): void {
    savePicture(this.viewer.copy(), this.element, colourTable(), this.fileName());
  }

  /** Name of a picture or film without its ending. */
  fileName(): string {
    const { store, watched } = this.session;
    const time = store.frame === null ? "" : `-${store.frame.simulatedTimeS.toFixed(2)}s`;
    return `tensormass-${watched ?? "empty"}${time}`;
  }

  /** Projects a point of the scene [m] to the page [CSS pixels]; null behind the camera. */
  project(point: Vector): { x: number; y: number } | null {
    const at = this.viewer.project(point);
    const { left, top } = this.element.getBoundingClientRect();
    return at === null ? null : { x: left + at.x, y: top + at.y };
  }

  /** Presses or releases the pedal: the tool that was moved last burns with its whole power, if it has some. */
  setPedal(down: boolean): void {
    if (down === (this.#pedal !== null)) {
      return;
    }
    if (this.#pedal !== null) {
      clearInterval(this.#pedal);
    }
    this.#pedal = down ? setInterval(() => this.#sendPose(), PEDAL_INTERVAL_MS) : null;
    this.#sendPose();
  }

  close(): void {
    this.setPedal(false);
    this.session.close();
    this.viewer.dispose();
    this.element.remove();
  }

  /** Sends the pose that brings the moved tool's sphere to its place and keeps the tool's orientation. */
  #sendPose(): void {
    if (this.#moved === null) {
      return;
    }
    const { tool: name, centerM } = this.#moved;
    const { topology, frame } = this.session.store;
    const shape = topology?.tools.find((tool) => tool.name === name);
    const state = frame?.tools.find((tool) => tool.name === name);
    if (shape !== undefined && state !== undefined) {
      const level = this.#pedal !== null && shape.burns ? 1 : 0;
      this.session.moveTool({ ...state, positionM: originFor(shape, state, centerM) }, level);
    }
  }
}
