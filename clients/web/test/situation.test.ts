import { create } from "@bufbuild/protobuf";
import { describe, expect, it } from "vitest";

import { PlayHeadSchema, ShownRecordingSchema } from "../src/generated/tensormass/v1/gateway_pb";
import { SceneStatusSchema } from "../src/generated/tensormass/v1/stream_pb";
import { linkSituation, recordingSituation, sceneSituation, type Scene } from "../src/situation";
import { SceneState, decodeFrame, decodeTopology } from "../src/stream/decode";
import { DAEMON, frameBytes, topologyBytes } from "./messages";

const SHOWN: Scene = { topology: decodeTopology(topologyBytes()), frame: decodeFrame(frameBytes()), status: null, unshown: null, unshownChanges: null };

function inState(state: SceneState, scene: Partial<Scene> = {}) {
  const status = create(SceneStatusSchema, { state, fault: "det F is 0" });
  return sceneSituation(DAEMON, null, "liver", { ...SHOWN, status, ...scene });
}

describe("sceneSituation", () => {
  it("is live only while the scene runs", () => {
    expect(inState(SceneState.RUNNING)).toEqual({ tone: "good", text: "Live", notice: null });
    expect(inState(SceneState.LOCKSTEP)).toEqual({
      tone: "waiting",
      text: "Lockstep",
      hint: "The scene steps only when it is asked to.",
      notice: null,
    });
    // No notice: it would cover the picture that the user paused to see.
    expect(inState(SceneState.PAUSED)).toMatchObject({ tone: "warning", text: "Paused", notice: null });
    expect(inState(SceneState.FAULTED)).toMatchObject({
      tone: "bad",
      text: "Stopped",
      notice: { tone: "warning", detail: "det F is 0" },
    });
  });

  it("waits for the first frame", () => {
    expect(inState(SceneState.RUNNING, { frame: null })).toEqual({ tone: "waiting", text: "Loading", notice: null });
  });

  it("is not live while the scene's messages are refused", () => {
    const refused = { unshown: "frame 9: a position is not finite" };
    expect(inState(SceneState.RUNNING, refused)).toMatchObject({
      tone: "bad",
      text: "Frozen",
      notice: { tone: "warning", detail: "frame 9: a position is not finite" },
    });
    expect(inState(SceneState.RUNNING, { ...refused, frame: null }).text).toBe("No picture");
    expect(inState(SceneState.PAUSED, refused).text).toBe("Frozen");
    expect(inState(SceneState.FAULTED, refused).text).toBe("Stopped");
  });

  it("says that a scene sends no frames, unless it has stopped", () => {
    const withoutFrames = { topology: decodeTopology(topologyBytes({ bodies: [] })), frame: null };
    expect(inState(SceneState.RUNNING, withoutFrames)).toMatchObject({
      text: "No frames",
      notice: { detail: "The scene sends no frames (streams.frame_rate_hz is 0)." },
    });
    expect(inState(SceneState.PAUSED, withoutFrames)).toMatchObject({ text: "Paused", notice: { title: "Nothing to show" } });
    expect(inState(SceneState.LOCKSTEP, withoutFrames).text).toBe("Lockstep");
    expect(inState(SceneState.FAULTED, withoutFrames).notice?.detail).toBe("det F is 0");
  });

  it("names the missing daemon or scene", () => {
    const detail = (change: object, wanted: string | null) =>
      sceneSituation({ ...DAEMON, ...change }, wanted, null, SHOWN).notice?.detail;
    const unknown = 'The daemon has no scene "kidney". It has "liver", "vein". Choose one in the header';
    expect(detail({ scenes: ["liver", "vein"] }, "kidney")).toBe(`${unknown}.`);
    expect(detail({ scenes: ["liver", "vein"], operator: true }, "kidney")).toBe(`${unknown}, or load another one with +.`);
    expect(detail({ scenes: [], operator: true }, null)).toBe("The daemon has no scene. Load one with + in the header.");
    expect(sceneSituation({ ...DAEMON, problem: "gone" }, null, null, SHOWN).notice?.detail).toBe("gone");
  });
});

describe("linkSituation", () => {
  it("distinguishes a lost connection, one that never opened and a refusal", () => {
    const title = (link: Parameters<typeof linkSituation>[0]) => linkSituation(link)?.notice?.title;
    expect(title({ kind: "lost", everOpened: true, reason: "" })).toBe("Connection lost, trying again");
    expect(title({ kind: "lost", everOpened: false, reason: "" })).toBe("No connection, trying again");
    expect(title({ kind: "refused", reason: "" })).toBe("Not let in");
  });

  it("is not live before a scene is shown", () => {
    expect(linkSituation({ kind: "connecting" })).toBeNull();
    expect(linkSituation({ kind: "open" })).toEqual({ tone: "waiting", text: "Connected", notice: null });
  });
});

describe("recordingSituation", () => {
  const recording = create(ShownRecordingSchema, { file: "a.mcap", durationS: 10, frames: 600 });
  const at = (timeS: number, playing: boolean) => create(PlayHeadSchema, { timeS, playing, speed: 1 });

  it("tells whether the recording plays, stands still or has ended", () => {
    expect(recordingSituation(recording, at(4, true), SHOWN)).toMatchObject({ tone: "good", text: "Playing", notice: null });
    expect(recordingSituation(recording, at(4, false), SHOWN)).toMatchObject({ tone: "warning", text: "Paused" });
    expect(recordingSituation(recording, at(10, false), SHOWN).text).toBe("Ended");
    expect(recordingSituation(recording, null, SHOWN).text).toBe("Loading");
    expect(recordingSituation(recording, at(0, false), { ...SHOWN, frame: null }).text).toBe("Loading");
  });

  it("says that a file was cut off, and shows where a guard stopped the scene", () => {
    const note = "The file was cut off.";
    const notice = { tone: "quiet", detail: note };
    expect(recordingSituation({ ...recording, note }, at(4, true), SHOWN)).toMatchObject({ text: "Playing", notice });
    const status = create(SceneStatusSchema, { state: SceneState.FAULTED, fault: "det F is 0" });
    const stopped = recordingSituation({ ...recording, note }, at(4, false), { ...SHOWN, status });
    expect(stopped).toMatchObject({ text: "Stopped", notice: { detail: "det F is 0" } });
  });
});
