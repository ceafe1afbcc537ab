// The operator's controls: pause, step and reset the scene on show, load and unload scenes.
import { find } from "../dom";
import type { DaemonState } from "../generated/tensormass/v1/gateway_pb";
import { SceneState, type Status } from "../stream/decode";

/** Commands of an operator. The gateway checks them again. */
export type Action = "pause" | "resume" | "step" | "reset" | "load" | "unload";

/** Why a control cannot be used now; null: it can. */
export type Reason = string | null;

export interface ControlState {
  /** What the first button does: pause the scene, or let it run again. */
  readonly pauses: boolean;
  readonly pause: Reason;
  readonly step: Reason;
  readonly reset: Reason;
  readonly unload: Reason;
  readonly load: Reason;
  readonly adjust: Reason;
}

export const LOOK_ONLY = "This address only lets you look. The operator's address controls scenes.";

/**
 * @param watched Name of the scene on show; null while the page shows no scene.
 * @param busy Text about the load or unload that the daemon has not answered yet; null if it has answered all.
 */
export function controlState(
  daemon: DaemonState | null,
  watched: string | null,
  status: Status | null,
  busy: string | null,
): ControlState {
  const state = status?.state;
  const pauses = state !== SceneState.PAUSED;
  const load = reasonToWait(daemon, busy);
  const scene = load ?? (watched === null ? "There is no scene." : null);
  const pause = scene ?? (status === null ? "The state of the scene is not known yet." : clockReason(state));
  const stands = state === SceneState.LOCKSTEP || state === SceneState.PAUSED;
  const step = scene ?? (stands ? null : "A scene that runs does not step by hand. Pause it.");
  return { pauses, pause, step, reset: scene, unload: scene, load, adjust: scene };
}

function reasonToWait(daemon: DaemonState | null, busy: string | null): Reason {
  if (daemon === null || daemon.problem !== "") {
    return "There is no daemon.";
  }
  if (!daemon.operator) {
    return LOOK_ONLY;
  }
  return busy === null ? null : `Waiting for an answer: ${busy}.`;
}

function clockReason(state: SceneState | undefined): Reason {
  switch (state) {
    case SceneState.LOCKSTEP:
      return "The scene is in lockstep: it steps only when it is asked to.";
    case SceneState.FAULTED:
      return "The scene has stopped. Reset it.";
    default:
      return null;
  }
}

export interface ControlActions {
  readonly command: (action: Action, options?: { builtin?: string; lockstep?: boolean }) => void;
}

/** The buttons of index.html. */
export class Controls {
  readonly #pause = find("#pause", HTMLButtonElement);
  readonly #step = find("#step", HTMLButtonElement);
  readonly #restart = find("#restart", HTMLButtonElement);
  readonly #menu = find("#scenes", HTMLDetailsElement);
  readonly #builtin = find("#builtin", HTMLSelectElement);
  readonly #lockstep = find("#lockstep", HTMLInputElement);
  readonly #load = find("#load", HTMLButtonElement);
  readonly #unload = find("#unload", HTMLButtonElement);
  #state: ControlState = controlState(null, null, null, null);

  constructor(actions: ControlActions) {
    this.#pause.addEventListener("click", () => actions.command(this.#state.pauses ? "pause" : "resume"));
    this.#step.addEventListener("click", () => actions.command("step"));
    this.#restart.addEventListener("click", () => actions.command("reset"));
    this.#load.addEventListener("click", () => {
      this.#menu.open = false;
      actions.command("load", { builtin: this.#builtin.value, lockstep: this.#lockstep.checked });
    });
    this.#unload.addEventListener("click", () => {
      this.#menu.open = false;
      actions.command("unload");
    });
  }

  /** Clicks a button, as a key does. A disabled button does nothing. */
  press(button: "pause" | "step" | "restart"): void {
    const buttons = { pause: this.#pause, step: this.#step, restart: this.#restart };
    buttons[button].click();
  }

  show(state: ControlState, daemon: DaemonState | null, watched: string | null): void {
    this.#state = state;
    this.#pause.dataset.shows = state.pauses ? "pause" : "play";
    explain(this.#pause, state.pauses ? "Pause the scene (Space)" : "Let the scene run (Space)", state.pause);
    explain(this.#step, "Make one step (S)", state.step);
    explain(this.#restart, "Reset the scene to its start (Home)", state.reset);
    explain(this.#load, "Load this scene and show it", state.load);
    explain(this.#unload, watched === null ? "Unload the scene" : `Unload ${watched}`, state.unload);
    const names = daemon?.builtinScenes ?? [];
    if ([...this.#builtin.options].map((option) => option.value).join() !== names.join()) {
      this.#builtin.replaceChildren(...names.map((name) => new Option(name, name)));
    }
    find("#look-only", HTMLElement).hidden = daemon === null || daemon.operator;
  }
}

/** Disables a button for a reason, which its tooltip then tells. */
function explain(button: HTMLButtonElement, title: string, reason: Reason): void {
  button.disabled = reason !== null;
  const text = reason ?? title;
  if (button.title !== text) {
    button.title = text;
    button.ariaLabel = reason === null ? title : `${title}. ${reason}`;
  }
}
