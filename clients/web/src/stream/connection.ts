// The WebSocket to the gateway: opens, watches a scene, acknowledges, asks for the clock, and reconnects after a loss.
import { slotOf, type StreamName, type ToolState } from "./decode";

/** Something that happened at a time of a recording. */
export interface Mark {
  readonly timeS: number;
  /** contact, guard, recovery, reset or stop */
  readonly kind: string;
  readonly text: string;
}

/** A recording that the gateway shows in place of a daemon. */
export interface Recording {
  readonly file: string;
  readonly durationS: number;
  /** Number of recorded frames. */
  readonly frames: number;
  readonly marks: readonly Mark[];
  /** Why the recording ends early or cannot be read; empty: neither. */
  readonly note: string;
}

/** The play head of a recording, which all pages share. */
export interface Head {
  readonly timeS: number;
  /** Frame on show, counted from 0. */
  readonly frame: number;
  readonly playing: boolean;
  readonly speed: number;
}

/** The gateway's view of the daemon. */
export interface DaemonState {
  /** Why there are no streams; empty while the gateway reaches the daemon. */
  readonly problem: string;
  readonly server: string;
  readonly version: string;
  readonly backend: string;
  readonly device: string;
  readonly posesAllowed: boolean;
  /** Whether this page may control scenes. */
  readonly operator: boolean;
  /** Names of the scenes that an operator can load. */
  readonly builtinScenes: readonly string[];
  /** Loaded scenes whose element fields the gateway can show. */
  readonly fieldScenes: readonly string[];
  readonly scenes: readonly string[];
  /** null: the gateway shows running scenes. */
  readonly recording: Recording | null;
}

export interface ClockReply {
  readonly clientTimeMs: number;
  readonly gatewayTimeMs: number;
  /** Frames of the watched scene that the gateway replaced by newer ones. */
  readonly replaced: number;
}

export interface CommandResult {
  readonly id: number;
  readonly scene: string;
  /** Empty: the command succeeded. */
  readonly error: string;
  /** All values of a scene after `adjust`. */
  readonly adjustments?: object;
}

export interface Command {
  readonly action: string;
  readonly scene: string;
  readonly lockstep?: boolean;
  /** What `adjust` changes: a SceneAdjustments of control.proto as JSON. */
  readonly changes?: object;
  readonly time_s?: number;
  readonly speed?: number;
  readonly steps?: number;
}

/** Frames that the page asks for. Fields that are absent stay as the address has them. */
export interface FrameChoice {
  /** Share of the triangles. */
  readonly detail?: number;
  /** Most frames a second; null: all of them. */
  readonly rate_hz?: number | null;
}

interface Waiting {
  readonly done: (result: CommandResult) => void;
  readonly fail: (error: Error) => void;
}

export type LinkState =
  | { readonly kind: "connecting" }
  | { readonly kind: "open" }
  /** The connection was lost or never opened. Another attempt follows. */
  | { readonly kind: "lost"; readonly everOpened: boolean; readonly reason: string }
  /** The gateway refuses this page. No attempt follows, because the answer would not change. */
  | { readonly kind: "refused"; readonly reason: string };

/** Why a connection did not open. */
export interface Diagnosis {
  readonly reason: string;
  /** Whether another attempt would fail too. */
  readonly final: boolean;
}

export interface ConnectionEvents {
  onLink(state: LinkState): void;
  onDaemon(state: DaemonState): void;
  onHead(head: Head): void;
  onMessage(data: ArrayBuffer): void;
  onClock(reply: ClockReply, receivedMs: number): void;
}

export interface ConnectionOptions {
  readonly url: string;
  readonly events: ConnectionEvents;
  readonly WebSocket?: typeof WebSocket;
  /** Called when a connection did not open; returns why. */
  readonly diagnose: () => Promise<Diagnosis>;
}

export const FIRST_RETRY_MS = 250;
export const LAST_RETRY_MS = 4000;
const CLOCK_INTERVAL_MS = 1000;

export class Connection {
  readonly #options: ConnectionOptions;
  readonly #WebSocket: typeof WebSocket;
  #socket: WebSocket | null = null;
  #retryMs = FIRST_RETRY_MS;
  #retry: ReturnType<typeof setTimeout> | undefined;
  #clock: ReturnType<typeof setInterval> | undefined;
  #everOpened = false;
  #paused = false;
  /** Acknowledgements that a paused page owes, and the keyframe of each. */
  readonly #owed = new Map<StreamName, number | null>();
  #lastCommand = 0;
  readonly #waiting = new Map<number, Waiting>();
  #frames: FrameChoice = {};

