import { describe, expect, it } from "vitest";

import { FIRST_WAIT_MS, Governor, LONGEST_WAIT_MS, TARGET_HZ, type Limits } from "../src/view/governor";

const LIMITS: Limits = { start: 0, best: 0, cheapest: 4 };

/** A machine that draws a picture of each level in so long [ms], and a governor on it. */
class Machine {
  readonly governor: Governor;
  readonly changes: number[] = [];
  nowMs = 0;

  constructor(
    public pictureMs: readonly number[],
    limits: Limits = LIMITS,
  ) {
    this.governor = new Governor(limits);
  }

  /** Lets it draw for a while. @param everyMs Time between two changes of the scene; 0: each turn has one. */
  run(durationMs: number, everyMs = 0): this {
    const endMs = this.nowMs + durationMs;
    let nextMs = this.nowMs;
    while (this.nowMs < endMs) {
      const drew = this.nowMs >= nextMs;
      nextMs = drew ? this.nowMs + everyMs : nextMs;
      this.turn(drew, drew ? Math.max(16, this.pictureMs[this.governor.place]!) : 16);
    }
    return this;
  }

  turn(drew: boolean, lastsMs: number): void {
    if (this.governor.turn(this.nowMs, drew)) {
      this.changes.push(this.governor.place);
    }
    this.nowMs += lastsMs;
  }
}

describe("Governor", () => {
  it("stays at the best level of a quick machine", () => {
    expect(new Machine([16, 16, 16, 16, 16]).run(60_000).changes).toEqual([]);
  });

  it("steps down until the machine draws fluently, and remembers the rates that did not", () => {
    const machine = new Machine([90, 75, 70, 40, 20]).run(60_000);
    expect(machine.changes).toEqual([1, 2, 3]);
    expect(1000 / machine.pictureMs[machine.governor.place]!).toBeGreaterThan(TARGET_HZ);
    expect(machine.governor.failedAtHz(0)).toBeCloseTo(1000 / 90);
    expect(machine.governor.failedAtHz(3)).toBeNull();
  });

  it("takes two steps at once far below the target, and ends at the cheapest level", () => {
    expect(new Machine([400, 300, 200, 180, 170]).run(60_000).changes).toEqual([2, 4]);
  });

  it("reaches the cheapest level where a picture takes longer than a window", () => {
    expect(new Machine([2500, 2000, 1500, 1200, 1100]).run(60_000).changes).toEqual([2, 4]);
  });

  it("takes no step for one late turn, and none for a slow second", () => {
    const machine = new Machine([20, 20, 20, 20, 20]);
    for (let i = 0; i < 20; i += 1) {
      machine.run(3000).turn(true, 900);
    }
    machine.pictureMs = [80, 80, 80, 80, 80];
    machine.run(1000);
    machine.pictureMs = [20, 20, 20, 20, 20];
    expect(machine.run(20_000).changes).toEqual([]);
  });

  it("steps up when it can, one level at a time", () => {
    const machine = new Machine([16, 16, 16, 16, 16], { start: 3, best: 1, cheapest: 4 }).run(60_000);
    expect(machine.changes).toEqual([2, 1]);
  });

  it("tries a level that failed ever more rarely", () => {
    const machine = new Machine([100, 20, 20, 20, 20]);
    const tries: number[] = [];
    while (machine.nowMs < 3 * LONGEST_WAIT_MS) {
      const count = machine.changes.length;
      machine.run(100);
      if (machine.changes.length > count && machine.governor.place === 0) {
        tries.push(machine.nowMs);
      }
    }
    const waits = tries.slice(1).map((atMs, i) => atMs - tries[i]!);
    expect(tries[0]).toBeGreaterThan(FIRST_WAIT_MS);
    waits.slice(1).forEach((waitMs, i) => expect(waitMs).toBeGreaterThan(1.4 * Math.min(waits[i]!, LONGEST_WAIT_MS / 2)));
    expect(Math.max(...waits)).toBeLessThan(LONGEST_WAIT_MS + 20_000);
    expect(tries.length).toBeLessThan(10);
  });

  it("trusts a level again that has held for long", () => {
    const machine = new Machine([20, 20, 20, 20, 20]);
    const fail = () => {
      machine.pictureMs = [100, 20, 20, 20, 20];
      machine.run(6000);
      machine.pictureMs = [20, 20, 20, 20, 20];
    };
    for (let i = 0; i < 4; i += 1) {
      fail();
      expect(machine.governor.place).toBe(1);
      machine.run(FIRST_WAIT_MS + 6000);
      expect(machine.governor.place).toBe(0);
      machine.run(70_000);
    }
  });

  it("says nothing about a scene that changes rarely or stands still", () => {
    expect(new Machine([60, 60, 60, 60, 60]).run(60_000, 200).changes).toEqual([]);
    expect(new Machine([500, 500, 500, 500, 500]).run(60_000, 10_000).changes).toEqual([]);
  });

  it("sees a slow picture of a scene that changes less often than the screen", () => {
    expect(new Machine([100, 30, 30, 30, 30]).run(20_000, 50).governor.place).toBe(1);
  });

  it("draws no conclusion from a page that was hidden, throttled or asleep", () => {
    const machine = new Machine([20, 20, 20, 20, 20]).run(5000);
    for (let i = 0; i < 20; i += 1) {
      machine.turn(i % 2 === 0, 1000); // throttled
    }
    for (let i = 0; i < 20; i += 1) {
      machine.turn(true, 3_600_000); // asleep
    }
    for (let i = 0; i < 20; i += 1) {
      machine.turn(true, 2000);
      machine.governor.interrupt(); // hidden
    }
    expect(machine.changes).toEqual([]);
  });
});
