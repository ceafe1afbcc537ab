import { describe, expect, it, vi } from "vitest";

import { Changes, FAST_DAMPING, GRAVITY, gravityOfLength, merged, SLOW_DAMPING, STIFFNESS, type Adjustments } from "../src/panel/material";

describe("scales of the material's sliders", () => {
  it.each([STIFFNESS, SLOW_DAMPING, FAST_DAMPING, GRAVITY])("$label: a position and its value belong together", (scale) => {
    for (const position of [0, 0.1, 0.5, 0.995, 1]) {
      expect(scale.positionOf(scale.valueAt(position))).toBeCloseTo(position, 12);
    }
  });

  it("has the loaded stiffness in the middle, and nothing at the low ends of the others", () => {
    expect(STIFFNESS.valueAt(0.5)).toBe(1);
    expect([SLOW_DAMPING, FAST_DAMPING, GRAVITY].map((scale) => scale.valueAt(0))).toEqual([0, 0, 0]);
  });

  it("stays at its end for a value beyond it", () => {
    expect(STIFFNESS.positionOf(1000)).toBe(1);
    expect(STIFFNESS.positionOf(0.001)).toBe(0);
    expect(SLOW_DAMPING.positionOf(1e6)).toBe(1);
  });

  it("writes values with their units", () => {
    expect(STIFFNESS.text(2.512)).toBe("× 2.5");
    expect(SLOW_DAMPING.text(0)).toBe("0 1/s");
    expect(FAST_DAMPING.text(0.00123)).toBe("0.0012 s");
    expect(GRAVITY.text(9.81)).toBe("9.8 m/s²");
  });
});

describe("gravityOfLength", () => {
  it("keeps the direction", () => {
    expect(gravityOfLength({ x: 0, y: 0, z: -9.81 }, 5)).toEqual({ x: 0, y: 0, z: -5 });
    const { x, y } = gravityOfLength({ x: 3, y: -4, z: 0 }, 10);
    expect([x, y]).toEqual([6, -8]);
  });

  it("points down where there is no direction", () => {
    expect(gravityOfLength({ x: 0, y: 0, z: 0 }, 3)).toEqual({ x: 0, y: -3, z: 0 });
  });
});

describe("merged", () => {
  it("loses no change that waits, and takes the later of two for one value", () => {
    const gravity = { x: 0, y: 0, z: -1 };
    const stiffer = merged({ gravityMPerS2: gravity }, { bodies: [{ body: "liver", stiffnessFactor: 2 }] });
    const calmer = merged(stiffer, { bodies: [{ body: "liver", rayleighMassPerS: 3 }, { body: "kidney", stiffnessFactor: 4 }] });
    expect(merged(calmer, { bodies: [{ body: "liver", stiffnessFactor: 5 }] })).toEqual({
      gravityMPerS2: gravity,
      bodies: [
        { body: "liver", stiffnessFactor: 5, rayleighMassPerS: 3 },
        { body: "kidney", stiffnessFactor: 4 },
      ],
    });
  });

  it("keeps a change when the panel only asks for the values", () => {
    const change = { bodies: [{ body: "liver", stiffnessFactor: 2 }] };
    expect(merged(change, {})).toEqual(change);
  });
});

describe("Changes", () => {
  it("sends one change at a time, merges those that wait, and shows the last values only", async () => {
    const answers: (() => void)[] = [];
    const sent: Adjustments[] = [];
    const adjust = (changes: Adjustments) => {
      sent.push(changes);
      return new Promise<Adjustments>((done) => answers.push(() => done(changes)));
    };
    const onValues = vi.fn();
    const changes = new Changes(adjust, onValues, vi.fn());
    const stiffness = (factor: number) => ({ bodies: [{ body: "liver", stiffnessFactor: factor }] });
    const gravity = { gravityMPerS2: { x: 0, y: 0, z: -1 } };
    [stiffness(1), gravity, stiffness(2), stiffness(3)].forEach((change) => changes.send(change));
    expect(sent).toEqual([stiffness(1)]);
    answers[0]!();
    await vi.waitFor(() => expect(sent).toEqual([stiffness(1), { ...gravity, ...stiffness(3) }]));
    expect(onValues).not.toHaveBeenCalled();
    answers[1]!();
    await vi.waitFor(() => expect(onValues).toHaveBeenCalledExactlyOnceWith({ ...gravity, ...stiffness(3) }));
  });

  it("goes on after a failure", async () => {
    const onError = vi.fn();
    const adjust = vi.fn<() => Promise<Adjustments>>().mockRejectedValueOnce(new Error("busy")).mockResolvedValue({});
    const onValues = vi.fn();
    const changes = new Changes(adjust, onValues, onError);
    changes.send({});
    await vi.waitFor(() => expect(onError).toHaveBeenCalledWith("busy"));
    changes.send({});
    await vi.waitFor(() => expect(onValues).toHaveBeenCalled());
  });
});
