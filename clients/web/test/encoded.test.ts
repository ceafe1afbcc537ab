import { readFileSync } from "node:fs";
import { join } from "node:path";

import { create, fromBinary, toBinary } from "@bufbuild/protobuf";
import { describe, expect, it } from "vitest";

import { EncodedFrameSchema, EncodedFrame_Codec as Codec } from "../src/generated/tensormass/v1/gateway_pb";
import { DecodeError, decodeFrame, type StreamName } from "../src/stream/decode";
import { FrameDecoder } from "../src/stream/encoded";
import { unpackNormals } from "../src/view/normals";
import { f32, frameBytes, type Fields } from "./messages";

interface Golden {
  readonly name: string;
  readonly stream: StreamName;
  readonly payload: string;
  readonly sequence?: number;
  readonly positions?: string;
  readonly normals?: string | null;
  readonly keyframe: number | null;
  /** The message must be refused. */
  readonly refusal?: string;
}

const GOLDEN = join(import.meta.dirname, "..", "..", "..", "tests", "proto", "encoded_frames.json");
const ORIGIN = { x: 1, y: 2, z: 3 };
const CELL = { x: 0.5, y: 0.25, z: 0 };

function bytes(base64: string): Uint8Array {
  return Uint8Array.from(Buffer.from(base64, "base64"));
}

function encoded(fields: Fields<typeof EncodedFrameSchema>): Uint8Array {
  return toBinary(EncodedFrameSchema, create(EncodedFrameSchema, { frame: { sequence: 1n }, ...fields }));
}

function u16(...values: number[]): Uint8Array {
  return new Uint8Array(Uint16Array.from(values).buffer);
}

const KEYFRAME = {
  codec: Codec.Q16,
  keyframe: 4n,
  vertexCount: 2,
  positions: u16(0, 1, 2, 65535, 4, 0),
  originM: ORIGIN,
  cellM: CELL,
};
const DIFFERENCES = { ...KEYFRAME, codec: Codec.DELTA, positions: Uint8Array.of(1, 255, 0, 128, 127, 0), wideDifferences: u16(300) };

