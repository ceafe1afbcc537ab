// The time line of a recording: play, step, a handle to drag, and marks where something happened. The gateway has the
// play head, which all pages of a recording share.
import { find, setText } from "../dom";
import type { PlayHead, RecordingMark, ShownRecording } from "../generated/tensormass/v1/gateway_pb";
import { LOOK_ONLY } from "./controls";

/** A command for the play head. */
export type HeadAction = "pause" | "resume" | "step" | "step_back" | "reset" | "seek" | "speed";

export interface HeadOptions {
  readonly timeS?: number;
  readonly speed?: number;
  readonly steps?: number;
}

/** Sends a command and waits for its answer. It must not fail: the page shows errors itself. */
export type SendHead = (action: HeadAction, options?: HeadOptions) => Promise<void>;

/**
 * A drag of the handle. One seek is under way at a time, and the newest replaces one that waits: a drag is faster than
 * the answers. A recording that plays pauses while the handle is held.
 */
export class Drag {
  readonly #send: SendHead;
  readonly #waiting: (() => Promise<void>)[] = [];
  #nextS: number | null = null;
  #busy = false;
  #held = false;
  #resumes = false;

  constructor(send: SendHead) {
    this.#send = send;
  }

  /** Whether the handle belongs to the pointer: the head that the gateway tells is older. */
  get active(): boolean {
    return this.#held || this.#busy;
  }

  hold(playing: boolean): void {
    if (!this.#held) {
      this.#held = true;
      this.#resumes = playing;
      if (playing) {
        this.#enqueue(() => this.#send("pause"));
      }
    }
  }

  moveTo(timeS: number): void {
    const waits = this.#nextS !== null;
    this.#nextS = timeS;
    if (!waits) {
      this.#enqueue(() => {
        const timeS = this.#nextS!;
        this.#nextS = null;
        return this.#send("seek", { timeS });
      });
    }
  }

  release(): void {
    if (this.#held) {
      this.#held = false;
      if (this.#resumes) {
        this.#enqueue(() => this.#send("resume"));
      }
    }
  }

  #enqueue(command: () => Promise<void>): void {
    this.#waiting.push(command);
    void this.#run();
  }

  async #run(): Promise<void> {
    if (this.#busy) {
      return;
    }
    this.#busy = true;
    for (let command = this.#waiting.shift(); command !== undefined; command = this.#waiting.shift()) {
      await command();
    }
    this.#busy = false;
  }
}

/** Steps by single frames. Those that come while one is under way, as from a held key, are sent together. */
export class Steps {
  readonly #send: SendHead;
  #owed = 0;
  #busy = false;

  constructor(send: SendHead) {
    this.#send = send;
  }

  /** @param count 1: one frame on, -1: one back. */
  async by(count: 1 | -1): Promise<void> {
    this.#owed += count;
    if (this.#busy) {
      return;
    }
    this.#busy = true;
    while (this.#owed !== 0) {
      const steps = Math.abs(this.#owed);
      const action = this.#owed > 0 ? "step" : "step_back";
      this.#owed = 0;
      await this.#send(action, { steps });
    }
    this.#busy = false;
  }
}

/** "3.20 / 12.00 s" */
export function timeText(timeS: number, durationS: number): string {
  return `${timeS.toFixed(2)} / ${durationS.toFixed(2)} s`;
}

/** Place of a time on the bar [%]. */
export function percentOf(timeS: number, durationS: number): number {
  return durationS > 0 ? Math.min(100, Math.max(0, (100 * timeS) / durationS)) : 0;
}

/** "2.40 s: probe touches." */
export function markText({ timeS, text }: RecordingMark): string {
  return `${timeS.toFixed(2)} s: ${text}`;
}

/** The elements of index.html. */
export class Timeline {
  readonly #send: SendHead;
  readonly #drag: Drag;
  readonly #section = find("#timeline", HTMLElement);
  readonly #play = find("#play", HTMLButtonElement);
  readonly #back = find("#frame-back", HTMLButtonElement);
  readonly #forward = find("#frame-forward", HTMLButtonElement);
  readonly #handle = find("#seek", HTMLInputElement);
  readonly #marks = find("#marks", HTMLElement);
  readonly #speed = find("#speed", HTMLSelectElement);
  #recording: ShownRecording | null = null;
  #head: PlayHead | null = null;

