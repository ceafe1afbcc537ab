// One scene and the connection that shows it: the gateway sends the streams of one scene on each WebSocket.
import type { MessageInitShape } from "@bufbuild/protobuf";

import type { SceneAdjustmentsSchema, SceneEditSchema } from "../generated/tensormass/v1/adjustment_pb";
import type { Finding as FindingMessage } from "../generated/tensormass/v1/finding_pb";
import type { ClockReply, CommandResult, DaemonState, PlayHead } from "../generated/tensormass/v1/gateway_pb";
import { linkSituation, recordingSituation, sceneSituation, type Situation } from "../situation";
import { decodeChanges } from "./changes";
import { GatewayClock } from "./clock";
import { Connection, type Diagnosis, type FrameChoice, type LinkState } from "./connection";
import {
  SceneState,
  decodeField,
  decodeFrame,
  decodeStatus,
  decodeTopology,
  slotOf,
  splitMessage,
  type BusMessage,
  type Frame,
  type Status,
  type StreamName,
  type ToolState,
} from "./decode";
import { FrameDecoder } from "./encoded";
import { decodeEvents, type SceneEvent } from "./events";
import { History } from "./history";
import { Pace } from "./pace";
import type { Finding } from "./findings";
import { SceneStore, type Counters } from "./store";
import type { Command } from "./texts";

type Adjustments = MessageInitShape<typeof SceneAdjustmentsSchema>;
type SceneEdit = MessageInitShape<typeof SceneEditSchema>;

/** How long a recovery shows after its last step [ms]. Most last for a few steps, which nobody would see. */
export const RECOVERY_SHOWS_MS = 1500;

export interface SessionEvents {
  /** Called with each state of the daemon: scenes may have come or gone. */
  onDaemon(): void;
  /** Called when `situation` may have changed. */
  onChange(): void;
  onFrame(): void;
  /** Called when the values that are shown as colours have changed other than by a frame. */
  onValues(): void;
}

export interface SessionOptions {
  /** Address of the WebSocket. */
  readonly url: string;
  readonly events: SessionEvents;
  readonly WebSocket?: typeof WebSocket;
  /** Called when a connection did not open; returns why. */
  readonly diagnose: () => Promise<Diagnosis>;
}

export interface Readings {
  readonly status: Status | null;
  /** `status` while its numbers are current, else null. */
  readonly currentStatus: Status | null;
  readonly findings: readonly Finding[];
  readonly events: readonly SceneEvent[];
  readonly counters: Counters;
  readonly drawRateHz: number | null;
  readonly ageMs: number | null;
  readonly ageUncertaintyMs: number | null;
  readonly replaced: number;
  /** Largest error of the positions on show; null: no frame. */
  readonly errorM: number | null;
}

export class Session {
  readonly store = new SceneStore();
  readonly history = new History();
  readonly pace = new Pace();
  readonly #events: SessionEvents;
  readonly #connection: Connection;
  readonly #frameDecoder = new FrameDecoder();
  readonly #clock = new GatewayClock();
  readonly #commands = new Set<Promise<CommandResult>>();
  #daemon: DaemonState | null = null;
  #head: PlayHead | null = null;
  #scene: string | null = null;
  #watched: string | null = null;
  #watchedSinceMs = 0;
  #link: Situation = { tone: "waiting", text: "Connecting", notice: null };
  /** The element field to show as colours; null: none. */
  #field: string | null = null;
  /** The element field that the gateway was asked for. */
  #askedField: string | null = null;
  #valuesRevision = 0;
  /** When a frame or status of a recovery last came. */
  #recoveredAtMs = -Infinity;
  #replaced = 0;
  /** The share of triangles that was asked for; undefined: that of the address. */
  #detail: number | undefined;
  #decoded = { bytes: 0, decodeMs: 0 };

