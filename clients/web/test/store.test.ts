import { create } from "@bufbuild/protobuf";
import { beforeEach, describe, expect, it } from "vitest";

import { SceneEventsSchema } from "../src/generated/tensormass/v1/event_pb";
import { SceneStatusSchema } from "../src/generated/tensormass/v1/stream_pb";
import { decodeFrame, decodeTopology } from "../src/stream/decode";
import { SceneStore, STATUS_HOLDS_NS } from "../src/stream/store";
import { STAY_MS } from "../src/stream/findings";
import { ATTACHED, f32, frameBytes, topologyBytes } from "./messages";

const frame = (sequence: bigint) => decodeFrame(frameBytes({ sequence }));
const topology = (version: bigint) => decodeTopology(topologyBytes({ version }));
const status = (serverTimeNs: bigint, ...messages: string[]) =>
  create(SceneStatusSchema, { serverTimeNs, findings: messages.map((message) => ({ body: message, message })) });

describe("SceneStore", () => {
  let store: SceneStore;
  beforeEach(() => {
    store = new SceneStore();
    store.setTopology(decodeTopology(topologyBytes()));
  });

  it("returns the newest frame once", () => {
    store.setFrame(frame(1n));
    store.setFrame(frame(2n));
    expect(store.takeFrame()?.sequence).toBe(2n);
    expect(store.takeFrame()).toBeNull();
    expect(store.frame?.sequence).toBe(2n);
  });

  it("counts the gap between drawn frames, wherever the missing ones were lost", () => {
    for (const sequence of [10n, 11n, 14n]) {
      store.setFrame(frame(sequence));
      store.takeFrame();
    }
    store.setFrame(frame(15n)); // replaced here
    store.setFrame(frame(16n));
    store.takeFrame();
    expect(store.counters).toMatchObject({ drawn: 4, dropped: 3 });
  });

  it("counts displacements from rest if it is known, else from the start or the first frame", () => {
    const at = (step: bigint, x: number, simulatedTimeS = 0) => {
      const positions = Float32Array.from({ length: 21 }, () => x);
      return decodeFrame(frameBytes({ step, simulatedTimeS, positions: f32(...positions) }));
    };
    expect(store.reference).toBeNull();
    store.setFrame(at(120n, 1, 2));
    expect(store.reference).toMatchObject({ since: "since 2.0 s", kind: "first frame" });
    store.setFrame(at(121n, 2, 2.1));
    expect(store.reference!.positions[0]).toBe(1);
    store.setFrame(at(0n, 3)); // a reset
    expect(store.reference).toMatchObject({ since: "since the start", kind: "start" });
    store.setRest(at(0n, 4));
    store.setFrame(at(0n, 5));
    expect(store.reference).toMatchObject({ since: "from rest", kind: "rest" });
    expect(store.reference!.positions[0]).toBe(4);
    store.setZero();
    expect(store.reference).toMatchObject({ kind: "chosen" });
    expect(store.reference!.positions[0]).toBe(5);
    store.setTopology(topology(7n)); // the same again
    expect(store.reference).not.toBeNull();
    store.setTopology(topology(8n));
    expect(store.reference).toBeNull();
  });

  it("keeps values of a field that fit the topology", () => {
    const values = new Float32Array(7);
    const revision = store.valuesRevision;
    store.setField({ name: "pressure", topologyVersion: 7n, values });
    expect(store.fieldValues("pressure")).toBe(values);
    expect(store.fieldValues("von_mises")).toBeNull();
    expect(store.valuesRevision).toBeGreaterThan(revision);
    const other = { name: "pressure", topologyVersion: 8n, values };
    expect(() => store.setField(other)).toThrow(/field pressure belongs to topology 8/);
    expect(() => store.setField({ ...other, topologyVersion: 7n, values: new Float32Array(6) })).toThrow(/6 vertices/);
    expect(() => store.setRest(decodeFrame(frameBytes({ positions: f32(0, 0, 0) })))).toThrow(/the rest state has 1 vertices/);
    store.setTopology(topology(8n));
    expect(store.fieldValues("pressure")).toBeNull();
  });

  it("treats a falling sequence as a restarted source", () => {
    for (const sequence of [100n, 1n, 2n]) {
      store.setFrame(frame(sequence));
      expect(store.takeFrame()?.sequence).toBe(sequence);
    }
    expect(store.counters.dropped).toBe(0);
  });

  it("refuses a frame of another topology", () => {
    expect(() => store.setFrame(decodeFrame(frameBytes({ topologyVersion: 8n })))).toThrow(/topology 8, on show is 7/);
    expect(store.takeFrame()).toBeNull();
  });

  it("refuses a frame with another number of vertices", () => {
    expect(() => store.setFrame(decodeFrame(frameBytes({ positions: f32(0, 0, 0) })))).toThrow(/1 vertices.* has 7/);
    expect(store.takeFrame()).toBeNull();
  });

  it("refuses a frame without the ends of its springs, or with the flags of other springs", () => {
    store.setTopology(decodeTopology(topologyBytes(ATTACHED.topology)));
    const { attachmentPoints } = ATTACHED.frame;
    const flags = (...brokenSprings: number[]) => decodeFrame(frameBytes({ attachmentPoints, brokenSprings: Uint8Array.from(brokenSprings) }));
    expect(() => store.setFrame(frame(1n))).toThrow(/frame 1 has 0 of 5 attachment points/);
    expect(() => store.setFrame(flags(1, 0))).toThrow(/2 bytes of flags for 3 springs/);
    expect(store.frame).toBeNull();
    store.setFrame(flags());
    store.setFrame(flags(0b101));
    expect(store.frame).not.toBeNull();
  });

  it("forgets the frame with its topology", () => {
    store.setFrame(frame(5n));
    const revision = store.topologyRevision;
    store.setTopology(decodeTopology(topologyBytes({ version: 8n })));
    expect(store.takeFrame()).toBeNull();
    expect(store.topologyRevision).toBeGreaterThan(revision);
    store.setFrame(decodeFrame(frameBytes({ topologyVersion: 8n, sequence: 40n })));
    expect(store.takeFrame()?.sequence).toBe(40n);
    expect(store.counters.dropped).toBe(0);
  });

  it("forgets everything when cleared", () => {
    store.setFrame(frame(5n));
    store.takeFrame();
    store.refuse("why", "frame");
    store.setStatus(status(9n, "too fast"));
    expect(store.findings.list().map(({ message }) => message)).toEqual(["too fast"]);
    store.clear();
    expect(store.findings.list().map(({ message }) => message)).toEqual([]);
    expect([store.topology, store.frame, store.status, store.takeFrame()]).toEqual([null, null, null, null]);
    expect(store.unshown).toBeNull();
    expect(store.counters).toEqual({ drawn: 0, dropped: 0, refused: 0, lastRefusal: null });
    expect(() => store.setFrame(frame(6n))).toThrow(/on show is none/);
  });

  it("says why the newest message is not on show, until a frame is", () => {
    store.setFrame(frame(1n));
    store.refuse("not a status", "status");
    store.refuse("no stream at all", null);
    expect(store.unshown).toBeNull();
    store.refuse("frame 2 is torn", "frame");
    expect(store.unshown).toBe("frame 2 is torn");
    store.setFrame(frame(3n));
    expect(store.unshown).toBeNull();

    // The frames after it are refused only because their topology is missing.
    store.refuse("the topology is torn", "topology");
    store.refuse("frame 4 belongs to another topology", "frame");
    expect(store.unshown).toBe("the topology is torn");
    store.setTopology(topology(8n));
    expect(store.unshown).toBeNull();
    expect(store.counters).toMatchObject({ refused: 5, lastRefusal: "frame 4 belongs to another topology" });
  });

  it("forgets status and findings of the previous scene with its topology", () => {
    store.setStatus(status(20n, "too fast"));
    store.setTopology(topology(30n));
    expect(store.status).toBeNull();
    expect(store.findings.list().map(({ message }) => message)).toEqual([]);
    store.setStatus(status(29n, "too fast")); // still under way
    expect(store.status).toBeNull();
    expect(store.findings.list().map(({ message }) => message)).toEqual([]);
  });

  it("keeps the new scene's status if it precedes the topology", () => {
    store.setStatus(status(20n, "too fast"));
    store.setStatus(status(31n, "too soft"));
    store.setTopology(topology(30n));
    expect(store.status?.serverTimeNs).toBe(31n);
    expect(store.findings.list().map(({ message }) => message)).toEqual(["too soft"]);
  });

  it("keeps what it knows of the bodies when attachments come and go", () => {
    store.setFrame(frame(1n));
    store.setZero();
    const { sceneVersion, reference } = store;
    store.setTopology(decodeTopology(topologyBytes({ version: 9n, ...ATTACHED.topology })));
    expect(store.topology!.attachments.map(({ name }) => name)).toEqual(["ligament", "string"]);
    expect(store).toMatchObject({ sceneVersion, reference, frame: null });
    // Removed and added again, with another length.
    const again = ATTACHED.topology.attachments.map((one) => ({ ...one, restLengthsM: new Uint8Array(one.restLengthsM.length) }));
    store.setTopology(decodeTopology(topologyBytes({ version: 10n, ...ATTACHED.topology, attachments: again })));
    expect(store).toMatchObject({ sceneVersion, reference });
    store.setTopology(topology(11n));
    expect(store).toMatchObject({ sceneVersion, reference });
    store.setTopology(topology(12n)); // loaded again
    expect(store).toMatchObject({ sceneVersion: 12n, reference: null });
  });

  it("keeps what it knows of the bodies when tools come and go", () => {
    const withTools = (version: bigint, ...names: string[]) =>
      decodeTopology(topologyBytes({ version, tools: names.map((name) => ({ name, radiusM: 0.01, tipOffsetM: {} })) }));
    store.setFrame(frame(1n));
    store.setZero();
    store.setStatus(status(20n, "too fast"));
    store.setEvents(create(SceneEventsSchema, { topologyVersion: 7n, events: [{ sequence: 1n }] }));
    const { sceneVersion, reference } = store;
    expect(sceneVersion).toBe(7n);
    store.setTopology(withTools(9n, "probe", "hook"));
    expect(store.topology!.tools.map(({ name }) => name)).toEqual(["probe", "hook"]);
    expect(store).toMatchObject({ sceneVersion, reference, frame: null });
    expect(store.status?.serverTimeNs).toBe(20n);
    expect(() => store.setFrame(frame(2n))).toThrow("belongs to topology 7");
    store.setEvents(create(SceneEventsSchema, { topologyVersion: 7n, events: [{ sequence: 1n }, { sequence: 2n }] }));
    expect(store.events).toHaveLength(2);
    store.setTopology(withTools(10n, "hook"));
    expect(store).toMatchObject({ sceneVersion, reference });

    store.setTopology(topology(30n)); // the scene was loaded again, or has other bodies
    store.setTopology(decodeTopology(topologyBytes({ version: 31n, bodies: [] })));
    expect(store).toMatchObject({ sceneVersion: 31n, reference: null, events: [] });
    store.setEvents(create(SceneEventsSchema, { topologyVersion: 7n, events: [{ sequence: 3n }] }));
    store.setEvents(create(SceneEventsSchema, { topologyVersion: 31n }));
    expect(store.events).toHaveLength(0);
  });

  it("forgets findings of later steps when a recording goes back", () => {
    const store = new SceneStore();
    store.setStatus(status(2_000_000_000n, "too fast"));
    store.setStatus(status(1_000_000_000n));
    expect(store.findings.list().map(({ message }) => message)).toEqual([]);
  });

  it("keeps status and findings when the same topology comes again", () => {
    store.setStatus(status(20n, "too fast"));
    store.setStatus(status(21n)); // a finding that comes and goes stays for a while
    store.setTopology(topology(7n));
    expect(store.status?.serverTimeNs).toBe(21n);
    expect(store.findings.list().map(({ message }) => message)).toEqual(["too fast"]);
  });

  it("expires a finding by the server's clock", () => {
    const at = (ms: number, ...found: string[]) => store.setStatus(status(BigInt(ms) * 1_000_000n, ...found));
    at(1000, "too fast");
    at(1000 + STAY_MS);
    expect(store.findings.list().map(({ message }) => message)).toEqual(["too fast"]);
    at(1001 + STAY_MS);
    expect(store.findings.list().map(({ message }) => message)).toEqual([]);
  });

  it("has no current status once frames have advanced without it", () => {
    const loaded = status(1_000n);
    expect(store.currentStatus).toBeNull();
    store.setStatus(loaded);
    expect(store.currentStatus).toBe(loaded);
    const at = (serverTimeNs: bigint) => store.setFrame(decodeFrame(frameBytes({ serverTimeNs })));
    at(1_000n + STATUS_HOLDS_NS);
    expect(store.currentStatus).toBe(loaded);
    at(1_001n + STATUS_HOLDS_NS);
    expect(store.currentStatus).toBeNull();
    expect(store.status).toBe(loaded);
    at(10n); // the scene stands still, its statuses continue
    expect(store.currentStatus).toBe(loaded);
  });

  it("knows whether a frame followed another of its topology", () => {
    const follows = [1n, 2n].map((sequence) => {
      store.setFrame(frame(sequence));
      store.takeFrame();
      return store.followsAnother;
    });
    store.setTopology(topology(7n));
    store.setFrame(frame(3n));
    store.takeFrame();
    expect([...follows, store.followsAnother]).toEqual([false, true, false]);
  });
});
