// The keys of the page.

const TYPING = "input[type=number], input[type=text], input[type=search], select, textarea";

/**
 * Listens to the keys, unless a dialog is open that hides the rest of the page.
 * @param {Object<string, Function>} keys What to do by key, in lower case; a space only where it presses nothing.
 * @param {Function} leave Called for escape outside of a field of the search.
 */
export function listenToKeys(keys, leave) {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog:modal")) return;
    if (event.key === "Escape" && !event.defaultPrevented && event.target.type !== "search") {
      leave();
      return;
    }
    if (event.target.closest(TYPING)) return;
    const key = event.key.toLowerCase();
    if (!Object.hasOwn(keys, key) || (key === " " && event.target.closest("button, summary, input"))) return;
    if (key === " " || key === "/" || key === "p") event.preventDefault();
    keys[key]();
  });
}
