/** The element of index.html that `selector` names; a page without it is our own mistake. */
export function find<Type extends Element>(selector: string, type: new () => Type): Type {
  const found = document.querySelector(selector);
  if (!(found instanceof type)) {
    throw new Error(`index.html has no ${type.name} "${selector}"`);
  }
  return found;
}
