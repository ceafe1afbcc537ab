// Decodes the bus's bytes into plain arrays to draw. The bytes come from outside, so sizes, indices and numbers are
// checked here, once. WebGL checks nothing itself; the results of this file are safe to pass to it.
import { fromBinary } from "@bufbuild/protobuf";

import { SimplifiedTopologySchema } from "../generated/tensormass/v1/gateway_pb";
import type { Tool, Vector3 as ProtoVector3 } from "../generated/tensormass/v1/scene_pb";
import {
  FrameSchema,
  type Frame as FrameMessage,
  SceneStatusSchema,
  SceneStatus_State,
  TopologySchema,
  type AttachmentSprings as AttachmentMessage,
  type SceneStatus,
  type ToolFeedback,
} from "../generated/tensormass/v1/stream_pb";

export type Vector = readonly [x: number, y: number, z: number];

export type StreamName =
  | "topology"
  | "simplified_topology"
  | "changes"
  | "rest"
  | "frame"
  | "encoded_frame"
  | "status"
  | "events"
  | "field";
const STREAM_NAMES: readonly string[] = [
  "topology",
  "simplified_topology",
  "changes",
  "rest",
  "frame",
  "encoded_frame",
  "status",
  "events",
  "field",
] satisfies StreamName[];

/** The slot of a stream in the gateway, which takes both kinds of frames as frames, and of topologies as topologies. */
export function slotOf(stream: StreamName): Exclude<StreamName, "encoded_frame" | "simplified_topology"> {
  switch (stream) {
    case "encoded_frame":
      return "frame";
    case "simplified_topology":
      return "topology";
    default:
      return stream;
  }
}

/** One message of the bus: `key`, a zero byte, the protobuf message. */
export interface BusMessage {
  readonly scene: string;
  readonly stream: StreamName;
  readonly payload: Uint8Array;
}

export interface Surface {
  readonly name: string;
  readonly firstVertex: number;
  readonly vertexCount: number;
  /** [triangle_count, 3], relative to `firstVertex`. */
  readonly triangles: Uint32Array;
  /** Vertices whose node is held or prescribed, relative to `firstVertex`. */
  readonly fixedVertices: Uint32Array;
  /** sRGB in [0, 1]; null: the viewer chooses. */
  readonly colorSrgb: Vector | null;
  /** The picture on it; null: it has none. */
  readonly texture: Texture | null;
}

export interface Texture {
  /** A PNG or JPEG. Nobody has decoded it yet. */
  readonly image: Uint8Array;
  /** [triangle_count, 3, 2]: place (u, v) of each corner in the picture, u to the right, v up. */
  readonly coordinates: Float32Array;
}

export interface ToolShape {
  readonly name: string;
  readonly radiusM: number;
  /** Centre of the sphere at the tip, in the tool's frame [m]. */
  readonly tipOffsetM: Vector;
  readonly core: ToolCore;
  /** The solid that it is, in the same frame as the core; null: a line with a radius. */
  readonly solid: Solid | null;
  /** Whether it stays where it is. */
  readonly fixed: boolean;
  /** Whether its tip has the power to burn tissue. */
  readonly burns: boolean;
  /** The tool as the scene describes it; null: the server does not say. */
  readonly description: Tool | null;
}

export type Solid =
  | { readonly kind: "box"; readonly sizeM: Vector; readonly edgeRadiusM: number }
  | { readonly kind: "plane" } // solid below, across the z axis
  | { readonly kind: "mesh"; readonly positions: Float32Array; readonly triangles: Uint32Array };

/** The core of a tool, in the tool's frame from the centre of the sphere at the tip on. */
export interface ToolCore {
  /** Corners of the line through the core [m]: one for a sphere and for kinds unknown here. */
  readonly cornersM: (jointValues: readonly number[]) => readonly Vector[];
  /** Start of a shaft along the z axis that is only drawn [m]; null: the core has its own. */
  readonly shaftM: Vector | null;
}

/** The springs of an attachment. */
export interface AttachmentSprings {
  readonly name: string;
  /** [spring_count, 2]: ends, as places in `Frame.attachmentPoints`. */
  readonly springs: Uint32Array;
  /** [spring_count] m */
  readonly restLengthsM: Float32Array;
  /** One spring's. */
  readonly stiffnessNPerM: number;
  /** Force at which one spring breaks; null: it never does. */
  readonly breakingForceN: number | null;
}

