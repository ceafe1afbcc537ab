import { expect, it } from "vitest";

import { originFor, tipOf } from "../src/view/tip";

const SHAPE = { name: "probe", radiusM: 0.01, tipOffsetM: [0, 0, 0.02], core: { cornersM: () => [], shaftM: null }, solid: null, fixed: false, burns: false, description: null } as const;
const HALF = Math.SQRT1_2;
/** A quarter turn about x: it moves the tip from above the origin to beside it, along -y. */
const TURNED = { positionM: [1, 2, 3], orientationWxyz: [HALF, HALF, 0, 0] } as const;

it("rotates the tip with its tool", () => {
  const { x, y, z } = tipOf(SHAPE, TURNED);
  expect([x, y, z]).toEqual([expect.closeTo(1), expect.closeTo(1.98), expect.closeTo(3)]);
});

it("finds the origin of a tool from its tip in any orientation", () => {
  const { x, y, z } = tipOf(SHAPE, TURNED);
  expect(originFor(SHAPE, TURNED, [x, y, z])).toEqual(TURNED.positionM.map((value) => expect.closeTo(value) as number));
});
