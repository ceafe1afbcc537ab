// The bodies: one mesh each. Every frame replaces the positions.
import * as THREE from "three";

import { ofFace, shapeOf, type BodyPatch, type Changes, type Shape } from "../stream/changes";
import type { Surface, Topology } from "../stream/decode";
import { AppendedFaces } from "./faces";
import type { Level } from "./quality";
import { unpackNormals, vertexNormals } from "./normals";
import { decodePicture } from "./picture";
import { fillCopies, splitSeams } from "./seams";
import { simpleMaterial } from "./simple_material";
import { tint } from "./tint";
import { setRange, valueMaterial } from "./value_material";

/** Colours for bodies without one: liver, kidney, gallbladder, spleen, fat. */
const PALETTE: readonly string[] = ["#82291f", "#a8493f", "#6f7a3c", "#6d2f45", "#c9a25a"];

export class Tissue {
  readonly group = new THREE.Group();
  readonly #bodies: readonly Body[];

  /**
   * @param positions [vertex_count, 3] m of the first frame. The surface pattern is fixed to these material points.
   * @param onPicture Called each time that a picture on a body has been decoded, some time later.
   */
  constructor(
    topology: Topology,
    positions: Float32Array,
    radiusM: number,
    { material }: Pick<Level, "material">,
    onPicture: () => void = () => undefined,
  ) {
    this.#bodies = topology.bodies
      .map((surface, place) => ({ surface, place }))
      .filter(({ surface }) => surface.triangles.length > 0)
      .map(({ surface, place }, index) => new Body(surface, place, positions, radiusM, PALETTE[index % PALETTE.length]!, material));
    for (const body of this.#bodies) {
      void body.showPicture().then((shown) => (shown ? onPicture() : undefined));
    }
    this.group.add(...this.#bodies.map((body) => body.mesh));
    this.update(positions);
  }

  /** Takes changes of the surface, which show from the next `update` on. null: it is as in the topology. */
  change(changes: Changes | null): void {
    for (const body of this.#bodies) {
      body.change(changes?.bodies[body.place] ?? null);
    }
  }

  /**
   * @param positions [vertex_count, 3] m, with appended vertices behind those of the topology
   * @param normals [vertex_count, 3], unit vectors times 127; null: computes them
   */
  update(positions: Float32Array, normals: Int8Array | null = null): void {
    for (const body of this.#bodies) {
      body.update(positions, normals);
    }
  }

  /** Shows values as colours. @param values One for each vertex; null: the tissue as it looks. */
  colour(values: Float32Array | null, least: number, most: number): void {
    for (const body of this.#bodies) {
      body.colour(values, least, most);
    }
  }

  /** Shows the edges of the triangles over the surface, or hides them. */
  showEdges(shown: boolean): void {
    for (const body of this.#bodies) {
      body.showEdges(shown);
    }
  }

  /** Marks the nodes that are held or prescribed, or not. */
  showFixed(shown: boolean): void {
    for (const body of this.#bodies) {
      body.showFixed(shown);
    }
  }

  /** Hides everything behind `plane`, in the room's frame. null: shows everything. */
  clip(plane: THREE.Plane | null): void {
    for (const body of this.#bodies) {
      body.clip(plane);
    }
  }

  dispose(): void {
    for (const body of this.#bodies) {
      body.dispose();
    }
  }
}

class Body {
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.Material>;
  readonly #surface: Surface;
  readonly #look: Look;
  readonly #colours = valueMaterial();
  readonly #edges: THREE.Mesh<THREE.BufferGeometry, THREE.MeshBasicMaterial>;
  readonly #fixed: THREE.Points<THREE.BufferGeometry, THREE.PointsMaterial>;
  readonly #values: THREE.BufferAttribute;
  readonly #positions: THREE.BufferAttribute;
  readonly #normals: THREE.BufferAttribute;
  /** Vertices that WebGL needs several times, because they lie on a seam of the picture. They follow all vertices. */
  readonly #copies: Uint32Array = new Uint32Array();
  /** Triangles as they are drawn, with copies; the same count and order as the surface's. */
  readonly #drawn: Uint32Array;
  readonly #makeFaces: () => AppendedFaces;
  #faces: AppendedFaces | null = null;
  #patch: BodyPatch | null = null;
  /** The triangles of a changed body that are drawn, and for how many vertices of a frame; null: they are not known yet. */
  #shown: { readonly shape: Shape; readonly frameCount: number; readonly outer: Uint32Array } | null = null;
  /** Positions and normals of all vertices of a changed body, appended ones last. */
  #all = new Float32Array(0);
  #allNormals = new Float32Array(0);
  #disposed = false;
  /** Vertex colours of raw tissue, and the colour of the material that they belong to. */
  #raw: Float32Array;
  #base: THREE.Color;
  #pales = false;