export interface Topology {
  readonly scene: string;
  readonly version: bigint;
  /** Version of the scene's own topology. This one may be a simplified form of it. */
  readonly wholeVersion: bigint;
  readonly vertexCount: number;
  readonly bodies: readonly Surface[];
  readonly tools: readonly ToolShape[];
  readonly attachments: readonly AttachmentSprings[];
  readonly attachmentPointCount: number;
  /** Unit vector against gravity; z without gravity. */
  readonly up: Vector;
}

export interface ToolState {
  readonly name: string;
  readonly positionM: Vector;
  readonly orientationWxyz: readonly [number, number, number, number];
  /** Force on the tool. */
  readonly forceN: Vector;
  /** Joints of the tool [rad or m]. */
  readonly jointValues: readonly number[];
  /** Whether the tool touches nothing, because its client has fallen silent. */
  readonly retired: boolean;
  /** Whether the step could not be made as planned: tools backed off, or the tissue was held. */
  readonly recovering: boolean;
  /** The client that claims the tool, so that the poses of others are refused; null: none does. */
  readonly claimedBy: bigint | null;
}

export interface Frame {
  readonly topologyVersion: bigint;
  readonly sequence: bigint;
  readonly step: bigint;
  readonly simulatedTimeS: number;
  readonly serverTimeNs: bigint;
  /** Revision of the surface: 0 as in the topology. */
  readonly revision: number;
  /** [vertex_count, 3] m: the vertices of the topology, then those that changes of this revision append. */
  readonly positions: Float32Array;
  /** No position is farther from the daemon's surface than this; 0: positions are exact. */
  readonly errorM: number;
  /** [vertex_count, 3], unit vectors times 127; null: the page computes them. */
  readonly normals: Int8Array | null;
  readonly tools: readonly ToolState[];
  /** [attachment_point_count, 3] m: nodes at the ends of springs. */
  readonly attachmentPoints: Float32Array;
  /** A bit for each spring of all attachments: `isBroken` reads it. Empty: none is broken. */
  readonly brokenSprings: Uint8Array;
}

/** Whether a spring is broken. @param spring Its number, counted over all attachments. */
export function isBroken({ brokenSprings }: Frame, spring: number): boolean {
  return brokenSprings.length > 0 && ((brokenSprings[spring >> 3]! >> (spring & 7)) & 1) === 1;
}

/** Values of an element field on the surface, which the gateway computes. */
export interface Field {
  readonly name: string;
  readonly topologyVersion: bigint;
  /** [vertex_count] */
  readonly values: Float32Array;
}

export type Status = SceneStatus;
export { SceneStatus_State as SceneState };

/** Says what was wrong with a message, and where. */
export class DecodeError extends Error {}

const MAX_KEY_BYTES = 512;
/** The server's limit on lengths. */
const MAX_LENGTH_M = 1e6;

/** Splits `tensormass/<server>/<scene>/<stream>`, a zero byte and a payload. Throws DecodeError on other data. */
export function splitMessage(data: ArrayBuffer): BusMessage {
  const bytes = new Uint8Array(data);
  const end = bytes.subarray(0, MAX_KEY_BYTES + 1).indexOf(0);
  if (end < 0) {
    throw new DecodeError(`a message of ${bytes.length} bytes has no key that ends in a zero byte`);
  }
  const key = new TextDecoder().decode(bytes.subarray(0, end));
  const [root, , scene, stream, ...rest] = key.split("/");
  if (root !== "tensormass" || !scene || !stream || rest.length > 0 || !STREAM_NAMES.includes(stream)) {
    throw new DecodeError(`key "${key}" names no stream that this viewer knows`);
  }
  return { scene, stream: stream as StreamName, payload: bytes.subarray(end + 1) };
}

/** Reads vertices of a body, or points. Throws DecodeError if one is outside its range. @param perItem Vertices of each item. */
export function vertices(where: string, bytes: Uint8Array, perItem: number, vertexCount: number, kind = "vertex"): Uint32Array {
  if (bytes.length % (4 * perItem) !== 0) {
    throw new DecodeError(`${where}: ${bytes.length} bytes are not a multiple of ${4 * perItem}`);
  }
  const numbers = new Uint32Array(aligned(bytes));
  const outside = numbers.findIndex((vertex) => vertex >= vertexCount);
  if (outside >= 0) {
    throw new DecodeError(`${where} ${Math.floor(outside / perItem)} names ${kind} ${numbers[outside]} of ${vertexCount}`);
  }
  return numbers;
}

