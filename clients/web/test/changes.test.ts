import { create, toBinary } from "@bufbuild/protobuf";
import * as THREE from "three";
import { beforeEach, describe, expect, it, vi } from "vitest";

import { BodyChangesSchema, BodyChanges_Face as Face, SurfaceChangesSchema } from "../src/generated/tensormass/v1/changes_pb";
import { SceneEventsSchema, SceneEvent_Kind as Kind } from "../src/generated/tensormass/v1/event_pb";
import { decodeChanges } from "../src/stream/changes";
import { decodeTopology } from "../src/stream/decode";
import { eventLabel, eventList } from "../src/stream/events";
import { Session } from "../src/stream/session";
import { LEVELS, placeOf } from "../src/view/quality";
import { Tissue } from "../src/view/tissue";
import { FakeSocket } from "./fake_socket";
import { busMessage, f32, frameBytes, topologyBytes, u32, type Fields } from "./messages";

const LOW = LEVELS[placeOf("low")]!;

/** Kills a triangle of the tetrahedron, and appends a burnt one with a vertex of its own. */
const BURNT = {
  deadTriangles: u32(3),
  appendedVertices: u32(7),
  appendedTriangles: u32(0, 2, 4),
  appendedKinds: Uint8Array.of(Face.BURNT),
} satisfies Fields<typeof BodyChangesSchema>;

function changesBytes(change: Fields<typeof SurfaceChangesSchema> = {}): Uint8Array {
  const given = { topologyVersion: 7n, revision: 1, appendedVertexCount: 1, bodies: [BURNT, {}], ...change };
  return toBinary(SurfaceChangesSchema, create(SurfaceChangesSchema, given));
}

const topology = decodeTopology(topologyBytes());

describe("decodeChanges", () => {
  it("decodes lists that fit the topology", () => {
    const changes = decodeChanges(changesBytes(), topology);
    expect(changes).toMatchObject({ revision: 1, appendedVertexCount: 1 });
    const [liver, vein] = changes.bodies;
    expect([liver!.dead, liver!.places, liver!.triangles].map((list) => [...list])).toEqual([[3], [7], [0, 2, 4]]);
    expect(vein!.faces).toHaveLength(0);
    const unknown = { ...BURNT, appendedKinds: Uint8Array.of(200) };
    expect([...decodeChanges(changesBytes({ bodies: [unknown, {}] }), topology).bodies[0]!.faces]).toEqual([0]);
    const pale = { ...BURNT, coagulation: Uint8Array.of(0, 85, 170, 255, 255) };
    expect([...liver!.coagulation]).toEqual([]);
    expect([...decodeChanges(changesBytes({ bodies: [pale, {}] }), topology).bodies[0]!.coagulation]).toEqual([0, 85, 170, 255, 255]);
    expect(decodeChanges(changesBytes({ bodies: [], appendedVertexCount: 0 }), topology).bodies).toEqual([]);
  });

  it.each([
    ["belong to topology 8", { topologyVersion: 8n }],
    ["1 bodies do not fit the 2", { bodies: [BURNT] }],
    ["3 bytes are not a multiple of 4", { bodies: [{ ...BURNT, deadTriangles: Uint8Array.of(1, 2, 3) }, {}] }],
    ["dead triangles do not ascend", { bodies: [{ ...BURNT, deadTriangles: u32(2, 2) }, {}] }],
    ["dead triangle 0 names triangle 5 of 5", { bodies: [{ ...BURNT, deadTriangles: u32(5) }, {}] }],
    ["appended vertex 0 is at place 6, which is the topology's", { bodies: [{ ...BURNT, appendedVertices: u32(6) }, {}] }],
    ["appended vertex 0 names place 8 of 8", { bodies: [{ ...BURNT, appendedVertices: u32(8) }, {}] }],
    ["appended triangle 0 names vertex 5 of 5", { bodies: [{ ...BURNT, appendedTriangles: u32(0, 1, 5) }, {}] }],
    ["8 bytes are not a multiple of 12", { bodies: [{ ...BURNT, appendedTriangles: u32(0, 1) }, {}] }],
    ["coagulation of 4 of 5 vertices", { bodies: [{ ...BURNT, coagulation: Uint8Array.of(1, 2, 3, 4) }, {}] }],
    ["2 kinds of 1 appended triangles", { bodies: [{ ...BURNT, appendedKinds: Uint8Array.of(1, 1) }, {}] }],
  ] satisfies [string, Fields<typeof SurfaceChangesSchema>][])("refuses: %s", (said, change) => {
    expect(() => decodeChanges(changesBytes(change), topology)).toThrow(said);
  });

  it("refuses what is not protobuf, and changes of no topology", () => {
    expect(() => decodeChanges(Uint8Array.of(255, 1), topology)).toThrow("a changes message is not protobuf");
    expect(() => decodeChanges(changesBytes(), null)).toThrow("belong to topology 7, on show");
  });
});

