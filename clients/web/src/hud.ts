// The readings beside the picture. They are written four times a second; faster digits cannot be read.
import { find, setText } from "./dom";
import type { Notice, Situation } from "./situation";
import type { DaemonState } from "./generated/tensormass/v1/gateway_pb";
import { SceneState, type Status } from "./stream/decode";
import { eventLabel, eventList } from "./stream/events";
import type { Finding } from "./stream/findings";
import type { Readings } from "./stream/session";

export interface Actions {
  readonly pickScene: (scene: string) => void;
  readonly resetView: () => void;
}

const UNKNOWN = "–";

export class Hud {
  readonly #picker = find("#scene", HTMLSelectElement);
  readonly #pill = find("#link", HTMLButtonElement);
  readonly #notice = element("notice");
  readonly #recovery = element("recovering");
  readonly #device = element("device");
  readonly #badge = find("#findings", HTMLDetailsElement);
  /** The findings on show. */
  #found = "[]";
  /** The notice, shown or hidden; null if the page has no notice. */
  #said: Notice = null;
  /** Whether the user closed the notice. A new notice opens again. */
  #noticeClosed = false;

  constructor(actions: Actions) {
    this.#picker.addEventListener("change", () => actions.pickScene(this.#picker.value));
    element("reset").addEventListener("click", actions.resetView);
    element("notice-close").addEventListener("click", () => this.#setNoticeClosed(true));
    this.#pill.addEventListener("click", () => this.#setNoticeClosed(!this.#noticeClosed));
  }

  hideNotice(): void {
    this.#setNoticeClosed(true);
  }

  showScenes(daemon: DaemonState, chosen: string | null): void {
    const names = chosen === null || daemon.scenes.includes(chosen) ? daemon.scenes : [chosen, ...daemon.scenes];
    this.#picker.replaceChildren(...names.map((name) => new Option(name, name, false, name === chosen)));
    this.#picker.disabled = names.length < 2;
    const parts = daemon.problem === "" ? [daemon.server, daemon.backend, daemon.device] : [];
    this.#device.textContent = parts.filter(Boolean).join(" · ");
  }

  /**
   * @param pictured Whether there is a picture. A notice must not cover it.
   * @param recovering Whether the scene recovers from a step that could not be made as planned.
   */
  show({ tone, text, hint, notice }: Situation, pictured: boolean, recovering = false): void {
    this.#recovery.hidden = !recovering;
    this.#pill.dataset.tone = tone;
    write("link", text);
    this.#pill.title = hint ?? (notice === null ? "" : "Show or hide what this means (Esc hides it)");
    this.#notice.dataset.place = pictured ? "aside" : "middle";
    this.#showNotice(notice);
  }

  showReadings(readings: Readings): void {
    const { currentStatus: status, findings, events, counters, drawRateHz, ageMs, ageUncertaintyMs, replaced } = readings;
    write("physics", status ? status.reachedRateHz.toFixed(status.reachedRateHz < 100 ? 1 : 0) : UNKNOWN);
    write("target", targetText(readings.status));
    write("drawn", drawRateHz === null ? UNKNOWN : drawRateHz.toFixed(drawRateHz < 10 ? 1 : 0));
    write("surface-error", errorText(readings.errorM));
    write("latency", ageMs === null ? UNKNOWN : ageMs.toFixed(ageMs < 10 ? 1 : 0));
    write("uncertainty", ageUncertaintyMs === null || ageUncertaintyMs < 1 ? "" : `± ${ageUncertaintyMs.toFixed(0)}`);
    write("dropped", String(counters.dropped));
    write("dropped-where", `${replaced} in gateway`);
    write("step-time", status ? (1e3 * status.stepTimeP99S).toFixed(1) : UNKNOWN);
    write("missed", status ? String(status.missedDeadlines) : UNKNOWN);
    write("iterations", status ? String(status.cgIterations) : UNKNOWN);
    write("summary", status ? `${trim(status.reachedRateHz)} Hz · step ${(1e3 * status.stepTimeP50S).toFixed(1)} ms` : "Readings");
    write("residual", status ? `res. ${status.cgRelativeResidual.toExponential(0)}` : "");
    const newest = events.at(-1);
    element("events-row").hidden = newest === undefined;
    element("events-row").title = eventList(events);
    write("event", newest === undefined ? "" : eventLabel(newest));
    write("event-step", newest === undefined ? "" : `step ${newest.step}`);
    element("recoveries-row").hidden = !status?.recoveries;
    write("recoveries", String(status?.recoveries ?? 0));
    write("recovering-steps", status ? recoveredText(status) : "");
    const lawRangeUsed = status?.lawRangeUsed ?? 0;
    element("law-range-row").hidden = lawRangeUsed === 0;
    write("law-range", (100 * lawRangeUsed).toFixed(0));
    element("law-range").dataset.tone = lawRangeUsed > 1 ? "warning" : "";
    this.#showFindings(findings);
    element("refused").hidden = counters.refused === 0;
    write("refused-count", String(counters.refused));
    element("refused").title = counters.lastRefusal ?? "";
    element("missed").dataset.tone = status && status.missedDeadlines > 0n ? "warning" : "";
  }

  #showNotice(notice: Notice): void {
    if (notice?.title !== this.#said?.title || notice?.detail !== this.#said?.detail) {
      this.#noticeClosed = false;
    }
    this.#said = notice;
    if (notice !== null) {
      this.#notice.dataset.tone = notice.tone;
      write("notice-title", notice.title);
      write("notice-detail", notice.detail);
    }
    this.#setNoticeClosed(this.#noticeClosed);
  }

