import { create } from "@bufbuild/protobuf";
import { describe, expect, it } from "vitest";

import { SceneStatusSchema } from "../src/generated/tensormass/v1/stream_pb";
import { controlState } from "../src/panel/controls";
import { SceneState } from "../src/stream/decode";
import { DAEMON } from "./messages";

const OPERATOR = { ...DAEMON, operator: true };
const inState = (state: SceneState) => controlState(OPERATOR, "liver", create(SceneStatusSchema, { state }), null);

describe("controlState", () => {
  it("pauses a scene that runs and resumes one that is paused", () => {
    expect(inState(SceneState.RUNNING)).toMatchObject({ pauses: true, pause: null, reset: null, unload: null, load: null });
    expect(inState(SceneState.PAUSED)).toMatchObject({ pauses: false, pause: null, reset: null });
  });

  it("steps a scene that stands, and does not pause one in lockstep", () => {
    expect(inState(SceneState.LOCKSTEP)).toMatchObject({ step: null, pause: expect.stringMatching(/lockstep/) as string });
    expect(inState(SceneState.PAUSED).step).toBeNull();
    for (const state of [SceneState.RUNNING, SceneState.FAULTED]) {
      expect(inState(state).step).toMatch(/by hand/);
    }
  });

  it("only resets or unloads a scene that has stopped", () => {
    expect(inState(SceneState.FAULTED)).toMatchObject({ pause: expect.stringMatching(/Reset/) as string, reset: null, unload: null });
  });

  it("gives one reason for everything to who only looks", () => {
    const status = create(SceneStatusSchema, { state: SceneState.LOCKSTEP });
    const { pauses, ...reasons } = controlState(DAEMON, "liver", status, null);
    expect(pauses).toBe(true);
    expect(new Set(Object.values(reasons))).toEqual(new Set([expect.stringMatching(/only lets you look/)]));
  });

  it("waits for the answer to a command", () => {
    const status = create(SceneStatusSchema, { state: SceneState.RUNNING });
    expect(controlState(OPERATOR, "liver", status, "load beam")).toMatchObject({
      pause: "Waiting for an answer: load beam.",
      load: "Waiting for an answer: load beam.",
    });
  });

  it("still loads where there is no scene, and does nothing without a daemon", () => {
    expect(controlState(OPERATOR, null, null, null)).toMatchObject({ load: null, reset: "There is no scene." });
    expect(controlState(OPERATOR, "liver", null, null)).toMatchObject({ pause: expect.stringMatching(/not known/) as string });
    expect(controlState(null, null, null, null).load).toBe("There is no daemon.");
    expect(controlState({ ...OPERATOR, problem: "gone" }, null, null, null).load).toBe("There is no daemon.");
  });
});