  constructor(options: ConnectionOptions) {
    this.#options = options;
    this.#WebSocket = options.WebSocket ?? WebSocket;
    this.#open();
  }

  /** Asks for the streams of a scene from their start. A new connection has no streams. */
  watch(scene: string): void {
    this.#send({ type: "watch", scene });
  }

  /**
   * Lets the gateway send the next message of `stream`.
   *
   * @param keyframe The keyframe that the page has, to which the next frame may refer; null if it has no keyframe.
   */
  acknowledge(stream: StreamName, keyframe: number | null = null): void {
    const slot = slotOf(stream);
    if (this.#paused) {
      this.#owed.set(slot, keyframe);
    } else {
      this.#sendAcknowledgement(slot, keyframe);
    }
  }

  /** A paused (hidden) page acknowledges nothing, so the gateway sends nothing. Resuming sends what is owed. */
  setPaused(paused: boolean): void {
    this.#paused = paused;
    if (!paused) {
      for (const [stream, keyframe] of this.#owed) {
        this.#sendAcknowledgement(stream, keyframe);
      }
      this.#owed.clear();
    }
  }

  /** Asks for other frames from now on, also after a loss of the connection. */
  chooseFrames(choice: FrameChoice): void {
    this.#frames = choice;
    this.#sendChoice();
  }

  /** Sends a pose of a tool. */
  moveTool({ name, positionM, orientationWxyz }: Pick<ToolState, "name" | "positionM" | "orientationWxyz">): void {
    this.#send({ type: "pose", tool: name, position_m: positionM, orientation: orientationWxyz });
  }

  /** Sends a command. Fails with the reason of the gateway or the daemon. */
  control(command: Command): Promise<CommandResult> {
    if (this.#socket?.readyState !== 1) {
      return Promise.reject(new Error("there is no connection to the gateway"));
    }
    const id = (this.#lastCommand += 1);
    this.#send({ type: "control", id, ...command });
    return new Promise((done, fail) => this.#waiting.set(id, { done, fail }));
  }

  /** Asks for the values of an element field of the watched scene, a few times a second. null: no field any more. */
  showField(name: string | null): void {
    this.#send({ type: "field", name: name ?? "" });
  }

  close(): void {
    clearTimeout(this.#retry);
    clearInterval(this.#clock);
    const socket = this.#socket;
    this.#socket = null;
    socket?.close();
  }

  #open(): void {
    this.#options.events.onLink({ kind: "connecting" });
    const socket = new this.#WebSocket(this.#options.url);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    let opened = false;
    socket.onopen = () => {
      opened = true;
      this.#everOpened = true;
      this.#owed.clear();
      this.#sendChoice();
      this.#options.events.onLink({ kind: "open" });
      this.#askClock();
      this.#clock = setInterval(() => this.#askClock(), CLOCK_INTERVAL_MS);
    };
    socket.onmessage = (event: MessageEvent<ArrayBuffer | string>) => this.#receive(event.data);
    socket.onclose = (event) => {
      clearInterval(this.#clock);
      for (const { fail } of this.#waiting.values()) {
        fail(new Error("the connection was lost before the gateway answered"));
      }
      this.#waiting.clear();
      if (this.#socket === socket) {
        this.#socket = null;
        this.#retryLater();
        if (opened) {
          this.#tellLost(event.reason || "the gateway does not answer");
        } else {
          void this.#diagnose();
        }
      }
    };
  }

  #retryLater(): void {
    // Jitter, so that the viewers of a restarted gateway do not reconnect at the same moment.
    const wait = this.#retryMs * (0.8 + 0.4 * Math.random());
    this.#retryMs = Math.min(LAST_RETRY_MS, 2 * this.#retryMs);
    this.#retry = setTimeout(() => this.#open(), wait);
  }

  async #diagnose(): Promise<void> {
    const { reason, final } = await this.#options.diagnose();
    // The next attempt may have started meanwhile. Its result is newer.
    if (this.#socket !== null) {
      return;
    }
    if (final) {
      clearTimeout(this.#retry);
      this.#options.events.onLink({ kind: "refused", reason });
    } else {
      this.#tellLost(reason);
    }
  }

  #tellLost(reason: string): void {
    this.#options.events.onLink({ kind: "lost", everOpened: this.#everOpened, reason });
  }

  #receive(data: ArrayBuffer | string): void {
    if (typeof data !== "string") {
      this.#options.events.onMessage(data);
      return;
    }
    const message = parseText(data);
    if (message === null) {
      console.warn("the gateway sent a message that this viewer does not know", data.slice(0, 200));
    } else if (message.type === "daemon") {
      this.#retryMs = FIRST_RETRY_MS;
      this.#options.events.onDaemon(message.state);
    } else if (message.type === "head") {
      this.#options.events.onHead(message.head);
    } else if (message.type === "result") {
      this.#settle(message.result);
    } else if (message.type === "frames") {
      if (message.error !== "") {
        console.warn(`the gateway keeps its frames as they are: ${message.error}`);
      }
    } else {
      this.#options.events.onClock(message.reply, performance.now());
    }
  }

  #settle(result: CommandResult): void {
    const waiting = this.#waiting.get(result.id);
    this.#waiting.delete(result.id);
    if (result.error === "") {
      waiting?.done(result);
    } else {
      waiting?.fail(new Error(result.error));
    }
  }

