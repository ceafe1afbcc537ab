// The panel that adds tools to a running scene and removes them.
import type { MessageInitShape } from "@bufbuild/protobuf";

import { find, setText } from "../dom";
import type { SceneEditSchema } from "../generated/tensormass/v1/adjustment_pb";
import type { Finding } from "../generated/tensormass/v1/finding_pb";
import type { ToolSchema } from "../generated/tensormass/v1/scene_pb";
import type { Topology, Vector } from "../stream/decode";
import type { Reason } from "./controls";

export type SceneEdit = MessageInitShape<typeof SceneEditSchema>;
type Tool = Omit<Exclude<MessageInitShape<typeof ToolSchema>, { $typeName: string }>, "$typeName">;

/** What a new tool can be. */
export interface Kind {
  readonly label: string;
  /** The start of its name. */
  readonly stem: string;
  readonly tool: Tool;
}

/** The place of new tools. */
export interface Place {
  /** Above the middle of the tissue. */
  readonly positionM: Vector;
  /** The tissue's. */
  readonly radiusM: number;
}

/** Distance of a new tool from the top of the tissue [its radii]. */
const CLEARANCE = 0.3;

/** Returns the place above some vertices. @param positions [vertices, 3] m, one or more. @param up Unit vector */
export function placeAbove(positions: Float32Array, up: Vector): Place {
  const least = [Infinity, Infinity, Infinity];
  const most = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < positions.length; i += 1) {
    least[i % 3] = Math.min(least[i % 3]!, positions[i]!);
    most[i % 3] = Math.max(most[i % 3]!, positions[i]!);
  }
  const center = least.map((value, c) => (value + most[c]!) / 2);
  const radiusM = Math.max(0.5 * Math.hypot(...least.map((value, c) => most[c]! - value)), 1e-6);
  let top = 0;
  for (let i = 0; i < positions.length; i += 3) {
    top = Math.max(top, up.reduce((sum, axis, c) => sum + axis * (positions[i + c]! - center[c]!), 0));
  }
  const positionM = center.map((value, c) => value + (top + CLEARANCE * radiusM) * up[c]!) as unknown as Vector;
  return { positionM, radiusM };
}

/** A length in two digits, so that the tool's description is short. */
const round = (length: number): number => Number(length.toPrecision(2));

/** Returns what a new tool can be: as one that the scene has, or one of a few sizes that suit the tissue. */
export function kindsOf(topology: Topology, { positionM: [x, y, z], radiusM }: Place): Kind[] {
  const preset = (label: string, stem: string, kind: NonNullable<Tool["kind"]>): Kind => ({
    label,
    stem,
    tool: { positionM: { x, y, z }, kind },
  });
  const present = topology.tools.flatMap(({ name, description }): Kind[] =>
    description === null ? [] : [{ label: `like ${name}`, stem: name.replace(/-\d+$/, ""), tool: description }],
  );
  return [
    ...present,
    preset("probe", "probe", { case: "sphericalProbe", value: { radiusM: round(0.06 * radiusM) } }),
    preset("rod", "rod", { case: "capsule", value: { radiusM: round(0.025 * radiusM), lengthM: round(radiusM) } }),
    preset("grasper", "grasper", { case: "grasper", value: { radiusM: round(0.025 * radiusM), jawLengthM: round(0.2 * radiusM) } }),
  ];
}

/** Returns `stem`, or the first of stem-2, stem-3, ... that no tool has. */
export function freeName(stem: string, taken: readonly string[]): string {
  let name = stem;
  for (let number = 2; taken.includes(name); number += 1) {
    name = `${stem}-${number}`;
  }
  return name;
}

/** Edits a scene and returns findings that concern new tools. Fails with the reason. */
export type Edit = (edit: SceneEdit) => Promise<readonly Finding[]>;

export class ToolsPanel {
  readonly #menu = find("#tools-menu", HTMLDetailsElement);
  readonly #list = find("#tools-list", HTMLUListElement);
  readonly #kind = find("#tool-kind", HTMLSelectElement);
  readonly #name = find("#tool-name", HTMLInputElement);
  readonly #add = find("#tool-add", HTMLButtonElement);
  readonly #note = find("#tools-note", HTMLElement);
  #edit: Edit | null = null;
  #kinds: readonly Kind[] = [];
  #names: readonly string[] = [];
  #shown: bigint | null = null;
  #reason: Reason = null;
  #waiting = false;
  /** What the last edit has to say: why it was refused, or a finding. */
  #said: string | null = null;

  constructor() {
    this.#kind.addEventListener("change", () => this.#propose());
    find("#tool-form", HTMLFormElement).addEventListener("submit", (event) => {
      event.preventDefault();
      const kind = this.#kinds[this.#kind.selectedIndex];
      if (kind !== undefined && !this.#add.disabled) {
        const name = this.#name.value.trim();
        void this.#send({ addTools: [{ ...kind.tool, name }] }, `Adding ${name}`);
      }
    });
  }

  /** Follows another scene; null: none. */
  follow(edit: Edit | null): void {
    this.#menu.open = false;
    this.#edit = edit;
    this.#shown = null;
    this.#said = null;
    this.#kinds = [];
    this.#list.replaceChildren();
  }

  /**
   * Shows the tools of a scene.
   *
   * @param reason Why the scene cannot be edited now
   * @param positions The positions of the frame on show; null if there is no frame yet
   */
  show(topology: Topology | null, positions: Float32Array | null, reason: Reason): void {
    this.#reason = reason;
    if (topology !== null && positions !== null && positions.length > 0 && topology.version !== this.#shown) {
      this.#shown = topology.version;
      this.#names = topology.tools.map(({ name }) => name);
      this.#kinds = kindsOf(topology, placeAbove(positions, topology.up));
      const chosen = this.#kind.value;
      this.#kind.replaceChildren(...this.#kinds.map(({ label }) => new Option(label, label)));
      this.#kind.value = this.#kinds.some(({ label }) => label === chosen) ? chosen : (this.#kinds[0]?.label ?? "");
      this.#list.replaceChildren(...this.#names.map((name) => this.#row(name)));
      this.#propose();
    }
    this.#enable();
  }

  #row(name: string): HTMLLIElement {
    const row = document.createElement("li");
    const label = document.createElement("span");
    const button = document.createElement("button");
    label.textContent = name;
    button.type = "button";
    button.textContent = "Remove";
    button.ariaLabel = `Remove ${name}`;
    button.addEventListener("click", () => void this.#send({ removeTools: [name] }, `Removing ${name}`));
    row.append(label, button);
    return row;
  }

  #propose(): void {
    const kind = this.#kinds[this.#kind.selectedIndex];
    this.#name.value = kind === undefined ? "" : freeName(kind.stem, this.#names);
  }

  #enable(): void {
    const reason = this.#reason ?? (this.#waiting ? "The server prepares the scene with other tools." : null);
    const note = reason ?? this.#said;
    this.#note.hidden = note === null;
    setText(this.#note, note ?? "");
    for (const control of this.#menu.querySelectorAll<HTMLButtonElement>(".sheet button, .sheet input, .sheet select")) {
      control.disabled = reason !== null;
    }
  }

  async #send(edit: SceneEdit, what: string): Promise<void> {
    if (this.#edit === null || this.#waiting) {
      return;
    }
    this.#waiting = true;
    this.#enable();
    try {
      this.#said = (await this.#edit(edit))[0]?.message ?? null;
    } catch (error) {
      this.#said = `${what}: ${error instanceof Error ? error.message : String(error)}`;
    }
    this.#waiting = false;
    this.#enable();
  }
}
