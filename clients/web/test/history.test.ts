import { create } from "@bufbuild/protobuf";
import { describe, expect, it } from "vitest";

import { SceneStatusSchema } from "../src/generated/tensormass/v1/stream_pb";
import { decodeFrame, decodeTopology } from "../src/stream/decode";
import { History, SPAN_S, Series } from "../src/stream/history";
import { frameBytes, topologyBytes } from "./messages";

describe("Series", () => {
  it("keeps the last seconds only", () => {
    const series = new Series();
    for (let second = 0; second <= 3 * SPAN_S; second += 1) {
      series.add(second, 2 * second);
    }
    expect(series.points[0]).toEqual({ timeS: 2 * SPAN_S, value: 4 * SPAN_S });
    expect(series.points.at(-1)).toEqual({ timeS: 3 * SPAN_S, value: 6 * SPAN_S });
  });

  it("is bounded, however many values arrive", () => {
    const series = new Series();
    for (let i = 0; i < 5000; i += 1) {
      series.add(i / 1000, i);
    }
    expect(series.points.length).toBe(1200);
    expect(series.points.at(-1)!.value).toBe(4999);
  });

  it("starts again after a reset, and replaces a value of the same time", () => {
    const series = new Series();
    series.add(5, 1);
    series.add(6, 2);
    series.add(0, 3);
    series.add(0, 4);
    expect(series.points).toEqual([{ timeS: 0, value: 4 }]);
  });

  it("keeps what lies before the play head of a recording that goes back", () => {
    const series = new Series();
    for (const timeS of [1, 2, 3, 4, 2.5]) {
      series.add(timeS, 10 * timeS);
    }
    expect(series.points.map(({ timeS }) => timeS)).toEqual([1, 2, 2.5]);
  });
});


describe("History", () => {
  it("keeps the force on each tool that moves", () => {
    const tools = ["probe", "table"].map((name) => ({ name, radiusM: 0.01, tool: { fixed: name === "table" } }));
    const forces = tools.map(({ name }) => ({ tool: name, forceN: { x: 3, y: 0, z: 4 } }));
    const history = new History();
    history.addFrame(decodeFrame(frameBytes({ simulatedTimeS: 2, tools: forces })), decodeTopology(topologyBytes({ tools })));
    expect([...history.forces].map(([name, { points }]) => [name, points])).toEqual([["probe", [{ timeS: 2, value: 5 }]]]);
  });

  it("keeps step time and rate over the server's clock", () => {
    const history = new History();
    history.addStatus(create(SceneStatusSchema, { serverTimeNs: 3_000_000_000n, stepTimeP50S: 0.002, reachedRateHz: 60 }));
    expect(history.stepTime.points).toEqual([{ timeS: 3, value: 2 }]);
    expect(history.rate.points).toEqual([{ timeS: 3, value: 60 }]);
  });
});
