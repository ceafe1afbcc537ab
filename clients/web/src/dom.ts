/**
 * Returns the first element within `root` that matches `selector`. Throws if the page lacks it, or if it has another
 * type: index.html and this program do not fit together.
 */
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
