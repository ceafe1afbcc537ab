// The WebSocket to the gateway: opens, watches a scene, acknowledges, asks for the clock, and reconnects after a loss.
import { fromJson } from "@bufbuild/protobuf";
import { ValueSchema } from "@bufbuild/protobuf/wkt";

import type { ClockReply, CommandResult, DaemonState, PlayHead } from "../generated/tensormass/v1/gateway_pb";
import { slotOf, type StreamName, type ToolState } from "./decode";
import { parseText, writeText, type Command, type Sent } from "./texts";

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
  onHead(head: PlayHead): void;
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
    this.#send({ case: "watch", value: { scene } });
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

  /**
   * Sends a pose of a tool.
   * @param level Share of its power that the tool uses, 0 to 1. Above zero the pose holds for half a second.
   */
  moveTool({ name, positionM, orientationWxyz }: Pick<ToolState, "name" | "positionM" | "orientationWxyz">, level = 0): void {
    const pose = { tool: name, positionM: [...positionM], orientation: [...orientationWxyz] };
    this.#send({ case: "pose", value: level > 0 ? { ...pose, level } : pose });
  }

  /** Sends a command. Fails with the reason of the gateway or the daemon. */
  control(command: Command): Promise<CommandResult> {
    if (this.#socket?.readyState !== 1) {
      return Promise.reject(new Error("there is no connection to the gateway"));
    }
    const id = (this.#lastCommand += 1);
    this.#send({ case: "control", value: { ...command, id } });
    return new Promise((done, fail) => this.#waiting.set(id, { done, fail }));
  }

  /** Asks for the values of an element field of the watched scene, a few times a second. null: no field any more. */
  showField(name: string | null): void {
    this.#send({ case: "field", value: { name: name ?? "" } });
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
    } else if (message.case === "daemon") {
      this.#retryMs = FIRST_RETRY_MS;
      this.#options.events.onDaemon(message.value);
    } else if (message.case === "head") {
      this.#options.events.onHead(message.value);
    } else if (message.case === "result") {
      this.#settle(message.value);
    } else if (message.case === "frames") {
      // The page knows what it asked for, so only an error is news.
      if (message.value.error !== "") {
        console.warn(`the gateway keeps its frames as they are: ${message.value.error}`);
      }
    } else {
      this.#options.events.onClock(message.value, performance.now());
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
    this.#send({ case: "ack", value: { stream, ...(keyframe === null ? {} : { keyframe }) } });
  }

  #sendChoice(): void {
    const { rate_hz, ...choice } = this.#frames;
    if (Object.keys(this.#frames).length > 0) {
      // null differs from no rate, which leaves it as it is.
      const rateHz = rate_hz === undefined ? {} : { rateHz: fromJson(ValueSchema, rate_hz) };
      this.#send({ case: "frames", value: { ...choice, ...rateHz } });
    }
  }

  #askClock(): void {
    this.#send({ case: "clock", value: { clientTimeMs: performance.now() } });
  }

  #send(message: Sent): void {
    // Drop the message if the socket is not open: a new connection starts without it.
    if (this.#socket?.readyState === 1) {
      this.#socket.send(writeText(message));
    }
  }
}
