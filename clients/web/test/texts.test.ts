import { create, type JsonObject } from "@bufbuild/protobuf";
import { describe, expect, it } from "vitest";

import { DaemonStateSchema, PlayHeadSchema } from "../src/generated/tensormass/v1/gateway_pb";
import { parseText, writeText, type Sent } from "../src/stream/texts";
import { DAEMON_TEXT } from "./messages";

const parsed = (message: object) => parseText(JSON.stringify(message));

describe("parseText", () => {
  it("reads a daemon, and nothing more into one that says less", () => {
    const state = { problem: "", server: "s", version: "1", backend: "cpu", device: "d", posesAllowed: true, scenes: ["liver"] };
    const value = create(DaemonStateSchema, state);
    expect(parsed(DAEMON_TEXT)).toEqual({ case: "daemon", value });
    expect(value).toMatchObject({ operator: false, builtinScenes: [], fieldScenes: [] });
    expect(value.recording).toBeUndefined();
    expect(parsed({ ...DAEMON_TEXT, poses_allowed: undefined })).toMatchObject({ value: { posesAllowed: false } });
  });

  it("reads a clock", () => {
    const clock = { type: "clock", client_time_ms: 1, gateway_time_ms: 2, replaced: 3 };
    expect(parsed(clock)).toMatchObject({ case: "clock", value: { clientTimeMs: 1, gatewayTimeMs: 2, replaced: 3 } });
  });

  it("reads a recording and its play head", () => {
    const marks = [{ time_s: 1.5, kind: "contact", text: "probe touches." }];
    const recording = { file: "a.mcap", duration_s: 12.5, frames: 700, marks, note: "" };
    expect(parsed({ ...DAEMON_TEXT, recording })).toMatchObject({
      value: {
        recording: { file: "a.mcap", durationS: 12.5, frames: 700, marks: [{ timeS: 1.5, kind: "contact" }], note: "" },
      },
    });
    const head = { type: "head", time_s: 1.25, frame: 75, playing: true, speed: 2 };
    const value = create(PlayHeadSchema, { timeS: 1.25, frame: 75, playing: true, speed: 2 });
    expect(parsed(head)).toEqual({ case: "head", value });
  });

  it("reads the values of an adjusted scene", () => {
    const adjustments = { gravity_m_per_s2: { z: -9.81 }, bodies: [{ body: "liver", stiffness_factor: 2 }] };
    expect(parsed({ type: "result", id: 3, action: "adjust", scene: "liver", error: "", adjustments })).toMatchObject({
      case: "result",
      value: { id: 3, adjustments: { gravityMPerS2: { z: -9.81 }, bodies: [{ body: "liver", stiffnessFactor: 2 }] } },
    });
  });

  it("passes over fields that it does not know, also within others", () => {
    const recording = { file: "a.mcap", chapters: ["one"] };
    expect(parsed({ ...DAEMON_TEXT, mood: "good", recording })).toMatchObject({ value: { recording: { file: "a.mcap" } } });
    const findings = [{ code: "FINDING_CODE_OF_TOMORROW", message: "it rains" }];
    expect(parsed({ type: "result", id: 1, findings })).toMatchObject({ value: { findings: [{ message: "it rains" }] } });
  });

  it.each([
    "",
    "no JSON",
    "null",
    "[]",
    "7",
    "{}",
    '{"type":"other"}',
    '{"type":["daemon"],"scenes":1}',
    '{"type":"result","id":"one"}',
    '{"type":"clock","client_time_ms":true}',
    '{"type":"head","time_s":"soon"}',
    '{"type":"daemon","scenes":1}',
    '{"type":"daemon","operator":"yes"}',
    '{"type":"daemon","poses_allowed":1}',
    '{"type":"daemon","recording":[]}',
  ])("knows nothing of %s", (text) => {
    expect(parseText(text)).toBeNull();
  });
});

describe("writeText", () => {
  it.each<[Sent, JsonObject]>([
    [
      { case: "watch", value: { scene: "liver" } },
      { type: "watch", scene: "liver" },
    ],
    // Zero and nothing are told apart where both mean something.
    [
      { case: "field", value: { name: "" } },
      { type: "field", name: "" },
    ],
    [
      { case: "ack", value: { stream: "frame" } },
      { type: "ack", stream: "frame" },
    ],
    [
      { case: "frames", value: { detail: 0.5 } },
      { type: "frames", detail: 0.5 },
    ],
    [
      { case: "control", value: { id: 1, action: "seek", scene: "liver", timeS: 0 } },
      { type: "control", id: 1, action: "seek", scene: "liver", time_s: 0 },
    ],
    [
      { case: "control", value: { id: 2, action: "adjust", scene: "liver", changes: { gravityMPerS2: { z: -1 } } } },
      {
        type: "control",
        id: 2,
        action: "adjust",
        scene: "liver",
        changes: { gravity_m_per_s2: { x: 0, y: 0, z: -1 }, bodies: [] },
      },
    ],
  ])("writes %o", (message, json) => {
    expect(JSON.parse(writeText(message))).toEqual(json);
  });
});
