// Connects the selected tile with panels, keys and commands. address.ts lists the parameters of the page's address.
import "./panel/panel.css";
import "./grid/grid.css";
import "./style.css";

import { Address } from "./address";
import { Commands } from "./commands";
import { find, setText } from "./dom";
import { Grid } from "./grid/grid";
import { layOut } from "./grid/layout";
import { MAX_TILES } from "./grid/plan";
import { Tile } from "./grid/tile";
import { Hud } from "./hud";
import { Controls, controlState } from "./panel/controls";
import { Display } from "./panel/display";
import { download } from "./panel/download";
import { filmOf } from "./panel/film";
import { holdKey, listenToKeys } from "./panel/keys";
import { Toast } from "./panel/legend";
import { MaterialPanel } from "./panel/material";
import { Plots } from "./panel/plots";
import { loadSettings, type Settings } from "./panel/settings";
import { Timeline } from "./panel/timeline";
import { ToolsPanel } from "./panel/tools";
import type { Session } from "./stream/session";
import type { Vector } from "./stream/decode";
import { QUALITIES, drawsInSoftware, qualityOf, type Level } from "./view/quality";
import { QualityControl } from "./view/quality_control";
import { Stage } from "./view/stage";

const READINGS_INTERVAL_MS = 250;

const address = new Address(window.location.href);
// Before anything connects, and so that neither history nor a copied address holds what lets a browser in.
const withoutSecrets = await address.enter();
if (withoutSecrets !== null) {
  window.history.replaceState(null, "", withoutSecrets);
}
let settings = loadSettings();
/** The scene that the panels follow. */
let followed: { readonly session: Session; readonly scene: string | null } | null = null;
/** The tile in which the pointer came over a tool, took it or left it last. */
let under: Tile | null = null;

const plots = new Plots();
const toast = new Toast();
const hud = new Hud({
  pickScene: (scene) => grid.choose(scene),
  resetView: () => grid.selected.viewer.resetView(),
});
const quality = new QualityControl(drawsInSoftware(), qualityOf(address.quality) ?? settings.quality, showLevel);
const stage = openStage();
const grid = new Grid({ scene: address.scene, on: address.grid, open: openTile, onChange: showGrid });
const commands = new Commands(() => grid.selected.session, toast, showState, (scene) => grid.choose(scene));
const controls = new Controls({ command: (action, options) => void commands.send(action, options) });
const timeline = new Timeline((action, options) => commands.send(action, options));
const material = new MaterialPanel((text) => toast.show(`Adjusting the scene: ${text}`, "bad"));
const tools = new ToolsPanel();
const display = new Display({
  change: changeDisplay,
  setZero: () => grid.selected.session.store.setZero(),
  chooseQuality(chosen) {
    quality.choose(chosen);
    window.history.replaceState(null, "", address.withoutQuality());
  },
  takePicture: () => grid.selected.takePicture(),
  film: toggleFilm,
});
const film = filmOf(() => stage.canvas, {
  onRunning(running) {
    // Some players show only the first size of a film.
    quality.hold(running);
    display.showFilm(running);
  },
  onFilm: download,
  onError: (text) => toast.show(text, "bad"),
});
display.showFilm(film.possible ? false : null);
display.showQuality(quality.choice);
if (address.quality !== null && qualityOf(address.quality) === null) {
  toast.show(`The address asks for quality "${address.quality}"; take one of ${QUALITIES.join(", ")}`, "bad");
}
document.documentElement.dataset.quality = quality.level.name;

const menus = [...document.querySelectorAll<HTMLDetailsElement>("details.menu")];
const plays = () => grid.selected.session.daemon?.recording !== undefined;
listenToKeys({
  " ": () => (plays() ? timeline.press("play") : controls.press("pause")),
  s: () => (plays() ? timeline.press("forward") : controls.press("step")),
  Home: () => (plays() ? timeline.toStart() : controls.press("restart")),
  ArrowLeft: () => timeline.press("back"),
  ArrowRight: () => timeline.press("forward"),
  g: () => grid.show(!grid.on),
  r: () => grid.selected.viewer.resetView(),
  t: () => display.change({ tools: !display.settings.tools }),
  w: () => display.change({ wireframe: !display.settings.wireframe }),
  n: () => display.change({ fixedNodes: !display.settings.fixedNodes }),
  l: () => display.change({ attachments: !display.settings.attachments }),
  a: () => display.change({ rulers: !display.settings.rulers }),
  c: () => display.nextColouring(),
  p: () => grid.selected.takePicture(),
  f: toggleFilm,
  d: () => find("#display", HTMLDetailsElement).toggleAttribute("open"),
  m: () => find("#material", HTMLDetailsElement).toggleAttribute("open"),
  i: () => find("#tools-menu", HTMLDetailsElement).toggleAttribute("open"),
  Escape: () => {
    hud.hideNotice();
    toast.hide();
    menus.forEach((menu) => (menu.open = false));
  },
});
let burning: Tile | null = null;
holdKey("b", (down) => {
  burning?.setPedal(false);
  burning = down ? grid.selected : null;
  burning?.setPedal(true);
});
find("#grid", HTMLButtonElement).addEventListener("click", () => grid.show(!grid.on));
// A click beside a menu closes it.
document.addEventListener("pointerdown", (event) => {
  for (const menu of menus) {
    menu.open &&= event.target instanceof Node && menu.contains(event.target);
  }
});
const panels = new ResizeObserver(() => layOut(grid));
panels.observe(find("#bottom", HTMLElement));
panels.observe(find("aside", HTMLElement));
window.addEventListener("resize", () => layOut(grid));
document.addEventListener("visibilitychange", () => {
  quality.interrupt();
  grid.tiles.forEach((tile) => tile.session.setPaused(document.hidden));
});
setInterval(showReadings, READINGS_INTERVAL_MS);