  #sendAcknowledgement(stream: StreamName, keyframe: number | null): void {
    this.#send({ type: "ack", stream, ...(keyframe === null ? {} : { keyframe }) });
  }

  #sendChoice(): void {
    if (Object.keys(this.#frames).length > 0) {
      this.#send({ type: "frames", ...this.#frames });
    }
  }

  #askClock(): void {
    this.#send({ type: "clock", client_time_ms: performance.now() });
  }

  #send(message: object): void {
    // Drop the message if the socket is not open: a new connection starts without it.
    if (this.#socket?.readyState === 1) {
      this.#socket.send(JSON.stringify(message));
    }
  }
}

type TextMessage =
  | { readonly type: "daemon"; readonly state: DaemonState }
  | { readonly type: "head"; readonly head: Head }
  | { readonly type: "result"; readonly result: CommandResult }
  /** An answer about the choice of frames. The page knows what it asked for, so only an error is news. */
  | { readonly type: "frames"; readonly error: string }
  | { readonly type: "clock"; readonly reply: ClockReply };

/** Parses a text message of the gateway. null if it is not one. */
export function parseText(text: string): TextMessage | null {
  let message: unknown;
  try {
    message = JSON.parse(text);
  } catch {
    return null;
  }
  if (typeof message !== "object" || message === null) {
    return null;
  }
  const { type, ...fields } = message as Record<string, unknown>;
  if (type === "clock") {
    const { client_time_ms, gateway_time_ms, replaced } = fields;
    return typeof client_time_ms === "number" && typeof gateway_time_ms === "number" && typeof replaced === "number"
      ? { type, reply: { clientTimeMs: client_time_ms, gatewayTimeMs: gateway_time_ms, replaced } }
      : null;
  }
  if (type === "result") {
    const { id, scene, error, adjustments } = fields;
    return typeof id === "number" && typeof scene === "string" && typeof error === "string"
      ? { type, result: { id, scene, error, ...(isObject(adjustments) ? { adjustments } : {}) } }
      : null;
  }
  if (type === "head") {
    const { time_s, frame, playing, speed } = fields;
    return typeof time_s === "number" && typeof frame === "number" && typeof playing === "boolean" && typeof speed === "number"
      ? { type, head: { timeS: time_s, frame, playing, speed } }
      : null;
  }
  if (type === "frames") {
    return typeof fields.error === "string" ? { type, error: fields.error } : null;
  }
  if (type === "daemon" && Array.isArray(fields.scenes)) {
    return {
      type,
      state: {
        problem: String(fields.problem),
        server: String(fields.server),
        version: String(fields.version),
        backend: String(fields.backend),
        device: String(fields.device),
        posesAllowed: fields.poses_allowed === true,
        operator: fields.operator === true,
        builtinScenes: names(fields.builtin_scenes),
        fieldScenes: names(fields.field_scenes),
        scenes: fields.scenes.map(String),
        recording: recordingOf(fields.recording),
      },
    };
  }
  return null;
}

function isObject(value: unknown): value is object {
  return typeof value === "object" && value !== null;
}

function recordingOf(value: unknown): Recording | null {
  if (typeof value !== "object" || value === null) {
    return null;
  }
  const { file, duration_s, frames, marks, note } = value as Record<string, unknown>;
  return {
    file: String(file),
    durationS: Number(duration_s),
    frames: Number(frames),
    marks: Array.isArray(marks) ? marks.flatMap(markOf) : [],
    note: String(note),
  };
}

function markOf(value: unknown): Mark[] {
  const { time_s, kind, text } = value as Record<string, unknown>;
  return typeof time_s === "number" ? [{ timeS: time_s, kind: String(kind), text: String(text) }] : [];
}

function names(value: unknown): string[] {
  return Array.isArray(value) ? value.map(String) : [];
}