/**
 * Decodes a message of the stream `topology` or `simplified_topology`. Throws DecodeError if a body's vertices or
 * triangles are outside its range, or if a spring has no end.
 */
export function decodeTopology(payload: Uint8Array, stream: StreamName = "topology"): Topology {
  const simplified = stream === "topology" ? null : parse(stream, () => fromBinary(SimplifiedTopologySchema, payload));
  const message = simplified === null ? parse(stream, () => fromBinary(TopologySchema, payload)) : simplified.topology;
  if (message === undefined) {
    throw new DecodeError("a simplified topology has no topology");
  }
  let vertexCount = 0;
  const bodies = message.bodies.map((body): Surface => {
    const where = `topology of scene "${message.scene}", body "${body.name}"`;
    if (body.firstVertex !== vertexCount) {
      throw new DecodeError(`${where}: first_vertex is ${body.firstVertex}, the bodies before it end at ${vertexCount}`);
    }
    vertexCount += body.vertexCount;
    const triangles = vertices(`${where}: triangle`, body.triangles, 3, body.vertexCount);
    return {
      name: body.name,
      firstVertex: body.firstVertex,
      vertexCount: body.vertexCount,
      triangles,
      fixedVertices: vertices(`${where}: fixed vertex`, body.fixedVertices, 1, body.vertexCount),
      colorSrgb: body.colorSrgb ? vector(`${where}, color_srgb`, body.colorSrgb) : null,
      texture:
        body.textureImage.length > 0
          ? { image: body.textureImage, coordinates: textureCoordinates(where, body.textureCoordinates, triangles.length) }
          : null,
    };
  });
  const tools = message.tools.map((tool): ToolShape => {
    const where = `topology of scene "${message.scene}", tool "${tool.name}"`;
    if (!(tool.radiusM > 0 && tool.radiusM < MAX_LENGTH_M)) {
      throw new DecodeError(`${where}: radius_m is ${tool.radiusM}`);
    }
    return {
      name: tool.name,
      radiusM: tool.radiusM,
      tipOffsetM: vector(`${where}, tip_offset_m`, tool.tipOffsetM),
      core: coreOf(where, tool.tool),
      solid: solidOf(where, tool.tool),
      fixed: tool.tool?.fixed ?? false,
      burns: tool.tool?.cautery !== undefined,
      description: tool.tool ?? null,
    };
  });
  const { scene, version, attachmentPointCount } = message;
  const attachments = message.attachments.map((attachment) =>
    springsOf(`topology of scene "${scene}", attachment "${attachment.name}"`, attachment, attachmentPointCount),
  );
  const wholeVersion = simplified?.wholeVersion ?? version;
  return { scene, version, wholeVersion, vertexCount, bodies, tools, attachments, attachmentPointCount, up: up(message.gravityMPerS2) };
}

function springsOf(where: string, message: AttachmentMessage, pointCount: number): AttachmentSprings {
  const springs = vertices(`${where}: spring`, message.springs, 2, pointCount, "point");
  if (2 * message.restLengthsM.length !== 4 * springs.length) {
    throw new DecodeError(`${where}: ${springs.length / 2} springs do not each have a length at rest`);
  }
  const restLengthsM = new Float32Array(aligned(message.restLengthsM));
  restLengthsM.forEach((length) => checkedLength(where, "a length at rest", length));
  const stiffnessNPerM = finite(`${where}, stiffness_n_per_m`, message.stiffnessNPerM);
  const breakingForceN = message.breakingForceN ?? null;
  if (breakingForceN !== null && !(breakingForceN > 0)) {
    throw new DecodeError(`${where}: breaking_force_n is ${breakingForceN}`);
  }
  return { name: message.name, springs, restLengthsM, stiffnessNPerM, breakingForceN };
}

function textureCoordinates(where: string, bytes: Uint8Array, cornerCount: number): Float32Array {
  if (bytes.length !== 8 * cornerCount) {
    throw new DecodeError(`${where}: ${bytes.length} bytes of texture coordinates for ${cornerCount} corners`);
  }
  const coordinates = new Float32Array(aligned(bytes));
  if (!coordinates.every(Number.isFinite)) {
    throw new DecodeError(`${where}: a texture coordinate is not finite`);
  }
  return coordinates;
}

