// Surroundings of a scene: lights, reflections, backdrop and floor. Their unit is the radius of the scene.
import * as THREE from "three";

import type { Level } from "./quality";

const FLOOR_RADIUS = 4.5;

/**
 * An operating lamp as the key, a cool light from behind to part tissue from backdrop, and warm light from the floor.
 * Without reflections the floor's light replaces them.
 */
export function lights({ reflections }: Pick<Level, "reflections">): THREE.Light[] {
  const key = new THREE.DirectionalLight("#fff1e2", 2.1);
  key.position.set(-1.6, 4.2, 2.4);
  key.castShadow = true;
  key.shadow.mapSize.setScalar(1024);
  key.shadow.radius = 7;
  key.shadow.bias = -0.0008;
  key.shadow.normalBias = 0.012;
  const extent = 1.9;
  Object.assign(key.shadow.camera, { left: -extent, right: extent, top: extent, bottom: -extent, near: 1, far: 9 });
  const rim = new THREE.DirectionalLight("#a9cdfd", 1.5);
  rim.position.set(2.6, 1.8, -3.2);
  const fill = new THREE.HemisphereLight("#cfe0ee", "#7a4a3e", reflections ? 0.35 : 2.2);
  return [key, rim, fill];
}

/** Environment for reflections: three softboxes in a dim room. Its blur takes seconds without a GPU. */
export function softboxes(renderer: THREE.WebGLRenderer): THREE.Texture {
  const room = new THREE.Scene();
  room.add(
    new THREE.Mesh(
      new THREE.SphereGeometry(12, 32, 16),
      new THREE.MeshBasicMaterial({ color: new THREE.Color(0.16, 0.19, 0.22), side: THREE.BackSide }),
    ),
  );
  const panel = (intensity: number, width: number, height: number, position: THREE.Vector3) => {
    const mesh = new THREE.Mesh(
      new THREE.PlaneGeometry(width, height),
      new THREE.MeshBasicMaterial({ color: new THREE.Color().setScalar(intensity), side: THREE.DoubleSide }),
    );
    mesh.position.copy(position);
    mesh.lookAt(0, 0, 0);
    room.add(mesh);
  };
  panel(9, 4.5, 4.5, new THREE.Vector3(-2, 7, 2.5));
  panel(4, 2, 6, new THREE.Vector3(7, 2.5, 1.5));
  panel(3, 6, 2, new THREE.Vector3(-3, 2, -7));
  const generator = new THREE.PMREMGenerator(renderer);
  const texture = generator.fromScene(room, 0.03).texture;
  generator.dispose();
  return texture;
}

/** Rings of the backdrop: radius [half a picture], sRGB colour. The last one reaches behind the corners. */
const BACKDROP = [
  [0, "#3a4a55"],
  [0.06, "#3a4a55"],
  [0.77, "#222d36"],
  [1.48, "#0f151a"],
  [1.7, "#0f151a"],
] as const;
const BACKDROP_SECTORS = 48;
const BACKDROP_CENTER_Y = 0.19;

/** A soft vignette from slate to near black, fixed to the tile. Colours at vertices cost a tenth of a picture's. */
export function backdrop(): THREE.Mesh {
  const positions: number[] = [];
  const colours: number[] = [];
  const triangles: number[] = [];
  const row = BACKDROP_SECTORS + 1;
  BACKDROP.forEach(([radius, hex], ring) => {
    // The screen takes sRGB, and so does the shader below.
    const colour = new THREE.Color(hex).convertLinearToSRGB().toArray();
    for (let sector = 0; sector < row; sector += 1) {
      const angle = (2 * Math.PI * sector) / BACKDROP_SECTORS;
      positions.push(radius * Math.cos(angle), BACKDROP_CENTER_Y + radius * Math.sin(angle), 0);
      colours.push(...colour);
      if (ring > 0 && sector > 0) {
        const [outer, inner] = [ring * row + sector, (ring - 1) * row + sector];
        triangles.push(inner - 1, outer - 1, outer, inner - 1, outer, inner);
      }
    }
  });
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
  geometry.setIndex(triangles);
  const material = new THREE.ShaderMaterial({
    vertexColors: true,
    depthTest: false,
    depthWrite: false,
    vertexShader: `
      varying vec3 vColour;
      void main() {
        vColour = color;
        gl_Position = vec4(position, 1.0);
      }`,
    fragmentShader: `
      varying vec3 vColour;
      void main() {
        gl_FragColor = vec4(vColour, 1.0);
      }`,
  });
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  mesh.renderOrder = -1;
  return mesh;
}

/** The floor: fine lines that fade out, and a plane that receives the shadow. */
export function floor({ ground, shadows }: Pick<Level, "ground" | "shadows">): THREE.Object3D[] {
  const lines = { grid: smoothGrid, lines: thinGrid, none: null }[ground];
  return [...(shadows ? [shadowPlane()] : []), ...(lines === null ? [] : [lines()])];
}

function shadowPlane(): THREE.Mesh {
  const plane = new THREE.Mesh(
    new THREE.CircleGeometry(FLOOR_RADIUS, 64).rotateX(-Math.PI / 2),
    new THREE.ShadowMaterial({ opacity: 0.42 }),
  );
  plane.position.y = -0.001;
  plane.receiveShadow = true;
  return plane;
}

/** A shader for each pixel of the floor draws smooth lines. */
function smoothGrid(): THREE.Mesh {
  return new THREE.Mesh(
    new THREE.CircleGeometry(FLOOR_RADIUS, 64).rotateX(-Math.PI / 2),
    new THREE.ShaderMaterial({
      transparent: true,
      depthWrite: false,
      vertexShader: `
        varying vec2 place;
        void main() {
          place = position.xz;
          gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
        }`,
      fragmentShader: `
        varying vec2 place;
        float lines(vec2 at, float spacing) {
          vec2 cell = at / spacing;
          vec2 distance = abs(fract(cell - 0.5) - 0.5) / fwidth(cell);
          return 1.0 - min(min(distance.x, distance.y), 1.0);
        }
        void main() {
          float fade = smoothstep(4.3, 0.6, length(place));
          float strength = 0.10 * lines(place, 0.25) + 0.16 * lines(place, 1.0);
          gl_FragColor = vec4(0.62, 0.76, 0.85, strength * fade * fade);
        }`,
    }),
  );
}

/** WebGL's own lines cost their few pixels only. They have no width, so far ones would flicker if there were more. */
function thinGrid(): THREE.LineSegments {
  const points: number[] = [];
  const colours: number[] = [];
  const add = (x: number, z: number) => {
    const fade = THREE.MathUtils.smoothstep(FLOOR_RADIUS - Math.hypot(x, z), 0, FLOOR_RADIUS - 0.6);
    points.push(x, 0, z);
    colours.push(0.62, 0.76, 0.85, 0.3 * fade * fade);
  };
  const last = Math.floor(FLOOR_RADIUS);
  for (let line = -last; line <= last; line += 1) {
    for (let part = -last; part < last; part += 1) {
      add(line, part);
      add(line, part + 1);
      add(part, line);
      add(part + 1, line);
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 4));
  const material = new THREE.LineBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false, toneMapped: false });
  return new THREE.LineSegments(geometry, material);
}
