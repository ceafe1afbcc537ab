import { describe, expect, it } from "vitest";

import { freeName, kindsOf, placeAbove } from "../src/panel/tools";
import { decodeTopology } from "../src/stream/decode";
import { topologyBytes } from "./messages";

const positions = Float32Array.of(-1, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 4);

describe("what a new tool can be", () => {
  it("is as one of the scene, or of a size that suits the tissue, above it", () => {
    const hook = { positionM: { x: 1, y: 2, z: 3 }, cautery: { powerW: 30 }, kind: { case: "capsule" as const, value: { radiusM: 0.01 } } };
    const tools = [{ name: "hook-2", radiusM: 0.01, tipOffsetM: { x: 0, y: 0, z: 0 }, tool: hook }];
    const place = placeAbove(positions, [0, 0, 1]);
    expect(place.positionM).toEqual([0, 1, expect.closeTo(4 + 0.3 * Math.sqrt(6), 6)]);
    expect(place.radiusM).toBeCloseTo(Math.sqrt(6), 6);
    const kinds = kindsOf(decodeTopology(topologyBytes({ tools })), place);
    expect(kinds.map(({ label }) => label)).toEqual(["like hook-2", "probe", "rod", "grasper"]);
    expect(kinds[0]).toMatchObject({ stem: "hook", tool: hook });
    expect(kinds[1]!.tool.positionM).toMatchObject({ x: 0, y: 1, z: expect.closeTo(4 + 0.3 * Math.sqrt(6), 6) as number });
    expect(kinds[1]!.tool.kind).toEqual({ case: "sphericalProbe", value: { radiusM: 0.15 } });
  });

  it("leaves out tools that the server does not describe", () => {
    const tools = [{ name: "probe", radiusM: 0.01, tipOffsetM: { x: 0, y: 0, z: 0 } }];
    const kinds = kindsOf(decodeTopology(topologyBytes({ tools })), placeAbove(positions, [0, 0, 1]));
    expect(kinds.map(({ label }) => label)).toEqual(["probe", "rod", "grasper"]);
  });

  it("has a name that no tool has", () => {
    expect(freeName("probe", [])).toBe("probe");
    expect(freeName("probe", ["probe", "probe-2", "rod"])).toBe("probe-3");
  });

  it("stands above tissue without any extent, too", () => {
    expect(placeAbove(Float32Array.of(1, 1, 1), [0, 1, 0])).toEqual({ positionM: [1, 1 + 3e-7, 1], radiusM: 1e-6 });
  });
});