function checkedLength(where: string, name: string, value: number): number {
  if (!(value >= 0 && value < MAX_LENGTH_M)) {
    throw new DecodeError(`${where}: ${name} is ${value}`);
  }
  return value;
}

function solidOf(where: string, tool: Tool | undefined): Solid | null {
  const kind = tool?.kind;
  switch (kind?.case) {
    case "box": {
      const { sizeXM, sizeYM, sizeZM, edgeRadiusM } = kind.value;
      const size = [sizeXM, sizeYM, sizeZM].map((value) => checkedLength(where, "size", value));
      return {
        kind: "box",
        sizeM: [size[0]!, size[1]!, size[2]!],
        edgeRadiusM: checkedLength(where, "edge_radius_m", edgeRadiusM),
      };
    }
    case "plane":
      return { kind: "plane" };
    case "mesh": {
      const source = kind.value.surface?.source;
      const packed = source?.case === "packed" ? source.value : { vertexPositions: new Uint8Array(), triangles: new Uint8Array() };
      if (packed.vertexPositions.length % 24 !== 0 || packed.triangles.length % 12 !== 0) {
        throw new DecodeError(`${where}: its surface has a fraction of a vertex or triangle`);
      }
      const scale = kind.value.scale ?? 1;
      const positions = Float32Array.from(new Float64Array(aligned(packed.vertexPositions)), (value) => value * scale);
      const triangles = new Uint32Array(aligned(packed.triangles));
      if (!positions.every(Number.isFinite) || triangles.some((vertex) => vertex >= positions.length / 3)) {
        throw new DecodeError(`${where}: its surface has a position that is not finite, or a triangle without a vertex`);
      }
      return { kind: "mesh", positions, triangles };
    }
    default:
      return null;
  }
}

/** The core of a tool. Each kind states its own in server/physics/tool. */
function coreOf(where: string, tool: Tool | undefined): ToolCore {
  const length = (name: string, value: number): number => checkedLength(where, name, value);
  const rigid = (...corners: Vector[]): ToolCore => ({ cornersM: () => corners, shaftM: null });
  const tip: Vector = [0, 0, 0];
  const kind = tool?.kind;
  switch (kind?.case) {
    case "capsule":
    case "scalpel": // its edge; the handle goes on from there
      return rigid(tip, [0, 0, length("length_m", kind.value.lengthM)]);
    case "retractor": {
      const blade = length("blade_length_m", kind.value.bladeLengthM);
      return rigid(tip, [blade, 0, 0], [blade, 0, length("shaft_length_m", kind.value.shaftLengthM)]);
    }
    case "scissors":
    case "grasper": {
      const jaw =
        kind.case === "grasper"
          ? length("jaw_length_m", kind.value.jawLengthM)
          : length("blade_length_m", kind.value.bladeLengthM);
      const hinge: Vector = [0, 0, jaw];
      const tipOf = (angle: number): Vector => [jaw * Math.sin(angle), 0, jaw * (1 - Math.cos(angle))];
      return {
        cornersM: ([opening = 0]) => [tipOf(-opening / 2), hinge, tipOf(opening / 2)],
        shaftM: hinge,
      };
    }
    case "box":
    case "plane":
    case "mesh":
      return rigid(tip);
    default:
      return { cornersM: () => [tip], shaftM: tip };
  }
}

/** Decodes a Frame. Throws DecodeError on a fraction of a vertex and on a coordinate that is not finite. */
export function decodeFrame(payload: Uint8Array): Frame {
  const message = parse("frame", () => fromBinary(FrameSchema, payload));
  const where = `frame ${message.sequence}`;
  return frameOf(where, message, finiteFloats(where, message.positions));
}

/** Reads float32 positions. Throws DecodeError like `decodeFrame`. */
export function finiteFloats(where: string, bytes: Uint8Array): Float32Array {
  if (bytes.length % 12 !== 0) {
    throw new DecodeError(`${where}: ${bytes.length} bytes of positions are not a multiple of 12`);
  }
  const positions = new Float32Array(aligned(bytes));
  // NaN · 0 and infinity · 0 are NaN, so the sum shows any of them without a branch.
  let probe = 0;
  for (const coordinate of positions) {
    probe += coordinate * 0;
  }
  if (probe !== 0) {
    throw new DecodeError(`${where}: a position is not finite`);
  }
  return positions;
}