  /** @param place Of the body in the topology. */
  constructor(
    surface: Surface,
    readonly place: number,
    positions: Float32Array,
    radiusM: number,
    fallbackColor: string,
    material: Level["material"],
  ) {
    this.#surface = surface;
    const geometry = new THREE.BufferGeometry();
    let triangles = surface.triangles;
    if (surface.texture !== null) {
      const split = splitSeams(triangles, surface.texture.coordinates, surface.vertexCount);
      triangles = split.triangles;
      this.#copies = split.copies;
      geometry.setAttribute("uv", new THREE.BufferAttribute(split.coordinates, 2));
    }
    const vertexCount = surface.vertexCount + this.#copies.length;
    this.#positions = dynamicAttribute(vertexCount);
    this.#normals = dynamicAttribute(vertexCount);
    const places = new Float32Array(3 * vertexCount);
    places.set(this.#slice(positions).map((coordinate) => coordinate / radiusM));
    fillCopies(places, this.#copies, surface.vertexCount, 3);
    geometry.setAttribute("position", this.#positions);
    geometry.setAttribute("normal", this.#normals);
    geometry.setAttribute("place", new THREE.BufferAttribute(places, 3));
    this.#raw = mottle(places);
    geometry.setAttribute("color", new THREE.BufferAttribute(this.#raw.slice(), 3));
    this.#drawn = triangles;
    geometry.setIndex(new THREE.BufferAttribute(triangles.slice(), 1));
    const color = surface.colorSrgb
      ? new THREE.Color().setRGB(...surface.colorSrgb, THREE.SRGBColorSpace)
      : new THREE.Color(fallbackColor);
    this.#base = color;
    this.#values = new THREE.BufferAttribute(new Float32Array(vertexCount), 1);
    this.#values.setUsage(THREE.DynamicDrawUsage);
    geometry.setAttribute("value", this.#values);
    this.#look = lookOf(material, color, surface.texture !== null);
    this.mesh = new THREE.Mesh(geometry, this.#look);
    this.#edges = new THREE.Mesh(
      geometry,
      new THREE.MeshBasicMaterial({ color: "#f2f6f8", wireframe: true, transparent: true, opacity: 0.22, toneMapped: false }),
    );
    this.#edges.frustumCulled = false;
    this.#edges.visible = false;
    this.#fixed = fixedPoints(this.#positions, surface.fixedVertices);
    this.#makeFaces = () => new AppendedFaces(color, material, this.#edges.material);
    this.mesh.add(this.#edges, this.#fixed);
    for (const material of [this.#look, this.#colours]) {
      // Keeps the edges in front of the surface that they lie on.
      Object.assign(material, { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
    }
    this.mesh.name = surface.name;
    this.mesh.castShadow = true;
    this.mesh.receiveShadow = true;
    // The bounds of a deforming mesh change with every frame. Computing them costs more than drawing off screen.
    this.mesh.frustumCulled = false;
  }

  /** Shows the picture of the surface as soon as it is decoded. Tells whether there is one to show. */
  async showPicture(): Promise<boolean> {
    const look = this.#look;
    if (this.#surface.texture === null || look instanceof THREE.ShaderMaterial) {
      return false;
    }
    let picture: THREE.Texture;
    try {
      picture = await decodePicture(new Uint8Array(this.#surface.texture.image));
    } catch (error) {
      console.warn(`the picture on body "${this.#surface.name}" cannot be decoded: ${String(error)}`);
      return false;
    }
    if (this.#disposed) {
      picture.dispose();
      return false;
    }
    // The picture has the tissue's own pattern.
    Object.assign(look, { map: picture, needsUpdate: true });
    look.color.set("#ffffff");
    this.#raw = new Float32Array(this.#raw.length).fill(1);
    this.#base = new THREE.Color("#ffffff");
    this.#tint(true);
    return true;
  }

  /** Pales what is coagulated. @param anew Although nothing is. */
  #tint(anew = false): void {
    const coagulation = this.#patch?.coagulation ?? new Uint8Array();
    if (!anew && !this.#pales && coagulation.length === 0) {
      return;
    }
    this.#pales = coagulation.length > 0;
    const { vertexCount } = this.#surface;
    const colours = this.mesh.geometry.getAttribute("color") as THREE.BufferAttribute;
    tint(this.#raw, this.#base, coagulation.subarray(0, vertexCount), colours.array as Float32Array);
    if (this.#pales) {
      fillCopies(colours.array, this.#copies, vertexCount, 3);
    }
    colours.needsUpdate = true;
  }

  change(patch: BodyPatch | null): void {
    this.#patch = patch;
    this.#shown = null;
    this.#tint();
    if (patch === null) {
      this.#drawBase(this.#drawn);
      this.#faces?.show({ base: this.#drawn, appended: new Uint32Array(), faces: new Uint8Array() });
    }
  }

  update(positions: Float32Array, normals: Int8Array | null): void {
    if (this.#patch !== null) {
      this.#updateChanged(this.#patch, positions);
      return;
    }
    const { vertexCount, triangles } = this.#surface;
    const ours = this.#positions.array as Float32Array;
    const allNormals = this.#normals.array as Float32Array;
    // Without the copies, so that both sides of a seam have the same normal.
    const ourNormals = allNormals.subarray(0, 3 * vertexCount);
    ours.set(this.#slice(positions));
    if (normals === null) {
      vertexNormals(ours, triangles, ourNormals);
    } else {
      unpackNormals(this.#slice(normals), ourNormals);
    }
    fillCopies(ours, this.#copies, vertexCount, 3);
    fillCopies(allNormals, this.#copies, vertexCount, 3);
    this.#positions.needsUpdate = true;
    this.#normals.needsUpdate = true;
  }

  /** As `update`. Normals are computed, because those of the gateway smooth the edges of a cut away. */
  #updateChanged(patch: BodyPatch, positions: Float32Array): void {
    const { firstVertex, vertexCount, triangles } = this.#surface;
    const count = vertexCount + patch.places.length;
    const frameCount = positions.length / 3;
    if (this.#shown?.frameCount !== frameCount) {
      this.#showChanged(patch, frameCount);
    }
    const { outer } = this.#shown!;
    const all = this.#all.subarray(0, 3 * count);
    const allNormals = this.#allNormals.subarray(0, 3 * count);
    all.set(this.#slice(positions));
    for (let i = 0; i < patch.places.length; i += 1) {
      // A vertex that the frame does not have is used by no triangle that is drawn.
      const at = 3 * (patch.places[i]! < frameCount ? patch.places[i]! : firstVertex);
      all.set(positions.subarray(at, at + 3), 3 * (vertexCount + i));
    }
    vertexNormals(all, outer, allNormals);
    const ours = this.#positions.array as Float32Array;
    const ourNormals = this.#normals.array as Float32Array;
    ours.set(all.subarray(0, 3 * vertexCount));
    ourNormals.set(allNormals.subarray(0, 3 * vertexCount));
    fillCopies(ours, this.#copies, vertexCount, 3);
    fillCopies(ourNormals, this.#copies, vertexCount, 3);
    this.#positions.needsUpdate = true;
    this.#normals.needsUpdate = true;
    if (triangles.length > 0) {
      this.#faces?.update(all, allNormals);
    }
  }

  /** Finds what to draw of a changed body. */
  #showChanged(patch: BodyPatch, frameCount: number): void {
    const { vertexCount, triangles } = this.#surface;
    const shape = shapeOf(triangles, vertexCount, patch, frameCount);
    const appendedOuter = ofFace(shape, "outer");
    const outer = new Uint32Array(shape.base.length + appendedOuter.length);
    outer.set(shape.base);
    outer.set(appendedOuter, shape.base.length);
    this.#shown = { shape, frameCount, outer };
    this.#drawBase(shapeOf(this.#drawn, vertexCount, patch, frameCount).base);
    const needed = 3 * (vertexCount + patch.places.length);
    if (this.#all.length < needed) {
      this.#all = new Float32Array(2 * needed);
      this.#allNormals = new Float32Array(2 * needed);
    }
    if (this.#faces === null && shape.appended.length > 0) {
      this.#faces = this.#makeFaces();
      this.#faces.edges.visible = this.#edges.visible;
      this.mesh.add(this.#faces.mesh, this.#faces.edges);
      this.#clipFaces();
    }
    this.#faces?.show(shape, patch.coagulation);
  }

  /** Draws these triangles of the topology, which are some of `#drawn`. */
  #drawBase(triangles: Uint32Array): void {
    const index = this.mesh.geometry.getIndex()!;
    (index.array as Uint32Array).fill(0);
    (index.array as Uint32Array).set(triangles);
    index.needsUpdate = true;
    this.mesh.geometry.setDrawRange(0, triangles.length);
  }

  colour(values: Float32Array | null, least: number, most: number): void {
    this.mesh.material = values === null ? this.#look : this.#colours;
    if (values !== null) {
      const { firstVertex, vertexCount } = this.#surface;
      this.#values.array.set(values.subarray(firstVertex, firstVertex + vertexCount));
      fillCopies(this.#values.array, this.#copies, vertexCount, 1);
      this.#values.needsUpdate = true;
      setRange(this.#colours, least, most);
    }
  }

  showEdges(shown: boolean): void {
    this.#edges.visible = shown;
    if (this.#faces !== null) {
      this.#faces.edges.visible = shown;
    }
  }

  showFixed(shown: boolean): void {
    this.#fixed.visible = shown;
  }

  clip(plane: THREE.Plane | null): void {
    for (const material of this.#materials) {
      material.clippingPlanes = plane === null ? null : [plane];
      // A cut surface shows its inner side.
      material.side = plane === null ? THREE.FrontSide : THREE.DoubleSide;
    }
    this.#clipFaces();
  }

  /** Clips the appended faces as the body. */
  #clipFaces(): void {
    const material = this.#faces?.mesh.material;
    if (material !== undefined) {
      material.clippingPlanes = this.#look.clippingPlanes;
      material.side = this.#look.side;
    }
  }

  dispose(): void {
    this.#disposed = true;
    if (!(this.#look instanceof THREE.ShaderMaterial)) {
      this.#look.map?.dispose();
    }
    this.mesh.geometry.dispose();
    this.#faces?.dispose();
    (this.#colours.uniforms.table!.value as THREE.Texture).dispose();
    this.#fixed.geometry.dispose();
    for (const material of this.#materials) {
      material.dispose();
    }
  }

  get #materials(): readonly THREE.Material[] {
    return [this.#look, this.#colours, this.#edges.material, this.#fixed.material];
  }

  /** The part of `values` [vertex_count, 3] that belongs to this body. */
  #slice<Values extends Float32Array | Int8Array>(values: Values): Values {
    const first = 3 * this.#surface.firstVertex;
    return values.subarray(first, first + 3 * this.#surface.vertexCount) as Values;
  }
}

/** Dots at some vertices, which move with the surface. */
function fixedPoints(positions: THREE.BufferAttribute, vertices: Uint32Array): THREE.Points<THREE.BufferGeometry, THREE.PointsMaterial> {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", positions);
  geometry.setIndex(new THREE.BufferAttribute(vertices, 1));
  const points = new THREE.Points(
    geometry,
    new THREE.PointsMaterial({ color: "#4fb4ff", size: 5, sizeAttenuation: false, toneMapped: false }),
  );
  points.frustumCulled = false;
  points.visible = false;
  return points;
}

function dynamicAttribute(vertexCount: number): THREE.BufferAttribute {
  const attribute = new THREE.BufferAttribute(new Float32Array(3 * vertexCount), 3);
  attribute.setUsage(THREE.DynamicDrawUsage);
  return attribute;
}

type Look = THREE.MeshStandardMaterial | THREE.MeshLambertMaterial | THREE.ShaderMaterial;

/** @param pictured Whether the surface shows a picture, which needs light in each pixel. */
function lookOf(material: Level["material"], color: THREE.Color, pictured: boolean): Look {
  switch (material) {
    case "moist":
      return moistMaterial(color);
    case "plain":
      return new THREE.MeshStandardMaterial({ color, vertexColors: true, roughness: 0.42 });
    case "simple":
      return pictured ? new THREE.MeshLambertMaterial({ color, vertexColors: true }) : simpleMaterial(color);
  }
}

/** A moist capsule over soft tissue: broad highlights, a thin sharp coat above them, light scattered at the rim. */
function moistMaterial(color: THREE.Color): THREE.MeshPhysicalMaterial {
  const material = new THREE.MeshPhysicalMaterial({
    color,
    vertexColors: true,
    roughness: 0.55,
    clearcoat: 0.5,
    clearcoatRoughness: 0.24,
    sheen: 0.4,
    sheenRoughness: 0.5,
    sheenColor: color.clone().lerp(new THREE.Color("#ffb3a0"), 0.5),
    specularIntensity: 0.55,
  });
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", "#include <common>\nattribute vec3 place;\nvarying vec3 vPlace;")
      .replace("#include <begin_vertex>", "#include <begin_vertex>\nvPlace = place;");
    shader.fragmentShader = shader.fragmentShader
      .replace("#include <common>", `#include <common>\n${GRAIN}`)
      .replace("#include <normal_fragment_maps>", "#include <normal_fragment_maps>\nnormal = grained(normal);")
      .replace(
        "#include <clearcoat_normal_fragment_maps>",
        "#include <clearcoat_normal_fragment_maps>\nclearcoatNormal = mix(clearcoatNormal, normal, 0.55);",
      );
  };
  return material;
}

/** Fine relief of a capsule: bump mapping without texture coordinates (Mikkelsen's surface gradient). */
const GRAIN = `
varying vec3 vPlace;

float hashed(vec3 cell) {
  cell = fract(cell * 0.3183099 + 0.1) * 17.0;
  return fract(cell.x * cell.y * cell.z * (cell.x + cell.y + cell.z));
}

float valueNoise(vec3 at) {
  vec3 cell = floor(at);
  vec3 t = fract(at);
  t = t * t * (3.0 - 2.0 * t);
  return mix(
    mix(mix(hashed(cell), hashed(cell + vec3(1, 0, 0)), t.x),
        mix(hashed(cell + vec3(0, 1, 0)), hashed(cell + vec3(1, 1, 0)), t.x), t.y),
    mix(mix(hashed(cell + vec3(0, 0, 1)), hashed(cell + vec3(1, 0, 1)), t.x),
        mix(hashed(cell + vec3(0, 1, 1)), hashed(cell + vec3(1, 1, 1)), t.x), t.y),
    t.z);
}

float grain(vec3 place) {
  return 0.0012 * valueNoise(20.0 * place) + 0.0008 * valueNoise(75.0 * place);
}

vec3 grained(vec3 normal) {
  vec3 dx = dFdx(vPlace);
  vec3 dy = dFdy(vPlace);
  float height = grain(vPlace);
  vec2 slope = vec2(grain(vPlace + dx), grain(vPlace + dy)) - height;
  vec3 r1 = cross(dFdy(vViewPosition), normal);
  vec3 r2 = cross(normal, dFdx(vViewPosition));
  float area = dot(dFdx(vViewPosition), r1);
  return normalize(abs(area) * normal + sign(area) * (slope.x * r1 + slope.y * r2));
}`;

/**
 * Computes faint lobules as vertex colours, once. Living tissue is not uniform, and a pattern fixed to the surface makes
 * its sliding visible.
 *
 * @param places [vertex_count, 3] scene radii
 */
function mottle(places: Float32Array): Float32Array {
  const colors = new Float32Array(places.length);
  for (let v = 0; v < places.length; v += 3) {
    const x = places[v]!;
    const y = places[v + 1]!;
    const z = places[v + 2]!;
    const broad = noise(3.1 * x, 3.1 * y, 3.1 * z);
    const fine = noise(11 * x + 7, 11 * y, 11 * z) * 0.6 + noise(27 * x, 27 * y + 3, 27 * z) * 0.4;
    const light = 0.84 + 0.15 * broad + 0.19 * fine;
    colors[v] = light;
    colors[v + 1] = light * (1 + 0.16 * broad - 0.06 * fine);
    colors[v + 2] = light * (1 + 0.08 * fine);
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
