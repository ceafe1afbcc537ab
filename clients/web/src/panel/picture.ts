// Saves what is on the screen as a PNG: the scene, the forces and the legend.
import { find } from "../dom";
import { download } from "./download";

const MARGIN_PX = 22;
const LEGEND_PX = { width: 220, height: 10 };

/** @param drawn The scene at full resolution. @param tile The tile that shows it. @param name Name of the file without its ending. */
export function savePicture(drawn: HTMLCanvasElement, tile: HTMLElement, colours: Uint8Array, name: string): void {
  const context = drawn.getContext("2d")!;
  const { left, top, width } = tile.getBoundingClientRect();
  const scale = drawn.width / width;
  context.scale(scale, scale);
  context.font = "600 14px Inter, sans-serif";
  context.textBaseline = "top";
  for (const label of tile.querySelectorAll<HTMLElement>(".force")) {
    const box = label.getBoundingClientRect();
    context.fillStyle = "rgb(20 16 8 / 70%)";
    context.fillRect(box.left - left, box.top - top, box.width, box.height);
    context.fillStyle = "#ffd78a";
    context.fillText(label.textContent, box.left - left + 8, box.top - top + 4);
  }
  if (!find(".legend", HTMLElement, tile).hidden) {
    drawLegend(context, tile, colours);
  }
  drawn.toBlob((blob) => {
    if (blob !== null) {
      download(blob, `${name}.png`);
    }
  }, "image/png");
}

function drawLegend(context: CanvasRenderingContext2D, tile: Element, colours: Uint8Array): void {
  const { width, height } = LEGEND_PX;
  const count = colours.length / 4;
  context.font = "12px Inter, sans-serif";
  context.fillStyle = "#eef3f6";
  context.fillText(find(".legend-title", HTMLElement, tile).textContent, MARGIN_PX, MARGIN_PX);
  for (let i = 0; i < count; i += 1) {
    context.fillStyle = `rgb(${colours[4 * i]!} ${colours[4 * i + 1]!} ${colours[4 * i + 2]!})`;
    context.fillRect(MARGIN_PX + (width * i) / count, MARGIN_PX + 19, width / count + 1, height);
  }
  context.fillStyle = "#93a3ae";
  [...tile.querySelectorAll(".legend-ticks span")].forEach((tick, index) => {
    context.textAlign = (["left", "center", "right"] as const)[index] ?? "left";
    context.fillText(tick.textContent, MARGIN_PX + (index * width) / 2, MARGIN_PX + 33);
  });
}