// For scripts and tests that control the page: what is drawn, and where.
Object.assign(window, {
  tensormass: {
    state: () => stateOf(grid.selected),
    tiles: () => grid.tiles.map(stateOf),
    project: (point: Vector) => grid.selected.project(point),
    costs: () => grid.selected.session.pace.costs,
  },
});

function openStage(): Stage {
  try {
    return new Stage(find("#view", HTMLCanvasElement), quality.level, (nowMs, drew) => quality.turn(nowMs, drew));
  } catch (error) {
    const detail = "This browser has no WebGL 2; enable hardware acceleration or use another browser.";
    const notice = { tone: "warning", title: "Nothing can be drawn", detail } as const;
    hud.show({ tone: "bad", text: "No WebGL", notice }, false);
    throw error;
  }
}

function openTile(): Tile {
  const tile = new Tile(stage, address, settings, {
    onDaemon: (changed) => changed === grid.selected && grid.arrange(),
    onChange: (changed) => (changed === grid.selected ? showState() : showTile(changed)),
    onFrame: ({ session }) => session === grid.selected.session && timeline.showStep(session.store.frame?.step ?? null),
    onPick: (picked) => grid.select(picked),
    onOpen(picked) {
      grid.select(picked);
      grid.show(false);
    },
    onHand: showHand,
  });
  tile.session.setPaused(document.hidden);
  tile.session.chooseFrames(address.framesOf(quality.level));
  return tile;
}

/** Shows which tiles there are and which is selected. */
function showGrid(): void {
  window.history.replaceState(null, "", address.with(grid.wanted, grid.on));
  layOut(grid);
  const { session } = grid.selected;
  if (session.daemon !== null) {
    const { recording, operator } = session.daemon;
    timeline.show(recording, operator);
    hud.showScenes(session.daemon, session.scene);
    const unknown = "Stress needs the elements, which this gateway knows only of scenes that it loaded.";
    const reason = recording === undefined ? unknown : "A recording has surfaces only. Replay it to get stresses.";
    display.offerFields(session.hasFields ? null : reason);
  }
  grid.tiles.forEach(showTile);
  showHand(grid.selected);
  showState();
}

function showTile(tile: Tile): void {
  tile.show(tile === grid.selected, grid.on);
}

/** Shows the state of the selected scene. */
function showState(): void {
  const { session } = grid.selected;
  const { daemon, head, watched, store } = session;
  if (followed?.session !== session || followed.scene !== watched) {
    followed = { session, scene: watched };
    material.follow(watched === null ? null : (changes) => session.adjust(watched, changes));
    tools.follow(watched === null ? null : (edit) => session.edit(watched, edit));
  }
  if (head !== null) {
    timeline.showHead(head);
  }
  hud.show(session.situation, store.frame !== null, session.recovering);
  showTile(grid.selected);
  const state = controlState(daemon, watched, store.status, commands.busy);
  controls.show(state, daemon, watched);
  material.show(state.adjust);
  tools.show(store.topology, store.frame?.positions ?? null, state.adjust);
}

function showReadings(): void {
  const { session } = grid.selected;
  hud.showReadings(session.readings());
  plots.draw(session.history);
  display.showQualityNote(quality.note());
  showHand(under !== null && grid.tiles.includes(under) ? under : grid.selected);
  // For programs that measure the page: docs/viewer.md describes both.
  document.documentElement.dataset.framesPerSecond = quality.picturesPerSecond.toFixed(1);
  grid.tiles.forEach(showTile);
  showState();
}

/** Draws at a level of quality from now on. The gateway sends what it needs. */
function showLevel(level: Level): void {
  if (level !== stage.level) {
    stage.setLevel(level);
  }
  grid.tiles.forEach(({ session }) => session.chooseFrames(address.framesOf(level)));
  document.documentElement.dataset.quality = level.name;
}

function changeDisplay(changed: Settings): void {
  settings = changed;
  grid.tiles.forEach((tile) => tile.setDisplay(changed));
}

/** Films the canvas, which in a grid has all tiles. */
function toggleFilm(): void {
  film.toggle(grid.selected.fileName());
}

/** Shows what the pointer can do with the tool below it in a tile, and whose that tool is. */
function showHand(tile: Tile): void {
  under = tile;
  const { daemon } = grid.selected.session;
  const orbit = "Drag to orbit · right-drag to pan · wheel to zoom";
  const drag = daemon?.posesAllowed === true ? `Drag a tool to move it · ${orbit.toLowerCase()}` : orbit;
  const count = daemon?.scenes.length ?? 0;
  const some = count > MAX_TILES ? `${MAX_TILES} of ${count} scenes · ` : "";
  const idle = grid.on ? `${some}Click to select · double-click to see one alone` : drag;
  setText(find("#hint", HTMLElement), tile.handHint ?? idle);
}

function stateOf({ session, viewer }: Tile): object {
  const { store } = session;
  return {
    scene: session.watched,
    topologyVersion: store.topology?.version.toString() ?? null,
    vertexCount: store.topology?.vertexCount ?? 0,
    revision: store.changes?.revision ?? 0,
    step: store.frame === null ? null : Number(store.frame.step),
    tools: store.frame?.tools ?? [],
    strands: viewer.strandCount,
    ...store.counters,
  };
}
