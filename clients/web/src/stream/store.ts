// State of the scene on show: topology, newest frame and status, and counts of losses. Refuses frames that do not match
// the topology, so that drawing needs no checks.
import type { Changes } from "./changes";
import { DecodeError, slotOf, type Field, type Frame, type Status, type StreamName, type Topology } from "./decode";
import type { SceneEvent, SceneEvents } from "./events";
import { Findings } from "./findings";

export interface Counters {
  drawn: number;
  /** Frames that the server made and this viewer never drew, wherever a newer one replaced them. */
  dropped: number;
  /** Messages that could not be decoded or did not match the topology. */
  refused: number;
  /** Reason for the last refusal. */
  lastRefusal: string | null;
}

/** Positions from which displacements count. */
export interface Reference {
  readonly positions: Float32Array;
  /** In words, behind "Displacement": "from rest". */
  readonly since: string;
  readonly kind: "rest" | "start" | "chosen" | "first frame";
}

/** A status is current for frames that are at most this much newer [ns on the server's clock]. */
export const STATUS_HOLDS_NS = 3_000_000_000n;

/** Tools and attachments of a topology, in words that differ where these do. */
function partsOf({ tools, attachments }: Topology): string {
  const springs = attachments.map(({ name, restLengthsM }) => `${name} ${restLengthsM.join(" ")}`);
  return [...tools.map(({ name }) => name), "", ...springs].join("\n");
}

/** Whether a topology is the one before with other tools or attachments: EditScene added or removed some. */
function hasOtherParts(before: Topology | null, now: Topology | null): boolean {
  if (before === null || now === null || before.scene !== now.scene || before.version === now.version) {
    return false;
  }
  return (
    partsOf(before) !== partsOf(now) &&
    before.bodies.length === now.bodies.length &&
    before.bodies.every(({ name, vertexCount, triangles }, i) => {
      const body = now.bodies[i]!;
      return (
        name === body.name &&
        vertexCount === body.vertexCount &&
        triangles.length === body.triangles.length &&
        triangles.every((vertex, k) => vertex === body.triangles[k])
      );
    })
  );
}

export class SceneStore {
  topology: Topology | null = null;
  /** Version of the first topology of the scene on show. Those that differ from it by their tools or attachments belong to it. */
  sceneVersion: bigint | null = null;
  frame: Frame | null = null;
  status: Status | null = null;
  /** Changes of the surface since the topology; null: none are known. Another object after each change. */
  changes: Changes | null = null;
  /** Why the newest changes are not on show; null while they are. */
  unshownChanges: string | null = null;
  /** The last 64 events, oldest first. */
  events: readonly SceneEvent[] = [];
  /** Why the scene's newest topology or frame is not on show; null while it is. */
  unshown: string | null = null;
  /** Whether the last frame taken followed another of its topology. The first frame may be of any age, because the
   * gateway requests it from a scene that stands still. */
  followsAnother = false;
  /** Positions from which displacements count; null before the first frame. */
  reference: Reference | null = null;
  /** Rises with each change of `reference` and of the values of a field. */
  valuesRevision = 0;
  readonly findings = new Findings();
  /** Rises with each change of the set of objects to draw. */
  topologyRevision = 0;
  readonly counters: Counters = { drawn: 0, dropped: 0, refused: 0, lastRefusal: null };

  #field: Field | null = null;
  #eventsVersion = 0n;
  #fresh = false;
  #lastDrawnSequence: bigint | null = null;

  /** Forgets the scene and resets the counters. */
  clear(): void {
    this.#replaceTopology(null);
    this.#forgetStatus();
    Object.assign(this.counters, { drawn: 0, dropped: 0, refused: 0, lastRefusal: null } satisfies Counters);
  }

  setTopology(topology: Topology): void {
    const another = topology.version !== this.topology?.version && !hasOtherParts(this.topology, topology);
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
    this.#checkVersion(`frame ${frame.sequence}`, frame.topologyVersion);
    this.#checkPositions(frame);
    this.#checkSprings(frame);
    this.frame = frame;
    if (this.reference === null) {
      this.#refer(frame, frame.step === 0n ? "start" : "first frame");
    } else if (this.reference.kind === "first frame" && frame.step === 0n) {
      this.#refer(frame, "start"); // the scene was reset
    }
    this.unshown = null;
    this.#fresh = true;
  }

  /**
   * Takes changes of the surface, which fit the topology on show. Drops those that are older than what is known.
   *
   * @param mayGoBack A recording is shown, which may go back in time.
   */
  setChanges(changes: Changes, mayGoBack: boolean): void {
    if (this.changes !== null && changes.revision < this.changes.revision && !mayGoBack) {
      return;
    }
    this.changes = changes;
    this.unshownChanges = null;
  }

  /** Takes the last events. Drops those of a previous scene. */
  setEvents({ events, topologyVersion }: SceneEvents): void {
    // Events have the version with which the scene was loaded. A page that came later knows the newest one only.
    if (topologyVersion >= this.#eventsVersion && topologyVersion <= (this.topology?.wholeVersion ?? topologyVersion)) {
      this.events = events;
      this.#eventsVersion = topologyVersion;
    }
  }