/** The faces that are drawn of a tissue: body, kind by colour, and the first coordinate of each corner. */
function drawn(tissue: Tissue): string[] {
  const found: string[] = [];
  const add = (name: string, kind: string, mesh: THREE.Mesh) => {
    const { start, count } = mesh.geometry.drawRange;
    const index = mesh.geometry.getIndex()!;
    const positions = mesh.geometry.getAttribute("position");
    const colours = mesh.geometry.getAttribute("color");
    for (let corner = start; corner < Math.min(start + count, index.count); corner += 3) {
      const vertices = [0, 1, 2].map((i) => index.getX(corner + i));
      const shade = kind === "" ? [0, 0, 0].map((_, i) => colours.getComponent(vertices[0]!, i)) : [];
      found.push([name, kind || kindOf(shade), ...vertices.map((vertex) => Math.round(positions.getX(vertex)))].join(" "));
    }
  };
  for (const mesh of tissue.group.children as unknown as THREE.Mesh[]) {
    add(mesh.name, "outer", mesh);
    const faces = mesh.children[2] as THREE.Mesh | undefined; // after edges and fixed vertices
    if (faces !== undefined) {
      add(mesh.name, "", faces);
    }
  }
  return found.sort();
}

/** Cut faces are red, burnt ones nearly black; the outer surface has the colour of its body. */
function kindOf([r, g, b]: number[]): string {
  const is = (colour: string) => new THREE.Color(colour).toArray().every((value, i) => Math.abs(value - [r!, g!, b!][i]!) < 1e-4);
  return is("#a8453b") ? "cut" : is("#2c1b14") ? "burnt" : "outer";
}

