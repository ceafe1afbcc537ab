import { create } from "@bufbuild/protobuf";
import { describe, expect, it } from "vitest";

import { RecordingMarkSchema } from "../src/generated/tensormass/v1/gateway_pb";
import { Drag, Steps, markText, percentOf, timeText, type HeadOptions } from "../src/panel/timeline";

/** A gateway that answers when the test says so. */
class Gateway {
  readonly sent: string[] = [];
  readonly #answers: (() => void)[] = [];

  readonly send = (action: string, options: HeadOptions = {}): Promise<void> => {
    this.sent.push([action, ...Object.values<number>({ ...options })].join(" "));
    return new Promise((done) => this.#answers.push(done));
  };

  async answer(): Promise<void> {
    this.#answers.shift()!();
    await new Promise((done) => setTimeout(done));
  }
}

describe("Drag", () => {
  it("has one seek under way and sends the newest place next", async () => {
    const gateway = new Gateway();
    const drag = new Drag(gateway.send);
    drag.hold(false);
    [1, 2, 3].forEach((timeS) => drag.moveTo(timeS));
    expect(gateway.sent).toEqual(["seek 1"]);
    await gateway.answer();
    expect(gateway.sent).toEqual(["seek 1", "seek 3"]);
    drag.moveTo(4);
    drag.release();
    await gateway.answer();
    expect(gateway.sent).toEqual(["seek 1", "seek 3", "seek 4"]);
    expect(drag.active).toBe(true);
    await gateway.answer();
    expect(drag.active).toBe(false);
  });

  it("pauses a recording that plays while the handle is held, and plays on from its last place", async () => {
    const gateway = new Gateway();
    const drag = new Drag(gateway.send);
    drag.hold(true);
    drag.hold(false); // a second pointer
    drag.moveTo(1);
    drag.moveTo(2);
    await gateway.answer();
    expect(drag.active).toBe(true);
    drag.release();
    drag.release();
    await gateway.answer();
    await gateway.answer();
    expect(gateway.sent).toEqual(["pause", "seek 2", "resume"]);
  });

  it("seeks without being held, as by a mark or a key", async () => {
    const gateway = new Gateway();
    const drag = new Drag(gateway.send);
    drag.moveTo(5);
    expect(drag.active).toBe(true);
    await gateway.answer();
    expect([gateway.sent, drag.active]).toEqual([["seek 5"], false]);
  });
});

describe("Steps", () => {
  it("sends the steps of a held key together, and none if they cancel out", async () => {
    const gateway = new Gateway();
    const steps = new Steps(gateway.send);
    void steps.by(1);
    [1, 1, 1, -1].forEach((count) => void steps.by(count as 1 | -1));
    await gateway.answer();
    void steps.by(-1);
    void steps.by(1);
    await gateway.answer();
    void steps.by(-1);
    await gateway.answer();
    expect(gateway.sent).toEqual(["step 1", "step 2", "step_back 1"]);
  });
});

it("writes times with the unit, and what a mark means", () => {
  expect(timeText(3.2, 12)).toBe("3.20 / 12.00 s");
  expect(markText(create(RecordingMarkSchema, { timeS: 2.4, kind: "contact", text: "probe touches." }))).toBe("2.40 s: probe touches.");
});

it("places times on the bar, and stays on it", () => {
  expect([percentOf(3, 12), percentOf(13, 12), percentOf(-1, 12), percentOf(0, 0)]).toEqual([25, 100, 0, 0]);
});
