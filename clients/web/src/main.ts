// Connects the gateway's stream to the store, and the store to the picture and the readings.
//
// Parameters of the address: ?token= as the gateway prints it; ?scene= names the scene to show (default: the first that
// runs); ?quality=high|low (default: high with a GPU, low without); ?codec=float32|q16|delta (default: q16), ?rate_hz= and
// ?normals= choose the frames that the gateway sends (docs/protocol.md).
import "./panel/panel.css";
import "./style.css";

import { find } from "./dom";
import { Hud } from "./hud";
import { Controls, controlState, type Action } from "./panel/controls";
import { Display } from "./panel/display";
import { download } from "./panel/download";
import { filmOf } from "./panel/film";
import { listenToKeys } from "./panel/keys";
import { LegendPanel, Toast } from "./panel/legend";
import { MaterialPanel, type Adjustments } from "./panel/material";
import { savePicture } from "./panel/picture";
import { Plots } from "./panel/plots";
import { loadSettings, type Settings } from "./panel/settings";
import { Timeline, type HeadAction, type HeadOptions } from "./panel/timeline";
import { linkSituation, recordingSituation, sceneSituation, type Situation } from "./situation";
import { GatewayClock } from "./stream/clock";
import { Connection, type ClockReply, type DaemonState, type Diagnosis, type Head, type LinkState } from "./stream/connection";
import {
  decodeField,
  decodeFrame,
  decodeStatus,
  decodeTopology,
  slotOf,
  splitMessage,
  type BusMessage,
  type Frame,
  type StreamName,
  type Vector,
} from "./stream/decode";
import { FrameDecoder } from "./stream/encoded";
import { SceneStore } from "./stream/store";
import { colourTable } from "./view/colouring";
import type { Hand } from "./view/drag";
import { chooseQuality } from "./view/quality";
import { originFor } from "./view/tip";
import { Viewer } from "./view/viewer";

const READINGS_INTERVAL_MS = 250;
const RATE_WINDOW_MS = 2000;
/** Number of frames whose costs the page remembers. */
const COSTS_KEPT = 300;

/** What a frame cost this page [ms]. */
interface Costs {
  readonly atMs: number;
  readonly bytes: number;
  readonly decodeMs: number;
  readonly prepareMs: number;
  readonly renderMs: number;
}

const address = new URL(window.location.href);
const token = address.searchParams.get("token") ?? "";
const quality = chooseQuality(address.searchParams.get("quality"));
const store = new SceneStore();
const plots = new Plots();
const legend = new LegendPanel();
const toast = new Toast();
const clock = new GatewayClock();
let wanted = address.searchParams.get("scene");
let watched: string | null = null;
let daemon: DaemonState | null = null;
/** The play head of a recording; null before the first message about it. */
let head: Head | null = null;
let watchedSinceMs = 0;
/** The load or unload that is not answered yet, in words. */
let busy: string | null = null;
/** The element field that the gateway was asked for. */
let field: string | null = null;
let valuesRevision = 0;
let replaced = 0;
let drawn: { atMs: number; ageMs: number | null }[] = [];
let decoded = { bytes: 0, decodeMs: 0 };
const costs: Costs[] = [];

const hud = new Hud({
  pickScene(scene) {
    wanted = scene;
    writeWanted();
    chooseScene();
  },
  resetView: () => viewer.resetView(),
});

const viewer = openViewer();
const controls = new Controls({ command: (action, options) => void command(action, options) });
const timeline = new Timeline(command);

const material = new MaterialPanel({
  adjust,
  onError: (text) => toast.show(`Adjusting the scene: ${text}`, "bad"),
});

const frameDecoder = new FrameDecoder();
const streamAddress = `//${address.host}/stream?${streamQuery().toString()}`;
const connection = new Connection({
  url: `${address.protocol === "https:" ? "wss:" : "ws:"}${streamAddress}`,
  events: { onLink, onDaemon, onHead, onMessage, onClock },
  diagnose,
});