describe("Tissue that changes", () => {
  const at = (count: number) => Float32Array.from({ length: 3 * count }, (_, i) => (i % 3 === 0 ? i / 3 : Math.sin(i)));

  it("leaves out dead triangles and paints faces by their kind, without building anew", () => {
    const tissue = new Tissue(topology, at(7), 1, LOW);
    const geometry = (tissue.group.children[0] as THREE.Mesh).geometry;
    const all = drawn(tissue);
    expect(all).toHaveLength(5);
    tissue.change(decodeChanges(changesBytes(), topology));
    tissue.update(at(8));
    expect(drawn(tissue)).toEqual([...all.filter((face) => face !== "liver outer 0 3 2"), "liver burnt 0 2 7"].sort());
    expect((tissue.group.children[0] as THREE.Mesh).geometry).toBe(geometry);
    // A frame from before: the appended triangle waits for its vertex.
    tissue.update(at(7));
    expect(drawn(tissue)).not.toContain("liver burnt 0 2 7");
    tissue.update(at(8));
    expect(drawn(tissue)).toContain("liver burnt 0 2 7");
    tissue.change(null);
    tissue.update(at(7));
    expect(drawn(tissue)).toEqual(all);
    tissue.dispose();
  });

  it("pales coagulated tissue, keeps burnt faces dark, and is raw again after a reset", () => {
    const tissue = new Tissue(topology, at(7), 1, LOW);
    const body = tissue.group.children[0] as THREE.Mesh<THREE.BufferGeometry, THREE.MeshStandardMaterial>;
    const colours = body.geometry.getAttribute("color");
    const raw = [...colours.array];
    const shown = (vertex: number) =>
      [0, 1, 2].map((c) => colours.getComponent(vertex, c) * ("color" in body.material ? body.material.color.toArray()[c]! : 1));
    const pale = { ...BURNT, coagulation: Uint8Array.of(0, 255, 85, 0, 255) };
    tissue.change(decodeChanges(changesBytes({ bodies: [pale, {}] }), topology));
    tissue.update(at(8));
    const whole = new THREE.Color("#b3947f").toArray();
    shown(1).forEach((channel, c) => expect(channel).toBeCloseTo(whole[c]!, 3));
    expect([...colours.array].slice(0, 3)).toEqual(raw.slice(0, 3));
    expect(shown(2)[1]).toBeGreaterThan(raw[7]! * body.material.color.g);
    expect(shown(2)[1]).toBeLessThan(whole[1]!);
    expect(drawn(tissue)).toContain("liver burnt 0 2 7");
    tissue.change(null);
    expect([...colours.array]).toEqual(raw);
    tissue.dispose();
  });

  it("clips and outlines appended faces as the body, and leaves their colour when values are shown", () => {
    const tissue = new Tissue(topology, at(7), 1, LOW);
    const plane = new THREE.Plane(new THREE.Vector3(-1, 0, 0), 0.5);
    tissue.clip(plane);
    tissue.showEdges(true);
    tissue.change(decodeChanges(changesBytes(), topology));
    tissue.update(at(8));
    const [faces, edges] = tissue.group.children[0]!.children.slice(2) as unknown as THREE.Mesh<THREE.BufferGeometry, THREE.Material>[];
    expect(faces!.material.clippingPlanes).toEqual([plane]);
    expect(edges!.visible).toBe(true);
    tissue.colour(Float32Array.of(0, 1, 2, 3, 4, 5, 6), 0, 5);
    tissue.clip(null);
    expect(drawn(tissue)).toContain("liver burnt 0 2 7");
    expect(faces!.material.clippingPlanes).toBeNull();
  });

  it("makes room by doubling, and keeps its buffers while there is room", () => {
    const tissue = new Tissue(topology, at(7), 1, LOW);
    const geometries = new Set<THREE.BufferGeometry>();
    for (let count = 1; count <= 400; count += 1) {
      const bodies = [
        {
          appendedVertices: u32(...Array.from({ length: count }, (_, i) => 7 + i)),
          appendedTriangles: u32(...Array.from({ length: count }, (_, i) => [0, 1, 4 + i]).flat()),
          appendedKinds: new Uint8Array(count).fill(Face.CUT),
        },
        {},
      ];
      tissue.change(decodeChanges(changesBytes({ revision: count, appendedVertexCount: count, bodies }), topology));
      tissue.update(at(7 + count));
      geometries.add((tissue.group.children[0]!.children[2] as THREE.Mesh).geometry);
    }
    const shown = drawn(tissue).filter((face) => face.startsWith("liver cut"));
    expect(new Set(shown)).toEqual(new Set(Array.from({ length: 400 }, (_, i) => `liver cut 0 1 ${7 + i}`)));
    expect(geometries.size).toBe(3); // for 192, 256 and 512 vertices
  });

  it("has normals of the triangles that are there", () => {
    const tissue = new Tissue(topology, at(7), 1, LOW);
    // The whole tetrahedron but one face dies: its corners have the normal of that face.
    const bodies = [{ deadTriangles: u32(1, 2, 3) }, {}];
    tissue.change(decodeChanges(changesBytes({ bodies, appendedVertexCount: 0 }), topology));
    tissue.update(f32Positions(0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 2, 0, 0, 3, 0, 0, 2, 1, 0), new Int8Array(21).fill(9));
    const normals = (tissue.group.children[0] as THREE.Mesh).geometry.getAttribute("normal");
    expect([...normals.array]).toEqual([0, 0, -1, 0, 0, -1, 0, 0, -1, 0, 0, 0]);
  });
});

function f32Positions(...values: number[]): Float32Array {
  return new Float32Array(f32(...values).buffer);
}

/** A scene that changes at random, with a plain account of what a viewer must show. */
class ChangingScene {
  revision = 0;
  sequence = 0n;
  appended = 0;
  /** Faces that must show at each revision, with the largest place of their corners. */
  readonly history: { face: string; last: number }[][] = [];
  #seed: number;
  #bodies = this.#fresh();

