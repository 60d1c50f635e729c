// The field in which a person looks for a number to plot: what matches is listed with its value now.

import { measured } from "./units.js";
import { h, say, set } from "./words.js";

const PAUSE_MS = 150;
const AGAIN_MS = 1000;
/** About the height of the list. */
const LIST_PX = 310;

export class SeriesPicker {
  /**
   * @param {HTMLInputElement} field The field.
   * @param {HTMLElement} list Shows what matches.
   * @param {Link} link Asks the server.
   * @param {Function} pick Takes the name of a series; returns whether it has been plotted.
   */
  constructor(field, list, link, pick) {
    this.field = field;
    this.list = list;
    this.link = link;
    this.pick = pick;
    this.at = -1;
    this.names = [];
    this.asked = 0;
    field.addEventListener("input", () => this.#look(PAUSE_MS));
    field.addEventListener("focus", () => this.#look(0));
    field.addEventListener("blur", () => this.#close());
    field.addEventListener("keydown", (event) => this.#key(event));
    // The field keeps the focus while a person clicks in the list.
    list.addEventListener("pointerdown", (event) => event.preventDefault());
    list.addEventListener("click", (event) => {
      const row = event.target.closest("[data-name]");
      if (row) this.#choose(row.dataset.name);
    });
  }

  #look(pause) {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.#ask(), pause);
  }

  async #ask() {
    const number = ++this.asked;
    const { ok, reason, result } = await this.link.ask("find", { words: this.field.value.slice(0, 200) });
    if (number !== this.asked || document.activeElement !== this.field) return;
    if (ok) this.#show(result);
    else this.list.replaceChildren(h("li.dim", {}, reason));
    this.list.hidden = false;
    // Below the field there may be no room on the screen.
    const { top, bottom } = this.field.getBoundingClientRect();
    this.list.classList.toggle("up", window.innerHeight - bottom < LIST_PX && top > window.innerHeight - bottom);
    set(this.field, "aria-expanded", "true");
    this.#look(AGAIN_MS);
  }

  #show({ rows, count, left_out }) {
    const names = rows.map(([name]) => name);
    const chosen = this.names[this.at];
    if (names.join() === this.names.join() && names.length) {
      rows.forEach(([, unit, value], index) => say(this.list.children[index].lastChild, measured(value, unit)));
      return;
    }
    this.names = names;
    this.at = names.indexOf(chosen);
    const options = rows.map(([name, unit, value], index) =>
      h("li", { role: "option", id: `found-${index}`, "data-name": name }, h("span", {}, name), h("b.figure", {}, measured(value, unit))),
    );
    const rest = count > rows.length ? `${count - rows.length} more: write another word to find them` : "";
    const nothing = count ? "" : "No number has such a name. Numbers of packets appear here as soon as a packet has come.";
    const room = left_out ? `${left_out} more numbers are not kept: there are too many` : "";
    const notes = [nothing, rest, room].filter(Boolean).map((text) => h("li.dim", {}, text));
    this.list.replaceChildren(...options, ...notes);
    this.#mark();
  }

  #mark() {
    this.names.forEach((_, index) => set(this.list.children[index], "aria-selected", String(index === this.at)));
    if (this.at >= 0) {
      set(this.field, "aria-activedescendant", `found-${this.at}`);
      this.list.children[this.at].scrollIntoView({ block: "nearest" });
    } else this.field.removeAttribute("aria-activedescendant");
  }

  #key(event) {
    if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      const step = event.key === "ArrowDown" ? 1 : -1;
      if (this.names.length) this.at = (Math.max(this.at, step > 0 ? -1 : 0) + step + this.names.length) % this.names.length;
      this.#mark();
    } else if (event.key === "Enter") {
      if (this.names.length) this.#choose(this.names[Math.max(0, this.at)]);
    } else if (event.key === "Escape" && !this.list.hidden) {
      event.stopPropagation();
      this.field.value = "";
      this.#close();
      this.field.blur();
    } else return;
    event.preventDefault();
  }

  #choose(name) {
    if (!this.pick(name)) {
      this.list.replaceChildren(h("li.warn", {}, "There are too many numbers in the plots: remove one."));
      this.names = [];
      return;
    }
    this.field.value = "";
    this.#look(0);
  }

  #close() {
    clearTimeout(this.timer);
    this.asked += 1;
    this.names = [];
    this.at = -1;
    this.list.hidden = true;
    set(this.field, "aria-expanded", "false");
    this.field.removeAttribute("aria-activedescendant");
  }
}
