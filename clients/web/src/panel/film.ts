// Films the canvas with the browser's MediaRecorder: the scene with its tools and arrows, without the panels.

/** The first type that the browser knows is taken. Safari has no WebM. */
const TYPES = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm", "video/mp4"] as const;
/** A film is kept in memory until it is saved. It ends by itself at this size. */
export const MAX_FILM_BYTES = 1 << 30;
/** Time between two parts of a film [ms], after which the size is checked. */
const PART_MS = 1000;
const BITS_PER_SECOND = 12_000_000;

/** The parts of MediaRecorder that a film uses. */
export interface Recorder {
  readonly state: "inactive" | "paused" | "recording";
  start(partMs: number): void;
  stop(): void;
}

/** What a recorder tells. After an error it stops by itself. */
export interface RecorderEvents {
  onPart(data: Blob): void;
  onError(): void;
  onStop(): void;
}

export type OpenRecorder = (type: string, events: RecorderEvents) => Recorder;

export interface FilmEvents {
  /** Called when a film starts and when it ends. */
  onRunning(running: boolean): void;
  /** A film ended. @param file All of it. @param name Name of the file. */
  onFilm(file: Blob, name: string): void;
  onError(text: string): void;
}

export class Film {
  readonly #open: OpenRecorder;
  readonly #type: string | null;
  readonly #events: FilmEvents;
  #recorder: Recorder | null = null;

  /** @param isSupported Whether the browser can record a type. @param open Makes a recorder of that type. */
  constructor(isSupported: (type: string) => boolean, open: OpenRecorder, events: FilmEvents) {
    this.#open = open;
    this.#type = TYPES.find(isSupported) ?? null;
    this.#events = events;
  }

  /** Whether this browser can film at all. */
  get possible(): boolean {
    return this.#type !== null;
  }

  get running(): boolean {
    return this.#recorder !== null;
  }

  /** Starts a film, or ends the one that runs. @param name Name of the file without its ending. */
  toggle(name: string): void {
    if (this.#recorder !== null) {
      this.#recorder.stop();
    } else if (this.#type !== null) {
      this.#start(this.#type, name);
    }
  }

  #start(type: string, name: string): void {
    const parts: Blob[] = [];
    let bytes = 0;
    let failed = false;
    let recorder: Recorder;
    try {
      recorder = this.#open(type, {
        onPart: (data) => {
          parts.push(data);
          bytes += data.size;
          if (bytes >= MAX_FILM_BYTES && recorder.state === "recording") {
            recorder.stop();
          }
        },
        onError: () => (failed = true),
        onStop: () => {
          this.#recorder = null;
          this.#events.onRunning(false);
          if (bytes > 0) {
            this.#events.onFilm(new Blob(parts, { type }), `${name}.${type.startsWith("video/mp4") ? "mp4" : "webm"}`);
          }
          if (failed || bytes === 0) {
            this.#events.onError(bytes === 0 ? "The browser recorded nothing" : "The browser stopped the film early");
          }
        },
      });
      recorder.start(PART_MS);
    } catch (error) {
      this.#events.onError(`No film: ${error instanceof Error ? error.message : String(error)}`);
      return;
    }
    this.#recorder = recorder;
    this.#events.onRunning(true);
  }
}

/** Makes a film of a canvas. @param canvas Returns it. It is the same while a film runs. */
export function filmOf(canvas: () => HTMLCanvasElement, events: FilmEvents): Film {
  const known = typeof MediaRecorder !== "undefined" && typeof canvas().captureStream === "function";
  return new Film(
    (type) => known && MediaRecorder.isTypeSupported(type),
    (mimeType, recorded) => {
      const options = { mimeType, videoBitsPerSecond: BITS_PER_SECOND };
      const recorder = new MediaRecorder(canvas().captureStream(), options);
      recorder.addEventListener("dataavailable", ({ data }) => recorded.onPart(data));
      recorder.addEventListener("error", () => recorded.onError());
      recorder.addEventListener("stop", () => recorded.onStop());
      return recorder;
    },
    events,
  );
}
