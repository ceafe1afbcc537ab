// Valid messages of a daemon, which tests then change.
import { create, toBinary, type DescMessage, type Message, type MessageInitShape } from "@bufbuild/protobuf";

import { DaemonStateSchema } from "../src/generated/tensormass/v1/gateway_pb";
import { FrameSchema, TopologySchema } from "../src/generated/tensormass/v1/stream_pb";

/** What the gateway tells about a daemon, to a page that only looks. */
export const DAEMON = create(DaemonStateSchema, {
  problem: "",
  server: "s",
  version: "1",
  backend: "cpu",
  device: "d",
  posesAllowed: false,
  operator: false,
  builtinScenes: ["beam", "demo"],
  fieldScenes: [],
  scenes: ["liver"],
});

/** A gateway's text about a daemon, as an object. */
export const DAEMON_TEXT = {
  type: "daemon",
  problem: "",
  server: "s",
  version: "1",
  backend: "cpu",
  device: "d",
  poses_allowed: true,
  scenes: ["liver"],
};

/** Fields of a message to set. */
export type Fields<Schema extends DescMessage> = Exclude<MessageInitShape<Schema>, Message>;

export function u32(...values: number[]): Uint8Array {
  return new Uint8Array(Uint32Array.from(values).buffer);
}

export function f32(...values: number[]): Uint8Array {
  return new Uint8Array(Float32Array.from(values).buffer);
}

/** A tetrahedron's surface and a single triangle beside it, with one probe; gravity along -y. */
export function topologyBytes(change: Fields<typeof TopologySchema> = {}): Uint8Array {
  return toBinary(
    TopologySchema,
    create(TopologySchema, {
      scene: "liver",
      version: 7n,
      bodies: [
        { name: "liver", firstVertex: 0, vertexCount: 4, triangles: u32(0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2), fixedVertices: u32(1, 3) },
        { name: "vein", firstVertex: 4, vertexCount: 3, triangles: u32(0, 1, 2), colorSrgb: { x: 0.1, y: 0.2, z: 0.9 } },
      ],
      tools: [{ name: "probe", radiusM: 0.005, tipOffsetM: { x: 0, y: 0, z: -0.1 } }],
      gravityMPerS2: { x: 0, y: -9.81, z: 0 },
      ...change,
    }),
  );
}

export const POSITIONS = f32(0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 2, 0, 0, 3, 0, 0, 2, 1, 0);

export function frameBytes(change: Fields<typeof FrameSchema> = {}): Uint8Array {
  return toBinary(
    FrameSchema,
    create(FrameSchema, {
      topologyVersion: 7n,
      sequence: 1n,
      step: 12n,
      simulatedTimeS: 0.2,
      serverTimeNs: 1_700_000_000_123_456_789n,
      positions: POSITIONS,
      tools: [
        {
          tool: "probe",
          positionM: { x: 0.1, y: 0.2, z: 0.3 },
          orientation: { w: 2, x: 0, y: 0, z: 0 },
          forceN: { x: 0, y: 1.5, z: 0 },
        },
      ],
      ...change,
    }),
  );
}

/** Fields of a topology and of its frames with two attachments: two springs that may break, and one that never does. */
export const ATTACHED = {
  topology: {
    attachments: [
      {
        name: "ligament",
        springs: u32(0, 1, 0, 2),
        restLengthsM: f32(2.5, 3),
        stiffnessNPerM: 10,
        breakingForceN: 40,
      },
      { name: "string", springs: u32(3, 4), restLengthsM: f32(0.1), stiffnessNPerM: 1e6 },
    ],
    attachmentPointCount: 5,
  },
  frame: { attachmentPoints: f32(0, 0, 0, 0, 0, 2, 3, 4, 0, 1, 0, 0, 0, 0, -1) },
} satisfies { topology: Fields<typeof TopologySchema>; frame: Fields<typeof FrameSchema> };

/** `key`, a zero byte, `payload`. */
export function busMessage(key: string, payload: Uint8Array): ArrayBuffer {
  const prefix = new TextEncoder().encode(`${key}\0`);
  const message = new Uint8Array(prefix.length + payload.length);
  message.set(prefix);
  message.set(payload, prefix.length);
  return message.buffer;
}