  constructor({ events, ...options }: SessionOptions) {
    this.#events = events;
    this.#connection = new Connection({
      ...options,
      events: {
        onLink: (state) => this.#onLink(state),
        onDaemon: (state) => this.#onDaemon(state),
        onHead: (head) => this.#onHead(head),
        onMessage: (data) => this.#onMessage(data),
        onClock: (reply, receivedMs) => this.#onClock(reply, receivedMs),
      },
    });
  }

  /** The daemon's state; null without a connection. */
  get daemon(): DaemonState | null {
    return this.#daemon;
  }

  /** The play head of a recording; null before the first message about it. */
  get head(): PlayHead | null {
    return this.#head;
  }

  /** Name of the scene to show; null: none is chosen. */
  get scene(): string | null {
    return this.#scene;
  }

  /** Name of the scene on show; null while the daemon does not have `scene`. */
  get watched(): string | null {
    return this.#watched;
  }

  /** Whether the gateway knows the elements of the scene on show. */
  get hasFields(): boolean {
    return this.#watched !== null && this.#daemon?.fieldScenes.includes(this.#watched) === true;
  }

  /** Whether to show that the scene recovers from a step that could not be made as planned. */
  get recovering(): boolean {
    if (this.store.status?.state === SceneState.FAULTED) {
      return false;
    }
    // A scene that stands still in a recovery goes on showing it.
    return recovers(this.store.frame) || performance.now() - this.#recoveredAtMs < RECOVERY_SHOWS_MS;
  }

  /** The state of scene and connection in words. */
  get situation(): Situation {
    const daemon = this.#daemon;
    if (daemon === null) {
      return this.#link;
    }
    return daemon.recording === undefined
      ? sceneSituation(daemon, this.#scene, this.#watched, this.store)
      : recordingSituation(daemon.recording, this.#head, this.store);
  }

  /** Shows this scene as soon as the daemon has it. */
  show(scene: string | null): void {
    this.#scene = scene;
    this.#watch();
  }

  /** Asks for the values of an element field as soon as the gateway knows it; null: no field any more. */
  showField(field: string | null): void {
    this.#field = field;
    this.#askForField();
  }

  /**
   * Asks for other frames from now on. Displacements that the user set to zero belong to the vertices on show, so the
   * detail stays while they count.
   */
  chooseFrames({ detail, ...choice }: FrameChoice): void {
    const kept = this.store.reference?.kind === "chosen" ? this.#detail : detail;
    this.#detail = kept;
    this.#connection.chooseFrames(kept === undefined ? choice : { ...choice, detail: kept });
  }

  /** Takes that the newest frame was drawn. */
  drawn(serverTimeNs: bigint, prepareMs: number, renderMs: number): void {
    const atMs = performance.now();
    const live = this.store.followsAnother && this.#daemon !== null && this.#daemon.recording === undefined;
    this.pace.add({ atMs, ...this.#decoded, prepareMs, renderMs }, live ? this.#clock.ageMs(serverTimeNs, atMs) : null);
  }

  readings(): Readings {
    const { store, pace } = this;
    const nowMs = performance.now();
    return {
      status: store.status,
      currentStatus: store.currentStatus,
      findings: store.findings.list(),
      events: store.events,
      counters: store.counters,
      drawRateHz: store.topology === null ? null : pace.rateHz(nowMs),
      ageMs: pace.ageMs(nowMs),
      ageUncertaintyMs: this.#clock.uncertaintyMs(),
      // The gateway may have replaced frames before one that is not drawn yet, so the count is bounded by `dropped`.
      replaced: Math.min(this.#replaced, store.counters.dropped),
      errorM: store.frame?.errorM ?? null,
    };
  }

  /** Sends a command. Fails with the reason of the gateway or the daemon. */
  async control(command: Command): Promise<CommandResult> {
    const answer = this.#connection.control(command);
    this.#commands.add(answer);
    try {
      return await answer;
    } finally {
      this.#commands.delete(answer);
    }
  }

  /** Changes values of a scene and returns all of them. */
  async adjust(scene: string, changes: Adjustments): Promise<Adjustments> {
    return (await this.control({ action: "adjust", scene, changes })).adjustments ?? {};
  }

  /** Adds tools to a scene or takes them from it. Returns findings that concern new ones. */
  async edit(scene: string, edit: SceneEdit): Promise<readonly FindingMessage[]> {
    return (await this.control({ action: "edit", scene, edit })).findings;
  }

  /** @param level Share of its power that the tool uses, 0 to 1. */
  moveTool(pose: Pick<ToolState, "name" | "positionM" | "orientationWxyz">, level = 0): void {
    this.#connection.moveTool(pose, level);
  }

  setPaused(paused: boolean): void {
    this.#connection.setPaused(paused);
  }

  /** Ends the connection. Commands that are under way get their answers first. */
  close(): void {
    void Promise.allSettled(this.#commands).then(() => this.#connection.close());
  }

  #onLink(state: LinkState): void {
    this.#frameDecoder.reset();
    if (state.kind === "lost" || state.kind === "refused") {
      this.#forget();
      this.#daemon = null;
    }
    const situation = linkSituation(state);
    if (situation !== null) {
      this.#link = situation;
      this.#events.onChange();
    }
  }

  #onDaemon(state: DaemonState): void {
    this.#daemon = state;
    this.#watch();
    this.#events.onDaemon();
    this.#events.onChange();
  }

  #onHead(head: PlayHead): void {
    this.#head = head;
    this.#events.onChange();
  }

  #watch(): void {
    if (this.#daemon === null) {
      return;
    }
    const target = this.#daemon.scenes.find((scene) => scene === this.#scene);
    if (target === undefined) {
      this.#forget();
    } else if (target !== this.#watched) {
      this.#forget();
      this.#watched = target;
      this.#watchedSinceMs = performance.now();
      this.#connection.watch(target);
      this.#askedField = null;
    }
    this.#askForField();
  }

  /** Forgets the scene on show. After a reload or a restart the same name may be another scene. */
  #forget(): void {
    this.#watched = null;
    this.#replaced = 0;
    this.#recoveredAtMs = -Infinity;
    this.store.clear();
    this.history.clear();
  }

  #askForField(): void {
    const next = this.hasFields ? this.#field : null;
    if (next !== this.#askedField) {
      this.#askedField = next;
      this.#connection.showField(next);
    }
  }

  #onMessage(data: ArrayBuffer): void {
    let stream: StreamName | null = null;
    try {
      const message = splitMessage(data);
      stream = message.stream;
      // A message of the previous scene may still be under way. It is acknowledged but not shown.
      if (message.scene === this.#watched) {
        this.#take(message);
      }
    } catch (error) {
      const reason = error instanceof Error ? error.message : String(error);
      console.warn(reason);
      this.store.refuse(reason, stream);
    }
    if (stream !== null) {
      this.#connection.acknowledge(stream, slotOf(stream) === "frame" ? this.#frameDecoder.keyframe : null);
    }
    if (this.#valuesRevision !== this.store.valuesRevision) {
      this.#valuesRevision = this.store.valuesRevision;
      this.#events.onValues();
    }
  }

  #take(message: BusMessage): void {
    const { store, history } = this;
    switch (message.stream) {
      case "topology":
      case "simplified_topology":
        store.setTopology(decodeTopology(message.payload, message.stream));
        break;
      case "frame":
      case "encoded_frame": {
        const frame = this.#decodeAndTime(message);
        store.setFrame(frame);
        this.#noteRecovery(recovers(frame));
        history.addFrame(frame, store.topology!);
        this.#events.onFrame();
        break;
      }
      case "changes":
        store.setChanges(decodeChanges(message.payload, store.topology), this.#daemon?.recording !== undefined);
        this.#events.onChange();
        break;
      case "events":
        store.setEvents(decodeEvents(message.payload));
        break;
      case "rest":
        store.setRest(decodeFrame(message.payload));
        break;
      case "field":
        store.setField(decodeField(message.payload));
        break;
      case "status":
        store.setStatus(decodeStatus(message.payload));
        if (store.status !== null) {
          // The daemon sends one as a recovery begins. Frames may miss it.
          this.#noteRecovery(store.status.recovering);
          history.addStatus(store.status);
        }
        this.#events.onChange();
        break;
    }
  }

  #noteRecovery(recovering: boolean): void {
    if (recovering) {
      this.#recoveredAtMs = performance.now();
    }
  }

  #decodeAndTime({ stream, payload }: BusMessage): Frame {
    const beganMs = performance.now();
    const frame = this.#frameDecoder.decode(stream, payload);
    this.#decoded = { bytes: payload.length, decodeMs: performance.now() - beganMs };
    return frame;
  }

  #onClock(reply: ClockReply, receivedMs: number): void {
    this.#clock.add(reply.clientTimeMs, receivedMs, reply.gatewayTimeMs);
    // A request sent before the change of scene counts frames of the previous scene.
    if (this.#watched !== null && reply.clientTimeMs >= this.#watchedSinceMs) {
      this.#replaced = reply.replaced;
    }
  }
}

function recovers(frame: Frame | null): boolean {
  return frame?.tools.some(({ recovering }) => recovering) ?? false;
}
