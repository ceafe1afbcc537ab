import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";

import {
  Connection,
  FIRST_RETRY_MS,
  LAST_RETRY_MS,
  type ConnectionEvents,
  type Diagnosis,
} from "../src/stream/connection";
import { FakeSocket } from "./fake_socket";
import { DAEMON_TEXT } from "./messages";

const DAEMON = JSON.stringify(DAEMON_TEXT);

describe("Connection", () => {
  const events = {
    onLink: vi.fn<ConnectionEvents["onLink"]>(),
    onDaemon: vi.fn<ConnectionEvents["onDaemon"]>(),
    onHead: vi.fn<ConnectionEvents["onHead"]>(),
    onMessage: vi.fn<ConnectionEvents["onMessage"]>(),
    onClock: vi.fn<ConnectionEvents["onClock"]>(),
  };
  const diagnose = vi.fn(() => Promise.resolve({ reason: "full", final: false }));
  let connection: Connection;

  beforeEach(() => {
    vi.useFakeTimers();
    vi.spyOn(Math, "random").mockReturnValue(0.5);
    FakeSocket.opened = [];
    vi.clearAllMocks();
    connection = new Connection({
      url: "ws://host/stream",
      events,
      diagnose,
      WebSocket: FakeSocket as unknown as typeof WebSocket,
    });
  });

  afterEach(() => {
    connection.close();
    vi.useRealTimers();
    vi.restoreAllMocks();
  });

  it("reconnects after a loss and reports the gateway's reason", async () => {
    FakeSocket.last.open();
    connection.watch("liver");
    expect(FakeSocket.last.of("watch")).toEqual([{ type: "watch", scene: "liver" }]);
    FakeSocket.last.fail("bye");
    await vi.advanceTimersByTimeAsync(FIRST_RETRY_MS);
    expect(FakeSocket.opened).toHaveLength(2);
    FakeSocket.last.open();
    expect(diagnose).not.toHaveBeenCalled();
    expect(events.onLink.mock.calls.map(([state]) => state)).toEqual([
      { kind: "connecting" },
      { kind: "open" },
      { kind: "lost", everOpened: true, reason: "bye" },
      { kind: "connecting" },
      { kind: "open" },
    ]);
  });

  it("waits longer after each failure, up to a limit, and starts short again after a success", async () => {
    const waits: number[] = [];
    for (let attempt = 0; attempt < 7; attempt += 1) {
      const count = FakeSocket.opened.length;
      FakeSocket.last.fail("");
      const begin = Date.now();
      while (FakeSocket.opened.length === count) {
        await vi.advanceTimersToNextTimerAsync();
      }
      waits.push(Date.now() - begin);
    }
    expect(waits).toEqual([250, 500, 1000, 2000, LAST_RETRY_MS, LAST_RETRY_MS, LAST_RETRY_MS]);

    FakeSocket.last.open();
    FakeSocket.last.onmessage?.({ data: DAEMON });
    const count = FakeSocket.opened.length;
    FakeSocket.last.fail("");
    await vi.advanceTimersByTimeAsync(FIRST_RETRY_MS);
    expect(FakeSocket.opened).toHaveLength(count + 1);
  });

  it("asks why a connection did not open, and tries again", async () => {
    FakeSocket.last.fail("");
    await vi.advanceTimersByTimeAsync(0);
    expect(events.onLink).toHaveBeenLastCalledWith({ kind: "lost", everOpened: false, reason: "full" });
    await vi.advanceTimersByTimeAsync(FIRST_RETRY_MS);
    expect(FakeSocket.opened).toHaveLength(2);
  });

  it("stops trying after a final refusal", async () => {
    diagnose.mockResolvedValueOnce({ reason: "the token is wrong", final: true });
    FakeSocket.last.fail("");
    await vi.advanceTimersByTimeAsync(10 * LAST_RETRY_MS);
    expect(events.onLink).toHaveBeenLastCalledWith({ kind: "refused", reason: "the token is wrong" });
    expect(FakeSocket.opened).toHaveLength(1);
  });

  it("owes one acknowledgement for each stream while paused", () => {
    FakeSocket.last.open();
    connection.acknowledge("frame");
    connection.setPaused(true);
    connection.acknowledge("frame");
    connection.acknowledge("status");
    expect(FakeSocket.last.of("ack")).toEqual([{ type: "ack", stream: "frame" }]);
    connection.setPaused(false);
    expect(FakeSocket.last.of("ack").map((ack) => ack.stream)).toEqual(["frame", "frame", "status"]);
    connection.setPaused(true);
    connection.setPaused(false); // an acknowledgement is sent once
    expect(FakeSocket.last.of("ack")).toHaveLength(3);
  });

  it("acknowledges an encoded frame as a frame, with the keyframe that the page has", () => {
    FakeSocket.last.open();
    connection.acknowledge("encoded_frame", 3);
    connection.acknowledge("frame", null);
    connection.setPaused(true);
    connection.acknowledge("encoded_frame", 4);
    connection.setPaused(false);
    expect(FakeSocket.last.of("ack")).toEqual([
      { type: "ack", stream: "frame", keyframe: 3 },
      { type: "ack", stream: "frame" },
      { type: "ack", stream: "frame", keyframe: 4 },
    ]);
  });

  it("warns when the gateway refuses a choice of frames", () => {
    const warn = vi.spyOn(console, "warn").mockReturnValue();
    FakeSocket.last.open();
    FakeSocket.last.onmessage?.({ data: '{"type":"frames","codec":"q16","rate_hz":null,"normals":false,"error":""}' });
    expect(warn).not.toHaveBeenCalled();
    FakeSocket.last.onmessage?.({ data: '{"type":"frames","error":"keyframe 7 was never sent"}' });
    expect(warn).toHaveBeenCalledWith(expect.stringContaining("keyframe 7 was never sent"));
  });

  it("owes a new connection no acknowledgements", async () => {
    FakeSocket.last.open();
    connection.setPaused(true);
    connection.acknowledge("frame");
    FakeSocket.last.fail("");
    await vi.advanceTimersByTimeAsync(FIRST_RETRY_MS);
    FakeSocket.last.open();
    connection.setPaused(false);
    expect(FakeSocket.last.of("ack")).toEqual([]);
  });

  it("moves a tool and keeps its orientation", () => {
    FakeSocket.last.open();
    connection.moveTool({ name: "probe", positionM: [1, 2, 3], orientationWxyz: [0.6, 0, 0.8, 0] });
    expect(FakeSocket.last.of("pose")).toEqual([
      { type: "pose", tool: "probe", position_m: [1, 2, 3], orientation: [0.6, 0, 0.8, 0] },
    ]);
  });

  it("sends the level of a tool that burns", () => {
    FakeSocket.last.open();
    const pose = { name: "probe", positionM: [1, 2, 3], orientationWxyz: [1, 0, 0, 0] } as const;
    connection.moveTool(pose, 0.5);
    connection.moveTool(pose, 0);
    const plain = { type: "pose", tool: "probe", position_m: [1, 2, 3], orientation: [1, 0, 0, 0] };
    expect(FakeSocket.last.of("pose")).toEqual([{ ...plain, level: 0.5 }, plain]);
  });

  it("returns the result of a command, or fails with the gateway's reason", async () => {
    FakeSocket.last.open();
    const loaded = connection.control({ action: "load", scene: "beam", lockstep: true });
    const refused = connection.control({ action: "step", scene: "beam" });
    expect(FakeSocket.last.of("control")).toEqual([
      { type: "control", id: 1, action: "load", scene: "beam", lockstep: true },
      { type: "control", id: 2, action: "step", scene: "beam" },
    ]);
    const answer = (fields: object) => FakeSocket.last.onmessage?.({ data: JSON.stringify({ type: "result", ...fields }) });
    answer({ id: 2, action: "step", scene: "beam", error: "it runs by the clock" });
    answer({ id: 1, action: "load", scene: "beam-2", error: "" });
    answer({ id: 9, action: "load", scene: "beam-2", error: "" }); // nobody asked
    await expect(refused).rejects.toThrow("it runs by the clock");
    expect(await loaded).toMatchObject({ scene: "beam-2" });
  });

  it("fails a command that the connection does not outlive, or that it never had", async () => {
    await expect(connection.control({ action: "pause", scene: "liver" })).rejects.toThrow("no connection");
    FakeSocket.last.open();
    const waiting = connection.control({ action: "pause", scene: "liver" });
    FakeSocket.last.fail("bye");
    await expect(waiting).rejects.toThrow("connection was lost");
  });

  it("asks for a field, and for none any more", () => {
    FakeSocket.last.open();
    connection.showField("von_mises");
    connection.showField(null);
    expect(FakeSocket.last.of("field").map(({ name }) => name)).toEqual(["von_mises", ""]);
  });

  it("stays closed when closed", async () => {
    FakeSocket.last.open();
    connection.close();
    await vi.advanceTimersByTimeAsync(10 * LAST_RETRY_MS);
    expect(FakeSocket.opened).toHaveLength(1);
  });

  it("stops trying when closed between two attempts", async () => {
    FakeSocket.last.fail("");
    connection.close();
    await vi.advanceTimersByTimeAsync(10 * LAST_RETRY_MS);
    expect(FakeSocket.opened).toHaveLength(1);
  });

  it("reports no failed attempt once the next has started", async () => {
    let answer: (diagnosis: Diagnosis) => void = () => undefined;
    diagnose.mockReturnValueOnce(new Promise((resolve) => (answer = resolve)));
    FakeSocket.last.fail("");
    await vi.advanceTimersByTimeAsync(FIRST_RETRY_MS);
    FakeSocket.last.open();
    answer({ reason: "the token is wrong", final: true });
    await vi.advanceTimersByTimeAsync(0);
    expect(events.onLink).toHaveBeenLastCalledWith({ kind: "open" });
  });

  it("gives a reason for a loss without one", () => {
    FakeSocket.last.open();
    FakeSocket.last.fail("");
    expect(events.onLink).toHaveBeenLastCalledWith({
      kind: "lost",
      everOpened: true,
      reason: "the gateway does not answer",
    });
  });

  it("sends nothing before it is open", () => {
    connection.watch("liver");
    expect(FakeSocket.last.sent).toEqual([]);
  });

  it("asks for the gateway's clock at once, then once a second, and uses one clock for sending and receiving", async () => {
    await vi.advanceTimersByTimeAsync(30);
    FakeSocket.last.open();
    const asked = performance.now();
    expect(FakeSocket.last.of("clock")).toEqual([{ type: "clock", client_time_ms: asked }]);
    await vi.advanceTimersByTimeAsync(40);
    const reply = JSON.stringify({ type: "clock", client_time_ms: asked, gateway_time_ms: 2, replaced: 3 });
    FakeSocket.last.onmessage?.({ data: reply });
    expect(events.onClock).toHaveBeenCalledWith(expect.objectContaining({ clientTimeMs: asked, gatewayTimeMs: 2, replaced: 3 }), asked + 40);
    FakeSocket.last.fail("");
    await vi.advanceTimersByTimeAsync(FIRST_RETRY_MS);
    FakeSocket.last.open();
    await vi.advanceTimersByTimeAsync(1000);
    expect(FakeSocket.last.of("clock")).toHaveLength(2);
  });

  it("passes on binary messages", () => {
    FakeSocket.last.open();
    FakeSocket.last.onmessage?.({ data: DAEMON });
    const data = new ArrayBuffer(4);
    FakeSocket.last.onmessage?.({ data });
    expect(events.onDaemon.mock.calls[0]?.[0]).toMatchObject({ posesAllowed: true, scenes: ["liver"] });
    expect(events.onMessage).toHaveBeenCalledWith(data);
  });
});
