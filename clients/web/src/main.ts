// Wires the gateway's stream to the store, the store to the picture and the numbers.
//
// Address: ?token= as the gateway prints it; ?scene= chooses a scene (else the first that runs);
// ?quality=high|low (else by whether there is a GPU).
import "./style.css";

import { find } from "./dom";
import { Hud, sceneNotice } from "./hud";
import { GatewayClock } from "./stream/clock";
import { Connection, type DaemonState, type LinkState } from "./stream/connection";
import { decodeFrame, decodeStatus, decodeTopology, splitMessage, type StreamName, type Vector } from "./stream/decode";
import { SceneStore } from "./stream/store";
import { chooseQuality } from "./view/quality";
import { Viewer } from "./view/viewer";

const READINGS_INTERVAL_MS = 250;
const RATE_WINDOW_MS = 2000;

const address = new URL(window.location.href);
const token = address.searchParams.get("token") ?? "";
const quality = chooseQuality(address.searchParams.get("quality"));
const store = new SceneStore();
const clock = new GatewayClock();
let wanted = address.searchParams.get("scene");
let watched: string | null = null;
let daemon: DaemonState | null = null;
let replaced = 0;
let drawn: { atMs: number; ageMs: number | null }[] = [];

const hud = new Hud({
  pickScene(scene) {
    wanted = scene;
    address.searchParams.set("scene", scene);
    window.history.replaceState(null, "", address);
    chooseScene();
  },
  resetView: () => viewer.resetView(),
  toggleTools: () => viewer.toggleTools(),
});

const viewer = openViewer();

const connection = new Connection({
  url: `${address.protocol === "https:" ? "wss:" : "ws:"}//${address.host}/stream?token=${encodeURIComponent(token)}`,
  events: { onLink, onDaemon, onMessage, onClock },
  diagnose,
});

document.addEventListener("visibilitychange", () => connection.setPaused(document.hidden));
connection.setPaused(document.hidden);
setInterval(showReadings, READINGS_INTERVAL_MS);

// For scripts and tests that drive the page: what is drawn, and where.
Object.assign(window, {
  tensormass: {
    state: () => ({
      scene: watched,
      topologyVersion: store.topology?.version.toString() ?? null,
      vertexCount: store.topology?.vertexCount ?? 0,
      tools: store.frame?.tools ?? [],
      ...store.counters,
    }),
    project: (point: Vector) => viewer.project(point),
  },
});

function openViewer(): Viewer {
  try {
    return new Viewer(find("canvas", HTMLCanvasElement), find("#labels", HTMLElement), store, quality, {
      onDrawn(serverTimeNs) {
        const atMs = performance.now();
        drawn.push({ atMs, ageMs: clock.ageMs(serverTimeNs, atMs) });
      },
      onToolMoved(tool, centerM) {
        connection.moveTool(tool, originOf(tool, centerM));
      },
    });
  } catch (error) {
    hud.showLink("bad", "No WebGL");
    const detail = "This browser draws no WebGL 2; enable hardware acceleration or take another browser.";
    hud.showNotice({ tone: "warning", title: "Nothing can be drawn", detail });
    throw error;
  }
}

function onLink(state: LinkState): void {
  if (state.kind === "open") {
    hud.showLink("waiting", "Connected");
  } else if (state.kind === "lost") {
    forget();
    daemon = null;
    hud.showLink("bad", "Disconnected");
    hud.showNotice({ tone: "warning", title: "Connection lost, trying again", detail: state.reason });
  }
}

function onDaemon(state: DaemonState): void {
  daemon = state;
  if (state.posesAllowed) {
    viewer.enableDrag();
  }
  chooseScene();
}

/** Watches the scene that is to be shown once the daemon has it. */
function chooseScene(): void {
  if (daemon === null) {
    return;
  }
  const present = daemon.scenes;
  const kept = watched !== null && present.includes(watched) ? watched : present[0];
  const target = wanted === null ? kept : present.find((scene) => scene === wanted);
  if (target === undefined) {
    forget();
  } else if (target !== watched) {
    forget();
    watched = target;
    connection.watch(target);
  }
  hud.showScenes(daemon, watched ?? wanted);
  showState();
}

/** What comes back under the same name, after a reload or a restart, may be another scene. */
function forget(): void {
  watched = null;
  store.clear();
}

function showState(): void {
  if (daemon === null) {
    return;
  }
  if (daemon.problem !== "") {
    hud.showLink("bad", "No daemon");
    hud.showNotice({ tone: "warning", title: "Waiting for the daemon", detail: daemon.problem });
  } else if (watched === null) {
    hud.showLink("waiting", "No scene");
    const detail = wanted === null ? "The daemon has no scene." : `The daemon has no scene "${wanted}".`;
    hud.showNotice({ tone: "quiet", title: "Waiting for a scene", detail });
  } else if (store.frame === null) {
    hud.showLink("waiting", "Loading");
    hud.showNotice(null);
  } else {
    hud.showLink("good", "Live");
    hud.showNotice(sceneNotice(store.status));
  }
}

function onMessage(data: ArrayBuffer): void {
  let stream: StreamName | null = null;
  try {
    const message = splitMessage(data);
    stream = message.stream;
    // What was on its way when the scene was changed is acknowledged but not shown.
    if (message.scene === watched) {
      switch (message.stream) {
        case "topology":
          store.setTopology(decodeTopology(message.payload));
          break;
        case "frame":
          store.setFrame(decodeFrame(message.payload));
          break;
        case "status":
          store.setStatus(decodeStatus(message.payload));
          break;
      }
    }
  } catch (error) {
    const reason = error instanceof Error ? error.message : String(error);
    console.warn(reason);
    store.refuse(reason);
  }
  if (stream !== null) {
    connection.acknowledge(stream);
  }
}

function onClock(reply: { clientTimeMs: number; gatewayTimeMs: number; replaced: number }, receivedMs: number): void {
  clock.add(reply.clientTimeMs, receivedMs, reply.gatewayTimeMs);
  replaced = reply.replaced;
}

/** A WebSocket that was refused says no reason; the gateway's status page does. */
async function diagnose(): Promise<string> {
  try {
    const reply = await fetch(`/status?token=${encodeURIComponent(token)}`);
    return reply.ok ? "" : await reply.text();
  } catch {
    return "";
  }
}

function showReadings(): void {
  const now = performance.now();
  drawn = drawn.filter(({ atMs }) => atMs > now - RATE_WINDOW_MS);
  const ages = drawn.flatMap(({ ageMs }) => ageMs ?? []).sort((a, b) => a - b);
  hud.showReadings({
    status: store.status,
    counters: store.counters,
    drawRateHz: store.topology === null ? null : drawn.length / (RATE_WINDOW_MS / 1000),
    ageMs: ages[Math.floor(ages.length / 2)] ?? null,
    ageUncertaintyMs: clock.uncertaintyMs(),
    replaced,
  });
  showState();
}

/** A pose is the tool's origin; what the pointer holds is its sphere. */
function originOf(tool: string, centerM: Vector): Vector {
  const offset = store.topology?.tools.find((shape) => shape.name === tool)?.tipOffsetM ?? [0, 0, 0];
  return [centerM[0] - offset[0], centerM[1] - offset[1], centerM[2] - offset[2]];
}
