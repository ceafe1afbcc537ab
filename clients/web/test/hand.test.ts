import { expect, it } from "vitest";

import { hintOf } from "../src/view/hand";

it("says what a drag does with a tool that nobody claims", () => {
  expect(hintOf("away", null)).toBeNull();
  expect(hintOf("away", 42n)).toBeNull();
  expect(hintOf("over", null)).toBe("Drag to move this tool");
  expect(hintOf("holds", null)).toBe("The tool follows the pointer");
});

it("says whose a claimed tool is, and that a drag takes it over", () => {
  expect(hintOf("over", 42n)).toBe("This tool is in the hand of client 0x2a · drag to take it over");
  expect(hintOf("holds", 2n ** 63n + 1n)).toBe("Taking this tool over from client 0x8000000000000001");
});
