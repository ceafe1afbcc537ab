// The numbers beside the picture. Written a few times a second: digits that change faster cannot be read.
import { find } from "./dom";
import type { DaemonState } from "./stream/connection";
import { SceneState, type Status } from "./stream/decode";
import type { Counters } from "./stream/store";

export interface Readings {
  readonly status: Status | null;
  readonly counters: Counters;
  readonly drawRateHz: number | null;
  readonly ageMs: number | null;
  readonly ageUncertaintyMs: number | null;
  readonly replaced: number;
}

export type Notice = { readonly tone: "quiet" | "warning"; readonly title: string; readonly detail: string } | null;

export interface Actions {
  readonly pickScene: (scene: string) => void;
  readonly resetView: () => void;
  readonly toggleTools: () => void;
}

const UNKNOWN = "–";

export class Hud {
  readonly #picker = find("#scene", HTMLSelectElement);
  readonly #pill = element("link");
  readonly #notice = element("notice");
  readonly #device = element("device");

  constructor(actions: Actions) {
    this.#picker.addEventListener("change", () => actions.pickScene(this.#picker.value));
    element("reset").addEventListener("click", actions.resetView);
    element("tools").addEventListener("click", actions.toggleTools);
    window.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) {
        return;
      }
      if (event.key === "r") {
        actions.resetView();
      } else if (event.key === "t") {
        actions.toggleTools();
      }
    });
  }

  showScenes(daemon: DaemonState, chosen: string | null): void {
    const names = chosen === null || daemon.scenes.includes(chosen) ? daemon.scenes : [chosen, ...daemon.scenes];
    this.#picker.replaceChildren(...names.map((name) => new Option(name, name, false, name === chosen)));
    this.#picker.disabled = names.length < 2;
    const parts = daemon.problem === "" ? [daemon.server, daemon.backend, daemon.device] : [];
    this.#device.textContent = parts.filter(Boolean).join(" · ");
  }

  showLink(tone: "good" | "waiting" | "bad", text: string): void {
    this.#pill.dataset.tone = tone;
    this.#pill.textContent = text;
  }

  showNotice(notice: Notice): void {
    this.#notice.hidden = notice === null;
    if (notice !== null) {
      this.#notice.dataset.tone = notice.tone;
      this.#notice.replaceChildren(paragraph("title", notice.title), paragraph("detail", notice.detail));
    }
  }

  showReadings({ status, counters, drawRateHz, ageMs, ageUncertaintyMs, replaced }: Readings): void {
    write("physics", status ? status.reachedRateHz.toFixed(status.reachedRateHz < 100 ? 1 : 0) : UNKNOWN);
    write("target", status ? `of ${trim(status.targetRateHz)} Hz` : "Hz");
    write("display", drawRateHz === null ? UNKNOWN : drawRateHz.toFixed(drawRateHz < 10 ? 1 : 0));
    write("latency", ageMs === null ? UNKNOWN : ageMs.toFixed(ageMs < 10 ? 1 : 0));
    write("uncertainty", ageUncertaintyMs === null || ageUncertaintyMs < 1 ? "" : `± ${ageUncertaintyMs.toFixed(0)}`);
    write("dropped", String(counters.dropped));
    write("dropped-where", `${replaced} in gateway`);
    write("step-time", status ? (1e3 * status.stepTimeP99S).toFixed(1) : UNKNOWN);
    write("missed", status ? String(status.missedDeadlines) : UNKNOWN);
    write("iterations", status ? String(status.cgIterations) : UNKNOWN);
    write("residual", status ? `res. ${status.cgRelativeResidual.toExponential(0)}` : "");
    element("refused").hidden = counters.refused === 0;
    write("refused-count", String(counters.refused));
    element("refused").title = counters.lastRefusal ?? "";
    element("missed").dataset.tone = status && status.missedDeadlines > 0n ? "warning" : "";
  }
}

/** What a viewer should say instead of, or above, the picture. */
export function sceneNotice(status: Status | null): Notice {
  switch (status?.state) {
    case SceneState.FAULTED:
      return { tone: "warning", title: "Scene stopped", detail: status.fault };
    case SceneState.PAUSED:
      return { tone: "quiet", title: "Paused", detail: "" };
    default:
      return null;
  }
}

function trim(value: number): string {
  return String(Number(value.toFixed(1)));
}

function write(id: string, text: string): void {
  const target = element(id);
  if (target.textContent !== text) {
    target.textContent = text;
  }
}

function paragraph(className: string, text: string): HTMLElement {
  const result = document.createElement("p");
  result.className = className;
  result.textContent = text;
  return result;
}

function element(id: string): HTMLElement {
  return find(`#${id}`, HTMLElement);
}