const display = new Display({ change: changeDisplay, setZero: () => store.setZero(), takePicture, film: toggleFilm });
const film = filmOf(find("#view", HTMLCanvasElement), {
  onRunning(running) {
    viewer.holdSize(running);
    display.showFilm(running);
  },
  onFilm: download,
  onError: (text) => toast.show(text, "bad"),
});
display.showFilm(film.possible ? false : null);
const menus = [...document.querySelectorAll<HTMLDetailsElement>("details.menu")];
listenToKeys({
  " ": () => (daemon?.recording ? timeline.press("play") : controls.press("pause")),
  s: () => (daemon?.recording ? timeline.press("forward") : controls.press("step")),
  Home: () => (daemon?.recording ? timeline.toStart() : controls.press("restart")),
  ArrowLeft: () => timeline.press("back"),
  ArrowRight: () => timeline.press("forward"),
  r: () => viewer.resetView(),
  t: () => display.change({ tools: !display.settings.tools }),
  w: () => display.change({ wireframe: !display.settings.wireframe }),
  n: () => display.change({ fixedNodes: !display.settings.fixedNodes }),
  a: () => display.change({ rulers: !display.settings.rulers }),
  c: () => display.nextColouring(),
  p: takePicture,
  f: toggleFilm,
  d: () => find("#display", HTMLDetailsElement).toggleAttribute("open"),
  m: () => find("#material", HTMLDetailsElement).toggleAttribute("open"),
  Escape: () => {
    hud.hideNotice();
    toast.hide();
    menus.forEach((menu) => (menu.open = false));
  },
});
// A click beside a menu closes it.
document.addEventListener("pointerdown", (event) => {
  for (const menu of menus) {
    menu.open &&= event.target instanceof Node && menu.contains(event.target);
  }
});
new ResizeObserver(coverView).observe(find("#bottom", HTMLElement));
window.addEventListener("resize", coverView);

document.addEventListener("visibilitychange", () => connection.setPaused(document.hidden));
connection.setPaused(document.hidden);
setInterval(showReadings, READINGS_INTERVAL_MS);

// For scripts and tests that control the page: what is drawn, and where.
Object.assign(window, {
  tensormass: {
    state: () => ({
      scene: watched,
      topologyVersion: store.topology?.version.toString() ?? null,
      vertexCount: store.topology?.vertexCount ?? 0,
      step: store.frame === null ? null : Number(store.frame.step),
      tools: store.frame?.tools ?? [],
      ...store.counters,
    }),
    project: (point: Vector) => viewer.project(point),
    costs: () => costs,
  },
});

function openViewer(): Viewer {
  try {
    return new Viewer(find("#view", HTMLCanvasElement), find("#labels", HTMLElement), store, quality, loadSettings(), {
      onDrawn(serverTimeNs, prepareMs, renderMs) {
        const atMs = performance.now();
        costs.push({ atMs, ...decoded, prepareMs, renderMs });
        costs.splice(0, costs.length - COSTS_KEPT);
        drawn.push({ atMs, ageMs: store.followsAnother && daemon?.recording === null ? clock.ageMs(serverTimeNs, atMs) : null });
      },
      onToolMoved: moveTool,
      onHand: showHand,
      onLegend: (meaning) => legend.show(meaning),
    });
  } catch (error) {
    const detail = "This browser has no WebGL 2; enable hardware acceleration or use another browser.";
    const notice = { tone: "warning", title: "Nothing can be drawn", detail } as const;
    hud.show({ tone: "bad", text: "No WebGL", notice }, false);
    throw error;
  }
}

/** The token, and what this page chooses of its frames. The gateway refuses a choice that there is not, in words. */
function streamQuery(): URLSearchParams {
  const query = new URLSearchParams({ token, codec: "q16" });
  for (const name of ["codec", "rate_hz", "normals", "detail"]) {
    const value = address.searchParams.get(name);
    if (value !== null) {
      query.set(name, value);
    }
  }
  return query;
}

function onLink(state: LinkState): void {
  frameDecoder.reset();
  if (state.kind === "lost" || state.kind === "refused") {
    forget();
    daemon = null;
  }
  const situation = linkSituation(state);
  if (situation !== null) {
    show(situation);
  }
}

function onDaemon(state: DaemonState): void {
  daemon = state;
  if (state.posesAllowed) {
    viewer.enableDrag();
  }
  showHand("away");
  timeline.show(state.recording, state.operator);
  chooseScene();
}

function onHead(newest: Head): void {
  head = newest;
  timeline.showHead(newest);
  showState();
}

/** Watches the wanted scene if the daemon has it. Without a wanted scene it keeps the present one or takes the first. */
function chooseScene(): void {
  if (daemon === null) {
    return;
  }
  const present = daemon.scenes;
  const kept = watched !== null && present.includes(watched) ? watched : present[0];
  // A recording has one scene, so a name that is left in the address means nothing.
  const target = wanted === null || daemon.recording !== null ? kept : present.find((scene) => scene === wanted);
  if (target === undefined) {
    forget();
  } else if (target !== watched) {
    forget();
    watched = target;
    watchedSinceMs = performance.now();
    connection.watch(target);
    field = null;
  }
  askForField();
  hud.showScenes(daemon, watched ?? wanted);
  const known = watched !== null && daemon.fieldScenes.includes(watched);
  const unknown = "Stress needs the elements, which this gateway knows only of scenes that it loaded.";
  const reason = daemon.recording === null ? unknown : "A recording has surfaces only. Replay it to get stresses.";
  display.offerFields(known ? null : reason);
  showState();
}

