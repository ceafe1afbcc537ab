// The state of the page in words: for the pill in the header and for the notice beside the picture.
import type { DaemonState, PlayHead, ShownRecording } from "./generated/tensormass/v1/gateway_pb";
import type { LinkState } from "./stream/connection";
import { SceneState, type Frame, type Status, type Topology } from "./stream/decode";

export type Tone = "good" | "waiting" | "warning" | "bad";

export type Notice = { readonly tone: "quiet" | "warning"; readonly title: string; readonly detail: string } | null;

export interface Situation {
  readonly tone: Tone;
  /** Text of the pill: a word or two. */
  readonly text: string;
  /** Tooltip of the pill. */
  readonly hint?: string;
  readonly notice: Notice;
}

/** The situation while there is no state of the daemon. null: the connection has nothing to say. */
export function linkSituation(link: LinkState): Situation | null {
  switch (link.kind) {
    case "connecting":
      return null;
    case "open":
      return { tone: "waiting", text: "Connected", notice: null };
    case "lost": {
      const title = link.everOpened ? "Connection lost, trying again" : "No connection, trying again";
      return { tone: "bad", text: "Disconnected", notice: { tone: "warning", title, detail: link.reason } };
    }
    case "refused":
      return { tone: "bad", text: "Refused", notice: { tone: "warning", title: "Not let in", detail: link.reason } };
  }
}

export interface Scene {
  readonly topology: Topology | null;
  readonly frame: Frame | null;
  readonly status: Status | null;
  /** Why the newest topology or frame is not on show; null while it is. */
  readonly unshown: string | null;
  /** Why the newest changes of the surface are not on show; null while they are. */
  readonly unshownChanges: string | null;
}

/**
 * @param wanted Name in the address; null if the user chose none.
 * @param watched Name of the scene on show; null while the daemon does not have it.
 */
export function sceneSituation(
  daemon: DaemonState,
  wanted: string | null,
  watched: string | null,
  scene: Scene,
): Situation {
  const { topology, frame, status } = scene;
  if (daemon.problem !== "") {
    const notice = { tone: "warning", title: "Waiting for the daemon", detail: daemon.problem } as const;
    return { tone: "bad", text: "No daemon", notice };
  }
  if (watched === null) {
    const detail = [
      wanted === null ? "The daemon has no scene." : `The daemon has no scene "${wanted}".`,
      daemon.scenes.length > 0 ? `It has ${daemon.scenes.map((name) => `"${name}"`).join(", ")}.` : "",
      remedy(daemon),
    ]
      .filter(Boolean)
      .join(" ");
    return { tone: "waiting", text: "No scene", notice: { tone: "quiet", title: "Waiting for a scene", detail } };
  }
  const trouble = troubleOf(scene);
  if (trouble !== null) {
    return trouble;
  }
  const standing = standingSituation(status);
  // A scene without frames has a topology without vertices.
  if (topology?.vertexCount === 0) {
    const detail = "The scene sends no frames (streams.frame_rate_hz is 0).";
    const notice = { tone: "quiet", title: "Nothing to show", detail } as const;
    return { ...(standing ?? { tone: "waiting", text: "No frames" }), notice };
  }
  if (standing !== null) {
    return { ...standing, notice: null };
  }
  return frame === null
    ? { tone: "waiting", text: "Loading", notice: null }
    : { tone: "good", text: "Live", notice: null };
}

/** How a page without a scene gets one. Only operators load. */
function remedy({ scenes, operator }: DaemonState): string {
  if (scenes.length === 0) {
    return operator ? "Load one with + in the header." : "";
  }
  return operator ? "Choose one in the header, or load another one with +." : "Choose one in the header.";
}

/** The situation of a page that shows a recording. @param head null before the gateway has told it. */
export function recordingSituation(recording: ShownRecording, head: PlayHead | null, scene: Scene): Situation {
  const notice =
    recording.note === "" ? null : ({ tone: "quiet", title: "Not the whole recording", detail: recording.note } as const);
  const trouble = troubleOf(scene);
  if (trouble !== null) {
    return trouble;
  }
  if (head === null || scene.frame === null) {
    return { tone: "waiting", text: "Loading", notice };
  }
  if (head.playing) {
    return { tone: "good", text: "Playing", hint: recording.file, notice };
  }
  const ended = head.timeS >= recording.durationS;
  return { tone: "warning", text: ended ? "Ended" : "Paused", hint: `${recording.file}: Space plays it`, notice };
}

/** The situation of a scene that a guard stopped, or whose frames cannot be drawn; null: neither. */
function troubleOf({ frame, status, unshown, unshownChanges }: Scene): Situation | null {
  if (status?.state === SceneState.FAULTED) {
    const notice = { tone: "warning", title: "Scene stopped", detail: status.fault } as const;
    return { tone: "bad", text: "Stopped", notice };
  }
  if (unshown !== null) {
    const notice = { tone: "warning", title: "New frames cannot be shown", detail: unshown } as const;
    return { tone: "bad", text: frame === null ? "No picture" : "Frozen", notice };
  }
  if (unshownChanges !== null) {
    const notice = { tone: "warning", title: "The surface has changed and cannot be shown", detail: unshownChanges } as const;
    return { tone: "bad", text: "Outdated", notice };
  }
  return null;
}

/** null if the scene steps by itself. */
function standingSituation(status: Status | null): Omit<Situation, "notice"> | null {
  switch (status?.state) {
    case SceneState.PAUSED:
      return { tone: "warning", text: "Paused", hint: "The scene does not step until it is resumed." };
    case SceneState.LOCKSTEP:
      return { tone: "waiting", text: "Lockstep", hint: "The scene steps only when it is asked to." };
    default:
      return null;
  }
}
