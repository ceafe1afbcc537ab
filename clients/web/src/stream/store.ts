// What is known of the scene on show: its topology, its newest frame and status, and what was lost on the way.
// Frames that do not fit the topology are refused here, so that drawing needs no checks.
import { DecodeError, type Frame, type Status, type StreamName, type Topology } from "./decode";
import { Warnings } from "./warnings";

export interface Counters {
  drawn: number;
  /** Frames that the server made and this viewer never drew, wherever they were replaced by a newer one. */
  dropped: number;
  /** Messages that could not be used. */
  refused: number;
  /** What was wrong with the last of them. */
  lastRefusal: string | null;
}

/** The numbers of a status say nothing of frames that are newer than it by more [ns on the server's clock]. */
export const STATUS_HOLDS_NS = 3_000_000_000n;

export class SceneStore {
  topology: Topology | null = null;
  frame: Frame | null = null;
  status: Status | null = null;
  /** Why the scene's newest topology or frame is not on show; null while it is. */
  unshown: string | null = null;
  /** Whether the frame taken last came after another of its topology. The first may be of any age: where a scene stands
   * still, the gateway asks for it. */
  followsAnother = false;
  readonly warnings = new Warnings();
  /** Rises with everything that changes which objects are drawn. */
  topologyRevision = 0;
  readonly counters: Counters = { drawn: 0, dropped: 0, refused: 0, lastRefusal: null };

  #fresh = false;
  #lastDrawnSequence: bigint | null = null;

  /** Forgets the scene; the counters begin anew. */
  clear(): void {
    this.#replaceTopology(null);
    this.#forgetStatus();
    Object.assign(this.counters, { drawn: 0, dropped: 0, refused: 0, lastRefusal: null } satisfies Counters);
  }

  setTopology(topology: Topology): void {
    const another = topology.version !== this.topology?.version;
    this.#replaceTopology(topology);
    const { status } = this;
    if (another && status !== null) {
      this.#forgetStatus();
      // Unless it is of the scene before: each stream finds its own way here, so that of the new one may have come first.
      this.setStatus(status);
    }
  }

  /** Throws DecodeError if the frame belongs to another topology than the one on show. */
  setFrame(frame: Frame): void {
    const topology = this.topology;
    if (topology?.version !== frame.topologyVersion) {
      throw new DecodeError(
        `frame ${frame.sequence} belongs to topology ${frame.topologyVersion}, on show is ${topology?.version ?? "none"}`,
      );
    }
    if (frame.positions.length !== 3 * topology.vertexCount) {
      throw new DecodeError(
        `frame ${frame.sequence} has ${frame.positions.length / 3} vertices, topology ${topology.version} has ` +
          `${topology.vertexCount}`,
      );
    }
    this.frame = frame;
    this.unshown = null;
    this.#fresh = true;
  }

  /** A status of a scene before the one on show is dropped. */
  setStatus(status: Status): void {
    // A topology's version is the server's time when its scene was loaded.
    if (this.topology !== null && status.serverTimeNs < this.topology.version) {
      return;
    }
    this.status = status;
    this.warnings.update(status.warnings, Number(status.serverTimeNs) / 1e6);
  }

  /** `status` while its numbers hold: null where frames have gone on without it. */
  get currentStatus(): Status | null {
    const { status, frame } = this;
    const overtaken = status !== null && frame !== null && frame.serverTimeNs - status.serverTimeNs > STATUS_HOLDS_NS;
    return overtaken ? null : status;
  }

  /** @param stream That of the message; null if not even that is known. */
  refuse(reason: string, stream: StreamName | null): void {
    this.counters.refused += 1;
    this.counters.lastRefusal = reason;
    if (stream === "topology" || stream === "frame") {
      // The first reason stays: frames that are refused for want of their topology would hide what was wrong with it.
      this.unshown ??= reason;
    }
  }

  /** The newest frame if it was not taken yet; taking it counts it as drawn and the gap before it as dropped. */
  takeFrame(): Frame | null {
    if (!this.#fresh || this.frame === null) {
      return null;
    }
    this.#fresh = false;
    const last = this.#lastDrawnSequence;
    this.followsAnother = last !== null;
    const sequence = this.frame.sequence;
    // A sequence that falls back is a source that began anew: nothing was lost.
    if (last !== null && sequence > last) {
      this.counters.dropped += Number(sequence - last - 1n);
    }
    this.#lastDrawnSequence = sequence;
    this.counters.drawn += 1;
    return this.frame;
  }

  #replaceTopology(topology: Topology | null): void {
    this.topology = topology;
    this.frame = null;
    this.unshown = null;
    this.topologyRevision += 1;
    this.#fresh = false;
    this.#lastDrawnSequence = null;
  }

  #forgetStatus(): void {
    this.status = null;
    this.warnings.clear();
  }
}
