// Surroundings of a scene: lights, reflections, backdrop and floor. Their unit is the radius of the scene.
import * as THREE from "three";

/** An operating lamp as the key, a cool light from behind to part tissue from backdrop, and warm light from the floor. */
export function lights(fillIntensity: number): THREE.Light[] {
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
  const fill = new THREE.HemisphereLight("#cfe0ee", "#7a4a3e", fillIntensity);
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

/** A soft vignette from slate to near black, fixed to the tile. */
export function backdrop(): THREE.Texture {
  const canvas = document.createElement("canvas");
  canvas.width = 256;
  canvas.height = 256;
  const context = canvas.getContext("2d")!;
  const gradient = context.createRadialGradient(128, 104, 8, 128, 128, 190);
  gradient.addColorStop(0, "#3a4a55");
  gradient.addColorStop(0.5, "#222d36");
  gradient.addColorStop(1, "#0f151a");
  context.fillStyle = gradient;
  context.fillRect(0, 0, 256, 256);
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  return texture;
}

/** The floor: fine lines that fade out, and a plane that receives the shadow. */
export function floor(): THREE.Object3D[] {
  const lines = new THREE.Mesh(
    new THREE.CircleGeometry(4.5, 64).rotateX(-Math.PI / 2),
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
  const shadow = new THREE.Mesh(
    new THREE.CircleGeometry(4.5, 64).rotateX(-Math.PI / 2),
    new THREE.ShadowMaterial({ opacity: 0.42 }),
  );
  shadow.position.y = -0.001;
  shadow.receiveShadow = true;
  return [shadow, lines];
}
