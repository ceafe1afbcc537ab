// Scale bar and axes: how long a metre is on the screen, and where x, y and z point.
import * as THREE from "three";

import { find } from "../dom";
import { prefixFor } from "./colouring";

/** The scale bar is at most this long [CSS pixels]. */
const LONGEST_PX = 120;
const ARM_PX = 24;
const AXES = [
  { name: "x", colour: "#ff7d6b", direction: new THREE.Vector3(1, 0, 0) },
  { name: "y", colour: "#6fd6a8", direction: new THREE.Vector3(0, 1, 0) },
  { name: "z", colour: "#8fb8ff", direction: new THREE.Vector3(0, 0, 1) },
] as const;

/** Longest of 1, 2 and 5 times a power of ten metres that is at most `longestPx` long. */
export function scaleBar(metresPerPx: number, longestPx: number): { lengthPx: number; text: string } {
  const longestM = metresPerPx * longestPx;
  const power = 10 ** Math.floor(Math.log10(longestM));
  const lengthM = power * ([5, 2, 1].find((factor) => factor * power <= longestM) ?? 1);
  // Centimetres are the unit of organs.
  const { factor, prefix } = lengthM >= 0.01 && lengthM < 1 ? { factor: 100, prefix: "c" } : prefixFor(lengthM);
  return { lengthPx: lengthM / metresPerPx, text: `${Number((lengthM * factor).toPrecision(2))} ${prefix}m` };
}

export class Rulers {
  readonly #block: HTMLElement;
  readonly #canvas: HTMLCanvasElement;
  readonly #bar: HTMLElement;
  readonly #text: HTMLElement;

  /** @param tile A tile of index.html. */
  constructor(tile: Element) {
    this.#block = find(".rulers", HTMLElement, tile);
    this.#canvas = find(".axes", HTMLCanvasElement, tile);
    this.#bar = find(".scale-bar", HTMLElement, tile);
    this.#text = find(".scale-text", HTMLElement, tile);
  }

  show(shown: boolean): void {
    this.#block.hidden = !shown;
  }

  /** @param metresPerPx At the point that the view turns around. @param turn From the scene's frame to the camera's. */
  draw(metresPerPx: number, turn: THREE.Quaternion): void {
    if (this.#block.hidden) {
      return;
    }
    const { lengthPx, text } = scaleBar(metresPerPx, LONGEST_PX);
    this.#bar.style.width = `${lengthPx.toFixed(1)}px`;
    this.#text.textContent = text;
    this.#drawAxes(turn);
  }

  #drawAxes(turn: THREE.Quaternion): void {
    const canvas = this.#canvas;
    const size = canvas.clientWidth;
    const ratio = window.devicePixelRatio;
    canvas.width = canvas.height = Math.round(size * ratio);
    const context = canvas.getContext("2d")!;
    context.scale(ratio, ratio);
    context.font = "600 11px Inter, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.lineWidth = 2;
    const arms = AXES.map((axis) => ({ ...axis, at: axis.direction.clone().applyQuaternion(turn) }));
    // The nearest arm is drawn last.
    for (const { name, colour, at } of arms.sort((a, b) => a.at.z - b.at.z)) {
      const [x, y] = [size / 2 + ARM_PX * at.x, size / 2 - ARM_PX * at.y];
      context.strokeStyle = context.fillStyle = colour;
      context.globalAlpha = at.z < -0.1 ? 0.55 : 1;
      context.beginPath();
      context.moveTo(size / 2, size / 2);
      context.lineTo(x, y);
      context.stroke();
      context.fillText(name, size / 2 + 1.32 * ARM_PX * at.x, size / 2 - 1.32 * ARM_PX * at.y);
    }
  }
}