  constructor(seed: number) {
    this.#seed = seed;
    this.history.push(this.#seen());
  }

  /** An integer from 0 up to, and without, `end`. */
  random(end: number): number {
    this.#seed = (Math.imul(this.#seed, 1664525) + 1013904223) >>> 0;
    return Math.floor((this.#seed / 2 ** 32) * end);
  }

  change(): void {
    this.revision += 1;
    if (this.random(10) === 0) {
      this.#bodies = this.#fresh();
      this.appended = 0;
    } else {
      this.#bodies.forEach((body, i) => {
        for (let n = this.random(4); n > 0; n -= 1) {
          body.places.push(7 + this.appended);
          this.appended += 1;
        }
        const vertices = topology.bodies[i]!.vertexCount + body.places.length;
        for (let n = this.random(5); n > 0; n -= 1) {
          body.triangles.push([this.random(vertices), this.random(vertices), this.random(vertices)]);
          body.kinds.push(this.random(3));
        }
        const count = topology.bodies[i]!.triangles.length / 3 + body.kinds.length;
        for (let n = this.random(3); n > 0; n -= 1) {
          body.dead.add(this.random(count));
        }
      });
    }
    this.history.push(this.#seen());
  }

  changes(): Uint8Array {
    const bodies = this.#bodies.map(({ dead, places, triangles, kinds }) => ({
      deadTriangles: u32(...[...dead].sort((a, b) => a - b)),
      appendedVertices: u32(...places),
      appendedTriangles: u32(...triangles.flat()),
      appendedKinds: Uint8Array.from(kinds),
    }));
    return changesBytes({ revision: this.revision, appendedVertexCount: this.appended, bodies });
  }

  frame(): Uint8Array {
    this.sequence += 1n;
    const positions = Array.from({ length: 3 * (7 + this.appended) }, (_, i) => (i % 3 === 0 ? i / 3 : this.random(100)));
    return frameBytes({ sequence: this.sequence, revision: this.revision, positions: f32(...positions) });
  }

  /** What a viewer must draw that has changes of a revision and a frame of so many vertices. */
  wanted(revision: number, count: number): string[] {
    return this.history[revision]!.filter(({ last }) => last < count).map(({ face }) => face);
  }

  #fresh(): { dead: Set<number>; places: number[]; triangles: number[][]; kinds: number[] }[] {
    return topology.bodies.map(() => ({ dead: new Set(), places: [], triangles: [], kinds: [] }));
  }

  #seen(): { face: string; last: number }[] {
    const faces = this.#bodies.flatMap(({ dead, places, triangles, kinds }, i) => {
      const { name, firstVertex, vertexCount, triangles: given } = topology.bodies[i]!;
      const base = Array.from({ length: given.length / 3 }, (_, t) => [...given.subarray(3 * t, 3 * t + 3)]);
      const place = (vertex: number) => (vertex < vertexCount ? firstVertex + vertex : places[vertex - vertexCount]!);
      return [...base, ...triangles].flatMap((corners, t) => {
        const at = corners.map(place);
        const kind = t < base.length ? "outer" : ["outer", "cut", "burnt"][kinds[t - base.length]!];
        return dead.has(t) ? [] : [{ face: [name, kind, ...at].join(" "), last: Math.max(...at) }];
      });
    });
    return faces.sort((a, b) => (a.face < b.face ? -1 : 1));
  }
}

/** A page that gets the messages of a scene, and draws. */
class Page {
  readonly session: Session;
  readonly #socket: FakeSocket;
  tissue: Tissue | null = null;
  #changes: unknown = null;

  constructor() {
    const none = () => undefined;
    this.session = new Session({
      url: "ws://host/stream",
      diagnose: () => Promise.resolve({ reason: "full", final: false }),
      events: { onDaemon: none, onChange: none, onFrame: none, onValues: none },
      WebSocket: FakeSocket as unknown as typeof WebSocket,
    });
    this.#socket = FakeSocket.last;
    this.session.show("liver");
    this.#socket.open();
    const daemon = { type: "daemon", problem: "", server: "s", version: "1", backend: "cpu", device: "d", scenes: ["liver"] };
    this.#socket.onmessage?.({ data: JSON.stringify(daemon) });
    this.receive("topology", topologyBytes());
  }

  receive(stream: string, payload: Uint8Array): void {
    this.#socket.onmessage?.({ data: busMessage(`tensormass/server/liver/${stream}`, payload) });
  }

  /** Draws as the viewer does. Returns the faces on show. */
  draw(): string[] {
    const { frame, changes, topology: shown } = this.session.store;
    this.tissue ??= new Tissue(shown!, frame!.positions, 1, LOW);
    if (this.#changes !== changes) {
      this.#changes = changes;
      this.tissue.change(changes);
    }
    this.tissue.update(frame!.positions);
    return drawn(this.tissue);
  }

  /** Revision of what it knows of the surface, and vertices of its frame. */
  get knows(): [revision: number, count: number] {
    const { frame, changes } = this.session.store;
    return [changes?.revision ?? 0, frame!.positions.length / 3];
  }
}

