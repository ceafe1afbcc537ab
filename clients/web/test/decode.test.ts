import { create, fromBinary, toBinary } from "@bufbuild/protobuf";
import { describe, expect, it } from "vitest";

import { SimplifiedTopologySchema } from "../src/generated/tensormass/v1/gateway_pb";
import { TopologySchema } from "../src/generated/tensormass/v1/stream_pb";
import { decodeField, decodeFrame, decodeStatus, decodeTopology, isBroken, slotOf, splitMessage } from "../src/stream/decode";
import { ATTACHED, POSITIONS, busMessage, f32, frameBytes, topologyBytes, u32 } from "./messages";

describe("splitMessage", () => {
  it("splits key and payload, which may contain zero bytes", () => {
    const { scene, stream, payload } = splitMessage(busMessage("tensormass/host/liver/frame", Uint8Array.of(0, 1, 0)));
    expect([scene, stream, [...payload]]).toEqual(["liver", "frame", [0, 1, 0]]);
  });

  it("knows the streams that take the place of others", () => {
    for (const [stream, slot] of [["encoded_frame", "frame"], ["simplified_topology", "topology"], ["rest", "rest"]] as const) {
      expect(slotOf(splitMessage(busMessage(`tensormass/host/liver/${stream}`, new Uint8Array())).stream)).toBe(slot);
    }
  });

  it.each([
    ["no zero byte", new Uint8Array(600).fill(65).buffer],
    ["nothing", new ArrayBuffer(0)],
    ["an unknown stream", busMessage("tensormass/host/liver/pose", new Uint8Array())],
    ["a longer key", busMessage("tensormass/host/liver/frame/1", new Uint8Array())],
    ["another root", busMessage("other/host/liver/frame", new Uint8Array())],
    ["an empty scene", busMessage("tensormass/host//frame", new Uint8Array())],
  ])("refuses %s", (_, data) => {
    expect(() => splitMessage(data)).toThrow(/key/);
  });
});

describe("decodeField", () => {
  const field = (head: string, ...values: number[]) => {
    const line = new TextEncoder().encode(head);
    return Uint8Array.from([...line, ...f32(...values)]);
  };
  const HEAD = '{"field": "pressure", "topology_version": "1800000000000000001", "step": 3}\n';

  it("reads the name, the topology and the values", () => {
    expect(decodeField(field(HEAD, 1.5, -2))).toEqual({
      name: "pressure",
      topologyVersion: 1_800_000_000_000_000_001n,
      values: Float32Array.of(1.5, -2),
    });
  });

  it.each([
    ["nothing", new Uint8Array()],
    ["no line", field("{}", 1)],
    ["no JSON", field("pressure\n", 1)],
    ["no object", field("null\n", 1)],
    ["a version that is not a whole number", field('{"field":"pressure","topology_version":"1e3"}\n', 1)],
    ["half a value", field(HEAD, 1).subarray(0, HEAD.length + 3)],
    ["a value that is not finite", field(HEAD, 1, NaN)],
  ])("refuses %s", (_, payload) => {
    expect(() => decodeField(payload)).toThrow(/field/);
  });
});

