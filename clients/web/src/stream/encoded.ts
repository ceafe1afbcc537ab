// Decodes frames in the codecs of gateway.proto. tests/proto/encoded_frames.json has messages that this decoder and
// the one in Python (tensormass_gateway/decoding.py) decode to the same bits.
import { fromBinary } from "@bufbuild/protobuf";
import { MeshoptDecoder } from "meshoptimizer/decoder";

import { EncodedFrameSchema, EncodedFrame_Codec as Codec, type EncodedFrame } from "../generated/tensormass/v1/gateway_pb";
import type { Vector3 } from "../generated/tensormass/v1/scene_pb";
import { DecodeError, decodeFrame, finiteFloats, frameOf, parse, type Frame, type StreamName } from "./decode";

const WIDE_MARK = -128;
/** No integer of the grid is larger: 16 bits of a keyframe and 16 bits of a difference. */
const MAX_CELLS = 2 ** 17;
const MAX_FLOAT32 = 3.4e38;
/** Vertices of the largest frame on the bus. A longer claim would only take memory. */
const MAX_VERTICES = Math.floor(2 ** 29 / 12);
/** More vertices in a byte than meshoptimizer's vertex codec can pack, which needs two bytes for 256. */
const MAX_VERTICES_PER_BYTE = 256;
/** Integers in a row of that codec: three and a zero. */
const ROW = 4;

/** Whether the page can decode meshopt: its decoder is WebAssembly, which is ready before the first frame. */
const meshoptIsReady =
  MeshoptDecoder.supported &&
  (await MeshoptDecoder.ready.then(
    () => true,
    () => false,
  ));

/** The error of the codec and that of less detail together [m]. Throws DecodeError if it is not finite. */
function errorOf(where: string, { errorM, detailErrorM }: EncodedFrame): number {
  const error = Math.hypot(errorM?.x ?? 0, errorM?.y ?? 0, errorM?.z ?? 0) + detailErrorM;
  if (!(error >= 0 && error < Infinity)) {
    throw new DecodeError(`${where}: its error is ${error} m`);
  }
  return error;
}

/** Decodes the frames of one connection, and keeps the keyframe to which later ones refer. */
export class FrameDecoder {
  #number = 0n;
  /** Integers of the keyframe, [vertex_count, 3]. */
  #cells = new Uint16Array(0);

  /** Number of the kept keyframe, for the acknowledgement of a frame; null if there is no keyframe. */
  get keyframe(): number | null {
    return this.#number === 0n ? null : Number(this.#number);
  }

  /** Forgets the keyframe, because a new connection counts from the start. */
  reset(): void {
    this.#number = 0n;
  }

  /**
   * Decodes a message of the stream `frame` or `encoded_frame`. Throws DecodeError if it is damaged or its keyframe is
   * missing. The decoder then keeps no keyframe, so the next acknowledgement asks for one.
   */
  decode(stream: StreamName, payload: Uint8Array): Frame {
    try {
      return stream === "encoded_frame" ? this.#decode(payload) : decodeFrame(payload);
    } catch (error) {
      this.reset();
      throw error;
    }
  }