  #setNoticeClosed(closed: boolean): void {
    if (closed && this.#notice.contains(document.activeElement)) {
      this.#pill.focus();
    }
    this.#noticeClosed = closed && this.#said !== null;
    this.#notice.hidden = closed || this.#said === null;
    this.#pill.disabled = this.#said === null;
    this.#pill.ariaExpanded = String(!this.#notice.hidden);
  }

  #showFindings(findings: readonly Finding[]): void {
    const said = JSON.stringify(findings.map(({ message, remedy, place, accepted }) => [message, remedy, place, accepted]));
    if (said === this.#found) {
      return; // a list that is rewritten loses its place under a reader
    }
    this.#found = said;
    const text = badgeText(findings);
    this.#badge.hidden = text === "";
    this.#badge.open &&= text !== "";
    write("findings-count", text);
    element("findings-list").replaceChildren(...findings.map(findingItem));
  }
}

/** The text of the badge: how many findings the scene does not accept; empty if there is none. */
export function badgeText(findings: readonly Finding[]): string {
  const count = findings.filter(({ accepted }) => accepted === "").length;
  return count === 0 ? "" : count === 1 ? "1 finding" : `${count} findings`;
}

/** The text after the rate of the physics: its target rate, or "in lockstep". */
export function targetText(status: Status | null): string {
  if (status?.state === SceneState.LOCKSTEP) {
    return "in lockstep";
  }
  return status ? `of ${trim(status.targetRateHz)} Hz` : "Hz";
}

/** The steps of all recoveries: "3 steps, 1 held". */
export function recoveredText({ recoveringSteps, heldSteps }: Pick<Status, "recoveringSteps" | "heldSteps">): string {
  const steps = recoveringSteps === 1n ? "1 step" : `${recoveringSteps} steps`;
  return heldSteps > 0n ? `${steps}, ${heldSteps} held` : steps;
}

/** The largest error of positions with two digits; empty if they are exact. @param errorM null: no frame. */
export function errorText(errorM: number | null): string {
  if (errorM === null || errorM === 0) {
    return "";
  }
  const [value, unit] = errorM < 1e-3 ? [1e6 * errorM, "µm"] : [1e3 * errorM, "mm"];
  return `± ${Number(value.toPrecision(2))} ${unit}`;
}

function trim(value: number): string {
  return String(Number(value.toFixed(1)));
}

function write(id: string, text: string): void {
  setText(element(id), text);
}

function findingItem({ message, remedy, place, accepted }: Finding): HTMLElement {
  const result = document.createElement("li");
  result.classList.toggle("accepted", accepted !== "");
  result.append(line("p", message));
  const advice = accepted === "" ? remedy : `Accepted: ${accepted}`;
  for (const text of [advice, place].filter(Boolean)) {
    result.append(line("small", text));
  }
  return result;
}

function line(tag: "p" | "small", text: string): HTMLElement {
  const result = document.createElement(tag);
  result.textContent = text;
  return result;
}

function element(id: string): HTMLElement {
  return find(`#${id}`, HTMLElement);
}
