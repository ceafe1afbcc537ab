// Tissue that is lit at its vertices. A pixel only interpolates a colour, which a processor without a GPU can do.
import * as THREE from "three";

/** Strength and width of the highlight. */
const SHINE = "0.13";
const SHARPNESS = "28.0";

/** @param color Multiplied by the vertex colours. The lights are those of the scene, without shadows. */
export function simpleMaterial(color: THREE.Color): THREE.ShaderMaterial {
  return new THREE.ShaderMaterial({
    clipping: true,
    lights: true,
    vertexColors: true,
    uniforms: THREE.UniformsUtils.merge([THREE.UniformsLib.lights, { base: { value: color } }]),
    // Tone mapping and sRGB as in three's own materials, but for vertices.
    vertexShader: `
      #include <common>
      #include <lights_pars_begin>
      #include <tonemapping_pars_fragment>
      #include <colorspace_pars_fragment>
      #include <clipping_planes_pars_vertex>
      uniform vec3 base;
      varying vec3 vShown;
      void main() {
        vec3 n = normalize(normalMatrix * normal);
        vec4 mvPosition = modelViewMatrix * vec4(position, 1.0);
        vec3 toEye = normalize(-mvPosition.xyz);
        vec3 diffuse = vec3(0.0);
        vec3 shine = vec3(0.0);
        for (int i = 0; i < NUM_DIR_LIGHTS; i++) {
          vec3 toLight = directionalLights[i].direction;
          float facing = max(dot(n, toLight), 0.0);
          diffuse += facing * directionalLights[i].color;
          shine += facing * pow(max(dot(n, normalize(toLight + toEye)), 0.0), ${SHARPNESS}) * directionalLights[i].color;
        }
        for (int i = 0; i < NUM_HEMI_LIGHTS; i++) {
          diffuse += getHemisphereLightIrradiance(hemisphereLights[i], n);
        }
        vec3 light = RECIPROCAL_PI * diffuse * base * color + ${SHINE} * shine;
        vShown = sRGBTransferOETF(vec4(ACESFilmicToneMapping(light), 1.0)).rgb;
        #include <clipping_planes_vertex>
        gl_Position = projectionMatrix * mvPosition;
      }`,
    // A cut surface shows its inner side, darker.
    fragmentShader: `
      #include <clipping_planes_pars_fragment>
      varying vec3 vShown;
      void main() {
        #include <clipping_planes_fragment>
        gl_FragColor = vec4(gl_FrontFacing ? vShown : 0.6 * vShown, 1.0);
      }`,
  });
}
