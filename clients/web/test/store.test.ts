import { create } from "@bufbuild/protobuf";
import { beforeEach, describe, expect, it } from "vitest";

import { SceneStatusSchema } from "../src/generated/tensormass/v1/stream_pb";
import { decodeFrame, decodeTopology } from "../src/stream/decode";
import { SceneStore } from "../src/stream/store";
import { f32, frameBytes, topologyBytes } from "./messages";

const frame = (sequence: bigint) => decodeFrame(frameBytes({ sequence }));

describe("SceneStore", () => {
  let store: SceneStore;
  beforeEach(() => {
    store = new SceneStore();
    store.setTopology(decodeTopology(topologyBytes()));
  });

  it("gives the newest frame once", () => {
    store.setFrame(frame(1n));
    store.setFrame(frame(2n));
    expect(store.takeFrame()?.sequence).toBe(2n);
    expect(store.takeFrame()).toBeNull();
    expect(store.frame?.sequence).toBe(2n);
  });

  it("counts the gap between frames that were drawn, wherever the frames between were lost", () => {
    for (const sequence of [10n, 11n, 14n]) {
      store.setFrame(frame(sequence));
      store.takeFrame();
    }
    store.setFrame(frame(15n)); // replaced here
    store.setFrame(frame(16n));
    store.takeFrame();
    expect(store.counters).toMatchObject({ drawn: 4, dropped: 3 });
  });

  it("takes a sequence that falls back for a source that began anew", () => {
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
    store.refuse("why");
    store.setStatus(create(SceneStatusSchema, { warnings: ["too fast"] }));
    expect(store.warnings.texts()).toEqual(["too fast"]);
    store.clear();
    expect(store.warnings.texts()).toEqual([]);
    expect([store.topology, store.frame, store.status, store.takeFrame()]).toEqual([null, null, null, null]);
    expect(store.counters).toEqual({ drawn: 0, dropped: 0, refused: 0, lastRefusal: null });
    expect(() => store.setFrame(frame(6n))).toThrow(/on show is none/);
  });
});
