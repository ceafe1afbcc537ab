// Changes of a surface since its topology (changes.proto): triangles that died, and vertices and triangles that were
// appended. Every list is checked here against the topology on show, so that drawing needs no checks.
//
// Frames and changes may overtake each other. Changes that are newer than the frame draw the triangles whose vertices the
// frame has; older ones draw what is known.
import { fromBinary } from "@bufbuild/protobuf";

import { BodyChanges_Face as FaceNumber, SurfaceChangesSchema, type BodyChanges } from "../generated/tensormass/v1/changes_pb";
import { DecodeError, parse, vertices, type Surface, type Topology } from "./decode";

/** What an appended triangle shows. */
export const FACES = ["outer", "cut", "burnt"] as const;
export type Face = (typeof FACES)[number];

/** What became of one body. Vertices and triangles are numbered in the body: those of its topology, then appended ones. */
export interface BodyPatch {
  /** Ascending. */
  readonly dead: Uint32Array;
  /** [appended vertices]: the place of each among the vertices of a frame. */
  readonly places: Uint32Array;
  /** [appended triangles, 3] */
  readonly triangles: Uint32Array;
  /** [appended triangles]: place in FACES */
  readonly faces: Uint8Array;
  /** [vertices of the body, appended ones last]: how far the tissue is coagulated, 0 to 255. Empty: it is raw. */
  readonly coagulation: Uint8Array;
}

export interface Changes {
  readonly topologyVersion: bigint;
  readonly revision: number;
  readonly appendedVertexCount: number;
  /** In the order of the topology's bodies; empty: all are as in the topology. */
  readonly bodies: readonly BodyPatch[];
}

/** Decodes changes of a topology. Throws DecodeError, with the body and the list, if they do not fit it. */
export function decodeChanges(payload: Uint8Array, topology: Topology | null): Changes {
  const { topologyVersion, revision, appendedVertexCount, bodies } = parse("changes", () => fromBinary(SurfaceChangesSchema, payload));
  if (topology?.version !== topologyVersion) {
    throw new DecodeError(`changes ${revision} belong to topology ${topologyVersion}, on show is ${topology?.version ?? "none"}`);
  }
  if (bodies.length > 0 && bodies.length !== topology.bodies.length) {
    throw new DecodeError(`changes ${revision}: ${bodies.length} bodies do not fit the ${topology.bodies.length} of the topology`);
  }
  const end = topology.vertexCount + appendedVertexCount;
  const patches = bodies.map((body, i) => patchOf(`changes ${revision}`, body, topology.bodies[i]!, topology.vertexCount, end));
  return { topologyVersion, revision, appendedVertexCount, bodies: patches };
}

/** @param first, end Places of appended vertices in a frame. */
function patchOf(what: string, message: BodyChanges, surface: Surface, first: number, end: number): BodyPatch {
  const where = `${what} of body "${surface.name}"`;
  const places = vertices(`${where}: appended vertex`, message.appendedVertices, 1, end, "place");
  const early = places.findIndex((place) => place < first);
  if (early >= 0) {
    throw new DecodeError(`${where}: appended vertex ${early} is at place ${places[early]}, which is the topology's`);
  }
  const triangles = vertices(`${where}: appended triangle`, message.appendedTriangles, 3, surface.vertexCount + places.length);
  const count = triangles.length / 3;
  if (message.appendedKinds.length !== count) {
    throw new DecodeError(`${where}: ${message.appendedKinds.length} kinds of ${count} appended triangles`);
  }
  const dead = vertices(`${where}: dead triangle`, message.deadTriangles, 1, surface.triangles.length / 3 + count, "triangle");
  if (dead.some((triangle, i) => i > 0 && triangle <= dead[i - 1]!)) {
    throw new DecodeError(`${where}: dead triangles do not ascend`);
  }
  const { coagulation } = message;
  if (coagulation.length !== 0 && coagulation.length !== surface.vertexCount + places.length) {
    throw new DecodeError(`${where}: coagulation of ${coagulation.length} of ${surface.vertexCount + places.length} vertices`);
  }
  return { dead, places, triangles, faces: Uint8Array.from(message.appendedKinds, faceOf), coagulation };
}

/** Names of the protocol's numbers. */
const NAMES = new Map<number, Face>([
  [FaceNumber.OUTER, "outer"],
  [FaceNumber.CUT, "cut"],
  [FaceNumber.BURNT, "burnt"],
]);

/** The place in FACES of a number of the protocol. One that is unknown is the body's own surface. */
function faceOf(number: number): number {
  return FACES.indexOf(NAMES.get(number) ?? "outer");
}

/** What there is to draw of a changed body. */
export interface Shape {
  /** [n, 3]: triangles of the topology that are alive. */
  readonly base: Uint32Array;
  /** [m, 3]: appended triangles that are alive and whose vertices are there. */
  readonly appended: Uint32Array;
  /** [m]: place in FACES of each of them. */
  readonly faces: Uint8Array;
}

/**
 * What to draw of a body.
 *
 * @param base [triangle_count, 3]: the triangles of its topology, as they are drawn
 * @param frameCount Vertices of the frame
 */
export function shapeOf(base: Uint32Array, vertexCount: number, patch: BodyPatch, frameCount: number): Shape {
  const baseCount = base.length / 3;
  const alive = new Uint8Array(baseCount + patch.faces.length).fill(1);
  for (const triangle of patch.dead) {
    alive[triangle] = 0;
  }
  const isThere = (vertex: number) => vertex < vertexCount || patch.places[vertex - vertexCount]! < frameCount;
  for (let triangle = 0; triangle < patch.faces.length; triangle += 1) {
    if (![0, 1, 2].every((corner) => isThere(patch.triangles[3 * triangle + corner]!))) {
      alive[baseCount + triangle] = 0;
    }
  }
  const kept = patch.faces.filter((_, triangle) => alive[baseCount + triangle] === 1);
  return { base: only(base, alive, 0), appended: only(patch.triangles, alive, baseCount), faces: kept };
}

/** The triangles that are alive. @param first Place of the first triangle in `alive`. */
function only(triangles: Uint32Array, alive: Uint8Array, first: number): Uint32Array {
  return triangles.filter((_, corner) => alive[first + Math.floor(corner / 3)] === 1);
}

/** The corners of a set of appended triangles in one face. */
export function ofFace({ appended, faces }: Shape, face: Face): Uint32Array {
  const number = FACES.indexOf(face);
  return appended.filter((_, corner) => faces[Math.floor(corner / 3)] === number);
}
