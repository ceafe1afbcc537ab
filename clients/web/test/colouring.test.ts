import * as THREE from "three";
import { describe, expect, it } from "vitest";

import { colourTable, cssGradient, displacements, fitRange, legendOf, prefixFor } from "../src/view/colouring";
import { scaleBar } from "../src/view/rulers";
import { valueMaterial } from "../src/view/value_material";

describe("fitRange", () => {
  it("starts magnitudes at zero and ends them at a round number", () => {
    expect(fitRange(Float32Array.of(0.001, 0.0031), null, null)).toEqual({ least: 0, most: 0.005 });
  });

  it("lies around the middle of signed values", () => {
    expect(fitRange(Float32Array.of(0.9375, 1.03125), 1, null)).toEqual({ least: 0.9, most: 1.1 });
  });

  it("grows at once, and shrinks only if the values use little of it", () => {
    const before = { least: 0, most: 0.005 };
    expect(fitRange(Float32Array.of(0.006), null, before).most).toBe(0.01);
    expect(fitRange(Float32Array.of(0.0019), null, before).most).toBe(0.005);
    expect(fitRange(Float32Array.of(0.0012), null, before).most).toBe(0.002);
  });
});

it("measures displacements from a reference", () => {
  const values = new Float32Array(2);
  displacements(Float32Array.of(3, 4, 0, 1, 1, 1), Float32Array.of(0, 0, 0, 1, 1, 3), values);
  expect([...values]).toEqual([5, 2]);
});

it("writes a legend in units", () => {
  expect(legendOf("displacement", { least: 0, most: 0.005 }, "from rest")).toEqual({
    title: "Displacement from rest",
    ticks: ["0", "2.5", "5 mm"],
  });
  expect(legendOf("pressure", { least: -2000, most: 2000 }, "").ticks).toEqual(["-2", "0", "2 kPa"]);
  expect(legendOf("volume_ratio", { least: 0.9, most: 1.1 }, "").ticks).toEqual(["0.9", "1", "1.1"]);
});

it.each([
  [5e-4, "µ"],
  [1e-3, "m"],
  [0.5, "m"],
  [1, ""],
  [2000, "k"],
  [3e6, "M"],
  [0, ""],
])("writes %s with the prefix '%s'", (value, prefix) => {
  expect(prefixFor(value).prefix).toBe(prefix);
});

it("has the same ends of the colours in picture and legend", () => {
  const table = colourTable();
  expect([...table.subarray(0, 4)]).toEqual([68, 1, 84, 255]);
  expect([...table.subarray(-4)]).toEqual([253, 231, 37, 255]);
  expect(cssGradient()).toMatch(/rgb\(68 1 84\).*rgb\(253 231 37\)/);
  const texture = valueMaterial().uniforms.table!.value as THREE.DataTexture;
  expect(texture.image.data).toEqual(table);
});

it("draws a scale bar of a round length that fits", () => {
  for (const metresPerPx of [1e-6, 2.3e-4, 0.01, 7]) {
    const { lengthPx, text } = scaleBar(metresPerPx, 120);
    expect(lengthPx).toBeLessThanOrEqual(120);
    expect(lengthPx).toBeGreaterThan(40);
    expect(text).toMatch(/^[125]0{0,2} [a-zµ]?m$/);
  }
  expect(scaleBar(5e-4, 120)).toEqual({ lengthPx: expect.closeTo(100) as number, text: "5 cm" });
});
