import { create, toBinary } from "@bufbuild/protobuf";
import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";

import { SceneStatusSchema } from "../src/generated/tensormass/v1/stream_pb";
import { SceneState } from "../src/stream/decode";
import { RECOVERY_SHOWS_MS, Session, type SessionEvents } from "../src/stream/session";
import { FakeSocket } from "./fake_socket";
import { busMessage, frameBytes, topologyBytes } from "./messages";

const daemonText = (scenes: string[], more: object = {}) =>
  JSON.stringify({ type: "daemon", problem: "", server: "s", version: "1", backend: "cpu", device: "d", scenes, ...more });

describe("Session", () => {
  const events = {
    onDaemon: vi.fn<SessionEvents["onDaemon"]>(),
    onChange: vi.fn<SessionEvents["onChange"]>(),
    onFrame: vi.fn<SessionEvents["onFrame"]>(),
    onValues: vi.fn<SessionEvents["onValues"]>(),
  };
  let session: Session;
  const receive = (data: unknown) => FakeSocket.last.onmessage?.({ data });
  const receiveStream = (scene: string, stream: string, payload: Uint8Array) =>
    receive(busMessage(`tensormass/server/${scene}/${stream}`, payload));
  const status = (fields: object) => toBinary(SceneStatusSchema, create(SceneStatusSchema, fields));

  beforeEach(() => {
    vi.useFakeTimers();
    vi.spyOn(console, "warn").mockReturnValue(undefined);
    FakeSocket.opened = [];
    vi.clearAllMocks();
    session = new Session({
      url: "ws://host/stream",
      diagnose: () => Promise.resolve({ reason: "full", final: false }),
      events,
      WebSocket: FakeSocket as unknown as typeof WebSocket,
    });
  });

  afterEach(() => {
    session.close();
    vi.useRealTimers();
    vi.restoreAllMocks();
  });

  it("watches its scene once the daemon has it, and again after the scene was gone", () => {
    session.show("liver");
    FakeSocket.last.open();
    receive(daemonText([]));
    expect(session.situation.text).toBe("No scene");
    expect(FakeSocket.last.of("watch")).toEqual([]);
    receive(daemonText(["kidney", "liver"]));
    receive(daemonText(["kidney", "liver"]));
    expect(FakeSocket.last.of("watch")).toEqual([{ type: "watch", scene: "liver" }]);
    receive(daemonText(["kidney"]));
    expect(session.watched).toBeNull();
    receive(daemonText(["liver"]));
    expect(FakeSocket.last.of("watch")).toHaveLength(2);
    expect(events.onDaemon).toHaveBeenCalledTimes(5);
  });

  it("stores messages of its scene, acknowledges all, and keeps forces and step times", () => {
    session.show("liver");
    FakeSocket.last.open();
    receive(daemonText(["liver"]));
    receiveStream("kidney", "topology", topologyBytes());
    expect(session.store.topology).toBeNull();
    receiveStream("liver", "topology", topologyBytes());
    receiveStream("liver", "frame", frameBytes());
    receiveStream("liver", "status", status({ serverTimeNs: 1_700_000_000_123_456_789n, stepTimeP50S: 0.003 }));
    expect(session.store.frame?.step).toBe(12n);
    expect(events.onFrame).toHaveBeenCalledTimes(1);
    expect(events.onValues).toHaveBeenCalled();
    expect(session.history.forces.get("probe")?.points).toEqual([{ timeS: 0.2, value: 1.5 }]);
    expect(session.history.stepTime.points[0]?.value).toBe(3);
    expect(FakeSocket.last.of("ack").map(({ stream }) => stream)).toEqual(["topology", "topology", "frame", "status"]);
    expect(session.situation.text).toBe("Live");
  });

  it("shows a recovery while a frame has it and for a while after, so that it is seen", () => {
    const tools = (recovering: boolean) => [{ tool: "probe" }, { tool: "hook", recovering }];
    session.show("liver");
    FakeSocket.last.open();
    receive(daemonText(["kidney", "liver"]));
    receiveStream("liver", "topology", topologyBytes());
    receiveStream("liver", "frame", frameBytes({ tools: tools(false) }));
    expect(session.recovering).toBe(false);
    receiveStream("liver", "frame", frameBytes({ tools: tools(true) }));
    vi.advanceTimersByTime(2 * RECOVERY_SHOWS_MS); // the scene is paused
    expect(session.recovering).toBe(true);
    receiveStream("liver", "frame", frameBytes({ tools: tools(true) }));
    receiveStream("liver", "frame", frameBytes({ tools: tools(false) }));
    vi.advanceTimersByTime(RECOVERY_SHOWS_MS - 1);
    expect(session.recovering).toBe(true);
    vi.advanceTimersByTime(1);
    expect(session.recovering).toBe(false);
    receiveStream("liver", "status", status({ serverTimeNs: 1_700_000_000_123_456_789n, recovering: true }));
    expect(session.recovering).toBe(true); // between two frames
    const stopped = { serverTimeNs: 1_700_000_000_123_456_790n, recovering: true, state: SceneState.FAULTED };
    receiveStream("liver", "status", status(stopped));
    expect(session.recovering).toBe(false);
    session.show("kidney");
    expect(session.recovering).toBe(false);
  });

  it("asks for other frames again after a loss of the connection, but for none of its own accord", () => {
    FakeSocket.last.open();
    expect(FakeSocket.last.of("frames")).toEqual([]);
    session.chooseFrames({ detail: 0.5, rate_hz: 30 });
    FakeSocket.last.fail("");
    vi.advanceTimersByTime(1000);
    FakeSocket.last.open();
    expect(FakeSocket.opened.map((socket) => socket.of("frames"))).toEqual([
      [{ type: "frames", detail: 0.5, rate_hz: 30 }],
      [{ type: "frames", detail: 0.5, rate_hz: 30 }],
    ]);
  });

  it("keeps the vertices from which the user lets displacements count", () => {
    session.show("liver");
    FakeSocket.last.open();
    receive(daemonText(["liver"]));
    receiveStream("liver", "topology", topologyBytes());
    receiveStream("liver", "frame", frameBytes());
    session.chooseFrames({ detail: 0.5, rate_hz: 30 });
    session.store.setZero();
    session.chooseFrames({ detail: 0.25, rate_hz: 20 });
    expect(FakeSocket.last.of("frames")).toEqual([
      { type: "frames", detail: 0.5, rate_hz: 30 },
      { type: "frames", detail: 0.5, rate_hz: 20 },
    ]);
  });

  it("forgets the scene when it shows another one, and when the connection is lost", () => {
    session.show("liver");
    FakeSocket.last.open();
    receive(daemonText(["kidney", "liver"]));
    receiveStream("liver", "topology", topologyBytes());
    receiveStream("liver", "frame", frameBytes());
    session.show("kidney");
    expect([session.watched, session.store.frame, session.history.forces.size]).toEqual(["kidney", null, 0]);
    receiveStream("kidney", "topology", topologyBytes({ scene: "kidney" }));
    FakeSocket.last.fail("bye");
    expect([session.daemon, session.watched, session.store.topology]).toEqual([null, null, null]);
    expect(session.situation).toMatchObject({ text: "Disconnected", notice: { detail: "bye" } });
    expect(session.scene).toBe("kidney");
  });

  it("asks for a field while the gateway knows the elements of its scene", () => {
    session.show("liver");
    session.showField("pressure");
    FakeSocket.last.open();
    receive(daemonText(["liver"]));
    expect(FakeSocket.last.of("field")).toEqual([]);
    receive(daemonText(["liver"], { field_scenes: ["liver"] }));
    session.showField("pressure");
    session.showField(null);
    expect(FakeSocket.last.of("field").map(({ name }) => name)).toEqual(["pressure", ""]);
  });

  it("counts refused messages and says why", () => {
    session.show("liver");
    FakeSocket.last.open();
    receive(daemonText(["liver"]));
    receiveStream("liver", "topology", topologyBytes());
    receiveStream("liver", "frame", frameBytes({ topologyVersion: 8n }));
    expect(session.readings().counters).toMatchObject({ refused: 1, lastRefusal: expect.stringMatching(/topology 8/) as string });
    expect(session.situation.text).toBe("No picture");
  });

  it("closes after the answers to commands that are under way", async () => {
    FakeSocket.last.open();
    const answer = session.control({ action: "unload", scene: "liver" });
    session.close();
    await vi.advanceTimersByTimeAsync(0);
    receive(JSON.stringify({ type: "result", id: 1, scene: "liver", error: "" }));
    expect((await answer).scene).toBe("liver");
    await vi.advanceTimersByTimeAsync(0);
    expect(FakeSocket.last.readyState).toBe(3);
    await vi.advanceTimersByTimeAsync(60_000);
    expect(FakeSocket.opened).toHaveLength(1);
  });
});
