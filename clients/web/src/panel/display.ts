// The panel of display options. Each change is remembered and given to the page.
import { find, setText } from "../dom";
import { LEVELS, qualityOf, type Quality } from "../view/quality";
import { CLIP_AXES, COLOURINGS, loadSettings, saveSettings, type Settings } from "./settings";

export interface DisplayActions {
  /** Called once at the start and after each change. */
  readonly change: (settings: Settings) => void;
  /** Displacements count from the present positions on. */
  readonly setZero: () => void;
  /** The user chose a quality, perhaps the one that was remembered already. */
  readonly chooseQuality: (quality: Quality) => void;
  readonly takePicture: () => void;
  /** Starts a film, or ends the one that runs. */
  readonly film: () => void;
}

type Flag = "wireframe" | "fixedNodes" | "attachments" | "rulers" | "tools";

export class Display {
  readonly #actions: DisplayActions;
  readonly #colouring = find("#colouring", HTMLSelectElement);
  readonly #clipAxis = find("#clip-axis", HTMLSelectElement);
  readonly #clipShare = find("#clip-share", HTMLInputElement);
  readonly #zero = find("#zero", HTMLButtonElement);
  readonly #quality = find("#quality", HTMLSelectElement);
  readonly #qualityNote = find("#quality-note", HTMLElement);
  readonly #film = find("#film", HTMLButtonElement);
  readonly #flags = {
    wireframe: find("#wireframe", HTMLInputElement),
    fixedNodes: find("#fixed-nodes", HTMLInputElement),
    attachments: find("#attachments", HTMLInputElement),
    rulers: find("#rulers-on", HTMLInputElement),
    tools: find("#tools", HTMLInputElement),
  };
  readonly #folds = { readings: find("#readings", HTMLDetailsElement), plots: find("#plots", HTMLDetailsElement) };
  #settings = loadSettings();

  constructor(actions: DisplayActions) {
    this.#actions = actions;
    const pick = (text: string) => COLOURINGS.find((name) => name === text) ?? "tissue";
    this.#colouring.addEventListener("change", () => this.change({ colouring: pick(this.#colouring.value) }));
    this.#clipAxis.addEventListener("change", () => {
      this.change({ clipAxis: CLIP_AXES.find((axis) => axis === this.#clipAxis.value) ?? "none" });
    });
    this.#clipShare.addEventListener("input", () => this.change({ clipShare: Number(this.#clipShare.value) / 100 }));
    for (const [name, box] of Object.entries(this.#flags)) {
      box.addEventListener("change", () => this.change({ [name]: box.checked }));
    }
    // A small window shows the organ first.
    const { innerWidth: width, innerHeight: height } = window;
    const roomy = { readings: width > 760, plots: width > 1080 && height > 700 };
    for (const [name, fold] of Object.entries(this.#folds) as ["readings" | "plots", HTMLDetailsElement][]) {
      fold.open = this.#settings[name] ?? roomy[name];
      fold.querySelector("summary")?.addEventListener("click", () => {
        // The browser toggles it after this event.
        this.change({ [name]: !fold.open });
      });
    }
    this.#quality.append(...LEVELS.map(({ name }) => new Option(name, name)));
    this.#quality.addEventListener("change", () => {
      const quality = qualityOf(this.#quality.value) ?? "automatic";
      this.change({ quality });
      actions.chooseQuality(quality);
    });
    this.#zero.addEventListener("click", actions.setZero);
    find("#picture", HTMLButtonElement).addEventListener("click", actions.takePicture);
    this.#film.addEventListener("click", actions.film);
    this.change({});
  }

  get settings(): Settings {
    return this.#settings;
  }

  /** Changes some settings, from a control or from a key. */
  change(some: Partial<Settings>): void {
    const settings = { ...this.#settings, ...some };
    this.#settings = settings;
    saveSettings(settings);
    this.#colouring.value = settings.colouring;
    this.#clipAxis.value = settings.clipAxis;
    this.#clipShare.value = String(Math.round(100 * settings.clipShare));
    this.#clipShare.disabled = settings.clipAxis === "none";
    this.#zero.hidden = settings.colouring !== "displacement";
    for (const [name, box] of Object.entries(this.#flags) as [Flag, HTMLInputElement][]) {
      box.checked = settings[name];
    }
    this.#actions.change(settings);
  }

  /** Shows the quality that holds, which the address may have chosen. */
  showQuality(quality: Quality): void {
    this.#quality.value = quality;
  }

  /** Shows in words what is drawn, and why. */
  showQualityNote(text: string): void {
    setText(this.#qualityNote, text);
  }

  /** Shows whether a film runs; null: this browser cannot film. */
  showFilm(running: boolean | null): void {
    this.#film.disabled = running === null;
    this.#film.title = running === null ? "This browser cannot record films" : "Film the scene (F)";
    this.#film.textContent = running === true ? "End the film and save it" : "Film the scene";
    this.#film.setAttribute("aria-pressed", String(running === true));
  }

  /** Takes the next way to colour, as a key does. */
  nextColouring(): void {
    const usable = [...this.#colouring.options].filter((option) => !option.disabled).map((option) => option.value);
    const next = usable[(usable.indexOf(this.#settings.colouring) + 1) % usable.length];
    this.change({ colouring: COLOURINGS.find((name) => name === next) ?? "tissue" });
  }

  /** Offers the colours of element fields, or says why they are missing. */
  offerFields(reason: string | null): void {
    for (const option of this.#colouring.options) {
      if (option.value !== "tissue" && option.value !== "displacement") {
        option.disabled = reason !== null;
        option.title = reason ?? "";
      }
    }
    const note = find("#fields-note", HTMLElement);
    note.hidden = reason === null;
    note.textContent = reason ?? "";
  }
}
