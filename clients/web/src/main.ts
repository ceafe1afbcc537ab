// Connects the gateway's stream to the store, and the store to the picture and the readings.
//
// Parameters of the address: ?token= as the gateway prints it; ?scene= names the scene to show (default: the first that
// runs); ?quality=high|low (default: high with a GPU, low without).
import "./style.css";

import { find } from "./dom";
import { Hud } from "./hud";
import { linkSituation, sceneSituation, type Situation } from "./situation";
import { GatewayClock } from "./stream/clock";
import { Connection, type ClockReply, type DaemonState, type Diagnosis, type LinkState } from "./stream/connection";
import { decodeFrame, decodeStatus, decodeTopology, splitMessage, type StreamName, type Vector } from "./stream/decode";
import { SceneStore } from "./stream/store";
import { chooseQuality } from "./view/quality";
import { originFor } from "./view/tip";
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
let watchedSinceMs = 0;
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

const streamAddress = `//${address.host}/stream?token=${encodeURIComponent(token)}`;
const connection = new Connection({
  url: `${address.protocol === "https:" ? "wss:" : "ws:"}${streamAddress}`,
  events: { onLink, onDaemon, onMessage, onClock },
  diagnose,
});

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
        drawn.push({ atMs, ageMs: store.followsAnother ? clock.ageMs(serverTimeNs, atMs) : null });
      },
      onToolMoved: moveTool,
    });
  } catch (error) {
    const detail = "This browser has no WebGL 2; enable hardware acceleration or use another browser.";
    const notice = { tone: "warning", title: "Nothing can be drawn", detail } as const;
    hud.show({ tone: "bad", text: "No WebGL", notice }, false);
    throw error;
  }
}

function onLink(state: LinkState): void {
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
  chooseScene();
}

/** Watches the wanted scene if the daemon has it. Without a wanted scene it keeps the present one or takes the first. */
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
    watchedSinceMs = performance.now();
    connection.watch(target);
  }
  hud.showScenes(daemon, watched ?? wanted);
  showState();
}

/** Forgets the watched scene. After a reload or a restart the same name may be another scene. */
function forget(): void {
  watched = null;
  replaced = 0;
  store.clear();
}

function showState(): void {
  if (daemon !== null) {
    show(sceneSituation(daemon, wanted, watched, store));
  }
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
    store.refuse(reason, stream);
  }
  if (stream !== null) {
    connection.acknowledge(stream);
  }
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
    return { reason: await reply.text(), final: reply.status === 403 };
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
  showState();
}

/** Sends the pose that brings the tool's sphere to `centerM` and keeps the tool's orientation. */
function moveTool(name: string, centerM: Vector): void {
  const shape = store.topology?.tools.find((tool) => tool.name === name);
  const state = store.frame?.tools.find((tool) => tool.name === name);
  if (shape !== undefined && state !== undefined) {
    connection.moveTool({ ...state, positionM: originFor(shape, state, centerM) });
  }
}
