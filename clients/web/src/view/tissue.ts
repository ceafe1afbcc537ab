// The bodies: one mesh each, whose positions are replaced by every frame.
import * as THREE from "three";

import type { Surface, Topology } from "../stream/decode";
import { vertexNormals } from "./normals";

/** For bodies without a colour of their own: liver, kidney, gallbladder, spleen, fat. */
const PALETTE: readonly string[] = ["#8f3428", "#a8493f", "#6f7a3c", "#6d2f45", "#c9a25a"];

export class Tissue {
  readonly group = new THREE.Group();
  readonly #bodies: readonly Body[];

  /** @param positions [vertex_count, 3] m of the first frame: the pattern of the surface sticks to these places. */
  constructor(topology: Topology, positions: Float32Array, radiusM: number) {
    this.#bodies = topology.bodies
      .filter((surface) => surface.triangles.length > 0)
      .map((surface, index) => new Body(surface, positions, radiusM, PALETTE[index % PALETTE.length]!));
    this.group.add(...this.#bodies.map((body) => body.mesh));
    this.update(positions);
  }

  /** @param positions [vertex_count, 3] m */
  update(positions: Float32Array): void {
    for (const body of this.#bodies) {
      body.update(positions);
    }
  }

  dispose(): void {
    for (const body of this.#bodies) {
      body.mesh.geometry.dispose();
      body.mesh.material.dispose();
    }
  }
}

class Body {
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.MeshPhysicalMaterial>;
  readonly #surface: Surface;
  readonly #positions: THREE.BufferAttribute;
  readonly #normals: THREE.BufferAttribute;

  constructor(surface: Surface, positions: Float32Array, radiusM: number, fallbackColor: string) {
    this.#surface = surface;
    this.#positions = dynamicAttribute(surface.vertexCount);
    this.#normals = dynamicAttribute(surface.vertexCount);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", this.#positions);
    geometry.setAttribute("normal", this.#normals);
    geometry.setAttribute("color", new THREE.BufferAttribute(mottle(this.#slice(positions), radiusM), 3));
    geometry.setIndex(new THREE.BufferAttribute(surface.triangles, 1));
    const color = surface.colorSrgb
      ? new THREE.Color().setRGB(...surface.colorSrgb, THREE.SRGBColorSpace)
      : new THREE.Color(fallbackColor);
    // A moist capsule over soft tissue: broad highlights below, a thin sharp coat above, light scattered at the rim.
    const material = new THREE.MeshPhysicalMaterial({
      color,
      vertexColors: true,
      roughness: 0.5,
      clearcoat: 0.55,
      clearcoatRoughness: 0.22,
      sheen: 0.6,
      sheenRoughness: 0.45,
      sheenColor: color.clone().lerp(new THREE.Color("#ffb3a0"), 0.55),
      specularIntensity: 0.6,
    });
    this.mesh = new THREE.Mesh(geometry, material);
    this.mesh.name = surface.name;
    this.mesh.castShadow = true;
    this.mesh.receiveShadow = true;
    // The bounds of a deforming mesh change with every frame; finding them costs more than drawing off screen.
    this.mesh.frustumCulled = false;
  }

  update(positions: Float32Array): void {
    (this.#positions.array as Float32Array).set(this.#slice(positions));
    vertexNormals(
      this.#positions.array as Float32Array,
      this.#surface.triangles,
      this.#normals.array as Float32Array,
    );
    this.#positions.needsUpdate = true;
    this.#normals.needsUpdate = true;
  }

  #slice(positions: Float32Array): Float32Array {
    const first = 3 * this.#surface.firstVertex;
    return positions.subarray(first, first + 3 * this.#surface.vertexCount);
  }
}

function dynamicAttribute(vertexCount: number): THREE.BufferAttribute {
  const attribute = new THREE.BufferAttribute(new Float32Array(3 * vertexCount), 3);
  attribute.setUsage(THREE.DynamicDrawUsage);
  return attribute;
}

/**
 * Faint lobules and vessels' shade as vertex colours, found once: living tissue is never of one colour, and a pattern
 * that sticks to the surface lets the eye see it slide.
 */
function mottle(positions: Float32Array, radiusM: number): Float32Array {
  const colors = new Float32Array(positions.length);
  const scale = 1 / radiusM;
  for (let v = 0; v < positions.length; v += 3) {
    const x = positions[v]! * scale;
    const y = positions[v + 1]! * scale;
    const z = positions[v + 2]! * scale;
    const broad = noise(3.1 * x, 3.1 * y, 3.1 * z);
    const fine = noise(11 * x + 7, 11 * y, 11 * z) * 0.6 + noise(27 * x, 27 * y + 3, 27 * z) * 0.4;
    const light = 1 + 0.1 * broad + 0.13 * fine;
    colors[v] = light;
    colors[v + 1] = light * (1 + 0.12 * broad - 0.05 * fine);
    colors[v + 2] = light * (1 + 0.06 * fine);
  }
  return colors;
}

/** Smooth value noise in [-1, 1]. */
function noise(x: number, y: number, z: number): number {
  const x0 = Math.floor(x);
  const y0 = Math.floor(y);
  const z0 = Math.floor(z);
  const u = fade(x - x0);
  const v = fade(y - y0);
  const w = fade(z - z0);
  const corner = (i: number, j: number, k: number) => lattice(x0 + i, y0 + j, z0 + k);
  const edge = (j: number, k: number) => corner(0, j, k) * (1 - u) + corner(1, j, k) * u;
  const face = (k: number) => edge(0, k) * (1 - v) + edge(1, k) * v;
  return face(0) * (1 - w) + face(1) * w;
}

function fade(t: number): number {
  return t * t * (3 - 2 * t);
}

function lattice(i: number, j: number, k: number): number {
  let hash = Math.imul(i, 374761393) ^ Math.imul(j, 668265263) ^ Math.imul(k, 2147483647);
  hash = Math.imul(hash ^ (hash >>> 13), 1274126177);
  return ((hash ^ (hash >>> 16)) & 0xffff) / 0x7fff - 1;
}
