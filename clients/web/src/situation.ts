// Where the page stands, in words: in the pill, and in a notice above the picture.
import type { DaemonState, LinkState } from "./stream/connection";
import { SceneState, type Frame, type Status, type Topology } from "./stream/decode";

export type Tone = "good" | "waiting" | "warning" | "bad";

export type Notice = { readonly tone: "quiet" | "warning"; readonly title: string; readonly detail: string } | null;

export interface Situation {
  readonly tone: Tone;
  /** A word or two. */
  readonly text: string;
  /** What they mean, for who points at them. */
  readonly hint?: string;
  readonly notice: Notice;
}

/** null while there is nothing to say about the connection. */
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
  /** Why what came last is not on show; null while it is. */
  readonly unshown: string | null;
}

/** @param watched The name of `scene`; null while the daemon has none that is `wanted`. */
export function sceneSituation(
  daemon: DaemonState,
  wanted: string | null,
  watched: string | null,
  { topology, frame, status, unshown }: Scene,
): Situation {
  if (daemon.problem !== "") {
    const notice = { tone: "warning", title: "Waiting for the daemon", detail: daemon.problem } as const;
    return { tone: "bad", text: "No daemon", notice };
  }
  if (watched === null) {
    const detail = wanted === null ? "The daemon has no scene." : `The daemon has no scene "${wanted}".`;
    return { tone: "waiting", text: "No scene", notice: { tone: "quiet", title: "Waiting for a scene", detail } };
  }
  if (status?.state === SceneState.FAULTED) {
    const notice = { tone: "warning", title: "Scene stopped", detail: status.fault } as const;
    return { tone: "bad", text: "Stopped", notice };
  }
  if (unshown !== null) {
    const notice = { tone: "warning", title: "New frames cannot be shown", detail: unshown } as const;
    return { tone: "bad", text: frame === null ? "No picture" : "Frozen", notice };
  }
  const standing = standingSituation(status);
  // The server gathers no vertices for a scene without frames, so its topology has none.
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

/** null for a scene that steps by itself. */
function standingSituation(status: Status | null): Omit<Situation, "notice"> | null {
  switch (status?.state) {
    case SceneState.PAUSED:
      return { tone: "warning", text: "Paused", hint: "The scene stands until it is resumed." };
    case SceneState.LOCKSTEP:
      return { tone: "waiting", text: "Lockstep", hint: "The scene steps only when it is asked to." };
    default:
      return null;
  }
}
