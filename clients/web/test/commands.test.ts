import { create } from "@bufbuild/protobuf";
import { beforeEach, describe, expect, it, vi } from "vitest";

import { Commands } from "../src/commands";
import { CommandResultSchema } from "../src/generated/tensormass/v1/gateway_pb";
import type { Toast } from "../src/panel/legend";
import type { Session } from "../src/stream/session";

const control = vi.fn<Session["control"]>();
const toast = { show: vi.fn<Toast["show"]>(), hide: vi.fn<Toast["hide"]>() };
const choose = vi.fn<(scene: string | null) => void>();
const busy: (string | null)[] = [];
let commands: Commands;

beforeEach(() => {
  vi.clearAllMocks();
  busy.length = 0;
  control.mockImplementation(({ scene }) => Promise.resolve(create(CommandResultSchema, { scene: `${scene}-2` })));
  const session = { watched: "liver", control } as unknown as Session;
  commands = new Commands(() => session, toast as unknown as Toast, () => busy.push(commands.busy), choose);
});

describe("Commands", () => {
  it("sends a command for the selected scene", async () => {
    await commands.send("step", { steps: 3 });
    expect(control).toHaveBeenCalledWith({ action: "step", scene: "liver", steps: 3 });
    expect(busy).toEqual([null, null]);
    expect(choose).not.toHaveBeenCalled();
  });

  it("selects a loaded scene by the name under which it runs, and none after an unload", async () => {
    await commands.send("load", { builtin: "beam", lockstep: true });
    expect(control).toHaveBeenCalledWith({ action: "load", scene: "beam", lockstep: true });
    expect(choose).toHaveBeenLastCalledWith("beam-2");
    expect(busy).toEqual(["load beam", null]);
    await commands.send("unload");
    expect(choose).toHaveBeenLastCalledWith(null);
  });

  it("shows why a command failed", async () => {
    control.mockRejectedValue(new Error("no such scene"));
    await commands.send("reset");
    expect(toast.show).toHaveBeenLastCalledWith("reset liver: no such scene", "bad");
  });
});
