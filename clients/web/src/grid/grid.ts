// The tiles of the page: one for each scene, or one alone. Panels, keys and commands act on the selected one.
import type { DaemonState } from "../generated/tensormass/v1/gateway_pb";
import { planTiles, type Plan } from "./plan";

/** The parts of a tile that the grid uses. */
export interface GridTile {
  readonly session: {
    readonly daemon: DaemonState | null;
    readonly scene: string | null;
    show(scene: string | null): void;
  };
  close(): void;
}

export interface GridOptions<Tile> {
  /** Scene that the address names; null: none. */
  readonly scene: string | null;
  /** Whether the address asks for the grid. */
  readonly on: boolean;
  /** Makes a tile without a scene. */
  readonly open: () => Tile;
  /** Called after tiles, selection or mode may have changed. */
  readonly onChange: () => void;
}

export class Grid<Tile extends GridTile> {
  readonly #options: GridOptions<Tile>;
  #tiles: readonly Tile[];
  #selected: Tile;
  #wanted: string | null;
  #on: boolean;

  constructor(options: GridOptions<Tile>) {
    this.#options = options;
    this.#wanted = options.scene;
    this.#on = options.on;
    this.#selected = options.open();
    this.#selected.session.show(options.scene);
    this.#tiles = [this.#selected];
  }

  /** The tiles in the order of their scenes. */
  get tiles(): readonly Tile[] {
    return this.#tiles;
  }

  get selected(): Tile {
    return this.#selected;
  }

  /** Scene that the user or the address chose; null: none. */
  get wanted(): string | null {
    return this.#wanted;
  }

  /** Whether all scenes are shown. A recording has one scene and no grid. */
  get on(): boolean {
    return this.#on && this.#selected.session.daemon?.recording === undefined;
  }

  /** Selects a scene, which may come later; null: the first one. */
  choose(scene: string | null): void {
    this.#wanted = scene;
    // The connection of the selected tile may be lost while that of another one is not.
    this.#selected = this.#tiles.find((tile) => tile.session.scene === scene) ?? this.#selected;
    this.arrange();
  }

  select(tile: Tile): void {
    if (tile !== this.#selected) {
      this.choose(tile.session.scene);
    }
  }

  /** Shows all scenes, or the selected one alone. */
  show(on: boolean): void {
    this.#on = on;
    // The wanted scene may be gone. The selected one then stays on show.
    this.#wanted = on ? this.#wanted : this.#selected.session.scene;
    this.arrange();
  }

  /** Matches the tiles with the daemon's scenes. A tile whose scene stays keeps its connection and camera. */
  arrange(): void {
    const plan = this.#plan();
    const kept = this.#tiles.filter((tile) => plan.scenes.includes(tile.session.scene));
    // The selected tile is used again first, because the state of the page comes from its connection.
    const others = this.#tiles.filter((tile) => tile !== this.#selected);
    const free = [this.#selected, ...others].filter((tile) => !kept.includes(tile));
    this.#tiles = plan.scenes.map((name) => kept.find((tile) => tile.session.scene === name) ?? this.#take(free, name));
    this.#selected = this.#tiles[plan.scenes.indexOf(plan.selected)]!;
    free.forEach((tile) => tile.close());
    this.#options.onChange();
  }

  /** Plans the tiles. Without a connection the scenes are unknown: those of the grid stay. */
  #plan(): Plan {
    const { daemon, scene } = this.#selected.session;
    if (daemon !== null) {
      return planTiles(daemon, this.#wanted, scene, this.#on);
    }
    return { scenes: this.#on ? this.#tiles.map((tile) => tile.session.scene) : [scene], selected: scene };
  }

  #take(free: Tile[], scene: string | null): Tile {
    const tile = free.shift() ?? this.#options.open();
    tile.session.show(scene);
    return tile;
  }
}
