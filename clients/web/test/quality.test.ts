import { describe, expect, it, vi } from "vitest";

import { LEVELS, QUALITIES, placeOf, qualityOf, type Level, type Quality } from "../src/view/quality";
import { QualityControl } from "../src/view/quality_control";

const MATERIALS: readonly Level["material"][] = ["moist", "plain", "simple"];
const GROUNDS: readonly Level["ground"][] = ["grid", "lines", "none"];

describe("levels", () => {
  it("cost less from one to the next: nothing gets finer, and something gets coarser", () => {
    const costs = LEVELS.map((level: Level) => [
      level.pixelRatio,
      Number(level.smooth),
      Number(level.antialias),
      -MATERIALS.indexOf(level.material),
      Number(level.reflections),
      Number(level.shadows),
      -GROUNDS.indexOf(level.ground),
      level.detail,
      level.rateHz ?? Infinity,
    ]);
    for (const [at, next] of costs.slice(1).entries()) {
      const before = costs[at]!;
      expect([LEVELS[at + 1]!.name, next.every((cost, i) => cost <= before[i]!)]).toEqual([LEVELS[at + 1]!.name, true]);
      expect(next).not.toEqual(before);
    }
  });

  it("ask the gateway for no more than it gives", () => {
    for (const { detail, rateHz } of LEVELS as readonly Level[]) {
      expect([detail >= 0.01, detail <= 1, rateHz === null || rateHz > 15]).toEqual([true, true, true]);
    }
  });

  it("have names that are known", () => {
    expect(QUALITIES.map(qualityOf)).toEqual(QUALITIES);
    expect(new Set(QUALITIES).size).toBe(LEVELS.length + 1);
    expect([qualityOf("best"), qualityOf(null), qualityOf(3)]).toEqual([null, null, null]);
    expect(LEVELS.map(({ name }) => LEVELS[placeOf(name)]!.name)).toEqual(LEVELS.map(({ name }) => name));
  });
});

describe("QualityControl", () => {
  const apply = vi.fn<(level: Level) => void>();
  let nowMs = 0;

  const open = (software: boolean, choice: Quality) => {
    apply.mockClear();
    nowMs = 0;
    return new QualityControl(software, choice, apply);
  };
  /** Lets each picture take so long for 30 s. */
  const run = (control: QualityControl, pictureMs: number) => {
    for (const endMs = nowMs + 30_000; nowMs < endMs; nowMs += pictureMs) {
      control.turn(nowMs, true);
    }
  };

  it("starts at the best level with a GPU, and at a cheap one without", () => {
    expect([open(false, "automatic"), open(true, "automatic")].map(({ level }) => level.name)).toEqual(["high", "simple"]);
    expect(open(false, "automatic").note()).toBe("Now high.");
    expect(open(true, "automatic").note()).toBe("Now simple: this browser draws without a GPU.");
  });

  it("goes down on a slow machine and says why", () => {
    const control = open(true, "automatic");
    run(control, 80);
    expect(control.level.name).toBe("least");
    expect(control.note()).toBe("Now least: coarse drew 13 pictures a second here.");
    expect(control.picturesPerSecond).toBeCloseTo(12.5, 0);
    expect(apply.mock.calls.map(([level]) => level.name)).toEqual(["coarse", "least"]);
  });

  it("goes up on a quick machine, without a GPU only to the level that starts at once", () => {
    const control = open(true, "automatic");
    run(control, 16);
    expect(control.level.name).toBe("low");
    expect(control.note()).toBe("Now low: this browser draws without a GPU.");
  });

  it.each(LEVELS.map(({ name }) => name))("never leaves %s if the user fixed it", (name) => {
    const control = open(true, name);
    run(control, 200);
    run(control, 16);
    expect([control.level.name, control.note()]).toEqual([name, `Fixed at ${name}.`]);
    expect(apply).not.toHaveBeenCalled();
  });

  it("takes what the user chooses, and chooses again by itself when asked to", () => {
    const control = open(false, "automatic");
    control.choose("least");
    run(control, 16);
    expect([control.choice, control.level.name]).toEqual(["least", "least"]);
    control.choose("automatic");
    expect(control.level.name).toBe("high");
    control.choose("automatic");
    expect(apply.mock.calls.map(([level]) => level.name)).toEqual(["least", "high"]);
  });

  it("keeps the level while it is held, and counts pictures nevertheless", () => {
    const control = open(false, "automatic");
    control.hold(true);
    run(control, 250);
    expect([control.level.name, control.picturesPerSecond]).toEqual(["high", 4]);
    control.hold(false);
    run(control, 250);
    expect(control.level.name).not.toBe("high");
  });
});