/** A frame of the decoded positions and of the other fields of its message. */
export function frameOf(where: string, message: FrameMessage, positions: Float32Array): Frame {
  return {
    topologyVersion: message.topologyVersion,
    sequence: message.sequence,
    step: message.step,
    simulatedTimeS: message.simulatedTimeS,
    serverTimeNs: message.serverTimeNs,
    revision: message.revision,
    positions,
    errorM: 0,
    normals: null,
    tools: message.tools.map((tool) => toolState(where, tool)),
    attachmentPoints: finiteFloats(`${where}, attachment_points`, message.attachmentPoints),
    brokenSprings: message.brokenSprings,
  };
}

export function decodeStatus(payload: Uint8Array): Status {
  return parse("status", () => fromBinary(SceneStatusSchema, payload));
}

/** Decodes a field: a line of JSON, then float32 values. Throws DecodeError on other data and on values that are not finite. */
export function decodeField(payload: Uint8Array): Field {
  const end = payload.indexOf(10);
  let head: unknown;
  try {
    head = JSON.parse(new TextDecoder().decode(payload.subarray(0, Math.max(end, 0))));
  } catch {
    head = null;
  }
  const { field, topology_version } = (head ?? {}) as Record<string, unknown>;
  if (typeof field !== "string" || typeof topology_version !== "string" || !/^\d{1,20}$/.test(topology_version)) {
    throw new DecodeError("a field message does not begin with its name and topology");
  }
  const bytes = payload.subarray(end + 1);
  if (bytes.length % 4 !== 0) {
    throw new DecodeError(`field ${field}: ${bytes.length} bytes of values are not a multiple of 4`);
  }
  const values = new Float32Array(aligned(bytes));
  if (!values.every(Number.isFinite)) {
    throw new DecodeError(`field ${field}: a value is not finite`);
  }
  return { name: field, topologyVersion: BigInt(topology_version), values };
}

function toolState(where: string, tool: ToolFeedback): ToolState {
  const here = `${where}, tool "${tool.tool}"`;
  const q = tool.orientation;
  const length = q ? Math.hypot(q.w, q.x, q.y, q.z) : 0;
  // An orientation of zeros means "not given", which is the identity.
  const orientationWxyz =
    q && length > 0 && Number.isFinite(length)
      ? ([q.w / length, q.x / length, q.y / length, q.z / length] as const)
      : ([1, 0, 0, 0] as const);
  return {
    name: tool.tool,
    positionM: vector(`${here}, position_m`, tool.positionM),
    orientationWxyz,
    // No limit: a stiff body can push with meganewtons.
    forceN: vector(`${here}, force_n`, tool.forceN, Infinity),
    jointValues: tool.jointValues.map((value, i) => finite(`${here}, joint_values[${i}]`, value)),
    retired: tool.retired,
    recovering: tool.recovering,
    claimedBy: tool.claimed ? tool.clientId : null,
  };
}

function up(gravity: ProtoVector3 | undefined): Vector {
  const length = gravity ? Math.hypot(gravity.x, gravity.y, gravity.z) : 0;
  return gravity && length > 0 && Number.isFinite(length)
    ? [-gravity.x / length, -gravity.y / length, -gravity.z / length]
    : [0, 0, 1];
}

function finite(where: string, value: number): number {
  if (!Number.isFinite(value)) {
    throw new DecodeError(`${where}: ${value} is not finite`);
  }
  return value;
}

/** @param limit Largest coordinate. Infinity: refuses only values that are not finite. */
function vector(where: string, value: ProtoVector3 | undefined, limit = MAX_LENGTH_M): Vector {
  const { x, y, z } = value ?? { x: 0, y: 0, z: 0 };
  if (!(Math.abs(x) < limit && Math.abs(y) < limit && Math.abs(z) < limit)) {
    throw new DecodeError(`${where}: (${x}, ${y}, ${z}) is not finite${limit < Infinity ? " or too large" : ""}`);
  }
  return [x, y, z];
}

export function parse<Message>(what: string, decode: () => Message): Message {
  try {
    return decode();
  } catch (error) {
    throw new DecodeError(`a ${what} message is not protobuf: ${error instanceof Error ? error.message : String(error)}`);
  }
}

/** Copies to a word boundary, which typed arrays need and protobuf's view does not guarantee. */
function aligned(bytes: Uint8Array): ArrayBuffer {
  return bytes.slice().buffer;
}