/** Forgets the watched scene. After a reload or a restart the same name may be another scene. */
function forget(): void {
  watched = null;
  replaced = 0;
  store.clear();
  plots.clear();
  material.forget();
}

function showState(): void {
  if (daemon !== null) {
    const { recording } = daemon;
    show(recording === null ? sceneSituation(daemon, wanted, watched, store) : recordingSituation(recording, head, store));
  }
  const state = controlState(daemon, watched, store.status, busy);
  controls.show(state, daemon, watched);
  material.show(state.adjust);
}

function show(situation: Situation): void {
  hud.show(situation, store.frame !== null);
}

function onMessage(data: ArrayBuffer): void {
  let stream: StreamName | null = null;
  try {
    const message = splitMessage(data);
    stream = message.stream;
    // A message of the previous scene may still be under way. It is acknowledged but not shown.
    if (message.scene === watched) {
      switch (message.stream) {
        case "topology":
        case "simplified_topology":
          store.setTopology(decodeTopology(message.payload, message.stream));
          break;
        case "frame":
        case "encoded_frame":
          store.setFrame(decodeAndTime(message));
          plotForces();
          timeline.showStep(store.frame?.step ?? null);
          break;
        case "rest":
          store.setRest(decodeFrame(message.payload));
          break;
        case "field":
          store.setField(decodeField(message.payload));
          break;
        case "status":
          store.setStatus(decodeStatus(message.payload));
          plotStatus();
          showState();
          break;
      }
    }
  } catch (error) {
    const reason = error instanceof Error ? error.message : String(error);
    console.warn(reason);
    store.refuse(reason, stream);
  }
  if (stream !== null) {
    connection.acknowledge(stream, slotOf(stream) === "frame" ? frameDecoder.keyframe : null);
  }
  if (valuesRevision !== store.valuesRevision) {
    valuesRevision = store.valuesRevision;
    viewer.recolour();
  }
}

function decodeAndTime({ stream, payload }: BusMessage): Frame {
  const beganMs = performance.now();
  const frame = frameDecoder.decode(stream, payload);
  decoded = { bytes: payload.length, decodeMs: performance.now() - beganMs };
  return frame;
}

function onClock(reply: ClockReply, receivedMs: number): void {
  clock.add(reply.clientTimeMs, receivedMs, reply.gatewayTimeMs);
  // A request sent before the change of scene counts frames of the previous scene.
  if (watched !== null && reply.clientTimeMs >= watchedSinceMs) {
    replaced = reply.replaced;
  }
}

/** Asks the gateway by POST why a connection failed. A browser hides the reason of a refused WebSocket from its page. */
async function diagnose(): Promise<Diagnosis> {
  try {
    const reply = await fetch(streamAddress, { method: "POST" });
    if (reply.ok) {
      return { reason: "the gateway answers, but no WebSocket gets through to it", final: false };
    }
    return { reason: await reply.text(), final: reply.status === 403 || reply.status === 400 };
  } catch {
    return { reason: "the gateway does not answer", final: false };
  }
}

function showReadings(): void {
  const now = performance.now();
  drawn = drawn.filter(({ atMs }) => atMs > now - RATE_WINDOW_MS);
  const ages = drawn.flatMap(({ ageMs }) => ageMs ?? []).sort((a, b) => a - b);
  hud.showReadings({
    status: store.status,
    currentStatus: store.currentStatus,
    warnings: store.warnings.texts(),
    counters: store.counters,
    drawRateHz: store.topology === null ? null : drawn.length / (RATE_WINDOW_MS / 1000),
    ageMs: ages[Math.floor(ages.length / 2)] ?? null,
    ageUncertaintyMs: clock.uncertaintyMs(),
    // The gateway may have replaced frames before one that is not drawn yet, so the count is bounded by `dropped`.
    replaced: Math.min(replaced, store.counters.dropped),
  });
  plots.draw();
  showState();
}

