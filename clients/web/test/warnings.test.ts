import { beforeEach, describe, expect, it } from "vitest";

import { REWORD_MS, STAY_MS, Warnings } from "../src/stream/warnings";

const steps = (seconds: string) => `steps take ${seconds} s of a budget of 0.01 s`;

describe("Warnings", () => {
  let warnings: Warnings;
  beforeEach(() => {
    warnings = new Warnings();
  });

  it("keeps a wording for a while although the numbers change", () => {
    warnings.update([steps("0.02")], 0);
    warnings.update([steps("3.1e-02")], REWORD_MS - 1);
    expect(warnings.texts()).toEqual([steps("0.02")]);
    warnings.update([steps("0.04")], REWORD_MS);
    expect(warnings.texts()).toEqual([steps("0.04")]);
  });

  it("keeps a warning that comes and goes, in its place, until it stays away", () => {
    warnings.update([steps("0.02"), "other"], 0);
    warnings.update(["other"], STAY_MS);
    expect(warnings.texts()).toEqual([steps("0.02"), "other"]);
    warnings.update(["other"], STAY_MS + 1);
    expect(warnings.texts()).toEqual(["other"]);
  });

  it("treats digits in quoted names as part of the name", () => {
    const texts = ["body 'lobe1': strain 0.5", "body 'lobe2': strain 0.5"];
    warnings.update(texts, 0);
    expect(warnings.texts()).toEqual(texts);
  });
});
