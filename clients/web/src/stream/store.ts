// What is known of the scene on show: its topology, its newest frame and status, and what was lost on the way.
// Frames that do not fit the topology are refused here, so that drawing needs no checks.
import { DecodeError, type Frame, type Status, type Topology } from "./decode";
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

export class SceneStore {
  topology: Topology | null = null;
  frame: Frame | null = null;
  status: Status | null = null;
  readonly warnings = new Warnings();
  /** Rises with everything that changes which objects are drawn. */
  topologyRevision = 0;
  readonly counters: Counters = { drawn: 0, dropped: 0, refused: 0, lastRefusal: null };

  #fresh = false;
  #lastDrawnSequence: bigint | null = null;

  /** Forgets the scene; the counters begin anew. */
  clear(): void {
    this.topology = null;
    this.frame = null;
    this.status = null;
    this.warnings.clear();
    this.topologyRevision += 1;
    Object.assign(this.counters, { drawn: 0, dropped: 0, refused: 0, lastRefusal: null } satisfies Counters);
    this.#fresh = false;
    this.#lastDrawnSequence = null;
  }

  setTopology(topology: Topology): void {
    this.topology = topology;
    this.frame = null;
    this.topologyRevision += 1;
    this.#fresh = false;
    this.#lastDrawnSequence = null;
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
    this.#fresh = true;
  }

  setStatus(status: Status): void {
    this.status = status;
    this.warnings.update(status.warnings, Number(status.serverTimeNs) / 1e6);
  }

  refuse(reason: string): void {
    this.counters.refused += 1;
    this.counters.lastRefusal = reason;
  }

  /** The newest frame if it was not taken yet; taking it counts it as drawn and the gap before it as dropped. */
  takeFrame(): Frame | null {
    if (!this.#fresh || this.frame === null) {
      return null;
    }
    this.#fresh = false;
    const last = this.#lastDrawnSequence;
    const sequence = this.frame.sequence;
    // A sequence that falls back is a source that began anew: nothing was lost.
    if (last !== null && sequence > last) {
      this.counters.dropped += Number(sequence - last - 1n);
    }
    this.#lastDrawnSequence = sequence;
    this.counters.drawn += 1;
    return this.frame;
  }
}
