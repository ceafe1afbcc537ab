// The keyboard: one letter for each action. Keys in a field or on a button belong to it.

export type KeyActions = Readonly<Record<string, () => void>>;

/** Calls the action of a key: the event's `key`, letters in lower case. */
export function listenToKeys(actions: KeyActions): void {
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) {
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

/** Space presses a button; a list or a slider takes letters and Home as well. Escape belongs to the page. */
function belongsToControl(target: EventTarget | null, key: string): boolean {
  if (!(target instanceof Element) || key === "Escape") {
    return false;
  }
  const takesAll = target.closest("select, input[type=range], input[type=text]") !== null;
  return takesAll || (key === " " && target.closest("button, input, summary") !== null);
}