  constructor(send: SendHead) {
    this.#send = send;
    this.#drag = new Drag(send);
    this.#play.addEventListener("click", () => void send(this.#head?.playing === true ? "pause" : "resume"));
    const steps = new Steps(send);
    this.#back.addEventListener("click", () => void steps.by(-1));
    this.#forward.addEventListener("click", () => void steps.by(1));
    this.#speed.addEventListener("change", () => void send("speed", { speed: Number(this.#speed.value) }));
    this.#handle.addEventListener("pointerdown", () => this.#drag.hold(this.#head?.playing === true));
    this.#handle.addEventListener("input", () => {
      this.#drag.moveTo(this.#handle.valueAsNumber);
      this.#showTime(this.#handle.valueAsNumber);
    });
    for (const end of ["pointerup", "pointercancel", "blur"]) {
      this.#handle.addEventListener(end, () => this.#drag.release());
    }
  }

  /** Clicks a button, as a key does. A hidden time line has no keys. */
  press(button: "play" | "back" | "forward"): void {
    if (!this.#section.hidden) {
      ({ play: this.#play, back: this.#back, forward: this.#forward })[button].click();
    }
  }

  /** Moves to the start. */
  toStart(): void {
    if (!this.#section.hidden && !this.#handle.disabled) {
      void this.#send("reset");
    }
  }

  /** Shows the time line of a recording; undefined: the page shows running scenes. */
  show(recording: ShownRecording | undefined, operator: boolean): void {
    document.body.dataset.source = recording === undefined ? "daemon" : "recording";
    this.#section.hidden = recording === undefined;
    if (recording === undefined || recording === this.#recording) {
      return;
    }
    this.#recording = recording;
    this.#handle.max = String(recording.durationS);
    for (const control of [this.#play, this.#back, this.#forward, this.#handle, this.#speed]) {
      control.disabled = !operator;
      control.title = operator ? (control.dataset.title ?? "") : LOOK_ONLY;
    }
    this.#marks.replaceChildren(...recording.marks.map((mark) => this.#markOf(mark, recording.durationS, operator)));
    this.#showHead();
  }

  showHead(head: PlayHead): void {
    this.#head = head;
    this.#showHead();
  }

  #showHead(): void {
    const head = this.#head;
    if (head === null || this.#recording === null) {
      return;
    }
    this.#play.dataset.shows = head.playing ? "pause" : "play";
    this.#play.ariaLabel = head.playing ? "Pause" : "Play";
    this.#speed.value = String(head.speed);
    setText(find("#timeline-frame", HTMLElement), `frame ${head.frame + 1} of ${this.#recording.frames}`);
    if (!this.#drag.active) {
      this.#handle.value = String(head.timeS);
      this.#showTime(head.timeS);
    }
  }

  /** Shows the step of the frame that is drawn. */
  showStep(step: bigint | null): void {
    setText(find("#timeline-step", HTMLElement), step === null ? "" : `step ${step}`);
  }

  #showTime(timeS: number): void {
    const durationS = this.#recording?.durationS ?? 0;
    const text = timeText(timeS, durationS);
    setText(find("#timeline-time", HTMLElement), text);
    this.#handle.ariaValueText = text;
    this.#handle.style.setProperty("--played", `${percentOf(timeS, durationS)}%`);
  }

  #markOf(mark: RecordingMark, durationS: number, operator: boolean): HTMLElement {
    const result = document.createElement("button");
    result.type = "button";
    result.dataset.kind = mark.kind;
    result.title = result.ariaLabel = markText(mark);
    result.style.left = `${percentOf(mark.timeS, durationS)}%`;
    result.disabled = !operator;
    // The handle has the same times for the keyboard.
    result.tabIndex = -1;
    result.addEventListener("click", () => this.#drag.moveTo(mark.timeS));
    return result;
  }
}