describe("FrameDecoder", () => {
  it("decodes the golden messages to the bits of the decoder in Python", () => {
    const { messages } = JSON.parse(readFileSync(GOLDEN, "utf8")) as { messages: Golden[] };
    const decoder = new FrameDecoder();
    for (const { name, stream, payload, sequence, positions, normals, keyframe, refusal } of messages) {
      if (refusal !== undefined) {
        expect(() => decoder.decode(stream, bytes(payload)), name).toThrow();
      } else {
        const frame = decoder.decode(stream, bytes(payload));
        expect(frame.sequence, name).toBe(BigInt(sequence!));
        expect(frame.tools[0]?.forceN, name).toEqual([0, 1.5, 0]);
        expect(new Uint8Array(frame.positions.buffer), name).toEqual(bytes(positions!));
        expect(frame.normals, name).toEqual(normals ? new Int8Array(bytes(normals).buffer) : null);
      }
      expect(decoder.keyframe, name).toBe(keyframe);
    }
    expect(messages.filter(({ refusal }) => refusal !== undefined)).toHaveLength(3);
  });

  it("tells the error of codec and less detail together", () => {
    const errorOf = (change: object) => new FrameDecoder().decode("encoded_frame", encoded({ ...KEYFRAME, ...change })).errorM;
    expect(errorOf({ errorM: { x: 3e-6, y: 4e-6, z: 0 }, detailErrorM: 1e-6 })).toBeCloseTo(6e-6, 12);
    expect(errorOf({ errorM: undefined, detailErrorM: 2e-3 })).toBe(2e-3);
    expect(() => errorOf({ detailErrorM: NaN })).toThrow(/its error is NaN m/);
    expect(decodeFrame(frameBytes()).errorM).toBe(0);
  });

  it("adds narrow and wide differences to the keyframe", () => {
    const decoder = new FrameDecoder();
    const first = decoder.decode("encoded_frame", encoded(KEYFRAME));
    expect([...first.positions]).toEqual([1, 2.25, 3, 1 + 0.5 * 65535, 3, 3]);
    const moved = decoder.decode("encoded_frame", encoded(DIFFERENCES));
    expect([...moved.positions]).toEqual([1.5, 2, 3, 1 + 0.5 * 65835, 2 + 0.25 * 131, 3]);
    expect(decoder.keyframe).toBe(4);
  });

  it("keeps no keyframe of plain q16", () => {
    const decoder = new FrameDecoder();
    decoder.decode("encoded_frame", encoded({ ...KEYFRAME, keyframe: 0n }));
    expect(decoder.keyframe).toBeNull();
  });

  it.each<[string, RegExp, Fields<typeof EncodedFrameSchema>]>([
    ["an unknown codec", /codec 0 is unknown/, { ...KEYFRAME, codec: Codec.UNSPECIFIED }],
    ["another keyframe", /refers to keyframe 5, but 4 was kept/, { ...DIFFERENCES, keyframe: 5n }],
    ["other vertices than the keyframe", /1 vertices differ from 2/, { ...DIFFERENCES, positions: new Uint8Array(3) }],
    ["half a wide difference", /half a wide difference/, { ...DIFFERENCES, wideDifferences: Uint8Array.of(1) }],
    ["a wide difference too few", /0 wide differences for 1 marks/, { ...DIFFERENCES, wideDifferences: u16() }],
    ["a wide difference too many", /2 wide differences for 1 marks/, { ...DIFFERENCES, wideDifferences: u16(1, 2) }],
    ["a fraction of a vertex", /5 bytes of positions/, { ...KEYFRAME, positions: new Uint8Array(5) }],
    ["another number of vertices", /2 positions of 3 vertices/, { ...KEYFRAME, vertexCount: 3 }],
    ["normals of other vertices", /1 bytes of normals/, { ...KEYFRAME, normals: new Uint8Array(1) }],
    ["a grid that is not finite", /grid is not finite/, { ...KEYFRAME, cellM: { x: 0, y: NaN, z: 0 } }],
    ["a grid that is too large", /grid is not finite or too large/, { ...KEYFRAME, originM: { x: 0, y: 0, z: 1e39 } }],
    ["a position that is not finite", /not finite/, { codec: Codec.FLOAT32, vertexCount: 1, positions: f32(0, NaN, 0) }],
    ["a message without its head", /without its head/, { ...KEYFRAME, frame: undefined }],
  ])("refuses %s and keeps no keyframe", (_, said, damaged) => {
    const decoder = new FrameDecoder();
    decoder.decode("encoded_frame", encoded(KEYFRAME));
    expect(() => decoder.decode("encoded_frame", encoded(damaged))).toThrow(said);
    expect(decoder.keyframe).toBeNull();
  });

  const golden = () => (JSON.parse(readFileSync(GOLDEN, "utf8")) as { messages: Golden[] }).messages;
  const meshopt = (name: string) => {
    const { payload } = golden().find((each) => each.name === name)!;
    return fromBinary(EncodedFrameSchema, bytes(payload));
  };

  it.each<[string, RegExp, Fields<typeof EncodedFrameSchema>]>([
    ["a vertex too many", /not in meshoptimizer's vertex codec/, { vertexCount: 601 }],
    ["a vertex too few", /not in meshoptimizer's vertex codec/, { vertexCount: 599 }],
    ["no vertices for its bytes", /not in meshoptimizer's vertex codec/, { vertexCount: 0 }],
    ["more vertices than a message can have", /claim 4294967295 vertices/, { vertexCount: 2 ** 32 - 1 }],
    ["more vertices than its bytes", /3 bytes of positions claim 769 vertices/, { vertexCount: 769, positions: new Uint8Array(3) }],
    ["no bytes", /0 bytes of positions claim 600 vertices/, { positions: new Uint8Array() }],
    ["zeros", /not in meshoptimizer's vertex codec/, { positions: new Uint8Array(100) }],
    ["a grid that is not finite", /grid is not finite/, { cellM: { x: 0, y: NaN, z: 0 } }],
  ])("refuses meshopt with %s", (_, said, damage) => {
    const { frame, codec, vertexCount, positions, originM, cellM } = meshopt("meshopt of many blocks");
    const damaged = encoded({ frame, codec, vertexCount, positions, originM, cellM, ...damage });
    expect(() => new FrameDecoder().decode("encoded_frame", damaged)).toThrow(said);
  });

  it("refuses meshopt of differences that do not fit their keyframe", () => {
    const message = meshopt("meshopt of differences, two of them wide");
    const decode = (keyframe: Uint8Array, change: Fields<typeof EncodedFrameSchema>) => {
      const { frame, codec, vertexCount, positions, wideDifferences, originM, cellM } = message;
      const decoder = new FrameDecoder();
      const kept = { ...KEYFRAME, vertexCount: keyframe.length / 6, positions: keyframe, keyframe: message.keyframe };
      decoder.decode("encoded_frame", encoded(kept));
      const differences = { frame, codec, vertexCount, positions, wideDifferences, originM, cellM, keyframe: message.keyframe };
      return decoder.decode("encoded_frame", encoded({ ...differences, ...change }));
    };
    expect(decode(new Uint8Array(3600), {}).positions).toHaveLength(1800);
    expect(() => decode(new Uint8Array(3600), { keyframe: 99n })).toThrow(/refers to keyframe 99/);
    expect(() => decode(new Uint8Array(3594), {})).toThrow(/600 vertices differ from 599 of the keyframe/);
    expect(() => decode(new Uint8Array(3600), { wideDifferences: u16(1) })).toThrow(/1 wide differences for 2 marks/);
    expect(() => decode(new Uint8Array(3600), { wideDifferences: u16(1, 2, 3) })).toThrow(/3 wide differences for 2 marks/);
    expect(() => decode(new Uint8Array(3600), { codec: Codec.MESHOPT })).toThrow(/not in meshoptimizer's vertex codec/);
  });

  it("decodes good meshopt after a damaged one", () => {
    const decoder = new FrameDecoder();
    const { payload, positions } = golden().find((each) => each.name === "meshopt of many blocks")!;
    for (let bit = 0; bit < 3000; bit += 7) {
      const message = meshopt("meshopt of many blocks");
      message.positions[bit >> 3]! ^= 1 << (bit & 7);
      try {
        decoder.decode("encoded_frame", toBinary(EncodedFrameSchema, message));
      } catch (error) {
        expect(error).toBeInstanceOf(DecodeError);
      }
    }
    const frame = decoder.decode("encoded_frame", bytes(payload));
    expect(new Uint8Array(frame.positions.buffer)).toEqual(bytes(positions!));
  });

  it("decodes meshopt without vertices", () => {
    const empty = encoded({ codec: Codec.MESHOPT, vertexCount: 0, originM: ORIGIN, cellM: CELL });
    expect(new FrameDecoder().decode("encoded_frame", empty).positions).toHaveLength(0);
  });

  it("starts without a keyframe after a reset", () => {
    const decoder = new FrameDecoder();
    decoder.decode("encoded_frame", encoded(KEYFRAME));
    decoder.reset();
    expect(() => decoder.decode("encoded_frame", encoded(DIFFERENCES))).toThrow(/none was kept/);
  });
});

it("unpackNormals reads unit vectors", () => {
  const normals = new Float32Array(3);
  unpackNormals(Int8Array.of(127, 0, -127), normals);
  expect([...normals]).toEqual([1, 0, -1]);
});
