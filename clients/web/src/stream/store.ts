// State of the scene on show: topology, newest frame and status, and counts of losses. Refuses frames that do not match
// the topology, so that drawing needs no checks.
import { DecodeError, type Frame, type Status, type StreamName, type Topology } from "./decode";
import { Warnings } from "./warnings";

export interface Counters {
  drawn: number;
  /** Frames that the server made and this viewer never drew, wherever a newer one replaced them. */
  dropped: number;
  /** Messages that could not be decoded or did not match the topology. */
  refused: number;
  /** Reason for the last refusal. */
  lastRefusal: string | null;
}

/** A status is current for frames that are at most this much newer [ns on the server's clock]. */
export const STATUS_HOLDS_NS = 3_000_000_000n;

export class SceneStore {
  topology: Topology | null = null;
  frame: Frame | null = null;
  status: Status | null = null;
  /** Why the scene's newest topology or frame is not on show; null while it is. */
  unshown: string | null = null;
  /** Whether the last frame taken followed another of its topology. The first frame may be of any age, because the
   * gateway requests it from a scene that stands still. */
  followsAnother = false;
  readonly warnings = new Warnings();
  /** Rises with each change of the set of objects to draw. */
  topologyRevision = 0;
  readonly counters: Counters = { drawn: 0, dropped: 0, refused: 0, lastRefusal: null };

  #fresh = false;
  #lastDrawnSequence: bigint | null = null;

  /** Forgets the scene and resets the counters. */
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
      // Streams may overtake each other: this status may already belong to the new scene. setStatus drops it if not.
      this.setStatus(status);
    }
  }

  /** Takes a frame. Throws DecodeError if it belongs to another topology than the one on show. */
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

  /** Takes a status. Drops it if it is of a previous scene. */
  setStatus(status: Status): void {
    // The version of a topology is the server's time when the scene was loaded.
    if (this.topology !== null && status.serverTimeNs < this.topology.version) {
      return;
    }
    this.status = status;
    this.warnings.update(status.warnings, Number(status.serverTimeNs) / 1e6);
  }

  /** `status` while its numbers are current; null once frames have advanced without it. */
  get currentStatus(): Status | null {
    const { status, frame } = this;
    const overtaken = status !== null && frame !== null && frame.serverTimeNs - status.serverTimeNs > STATUS_HOLDS_NS;
    return overtaken ? null : status;
  }

  /** Counts a refused message. @param stream Stream of the message; null if unknown. */
  refuse(reason: string, stream: StreamName | null): void {
    this.counters.refused += 1;
    this.counters.lastRefusal = reason;
    if (stream === "topology" || stream === "frame") {
      // Keep the first reason. Later frames are refused because their topology is missing, which would hide the cause.
      this.unshown ??= reason;
    }
  }

  /** Returns the newest frame, once. Counts it as drawn and the gap before it as dropped. */
  takeFrame(): Frame | null {
    if (!this.#fresh || this.frame === null) {
      return null;
    }
    this.#fresh = false;
    const last = this.#lastDrawnSequence;
    this.followsAnother = last !== null;
    const sequence = this.frame.sequence;
    // A sequence that falls belongs to a restarted source: nothing was lost.
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
