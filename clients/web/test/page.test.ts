import { readFileSync } from "node:fs";

import { expect, it } from "vitest";

it("gives each id to one element only, because the program finds elements by id", () => {
  const page = readFileSync(new URL("../index.html", import.meta.url), "utf8");
  const ids = [...page.matchAll(/\sid="([^"]+)"/g)].map((match) => match[1]);
  expect(ids.length).toBeGreaterThan(20);
  expect(ids.filter((id, index) => ids.indexOf(id) !== index)).toEqual([]);
});
