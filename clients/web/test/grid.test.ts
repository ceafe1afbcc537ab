import { create } from "@bufbuild/protobuf";
import { beforeEach, describe, expect, it, vi } from "vitest";

import { ShownRecordingSchema, type DaemonState } from "../src/generated/tensormass/v1/gateway_pb";
import { Grid } from "../src/grid/grid";
import { DAEMON } from "./messages";

/** What all open connections tell; null: none is open. */
let daemon: DaemonState | null;

class FakeTile {
  closed = false;
  readonly session = {
    scene: null as string | null,
    lost: false,
    get daemon() {
      return this.lost ? null : daemon;
    },
    show(scene: string | null) {
      this.scene = scene;
    },
  };

  close(): void {
    this.closed = true;
  }
}

const has = (...scenes: string[]) => (daemon = { ...DAEMON, scenes });
const namesOf = (grid: Grid<FakeTile>) => grid.tiles.map(({ session }) => session.scene);
const onChange = vi.fn();
const opened: FakeTile[] = [];
const open = () => {
  opened.push(new FakeTile());
  return opened.at(-1)!;
};
const gridOf = (scene: string | null, on: boolean) => new Grid<FakeTile>({ scene, on, open, onChange });

beforeEach(() => {
  daemon = null;
  opened.length = 0;
  onChange.mockClear();
});

describe("Grid", () => {
  it("has one tile before the daemon is known, and one for each scene after", () => {
    const grid = gridOf("b", true);
    grid.arrange();
    expect(namesOf(grid)).toEqual(["b"]);
    has("a", "b", "c");
    grid.arrange();
    expect(namesOf(grid)).toEqual(["a", "b", "c"]);
    expect(grid.selected).toBe(opened[0]); // the first connection keeps its scene
    expect(grid.selected.session.scene).toBe("b");
  });

  it("shows another scene alone on the same connection", () => {
    const grid = gridOf(null, false);
    has("a", "b");
    grid.arrange();
    grid.choose("b");
    expect(namesOf(grid)).toEqual(["b"]);
    expect(opened).toHaveLength(1);
  });

  it("follows scenes that come and go, and keeps the tiles of those that stay", () => {
    const grid = gridOf(null, true);
    has("a", "b");
    grid.arrange();
    const [a, b] = grid.tiles;
    grid.select(b!);
    has("b", "c");
    grid.arrange();
    expect(namesOf(grid)).toEqual(["b", "c"]);
    expect(grid.tiles).toEqual([b, a]); // the tile of the scene that went shows the one that came
    expect(grid.selected).toBe(b);
    has("c");
    grid.arrange();
    expect(namesOf(grid)).toEqual(["c"]);
    expect(b!.closed).toBe(true);
    has();
    grid.arrange();
    expect(grid.tiles).toHaveLength(1);
    expect(grid.tiles[0]!.closed).toBe(false);
  });

  it("keeps the connection of the selected tile when all scenes change", () => {
    const grid = gridOf("b", true);
    has("a", "b");
    grid.arrange();
    const [a, b] = grid.tiles;
    has("c");
    grid.arrange();
    expect(grid.tiles).toEqual([b]);
    expect(a!.closed).toBe(true);
  });

  it("shows the selected scene alone and closes the other connections", () => {
    const grid = gridOf(null, true);
    has("a", "b", "c");
    grid.arrange();
    const [a, b, c] = grid.tiles;
    grid.select(b!);
    grid.show(false);
    expect(grid.tiles).toEqual([b]);
    expect([a!.closed, b!.closed, c!.closed]).toEqual([true, false, true]);
    expect([grid.wanted, grid.on]).toEqual(["b", false]);
    grid.show(true);
    expect(namesOf(grid)).toEqual(["a", "b", "c"]);
    expect(grid.selected).toBe(b);
  });

  it("keeps what is on show when the grid ends and the wanted scene is gone", () => {
    const grid = gridOf("gone", true);
    has("a", "b");
    grid.arrange();
    grid.show(false);
    expect(namesOf(grid)).toEqual(["a"]);
  });

  it("can leave a tile whose connection is lost, or show it alone", () => {
    const grid = gridOf("a", true);
    has("a", "b");
    grid.arrange();
    const [a, b] = grid.tiles;
    a!.session.lost = true;
    grid.arrange();
    expect(namesOf(grid)).toEqual(["a", "b"]);
    grid.select(b!);
    expect(grid.selected).toBe(b);
    grid.select(a!);
    grid.show(false);
    expect(grid.tiles).toEqual([a]);
    expect(b!.closed).toBe(true);
  });

  it("is off for a recording", () => {
    const grid = gridOf(null, true);
    daemon = { ...DAEMON, recording: create(ShownRecordingSchema, { file: "f" }) };
    grid.arrange();
    expect(grid.on).toBe(false);
    expect(grid.tiles).toHaveLength(1);
  });

  it("tells each change", () => {
    const grid = gridOf(null, true);
    has("a", "b");
    grid.arrange();
    grid.select(grid.selected);
    expect(onChange).toHaveBeenCalledTimes(1);
    grid.select(grid.tiles[1]!);
    expect(onChange).toHaveBeenCalledTimes(2);
  });
});
