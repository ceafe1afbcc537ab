/** Returns the element of index.html that matches `selector`, within `root`. Throws if there is none: an error of our own. */
export function find<Type extends Element>(selector: string, type: new () => Type, root: ParentNode = document): Type {
  const found = root.querySelector(selector);
  if (!(found instanceof type)) {
    throw new Error(`index.html has no ${type.name} "${selector}"`);
  }
  return found;
}

/** Changes the text of an element. The same text again costs no layout. */
export function setText(target: Element, text: string): void {
  if (target.textContent !== text) {
    target.textContent = text;
  }
}
