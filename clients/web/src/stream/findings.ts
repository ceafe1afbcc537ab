// Makes the findings of a scene's statuses readable. Numbers in a finding change with every status, and some findings
// come and go with every step.
import type { Status } from "./decode";

/** How long a finding stays after the last status that held it [ms]. */
export const STAY_MS = 5000;
/** How long a finding keeps its wording [ms]. */
export const REWORD_MS = 2000;

/** A probable mistake in the scene, or a fault of its results. */
export interface Finding {
  readonly message: string;
  readonly remedy: string;
  /** The field of the scene to look at; empty if the server did not say. */
  readonly place: string;
  /** Why the scene accepts it; empty: it does not. */
  readonly accepted: string;
}

interface Shown {
  finding: Finding;
  wordedMs: number;
  seenMs: number;
}

export class Findings {
  /** Findings by kind, in order of arrival. */
  readonly #shown = new Map<string, Shown>();

  /** Takes the findings of a status. @param nowMs Time of the status on the server's clock. */
  update(status: Status, nowMs: number): void {
    for (const [key, finding] of keyed(status)) {
      const shown = this.#shown.get(key);
      if (shown === undefined) {
        this.#shown.set(key, { finding, wordedMs: nowMs, seenMs: nowMs });
        continue;
      }
      shown.seenMs = nowMs;
      if (nowMs - shown.wordedMs >= REWORD_MS) {
        Object.assign(shown, { finding, wordedMs: nowMs });
      }
    }
    for (const [key, { seenMs }] of this.#shown) {
      if (nowMs - seenMs > STAY_MS) {
        this.#shown.delete(key);
      }
    }
  }

  /** The findings; those that the scene accepts last. */
  list(): Finding[] {
    const all = [...this.#shown.values()].map(({ finding }) => finding);
    return [...all.filter(({ accepted }) => accepted === ""), ...all.filter(({ accepted }) => accepted !== "")];
  }

  clear(): void {
    this.#shown.clear();
  }
}

/** The findings of a status by their code and the things that they concern. An older server only has warnings. */
function keyed({ findings, warnings }: Status): [string, Finding][] {
  return findings.length > 0
    ? findings.map((one) => [[one.code, one.body, one.other, one.tool].join("\n"), one])
    : warnings.map((message) => [kindOf(message), { message, remedy: "", place: "", accepted: "" }]);
}

/** The text without its numbers. Digits in a quoted name stay. */
function kindOf(text: string): string {
  return text
    .split("'")
    .map((part, index) => (index % 2 === 1 ? part : part.replace(/[+-]?\d+(\.\d+)?(e[+-]?\d+)?/gi, "#")))
    .join("'");
}
