// The material that shows values as colours. Light only shades it slightly, so that colours agree with the legend.
import * as THREE from "three";

import { colourTable } from "./colouring";

/** Values per vertex are the attribute `value`; `setRange` says which of them are the ends of the colours. */
export function valueMaterial(): THREE.ShaderMaterial {
  const table = colourTable();
  const texture = new THREE.DataTexture(table, table.length / 4, 1);
  texture.magFilter = THREE.LinearFilter;
  texture.minFilter = THREE.LinearFilter;
  texture.needsUpdate = true;
  return new THREE.ShaderMaterial({
    clipping: true,
    uniforms: { table: { value: texture }, least: { value: 0 }, most: { value: 1 } },
    vertexShader: `
      #include <clipping_planes_pars_vertex>
      attribute float value;
      varying float vValue;
      varying vec3 vNormal;
      varying vec3 vToEye;
      void main() {
        vValue = value;
        vNormal = normalMatrix * normal;
        vec4 mvPosition = modelViewMatrix * vec4(position, 1.0);
        vToEye = -mvPosition.xyz;
        #include <clipping_planes_vertex>
        gl_Position = projectionMatrix * mvPosition;
      }`,
    // The table holds sRGB, and the screen takes sRGB: no conversion.
    fragmentShader: `
      #include <clipping_planes_pars_fragment>
      uniform sampler2D table;
      uniform float least;
      uniform float most;
      varying float vValue;
      varying vec3 vNormal;
      varying vec3 vToEye;
      void main() {
        #include <clipping_planes_fragment>
        float share = clamp((vValue - least) / (most - least), 0.0, 1.0);
        float facing = abs(dot(normalize(vNormal), normalize(vToEye)));
        float shade = (gl_FrontFacing ? 1.0 : 0.6) * mix(0.62, 1.0, facing);
        gl_FragColor = vec4(texture2D(table, vec2(share, 0.5)).rgb * shade, 1.0);
      }`,
  });
}

export function setRange(material: THREE.ShaderMaterial, least: number, most: number): void {
  material.uniforms.least!.value = least;
  material.uniforms.most!.value = most;
}