describe("decodeTopology", () => {
  it("takes the topology out of a simplified one", () => {
    const whole = create(SimplifiedTopologySchema, {
      topology: fromBinary(TopologySchema, topologyBytes()),
      wholeVertices: u32(0, 2, 5, 8, 9, 10, 12),
      wholeVersion: 5n,
      wholeVertexCount: 20,
    });
    const payload = toBinary(SimplifiedTopologySchema, whole);
    const { version, wholeVersion, vertexCount, bodies } = decodeTopology(payload, "simplified_topology");
    expect([version, wholeVersion, vertexCount]).toEqual([7n, 5n, 7]);
    expect(bodies).toEqual(decodeTopology(topologyBytes()).bodies);
    expect(decodeTopology(topologyBytes()).wholeVersion).toBe(7n);
  });

  it.each([
    ["without a topology", new Uint8Array(), /has no topology/],
    ["that is not protobuf", Uint8Array.of(255, 255), /not protobuf/],
    [
      "with a triangle of a vertex that went",
      toBinary(
        SimplifiedTopologySchema,
        create(SimplifiedTopologySchema, { topology: { bodies: [{ name: "liver", vertexCount: 3, triangles: u32(0, 1, 3) }] } }),
      ),
      /triangle 0 names vertex 3 of 3/,
    ],
  ])("refuses a simplified topology %s", (_, payload, said) => {
    expect(() => decodeTopology(payload, "simplified_topology")).toThrow(said);
  });

  it("decodes the picture on a body, and refuses coordinates that do not fit", () => {
    const textured = (textureCoordinates: Uint8Array) =>
      topologyBytes({
        bodies: [{ name: "a", vertexCount: 3, triangles: u32(0, 1, 2), textureImage: Uint8Array.of(1, 2), textureCoordinates }],
      });
    const [surface] = decodeTopology(textured(f32(0, 0, 1, 0, 0, 1))).bodies;
    expect([...surface!.texture!.image]).toEqual([1, 2]);
    expect([...surface!.texture!.coordinates]).toEqual([0, 0, 1, 0, 0, 1]);
    expect(decodeTopology(topologyBytes()).bodies[0]!.texture).toBeNull();
    expect(() => decodeTopology(textured(f32(0, 0, 1, 0)))).toThrow(/16 bytes of texture coordinates for 3 corners/);
    expect(() => decodeTopology(textured(f32(0, 0, 1, 0, 0, NaN)))).toThrow(/not finite/);
  });

  it("decodes bodies, tools and the up direction", () => {
    const topology = decodeTopology(topologyBytes());
    expect(topology.version).toBe(7n);
    expect(topology.vertexCount).toBe(7);
    expect(topology.up).toEqual([-0, 1, -0]);
    expect(topology.bodies.map((body) => [body.name, body.firstVertex, body.triangles.length])).toEqual([
      ["liver", 0, 12],
      ["vein", 4, 3],
    ]);
    expect(topology.bodies.map((body) => body.colorSrgb)).toEqual([null, [0.1, 0.2, 0.9]]);
    expect(topology.tools).toMatchObject([{ name: "probe", radiusM: 0.005, tipOffsetM: [0, 0, -0.1], core: { shaftM: [0, 0, 0] } }]);
    expect(topology.tools[0]?.core.cornersM([])).toEqual([[0, 0, 0]]);
  });

  it("uses z as up without gravity", () => {
    expect(decodeTopology(topologyBytes({ gravityMPerS2: { x: 0, y: 0, z: 0 } })).up).toEqual([0, 0, 1]);
  });

  it("names the triangle that points outside its body", () => {
    const bodies = [{ name: "liver", firstVertex: 0, vertexCount: 3, triangles: u32(0, 1, 2, 0, 1, 3) }];
    expect(() => decodeTopology(topologyBytes({ bodies }))).toThrow(/body "liver": triangle 1 names vertex 3 of 3/);
  });

  it("names the fixed vertex that its body does not have", () => {
    const bodies = [{ name: "liver", firstVertex: 0, vertexCount: 3, triangles: u32(0, 1, 2), fixedVertices: u32(2, 0, 4) }];
    expect(() => decodeTopology(topologyBytes({ bodies }))).toThrow(/body "liver": fixed vertex 2 names vertex 4 of 3/);
  });

  it("decodes attachments, which may be able to break", () => {
    const { attachments, attachmentPointCount } = decodeTopology(topologyBytes(ATTACHED.topology));
    expect(attachmentPointCount).toBe(5);
    expect(attachments.map(({ name, springs, restLengthsM }) => [name, [...springs], [...restLengthsM]])).toEqual([
      ["ligament", [0, 1, 0, 2], [2.5, 3]],
      ["string", [3, 4], [expect.closeTo(0.1, 6)]],
    ]);
    expect(attachments.map(({ stiffnessNPerM, breakingForceN }) => [stiffnessNPerM, breakingForceN])).toEqual([
      [10, 40],
      [1e6, null],
    ]);
    expect(decodeTopology(topologyBytes()).attachments).toEqual([]);
  });

  it.each([
    ["a point that no frame has", { springs: u32(0, 1, 0, 5) }, /"ligament": spring 1 names point 5 of 5/],
    ["half a spring", { springs: u32(0, 1, 0) }, /spring: 12 bytes are not a multiple of 8/],
    ["a spring without a length", { restLengthsM: f32(1) }, /2 springs do not each have a length at rest/],
    ["a length that is not finite", { restLengthsM: f32(1, NaN) }, /a length at rest is NaN/],
    ["a stiffness that is not finite", { stiffnessNPerM: Infinity }, /stiffness_n_per_m: Infinity is not finite/],
    ["a force that breaks nothing", { breakingForceN: 0 }, /breaking_force_n is 0/],
  ])("refuses an attachment with %s", (_, change, said) => {
    const attachments = [{ ...ATTACHED.topology.attachments[0], ...change }];
    expect(() => decodeTopology(topologyBytes({ ...ATTACHED.topology, attachments }))).toThrow(said);
  });

  it("refuses bodies that overlap", () => {
    const body = { name: "a", firstVertex: 0, vertexCount: 3, triangles: u32(0, 1, 2) };
    expect(() => decodeTopology(topologyBytes({ bodies: [body, { ...body, name: "b", firstVertex: 2 }] }))).toThrow(
      /body "b": first_vertex is 2, the bodies before it end at 3/,
    );
  });

  it("refuses an incomplete triangle, a tool without size and a colour that is not finite", () => {
    const torn = [{ name: "a", firstVertex: 0, vertexCount: 3, triangles: u32(0, 1, 2).subarray(0, 11) }];
    expect(() => decodeTopology(topologyBytes({ bodies: torn }))).toThrow(/triangle: 11 bytes are not a multiple of 12/);
    for (const radiusM of [0, -1, NaN, 1e6]) {
      expect(() => decodeTopology(topologyBytes({ tools: [{ name: "p", radiusM }] }))).toThrow(`radius_m is ${radiusM}`);
    }
    for (const lengthM of [-1, NaN, 1e6]) {
      const tool = { kind: { case: "capsule" as const, value: { radiusM: 0.01, lengthM } } };
      expect(() => decodeTopology(topologyBytes({ tools: [{ name: "p", radiusM: 0.01, tool }] }))).toThrow(
        `length_m is ${lengthM}`,
      );
    }
    const colored = [{ name: "a", vertexCount: 0, colorSrgb: { x: NaN, y: 0, z: 0 } }];
    expect(() => decodeTopology(topologyBytes({ bodies: colored }))).toThrow(/color_srgb/);
  });

  it("refuses what is not protobuf", () => {
    expect(() => decodeTopology(Uint8Array.of(255, 255, 255))).toThrow(/topology message is not protobuf/);
  });
});