describe("pages of a scene that changes", () => {
  beforeEach(() => {
    vi.spyOn(console, "warn").mockReturnValue(undefined);
    FakeSocket.opened = [];
  });

  it.each([1, 2, 3, 4, 5, 6, 7, 8])("draw what a fresh one draws, seed %i", (seed) => {
    const scene = new ChangingScene(seed);
    const pages: Page[] = [];
    for (let round = 0; round < 60; round += 1) {
      if (round % 20 === 0) {
        pages.push(new Page());
        pages.at(-1)!.receive("changes", scene.changes());
        pages.at(-1)!.receive("frame", scene.frame());
      }
      if (scene.random(10) < 6) {
        scene.change();
      }
      const [changes, frame] = [scene.changes(), scene.frame()];
      const tells = scene.random(2) === 0; // changes go out less often than frames
      pages.forEach((page, i) => {
        const stopped = i === 0 && round > 10 && round < 50; // ten seconds at 4 Hz
        if (stopped || scene.random(10) < 3) {
          return;
        }
        const early = scene.random(2) === 0;
        if (tells && early) {
          page.receive("changes", changes);
        }
        page.receive("frame", frame);
        if (tells && !early) {
          page.receive("changes", changes);
        }
        expect(page.draw(), `round ${round}, page ${i}`).toEqual(scene.wanted(...page.knows));
      });
    }
    const fresh = new Page();
    for (const page of [...pages, fresh]) {
      page.receive("frame", scene.frame());
      page.receive("changes", scene.changes());
      expect(page.draw()).toEqual(scene.wanted(scene.revision, Infinity));
      expect(page.session.store.counters.refused).toBe(0);
    }
  });

  it("keep the surface and say so when changes do not fit, until some do", () => {
    const page = new Page();
    page.receive("frame", frameBytes());
    const before = page.draw();
    page.receive("changes", changesBytes({ bodies: [{ ...BURNT, appendedTriangles: u32(0, 1, 9) }, {}] }));
    expect(page.draw()).toEqual(before);
    expect(page.session.situation).toMatchObject({ text: "Outdated", notice: { detail: expect.stringContaining("names vertex 9 of 5") as string } });
    expect(page.session.store.counters.refused).toBe(1);
    page.receive("frame", frameBytes({ sequence: 2n, revision: 1, positions: f32(...Array<number>(24).fill(1)) }));
    expect(page.draw()).toHaveLength(before.length);
    page.receive("changes", changesBytes());
    expect(page.session.situation.text).toBe("Live");
    expect(page.draw()).toContain("liver burnt 1 1 1");
  });

  it("drop older changes, but follow a recording back", () => {
    const page = new Page();
    page.receive("changes", changesBytes({ revision: 4 }));
    page.receive("changes", changesBytes({ revision: 3 }));
    expect(page.session.store.changes?.revision).toBe(4);
    page.session.store.setChanges(decodeChanges(changesBytes({ revision: 2 }), topology), true);
    expect(page.session.store.changes?.revision).toBe(2);
    page.receive("topology", topologyBytes({ version: 8n }));
    expect(page.session.store.changes).toBeNull();
  });

  it("refuse frames with other vertices than their revision has", () => {
    const page = new Page();
    page.receive("changes", changesBytes());
    const refused = () => page.session.store.counters.lastRefusal;
    page.receive("frame", frameBytes({ revision: 1 }));
    expect(refused()).toContain("has 7 vertices, topology 7 has 7 and 1 appended");
    page.receive("frame", frameBytes({ revision: 0, positions: f32(...Array<number>(24).fill(0)) }));
    expect(refused()).toContain("has 8 vertices, topology 7 has 7");
    page.receive("frame", frameBytes({ revision: 2, positions: f32(0, 0, 0) }));
    expect(refused()).toContain("has 1 vertices, topology 7 has 7 and unknown appended");
    page.receive("frame", frameBytes({ revision: 2, positions: f32(...Array<number>(27).fill(0)) }));
    expect(page.session.store.frame?.revision).toBe(2);
  });

  it("keep the last events of the scene on show", () => {
    const page = new Page();
    const events = (topologyVersion: bigint) =>
      toBinary(
        SceneEventsSchema,
        create(SceneEventsSchema, {
          topologyVersion,
          events: [
            { sequence: 1n, step: 5n, kind: Kind.RESET, text: "the scene was reset" },
            { sequence: 2n, step: 9n, kind: Kind.ABLATED, text: "2 mm³ burnt away" },
          ],
        }),
      );
    page.receive("events", events(7n));
    const kept = page.session.readings().events;
    expect(eventList(kept)).toBe("Step 9: 2 mm³ burnt away\nStep 5: the scene was reset");
    expect(kept.map(eventLabel)).toEqual(["reset", "burnt"]);
    page.receive("topology", topologyBytes({ version: 8n }));
    page.receive("events", events(7n));
    expect(page.session.readings().events).toEqual([]);
    for (const kind of [Kind.UNSPECIFIED, Kind.PIECE_FREE, Kind.SEVERED, Kind.ADJUSTED, Kind.RESTORED, Kind.GUARD, Kind.HELD, Kind.BROKEN, Kind.CUT, Kind.CUT_BEGUN, Kind.CUT_ENDED, Kind.TOOL_ADDED, Kind.TOOL_REMOVED, Kind.ATTACHMENT_ADDED, Kind.ATTACHMENT_REMOVED]) {
      expect(eventLabel({ kind })).not.toBe("");
    }
  });
});
