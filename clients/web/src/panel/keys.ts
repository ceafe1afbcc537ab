// The keyboard: one letter for each action. Keys in a field or on a button belong to it.

export type KeyActions = Readonly<Record<string, () => void>>;

/** Calls the action of a key: the event's `key`, letters in lower case. */
export function listenToKeys(actions: KeyActions): void {
  window.addEventListener("keydown", (event) => {
    // A held arrow goes on through the frames of a recording.
    const repeats = event.repeat && !event.key.startsWith("Arrow");
    if (event.ctrlKey || event.metaKey || event.altKey || repeats) {
      return;
    }
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const action = actions[key];
    if (action !== undefined && !belongsToControl(event.target, key)) {
      event.preventDefault();
      action();
    }
  });
}

/** Calls `hold(true)` while a key is down. A page that loses the focus counts as a key that is released. */
export function holdKey(key: string, hold: (down: boolean) => void): void {
  window.addEventListener("keydown", (event) => {
    const modified = event.ctrlKey || event.metaKey || event.altKey;
    if (event.key.toLowerCase() === key && !modified && !event.repeat && !belongsToControl(event.target, key)) {
      hold(true);
    }
  });
  window.addEventListener("keyup", (event) => {
    if (event.key.toLowerCase() === key) {
      hold(false);
    }
  });
  window.addEventListener("blur", () => hold(false));
}

/**
 * Space presses a button; a list or a slider takes letters and Home as well. Escape belongs to the page, and so do the
 * keys of a time line, whose handle has the focus after a drag.
 */
function belongsToControl(target: EventTarget | null, key: string): boolean {
  if (!(target instanceof Element) || key === "Escape") {
    return false;
  }
  if (target.id === "seek") {
    return false;
  }
  const takesAll = target.closest("select, input[type=range], input[type=text]") !== null;
  return takesAll || (key === " " && target.closest("button, input, summary") !== null);
}
