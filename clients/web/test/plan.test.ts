import { create } from "@bufbuild/protobuf";
import { describe, expect, it } from "vitest";

import { ShownRecordingSchema } from "../src/generated/tensormass/v1/gateway_pb";
import { MAX_TILES, columnsFor, freeArea, planTiles } from "../src/grid/plan";
import { DAEMON } from "./messages";

const having = (...scenes: string[]) => ({ ...DAEMON, scenes });

describe("planTiles", () => {
  it("shows one scene alone: the wanted one, else the one on show, else the first", () => {
    const daemon = having("a", "b", "c");
    expect(planTiles(daemon, "c", "b", false)).toEqual({ scenes: ["c"], selected: "c" });
    expect(planTiles(daemon, null, "b", false)).toEqual({ scenes: ["b"], selected: "b" });
    expect(planTiles(daemon, null, "gone", false)).toEqual({ scenes: ["a"], selected: "a" });
  });

  it("waits for a wanted scene that the daemon lacks", () => {
    expect(planTiles(having("a"), "later", "a", false)).toEqual({ scenes: ["later"], selected: "later" });
    expect(planTiles(having(), "later", null, true)).toEqual({ scenes: ["later"], selected: "later" });
    expect(planTiles(having(), null, null, false)).toEqual({ scenes: [null], selected: null });
  });

  it("shows all scenes in a grid and keeps the selection while its scene is there", () => {
    expect(planTiles(having("a", "b"), "b", null, true)).toEqual({ scenes: ["a", "b"], selected: "b" });
    expect(planTiles(having("a", "b"), null, "b", true)).toEqual({ scenes: ["a", "b"], selected: "b" });
    expect(planTiles(having("a"), "b", "b", true)).toEqual({ scenes: ["a"], selected: "a" });
  });

  it("has a limit of tiles, and the selected scene is always one of them", () => {
    const names = Array.from({ length: MAX_TILES + 2 }, (_, index) => `scene${10 + index}`);
    const { scenes, selected } = planTiles(having(...names), names.at(-1)!, null, true);
    expect(scenes).toEqual([...names.slice(0, MAX_TILES - 1), names.at(-1)]);
    expect(selected).toBe(names.at(-1));
  });

  it("has no grid for a recording, and no name to wait for", () => {
    const recording = create(ShownRecordingSchema, { file: "f" });
    for (const grid of [false, true]) {
      expect(planTiles({ ...having("a"), recording }, "b", null, grid)).toEqual({ scenes: ["a"], selected: "a" });
    }
  });
});

describe("columnsFor", () => {
  it.each([
    [1, 1200, 700, 1],
    [2, 1200, 700, 2],
    [2, 500, 700, 1],
    [4, 1200, 700, 2],
    [6, 1200, 700, 3],
    [9, 1200, 700, 3],
    [9, 346, 700, 1], // a phone
  ])("lays %i scenes in %i x %i pixels out in %i columns", (count, width, height, columns) => {
    expect(columnsFor(count, width, height)).toBe(columns);
  });
});

describe("freeArea", () => {
  const header = { left: 22, top: 18, right: 938, bottom: 50 };
  const buttons = { left: 500, top: 580, right: 938, bottom: 618 };

  it("leaves open readings beside the grid and folded ones below it", () => {
    const size = { width: 960, height: 640 };
    const open = { left: 22, top: 300, right: 260, bottom: 618 };
    expect(freeArea(size, header, open, buttons)).toEqual({ left: 274, top: 64, right: 938, bottom: 566 });
    expect(freeArea(size, header, { ...open, top: 545 }, buttons)).toEqual({ left: 22, top: 64, right: 938, bottom: 531 });
    const withWarning = { ...open, top: 500 };
    expect(freeArea(size, header, withWarning, buttons)).toEqual({ left: 22, top: 64, right: 938, bottom: 486 });
  });

  it("takes half of a narrow window, however long the readings are", () => {
    const readings = { left: 22, top: 150, right: 368, bottom: 822 };
    const area = freeArea({ width: 390, height: 844 }, header, readings, { left: 22, top: 110, right: 368, bottom: 140 });
    expect(area).toEqual({ left: 22, top: 64, right: 368, bottom: 64 + (844 - 64) / 2 });
  });
});