function plotForces(): void {
  const { frame, topology } = store;
  if (frame !== null && topology !== null) {
    const moving = new Set(topology.tools.filter((tool) => !tool.fixed).map((tool) => tool.name));
    const forces = frame.tools.filter((tool) => moving.has(tool.name));
    plots.addForces(
      frame.simulatedTimeS,
      forces.map((tool) => ({ name: tool.name, magnitudeN: Math.hypot(...tool.forceN) })),
    );
  }
}

function plotStatus(): void {
  const { status } = store;
  if (status !== null) {
    plots.addStatus(Number(status.serverTimeNs) / 1e9, 1e3 * status.stepTimeP50S, status.reachedRateHz);
  }
}

/** Sends a command of the operator and shows its failure. */
async function command(
  action: Action | HeadAction,
  options: HeadOptions & { builtin?: string; lockstep?: boolean } = {},
): Promise<void> {
  const { builtin, lockstep = false, ...more } = options;
  const scene = builtin ?? watched;
  if (scene === null) {
    return;
  }
  // The other commands take a step's time. Keys that follow each other quickly must not get lost.
  const slow = action === "load" || action === "unload";
  busy = slow ? `${action} ${scene}` : busy;
  showState();
  if (action === "load") {
    toast.show(`Loading ${scene} …`, "quiet");
  }
  try {
    const result = await connection.control({ action, scene, ...(action === "load" ? { lockstep } : more) });
    toast.hide();
    if (slow) {
      wanted = action === "load" ? result.scene : null;
      writeWanted();
      chooseScene();
    }
  } catch (error) {
    toast.show(`${action} ${scene}: ${error instanceof Error ? error.message : String(error)}`, "bad");
  }
  busy = slow ? null : busy;
  showState();
}

/** Changes values of the watched scene. The gateway checks what it answers, so its form is known. */
async function adjust(changes: Adjustments): Promise<Adjustments> {
  if (watched === null) {
    return {};
  }
  const result = await connection.control({ action: "adjust", scene: watched, changes });
  return result.adjustments ?? {};
}

/** Keeps the chosen scene in the address, so that a reload shows it again. */
function writeWanted(): void {
  if (wanted === null) {
    address.searchParams.delete("scene");
  } else {
    address.searchParams.set("scene", wanted);
  }
  window.history.replaceState(null, "", address);
}

function changeDisplay(settings: Settings): void {
  viewer.setDisplay(settings);
  askForField(settings);
}

/** Asks the gateway for the element field that is shown as colours, and for none if none is. */
function askForField(settings: Settings = display.settings): void {
  const known = daemon !== null && watched !== null && daemon.fieldScenes.includes(watched);
  const { colouring } = settings;
  const next = known && colouring !== "tissue" && colouring !== "displacement" ? colouring : null;
  if (next !== field) {
    field = next;
    connection.showField(next);
  }
}

function takePicture(): void {
  savePicture(viewer.drawForPicture(), colourTable(), nameOfFile());
}

function toggleFilm(): void {
  film.toggle(nameOfFile());
}

/** The name of a picture or film without its ending: the scene and its time. */
function nameOfFile(): string {
  const time = store.frame === null ? "" : `-${store.frame.simulatedTimeS.toFixed(2)}s`;
  return `tensormass-${watched ?? "empty"}${time}`;
}

/** Shows what the pointer can do with the tool below it. */
function showHand(hand: Hand): void {
  find("#view", HTMLElement).dataset.hand = hand;
  const orbit = "Drag to orbit · right-drag to pan · wheel to zoom";
  const drag = daemon?.posesAllowed === true ? `Drag a tool to move it · ${orbit.toLowerCase()}` : orbit;
  find("#hint", HTMLElement).textContent = hand === "over" ? "Drag to move this tool" : hand === "holds" ? "The tool follows the pointer" : drag;
}

/** Keeps the organ out from under the panels of a narrow window. */
function coverView(): void {
  const narrow = window.innerWidth <= 760;
  const { top } = find(narrow ? "#bottom" : "#timeline", HTMLElement).getBoundingClientRect();
  // A time line that is hidden has no place.
  const covered = top > 0 ? Math.min(window.innerHeight - top, window.innerHeight / 2) : 0;
  viewer.cover(narrow ? 64 : 0, covered);
}

/** Sends the pose that brings the tool's sphere to `centerM` and keeps the tool's orientation. */
function moveTool(name: string, centerM: Vector): void {
  const shape = store.topology?.tools.find((tool) => tool.name === name);
  const state = store.frame?.tools.find((tool) => tool.name === name);
  if (shape !== undefined && state !== undefined) {
    connection.moveTool({ ...state, positionM: originFor(shape, state, centerM) });
  }
}