  /** Takes the rest positions, as a frame in which nothing has moved. Throws DecodeError like `setFrame`. */
  setRest(frame: Frame): void {
    this.#check("the rest state", frame.topologyVersion, frame.positions.length / 3);
    this.#refer(frame, "rest");
  }

  /** Takes a field. Throws DecodeError like `setFrame`. */
  setField(field: Field): void {
    this.#check(`field ${field.name}`, field.topologyVersion, field.values.length);
    this.#field = field;
    this.valuesRevision += 1;
  }

  /** Values of the field `name` on the surface; null before they have arrived. */
  fieldValues(name: string): Float32Array | null {
    return this.#field?.name === name ? this.#field.values : null;
  }

  /** Lets displacements count from the newest frame on. */
  setZero(): void {
    if (this.frame !== null) {
      this.#refer(this.frame, "chosen");
    }
  }

  /** Takes a status. Drops it if it is of a previous scene. */
  setStatus(status: Status): void {
    // The version of a topology is the server's time when the scene was loaded.
    if (this.topology !== null && status.serverTimeNs < this.topology.version) {
      return;
    }
    if (this.status !== null && status.serverTimeNs < this.status.serverTimeNs) {
      this.findings.clear(); // a recording went back, to before them
    }
    this.status = status;
    this.findings.update(status, Number(status.serverTimeNs) / 1e6);
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
    const slot = stream === null ? null : slotOf(stream);
    if (slot === "topology" || slot === "frame") {
      // Keep the first reason. Later frames are refused because their topology is missing, which would hide the cause.
      this.unshown ??= reason;
    } else if (slot === "changes") {
      this.unshownChanges = reason;
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

  #refer(frame: Frame, kind: Reference["kind"]): void {
    const at = `since ${frame.simulatedTimeS.toFixed(1)} s`;
    const since = { rest: "from rest", start: "since the start", chosen: at, "first frame": at }[kind];
    this.reference = { positions: frame.positions, since, kind };
    this.valuesRevision += 1;
  }

  /** Throws DecodeError if a message does not fit the topology on show. */
  #check(what: string, version: bigint, vertexCount: number): void {
    this.#checkVersion(what, version);
    const topology = this.topology!;
    if (vertexCount !== topology.vertexCount) {
      throw new DecodeError(
        `${what} has ${vertexCount} vertices, topology ${topology.version} has ${topology.vertexCount}`,
      );
    }
  }

  #checkVersion(what: string, version: bigint): void {
    if (this.topology?.version !== version) {
      throw new DecodeError(`${what} belongs to topology ${version}, on show is ${this.topology?.version ?? "none"}`);
    }
  }

  /** Throws DecodeError if a frame has fewer vertices than the topology, or others than its revision appends. */
  #checkPositions({ sequence, revision, positions }: Frame): void {
    const { version, vertexCount } = this.topology!;
    const count = positions.length / 3;
    const known = revision === 0 ? 0 : revision === this.changes?.revision ? this.changes.appendedVertexCount : null;
    // A frame may have any number of appended vertices if its revision is not known.
    if (known === null ? count < vertexCount : count !== vertexCount + known) {
      const more = known === 0 ? "" : ` and ${known ?? "unknown"} appended`;
      throw new DecodeError(`frame ${sequence} has ${count} vertices, topology ${version} has ${vertexCount}${more}`);
    }
  }

  /** Throws DecodeError if a frame lacks ends of springs, or has the flags of another number of springs. */
  #checkSprings({ sequence, attachmentPoints, brokenSprings }: Frame): void {
    const { attachments, attachmentPointCount } = this.topology!;
    if (attachmentPoints.length !== 3 * attachmentPointCount) {
      throw new DecodeError(`frame ${sequence} has ${attachmentPoints.length / 3} of ${attachmentPointCount} attachment points`);
    }
    const springCount = attachments.reduce((count, { springs }) => count + springs.length / 2, 0);
    if (brokenSprings.length !== 0 && brokenSprings.length !== Math.ceil(springCount / 8)) {
      throw new DecodeError(`frame ${sequence} has ${brokenSprings.length} bytes of flags for ${springCount} springs`);
    }
  }

  #replaceTopology(topology: Topology | null): void {
    const sameScene = topology?.wholeVersion === this.topology?.wholeVersion || hasOtherParts(this.topology, topology);
    // The same topology may come again. What the user chose as zero then stays.
    if (topology?.version !== this.topology?.version && !hasOtherParts(this.topology, topology)) {
      this.reference = null;
      this.#field = null;
      this.valuesRevision += 1;
    }
    if (!sameScene) {
      this.events = [];
      // Those of a previous scene have at most the version of its last topology.
      this.#eventsVersion = topology === null || this.topology === null ? 0n : this.topology.wholeVersion + 1n;
      this.sceneVersion = topology?.wholeVersion ?? null;
    }
    this.changes = null;
    this.unshownChanges = null;
    this.topology = topology;
    this.frame = null;
    this.unshown = null;
    this.topologyRevision += 1;
    this.#fresh = false;
    this.#lastDrawnSequence = null;
  }

  #forgetStatus(): void {
    this.status = null;
    this.findings.clear();
  }
}
