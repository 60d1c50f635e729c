// The list of events, newest first.

import { clock, colour, h } from "./words.js";

const SHOWN = 250;
const MOVES = new Set([
  "migration_asked", "migration_bid", "migration_refused", "migration", "task_frozen", "task_arrived",
  "task_handed_over", "task_resumed", "task_adopted", "task_forgotten", "handoff_failed", "taken_over",
  "task_created", "task_removed",
]);

/** Returns the kind of an event, for its colour and the filter. */
export function sort(event) {
  if (event.kind === "migration_bid") return "bid";
  if (event.kind === "migration_refused" || event.kind === "handoff_failed") return "refused";
  if (MOVES.has(event.kind)) return "move";
  if (event.kind === "line") return event.level === "error" ? "error" : event.level === "warning" ? "warning" : "plain";
  if (/failed|given_up|collision|refused|stuck|lost|disputed|waits/.test(event.kind)) return "warning";
  return "plain";
}

export class Events {
  constructor(box, filterBox, go) {
    this.box = box;
    this.go = go;
    this.events = [];
    this.until = Infinity;
    this.filter = "news";
    this.stale = false;
    filterBox.addEventListener("change", (event) => {
      this.filter = event.target.value;
      this.stale = true;
    });
  }

  forget() {
    this.events = [];
    this.stale = true;
  }

  add(events) {
    const before = Math.max(0, this.events.length - 1);
    this.events.push(...events);
    // Earlier events arrive agent by agent, so they are not in order of time.
    const disorder = this.events.some((it, index) => index > before && it.t < this.events[index - 1].t);
    if (disorder) this.events.sort((a, b) => a.t - b.t || a.n - b.n);
    if (this.events.length > 4000) this.events.splice(0, this.events.length - 4000);
    this.stale = true;
  }

  /** Shows the events until a moment. */
  show(until) {
    if (until === this.until) return;
    const [one, other] = [Math.min(until, this.until), Math.max(until, this.until)];
    this.until = until;
    if (this.events.some((it) => it.t > one && it.t <= other)) this.stale = true;
  }

  /** Returns the events after `from`, until `to`. */
  between(from, to) {
    return this.events.filter((it) => it.t > from && it.t <= to);
  }

  #wanted(event) {
    if (event.t > this.until) return false;
    const kind = sort(event);
    if (this.filter === "moves") return MOVES.has(event.kind);
    if (this.filter === "warnings") return kind === "warning" || kind === "error" || kind === "refused";
    return this.filter === "all" || !event.quiet || MOVES.has(event.kind);
  }

  render() {
    if (!this.stale) return;
    this.stale = false;
    const shown = [];
    for (let index = this.events.length - 1; index >= 0 && shown.length < SHOWN; index -= 1) {
      if (this.#wanted(this.events[index])) shown.push(this.events[index]);
    }
    const known = new Map([...this.box.children].map((row) => [row.dataset.n, row]));
    const rows = shown.map((event) => known.get(String(event.n)) || this.#row(event));
    if (!rows.length) rows.push(h("li.nothing.dim", {}, "nothing yet"));
    this.box.replaceChildren(...rows);
  }

  #row(event) {
    const row = h(
      "li",
      { "data-n": String(event.n), "data-kind": sort(event) },
      h(
        "button",
        { type: "button", onclick: () => this.go(event.t), title: "To this moment on the timeline" },
        h("time", {}, clock(event.m)),
        h("span.text", {}, event.text),
      ),
    );
    row.style.setProperty("--tint", colour(event.agent));
    return row;
  }
}
