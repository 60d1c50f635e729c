// The search over agents, tasks and events.

import { say } from "./words.js";

/** Returns a function that tells whether texts have all the words that a person wrote; null if there are none. */
export function matcher(text) {
  const words = text.toLowerCase().split(/\s+/).filter(Boolean);
  if (!words.length) return null;
  return (...parts) => {
    const whole = parts.join(" ").toLowerCase();
    return words.every((word) => whole.includes(word));
  };
}

export class Search {
  /**
   * @param {HTMLInputElement} field The field.
   * @param {HTMLElement} said Says how much is found.
   * @param {Cards} cards Shows the agents and tasks that are found.
   * @param {Events} events Lists the events that are found.
   */
  constructor(field, said, cards, events) {
    this.field = field;
    this.said = said;
    this.cards = cards;
    this.events = events;
    field.addEventListener("input", () => this.apply());
    field.addEventListener("keydown", (event) => {
      if (event.key !== "Escape") return;
      this.look("");
      field.blur();
    });
  }

  get text() {
    return this.field.value.trim();
  }

  /** Looks for a text, as if a person had written it. */
  look(text) {
    this.field.value = text;
    this.apply();
  }

  /** Shows what is found now. */
  apply() {
    const found = matcher(this.text);
    const { agents, tasks } = this.cards.search(found);
    this.events.search(found);
    const count = (number, word) => `${number} ${word}${number === 1 ? "" : "s"}`;
    say(this.said, found ? `${count(agents, "agent")}, ${count(tasks, "task")}` : "");
  }
}
