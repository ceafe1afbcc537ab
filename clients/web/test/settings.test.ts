import { expect, it } from "vitest";

import { DEFAULTS, parseSettings } from "../src/panel/settings";

it("reads what it wrote", () => {
  const settings = { ...DEFAULTS, colouring: "pressure", clipAxis: "y", clipShare: 0.25, rulers: true, quality: "simple", plots: false } as const;
  expect(parseSettings(JSON.stringify(settings))).toEqual(settings);
});

it.each([
  null,
  "",
  "no JSON",
  "null",
  "[1]",
  '{"colouring":"temperature","wireframe":"yes","clipAxis":1,"clipShare":7,"tools":null,"quality":"best","readings":"open"}',
  '{"clipShare":null}',
])("takes the default for what is missing or wrong in %s", (text) => {
  expect(parseSettings(text)).toEqual(DEFAULTS);
});
