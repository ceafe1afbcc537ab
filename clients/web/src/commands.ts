// Sends the operator's commands for the selected scene, and says why one failed.
import type { Action } from "./panel/controls";
import type { Toast } from "./panel/legend";
import type { HeadAction, HeadOptions } from "./panel/timeline";
import type { Session } from "./stream/session";

export interface CommandOptions extends HeadOptions {
  /** Scene to load. */
  readonly builtin?: string;
  readonly lockstep?: boolean;
}

export class Commands {
  readonly #selected: () => Session;
  readonly #toast: Toast;
  readonly #onChange: () => void;
  readonly #choose: (scene: string | null) => void;
  #busy: string | null = null;

  /**
   * @param selected Returns the session of the selected scene.
   * @param onChange Called when `busy` may have changed.
   * @param choose Called with the scene to select after a load, and with null after an unload.
   */
  constructor(selected: () => Session, toast: Toast, onChange: () => void, choose: (scene: string | null) => void) {
    this.#selected = selected;
    this.#toast = toast;
    this.#onChange = onChange;
    this.#choose = choose;
  }

  /** The load or unload that is not answered yet, in words; null: none. */
  get busy(): string | null {
    return this.#busy;
  }

  /** Sends a command and shows its failure. */
  async send(action: Action | HeadAction, options: CommandOptions = {}): Promise<void> {
    const { builtin, lockstep = false, ...more } = options;
    const session = this.#selected();
    const scene = builtin ?? session.watched;
    if (scene === null) {
      return;
    }
    // The other commands take a step's time. Keys that follow each other quickly must not get lost.
    const slow = action === "load" || action === "unload";
    this.#busy = slow ? `${action} ${scene}` : this.#busy;
    this.#onChange();
    if (action === "load") {
      this.#toast.show(`Loading ${scene} …`, "quiet");
    }
    try {
      const result = await session.control({ action, scene, ...(action === "load" ? { lockstep } : more) });
      this.#toast.hide();
      if (slow) {
        this.#choose(action === "load" ? result.scene : null);
      }
    } catch (error) {
      this.#toast.show(`${action} ${scene}: ${error instanceof Error ? error.message : String(error)}`, "bad");
    }
    this.#busy = slow ? null : this.#busy;
    this.#onChange();
  }
}
