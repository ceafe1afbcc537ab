// The triangles that were appended to a body while its scene stepped, coloured by what they show. Buffers grow by
// doubling, so that a body that is burnt for long is not built anew with each message.
import * as THREE from "three";

import { FACES, type Shape } from "../stream/changes";
import type { Level } from "./quality";
import { vertexNormals } from "./normals";
import { simpleMaterial } from "./simple_material";
import { COAGULATED } from "./tint";

/** Colours of faces [sRGB], in the order of FACES; null: that of the body. */
const COLOURS = [null, "#a8453b", "#2c1b14"] as const;
const LEAST_VERTICES = 192;

export class AppendedFaces {
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.Material>;
  readonly edges: THREE.Mesh<THREE.BufferGeometry, THREE.Material>;
  readonly #colours: readonly THREE.Color[];
  /** [vertex]: the body's vertex that it is. Faces of two kinds share no vertex, so that edges between them are sharp. */
  #sources = new Uint32Array(0);
  #triangles = new Uint32Array(0);
  /** Vertices of the outer surface, which come first. */
  #outerCount = 0;
  #capacity = 0;

  /** @param bodyColour As the body's material has it. @param edges Draws the edges of triangles. */
  constructor(bodyColour: THREE.Color, material: Level["material"], edges: THREE.Material) {
    this.#colours = COLOURS.map((colour) => (colour === null ? bodyColour.clone() : new THREE.Color(colour)));
    const white = new THREE.Color("#ffffff");
    const look =
      material === "simple" ? simpleMaterial(white) : new THREE.MeshStandardMaterial({ color: white, vertexColors: true, roughness: 0.8 });
    Object.assign(look, { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
    this.mesh = new THREE.Mesh(new THREE.BufferGeometry(), look);
    this.edges = new THREE.Mesh(this.mesh.geometry, edges);
    for (const mesh of [this.mesh, this.edges]) {
      mesh.frustumCulled = false; // as the body
    }
    this.mesh.castShadow = true;
    this.mesh.receiveShadow = true;
  }

  /**
   * Shows other triangles from the next `update` on.
   *
   * @param coagulation As of BodyPatch. Burnt faces stay dark.
   */
  show({ appended, faces }: Shape, coagulation: Uint8Array = new Uint8Array()): void {
    const numbers = new Map<string, number>();
    const sources: number[] = [];
    const colours: THREE.Color[] = [];
    const triangles: number[] = [];
    for (const face of FACES.keys()) {
      for (let triangle = 0; triangle < faces.length; triangle += 1) {
        if (faces[triangle] !== face) {
          continue;
        }
        for (const vertex of appended.subarray(3 * triangle, 3 * triangle + 3)) {
          const key = `${face} ${vertex}`;
          let number = numbers.get(key);
          if (number === undefined) {
            numbers.set(key, (number = sources.length));
            sources.push(vertex);
            const raw = this.#colours[face]!;
            const paleness = FACES[face] === "burnt" ? 0 : (coagulation[vertex] ?? 0) / 255;
            colours.push(paleness === 0 ? raw : raw.clone().lerp(COAGULATED, paleness));
          }
          triangles.push(number);
        }
      }
      if (face === 0) {
        this.#outerCount = sources.length;
      }
    }
    this.#sources = Uint32Array.from(sources);
    this.#triangles = Uint32Array.from(triangles);
    this.#reserve(Math.max(sources.length, triangles.length / 3));
    const { geometry } = this.mesh;
    const shades = geometry.getAttribute("color") as THREE.BufferAttribute;
    colours.forEach(({ r, g, b }, vertex) => shades.setXYZ(vertex, r, g, b));
    shades.needsUpdate = true;
    const index = geometry.getIndex()!;
    (index.array as Uint32Array).fill(0);
    (index.array as Uint32Array).set(this.#triangles);
    index.needsUpdate = true;
    geometry.setDrawRange(0, this.#triangles.length);
  }

  /**
   * Moves the triangles.
   *
   * @param positions [vertices of the body, 3] m, appended ones last
   * @param normals [vertices of the body, 3] of the outer surface
   */
  update(positions: Float32Array, normals: Float32Array): void {
    const { geometry } = this.mesh;
    const count = 3 * this.#sources.length;
    const places = geometry.getAttribute("position") as THREE.BufferAttribute;
    const directions = geometry.getAttribute("normal") as THREE.BufferAttribute;
    const ours = (places.array as Float32Array).subarray(0, count);
    const ourNormals = (directions.array as Float32Array).subarray(0, count);
    gather(positions, this.#sources, ours);
    vertexNormals(ours, this.#triangles, ourNormals);
    // The outer surface goes on smoothly to the triangles of the topology.
    gather(normals, this.#sources.subarray(0, this.#outerCount), ourNormals);
    places.needsUpdate = true;
    directions.needsUpdate = true;
  }

  dispose(): void {
    this.mesh.geometry.dispose();
    this.mesh.material.dispose();
  }

  /** Makes room for so many vertices, and as many triangles. */
  #reserve(count: number): void {
    if (count <= this.#capacity) {
      return;
    }
    this.#capacity = Math.max(LEAST_VERTICES, 2 ** Math.ceil(Math.log2(count)));
    const geometry = new THREE.BufferGeometry();
    for (const name of ["position", "normal", "color"]) {
      const attribute = new THREE.BufferAttribute(new Float32Array(3 * this.#capacity), 3);
      attribute.setUsage(THREE.DynamicDrawUsage);
      geometry.setAttribute(name, attribute);
    }
    geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(3 * this.#capacity), 1));
    this.mesh.geometry.dispose();
    this.mesh.geometry = this.edges.geometry = geometry;
  }
}

/** Copies the vectors of some vertices. */
function gather(from: Float32Array, vertices: Uint32Array, to: Float32Array): void {
  for (let i = 0; i < vertices.length; i += 1) {
    const at = 3 * vertices[i]!;
    to[3 * i] = from[at]!;
    to[3 * i + 1] = from[at + 1]!;
    to[3 * i + 2] = from[at + 2]!;
  }
}
