// Makes the warnings of a scene's statuses readable. Numbers in a warning change with every status, and some warnings
// come and go with every step.

/** How long a warning stays after the last status that held it [ms]. */
export const STAY_MS = 5000;
/** How long a warning keeps its wording [ms]. */
export const REWORD_MS = 2000;

interface Shown {
  text: string;
  wordedMs: number;
  seenMs: number;
}

export class Warnings {
  /** Warnings by kind, in order of arrival. */
  readonly #shown = new Map<string, Shown>();

  /** Takes the warnings of a status. @param nowMs Time of the status on the server's clock. */
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

/** The text without its numbers. Digits in a quoted name stay. */
function kindOf(text: string): string {
  return text
    .split("'")
    .map((part, index) => (index % 2 === 1 ? part : part.replace(/[+-]?\d+(\.\d+)?(e[+-]?\d+)?/gi, "#")))
    .join("'");
}
