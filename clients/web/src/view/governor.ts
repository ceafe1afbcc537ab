// Chooses the level of quality at which this machine draws fluently. It knows no clock, page or GPU: each turn of the
// browser's drawing loop tells it the time and whether that turn drew a picture.
//
// A GPU draws after the calls to WebGL have returned, so their duration says nothing. The browser starts no turn while
// pictures wait, so the turns of a window that draws count how many pictures a second the machine could show, whatever
// rate the scene has. A slow window takes a step down. Turns well above the need try the next better level. A level
// that failed is tried again after a wait that doubles with each failure, so the picture does not swing to and fro.

/** Pictures a second that a level must reach. */
export const TARGET_HZ = 15;
/** A window below this rate is slow: the target, and a little for windows that differ. */
const SLOW_HZ = 17;
/** A window below this rate takes two steps down at once. */
const FAR_HZ = 8;
/** Above this rate there may be time for a better level: it often costs twice as much. */
const FAST_HZ = 40;

/** A window lasts so long, and has so many pictures. */
const WINDOW_MS = 1000;
const LEAST_PICTURES = 3;
/** So many windows in a row decide. */
const SLOW_WINDOWS = 2;
const FAST_WINDOWS = 3;
/** After a change, shaders compile and objects are built: so much is not counted. */
const SETTLING_MS = 1000;
const SETTLING_PICTURES = 3;
/** A turn that comes so late means that the page was hidden or the machine asleep. */
const PAUSE_MS = 5000;
/** So late after a turn without a picture, too: the browser slows down what nobody sees. */
const THROTTLED_MS = 250;

/** Waits before a level that failed is tried again. */
export const FIRST_WAIT_MS = 10_000;
export const LONGEST_WAIT_MS = 600_000;
/** A level that held for so long is trusted again: its next failure starts with the first wait. */
const TRUSTED_MS = 60_000;

interface Failure {
  /** Turns a second that the level reached. */
  readonly rateHz: number;
  readonly waitMs: number;
  readonly untilMs: number;
}

/** Places of levels count from the best one, 0. */
export interface Limits {
  readonly start: number;
  /** The best level that is tried. */
  readonly best: number;
  readonly cheapest: number;
}

export class Governor {
  readonly #limits: Limits;
  readonly #failures = new Map<number, Failure>();
  #place: number;
  #sinceMs: number | null = null;
  #settlingPictures = SETTLING_PICTURES;
  #lastMs: number | null = null;
  #lastDrew = false;
  #turns = 0;
  #pictures = 0;
  #timeMs = 0;
  #longestMs = 0;
  #slowWindows = 0;
  #fastWindows = 0;

  constructor(limits: Limits) {
    this.#limits = limits;
    this.#place = limits.start;
  }

  /** Place of the level that is chosen. */
  get place(): number {
    return this.#place;
  }

  /** Pictures a second at which a level failed last; null: it has not. */
  failedAtHz(place: number): number | null {
    return this.#failures.get(place)?.rateHz ?? null;
  }

  /** Takes a turn of the drawing loop. Returns whether another level is chosen from now on. */
  turn(nowMs: number, drew: boolean): boolean {
    const intervalMs = this.#lastMs === null ? null : nowMs - this.#lastMs;
    const afterPicture = this.#lastDrew;
    this.#lastMs = nowMs;
    this.#lastDrew = drew;
    this.#sinceMs ??= nowMs;
    if (intervalMs === null || intervalMs > PAUSE_MS || (!afterPicture && intervalMs > THROTTLED_MS)) {
      this.#clearWindow();
      return false;
    }
    if (this.#settlingPictures > 0 || nowMs - this.#sinceMs < SETTLING_MS) {
      this.#settlingPictures -= afterPicture ? 1 : 0;
      return false;
    }
    this.#turns += 1;
    this.#pictures += afterPicture ? 1 : 0;
    this.#timeMs += intervalMs;
    this.#longestMs = Math.max(this.#longestMs, intervalMs);
    if (this.#timeMs < WINDOW_MS) {
      return false;
    }
    if (this.#pictures < LEAST_PICTURES) {
      // A scene that stands still says nothing. A machine that draws once a second needs a longer window.
      if (this.#timeMs > PAUSE_MS) {
        this.#clearWindow();
      }
      return false;
    }
    // One turn may be late for another reason, such as a scene that arrived.
    const rateHz = (1000 * (this.#turns - 1)) / (this.#timeMs - this.#longestMs);
    this.#clearWindow();
    return this.#judge(rateHz, nowMs);
  }

  /** Forgets the turns so far, because the next ones are of another kind. */
  interrupt(): void {
    this.#lastMs = null;
    this.#clearWindow();
    this.#slowWindows = this.#fastWindows = 0;
  }

  #judge(rateHz: number, nowMs: number): boolean {
    const { best, cheapest } = this.#limits;
    this.#slowWindows = rateHz < SLOW_HZ ? this.#slowWindows + 1 : 0;
    this.#fastWindows = rateHz > FAST_HZ ? this.#fastWindows + 1 : 0;
    const far = rateHz < FAR_HZ;
    if (this.#place < cheapest && (far || this.#slowWindows === SLOW_WINDOWS)) {
      this.#fail(rateHz, nowMs);
      return this.#change(Math.min(this.#place + (far ? 2 : 1), cheapest), nowMs);
    }
    const next = this.#failures.get(this.#place - 1);
    if (this.#place > best && this.#fastWindows >= FAST_WINDOWS && nowMs >= (next?.untilMs ?? 0)) {
      return this.#change(this.#place - 1, nowMs);
    }
    return false;
  }

  #fail(rateHz: number, nowMs: number): void {
    const before = this.#failures.get(this.#place);
    const trusted = before === undefined || nowMs - (this.#sinceMs ?? nowMs) > TRUSTED_MS;
    const waitMs = trusted ? FIRST_WAIT_MS : Math.min(2 * before.waitMs, LONGEST_WAIT_MS);
    this.#failures.set(this.#place, { rateHz, waitMs, untilMs: nowMs + waitMs });
  }

  #change(place: number, nowMs: number): boolean {
    this.#place = place;
    this.#sinceMs = nowMs;
    this.#settlingPictures = SETTLING_PICTURES;
    this.#slowWindows = this.#fastWindows = 0;
    return true;
  }

  #clearWindow(): void {
    this.#turns = this.#pictures = this.#timeMs = this.#longestMs = 0;
  }
}
