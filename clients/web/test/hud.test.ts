import { create } from "@bufbuild/protobuf";
import { expect, it } from "vitest";

import { SceneStatusSchema } from "../src/generated/tensormass/v1/stream_pb";
import { errorText, targetText } from "../src/hud";
import { SceneState } from "../src/stream/decode";

it("names the target rate of the physics, if there is one", () => {
  const text = (fields: object) => targetText(create(SceneStatusSchema, fields));
  expect(text({ state: SceneState.RUNNING, targetRateHz: 60 })).toBe("of 60 Hz");
  expect(text({ state: SceneState.PAUSED, targetRateHz: 33.333 })).toBe("of 33.3 Hz");
  expect(text({ state: SceneState.LOCKSTEP, targetRateHz: 0 })).toBe("in lockstep");
  expect(targetText(null)).toBe("Hz");
});

it("states the error of positions in a unit that fits", () => {
  expect([1.234e-6, 9.96e-4, 0.00213].map(errorText)).toEqual(["± 1.2 µm", "± 1000 µm", "± 2.1 mm"]);
  expect([0, null].map(errorText)).toEqual(["", ""]);
});
