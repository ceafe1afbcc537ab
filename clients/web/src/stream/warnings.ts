// The warnings of a scene's statuses as they can be read: the numbers in one change from status to status, and some
// come and go with every step.

/** A warning stays for so long after the last status that held it. */
export const STAY_MS = 5000;
/** So long it keeps its wording. */
export const REWORD_MS = 2000;

interface Shown {
  text: string;
  wordedMs: number;
  seenMs: number;
}

export class Warnings {
  /** In the order in which they came. */
  readonly #shown = new Map<string, Shown>();

  /** Takes the warnings of a status of the time `nowMs` on the server's clock. */
  update(texts: readonly string[], nowMs: number): void {
    for (const text of texts) {
      const shown = this.#shown.get(kindOf(text));
      if (shown === undefined) {
        this.#shown.set(kindOf(text), { text, wordedMs: nowMs, seenMs: nowMs });
        continue;
      }
      shown.seenMs = nowMs;
      if (nowMs - shown.wordedMs >= REWORD_MS) {
        Object.assign(shown, { text, wordedMs: nowMs });
      }
    }
    for (const [kind, { seenMs }] of this.#shown) {
      if (nowMs - seenMs > STAY_MS) {
        this.#shown.delete(kind);
      }
    }
  }

  texts(): string[] {
    return [...this.#shown.values()].map(({ text }) => text);
  }

  clear(): void {
    this.#shown.clear();
  }
}

/** The text without its numbers. A digit within a quoted name belongs to the name. */
function kindOf(text: string): string {
  return text
    .split("'")
    .map((part, index) => (index % 2 === 1 ? part : part.replace(/[+-]?\d+(\.\d+)?(e[+-]?\d+)?/gi, "#")))
    .join("'");
}