describe("decodeFrame", () => {
  it("decodes ends of springs and which of them are broken", () => {
    const frame = decodeFrame(frameBytes({ ...ATTACHED.frame, brokenSprings: Uint8Array.of(0b1000_0010, 1) }));
    expect([...frame.attachmentPoints.subarray(3, 6)]).toEqual([0, 0, 2]);
    expect([0, 1, 2, 6, 7, 8, 9].filter((spring) => isBroken(frame, spring))).toEqual([1, 7, 8]);
    const whole = decodeFrame(frameBytes());
    expect([whole.attachmentPoints.length, isBroken(whole, 3)]).toEqual([0, false]);
    for (const attachmentPoints of [f32(0, 1), f32(0, NaN, 0)]) {
      expect(() => decodeFrame(frameBytes({ attachmentPoints }))).toThrow(/attachment_points: .*(multiple of 12|not finite)/);
    }
  });

  it("reads little-endian floats at any alignment", () => {
    // The payload of a bus message starts wherever its key ends.
    for (const server of ["a", "ab", "abc", "abcd"]) {
      const { payload } = splitMessage(busMessage(`tensormass/${server}/liver/frame`, frameBytes()));
      const frame = decodeFrame(payload);
      expect(frame.positions).toEqual(new Float32Array(POSITIONS.buffer));
      expect(frame.serverTimeNs).toBe(1_700_000_000_123_456_789n);
    }
  });

  it("normalises orientations and reads zeros as the identity", () => {
    expect(decodeFrame(frameBytes()).tools[0]).toEqual({
      name: "probe",
      positionM: [0.1, 0.2, 0.3],
      orientationWxyz: [1, 0, 0, 0],
      forceN: [0, 1.5, 0],
      jointValues: [],
      retired: false,
      recovering: false,
      claimedBy: null,
    });
    // The client of the newest pose claims nothing by that alone.
    expect(decodeFrame(frameBytes({ tools: [{ tool: "p", clientId: 42n }] })).tools[0]?.claimedBy).toBeNull();
    expect(decodeFrame(frameBytes({ tools: [{ tool: "p", clientId: 42n, claimed: true }] })).tools[0]?.claimedBy).toBe(42n);
    const recovering = decodeFrame(frameBytes({ tools: [{ tool: "p", recovering: true }] }));
    expect(recovering.tools[0]?.recovering).toBe(true);
    const unit = (w: number, x: number, y: number, z: number) =>
      decodeFrame(frameBytes({ tools: [{ tool: "p", orientation: { w, x, y, z } }] })).tools[0]?.orientationWxyz;
    expect(unit(0, 0, 0, 0)).toEqual([1, 0, 0, 0]);
    expect(unit(1, -2, 2, 4)).toEqual([0.2, -0.4, 0.4, 0.8]);
  });

  it.each([NaN, Infinity, -Infinity])("refuses a position of %s", (value) => {
    expect(() => decodeFrame(frameBytes({ positions: f32(0, 0, value) }))).toThrow(/frame 1: a position is not finite/);
  });

  it("refuses an incomplete vertex, a force that is not finite and a tool beyond the largest length", () => {
    const withTool = (fields: object) => decodeFrame(frameBytes({ tools: [{ tool: "p", ...fields }] }));
    expect(() => decodeFrame(frameBytes({ positions: f32(0, 0) }))).toThrow(/8 bytes of positions/);
    expect(() => withTool({ forceN: { x: 0, y: NaN, z: 0 } })).toThrow(/tool "p", force_n: \(0, NaN, 0\) is not finite$/);
    expect(() => withTool({ forceN: { x: -Infinity, y: 0, z: 0 } })).toThrow(/force_n: \(-Infinity, 0, 0\)/);
    expect(() => withTool({ positionM: { x: 0, y: 0, z: 1e6 } })).toThrow(/position_m: .* is not finite or too large/);
  });

  it("accepts a finite force of any size", () => {
    const forceN = { x: 0, y: -1e6, z: 4.5e9 };
    expect(decodeFrame(frameBytes({ tools: [{ tool: "p", forceN }] })).tools[0]?.forceN).toEqual([0, -1e6, 4.5e9]);
  });
});

it("decodeStatus refuses what is not protobuf", () => {
  expect(() => decodeStatus(Uint8Array.of(10, 200))).toThrow(/status message is not protobuf/);
});
