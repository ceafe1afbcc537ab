import { create } from "@bufbuild/protobuf";
import { expect, it } from "vitest";

import { SceneStatusSchema } from "../src/generated/tensormass/v1/stream_pb";
import { errorText, recoveredText, targetText } from "../src/hud";
import { SceneState } from "../src/stream/decode";

it("names the target rate of the physics, if there is one", () => {
  const text = (fields: object) => targetText(create(SceneStatusSchema, fields));
  expect(text({ state: SceneState.RUNNING, targetRateHz: 60 })).toBe("of 60 Hz");
  expect(text({ state: SceneState.PAUSED, targetRateHz: 33.333 })).toBe("of 33.3 Hz");
  expect(text({ state: SceneState.LOCKSTEP, targetRateHz: 0 })).toBe("in lockstep");
  expect(targetText(null)).toBe("Hz");
});

it("counts the steps of recoveries, and those in which tissue was held", () => {
  const text = (recoveringSteps: bigint, heldSteps: bigint) => recoveredText({ recoveringSteps, heldSteps });
  expect([text(1n, 0n), text(3n, 0n), text(3n, 1n)]).toEqual(["1 step", "3 steps", "3 steps, 1 held"]);
});

it("states the error of positions in a unit that fits", () => {
  expect([1.234e-6, 9.96e-4, 0.00213].map(errorText)).toEqual(["± 1.2 µm", "± 1000 µm", "± 2.1 mm"]);
  expect([0, null].map(errorText)).toEqual(["", ""]);
});