  #decode(payload: Uint8Array): Frame {
    const message = parse("encoded_frame", () => fromBinary(EncodedFrameSchema, payload));
    const where = `encoded frame ${message.frame?.sequence ?? "without its head"}`;
    if (message.frame === undefined) {
      throw new DecodeError(where);
    }
    const positions = this.#positions(where, message);
    if (positions.length !== 3 * message.vertexCount) {
      throw new DecodeError(`${where}: ${positions.length / 3} positions of ${message.vertexCount} vertices`);
    }
    if (message.normals.length !== 0 && message.normals.length !== positions.length) {
      throw new DecodeError(`${where}: ${message.normals.length} bytes of normals for ${message.vertexCount} vertices`);
    }
    const { buffer, byteOffset, length } = message.normals;
    return {
      ...frameOf(where, message.frame, positions),
      errorM: errorOf(where, message),
      normals: length === 0 ? null : new Int8Array(buffer, byteOffset, length),
    };
  }

  #positions(where: string, message: EncodedFrame): Float32Array {
    const { positions } = message;
    switch (message.codec) {
      case Codec.FLOAT32:
        return finiteFloats(where, positions);
      case Codec.Q16:
        if (positions.length % 6 !== 0) {
          throw new DecodeError(`${where}: ${positions.length} bytes of positions are a fraction of a vertex`);
        }
        // Copies to a word boundary, which protobuf's view does not guarantee.
        return this.#absolute(where, message, new Uint16Array(positions.slice().buffer), 3);
      case Codec.DELTA:
        return this.#moved(where, message, new Int8Array(positions.buffer, positions.byteOffset, positions.length), 3);
      case Codec.MESHOPT:
        return this.#absolute(where, message, new Uint16Array(unpacked(where, message, 8)), ROW);
      case Codec.MESHOPT_DELTA:
        return this.#moved(where, message, new Int8Array(unpacked(where, message, 4)), ROW);
      default:
        throw new DecodeError(`${where}: codec ${message.codec} is unknown`);
    }
  }

  /** @param stride From one vertex to the next in `cells`. */
  #absolute(where: string, message: EncodedFrame, cells: Uint16Array, stride: number): Float32Array {
    const kept = message.keyframe === 0n ? null : new Uint16Array((3 * cells.length) / stride);
    const { x, y, z, cellX, cellY, cellZ } = gridOf(where, message.originM, message.cellM);
    const positions = new Float32Array((3 * cells.length) / stride);
    for (let i = 0, from = 0; i < positions.length; i += 3, from += stride) {
      positions[i] = x + cellX * cells[from]!;
      positions[i + 1] = y + cellY * cells[from + 1]!;
      positions[i + 2] = z + cellZ * cells[from + 2]!;
      if (kept !== null) {
        kept[i] = cells[from]!;
        kept[i + 1] = cells[from + 1]!;
        kept[i + 2] = cells[from + 2]!;
      }
    }
    if (kept !== null) {
      this.#number = message.keyframe;
      this.#cells = kept;
    }
    return positions;
  }

  /** @param stride From one vertex to the next in `differences`. */
  #moved(where: string, message: EncodedFrame, differences: Int8Array, stride: number): Float32Array {
    if (this.#number === 0n || message.keyframe !== this.#number) {
      throw new DecodeError(`${where} refers to keyframe ${message.keyframe}, but ${this.keyframe ?? "none"} was kept`);
    }
    const keyframe = this.#cells;
    if (3 * differences.length !== stride * keyframe.length) {
      const vertices = differences.length / stride;
      throw new DecodeError(`${where}: ${vertices} vertices differ from ${keyframe.length / 3} of the keyframe`);
    }
    if (message.wideDifferences.length % 2 !== 0) {
      throw new DecodeError(`${where}: half a wide difference`);
    }
    const wide = new Int16Array(message.wideDifferences.slice().buffer);
    let taken = 0;
    const next = (index: number, from: number): number => {
      const narrow = differences[from]!;
      return keyframe[index]! + (narrow === WIDE_MARK ? (wide[taken++] ?? 0) : narrow);
    };
    const { x, y, z, cellX, cellY, cellZ } = gridOf(where, message.originM, message.cellM);
    const positions = new Float32Array(keyframe.length);
    for (let i = 0, from = 0; i < positions.length; i += 3, from += stride) {
      positions[i] = x + cellX * next(i, from);
      positions[i + 1] = y + cellY * next(i + 1, from + 1);
      positions[i + 2] = z + cellZ * next(i + 2, from + 2);
    }
    if (taken !== wide.length) {
      throw new DecodeError(`${where}: ${wide.length} wide differences for ${taken} marks`);
    }
    return positions;
  }
}

/** Rows of `rowBytes` bytes, one for each vertex, of meshoptimizer's vertex codec. Throws DecodeError on a damaged message. */
function unpacked(where: string, { positions, vertexCount }: EncodedFrame, rowBytes: number): ArrayBuffer {
  if (vertexCount > Math.min(MAX_VERTICES, MAX_VERTICES_PER_BYTE * positions.length)) {
    throw new DecodeError(`${where}: ${positions.length} bytes of positions claim ${vertexCount} vertices`);
  }
  if (!meshoptIsReady) {
    throw new DecodeError(`${where}: codec meshopt needs WebAssembly, which this browser does not run; take q16`);
  }
  const rows = new ArrayBuffer(rowBytes * vertexCount);
  // The codec has no form for no rows.
  if (vertexCount > 0 || positions.length > 0) {
    try {
      MeshoptDecoder.decodeVertexBuffer(new Uint8Array(rows), vertexCount, rowBytes, positions);
    } catch (error) {
      throw new DecodeError(`${where}: its positions are not in meshoptimizer's vertex codec: ${String(error)}`);
    }
  }
  return rows;
}

interface Grid {
  readonly x: number;
  readonly y: number;
  readonly z: number;
  readonly cellX: number;
  readonly cellY: number;
  readonly cellZ: number;
}

/** The grid of a message, on which every position is finite. */
function gridOf(where: string, origin: Vector3 | undefined, cell: Vector3 | undefined): Grid {
  const { x, y, z } = origin ?? { x: 0, y: 0, z: 0 };
  const { x: cellX, y: cellY, z: cellZ } = cell ?? { x: 0, y: 0, z: 0 };
  const reach = (start: number, size: number) => Math.abs(start) + MAX_CELLS * Math.abs(size);
  if (!(reach(x, cellX) < MAX_FLOAT32 && reach(y, cellY) < MAX_FLOAT32 && reach(z, cellZ) < MAX_FLOAT32)) {
    throw new DecodeError(`${where}: its grid is not finite or too large`);
  }
  return { x, y, z, cellX, cellY, cellZ };
}
