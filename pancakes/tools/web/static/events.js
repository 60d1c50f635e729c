// The list of events, newest first.

import { grouped } from "./event_groups.js";
import { tidy } from "./units.js";
import { clock, colour, h } from "./words.js";

const SHOWN = 250;
/** The most events that are grouped for one list. */
const LOOKED_AT = 1500;
const MOVES = new Set([
  "migration_asked", "migration_bid", "migration_refused", "migration", "task_frozen", "task_arrived",
  "task_handed_over", "task_resumed", "task_adopted", "task_forgotten", "handoff_failed", "taken_over",
  "task_created", "task_removed", "allocation",
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

const FAILURE = /failed|given_up|stuck|collision/;

/** Returns how an event is marked: as a `move` or a `failure`, in plots too; as a `warning`; empty if it is not. */
export function markOf(event) {
  if (event.kind === "migration") return { moved: "move", stayed: "failure", fenced: "failure" }[event.outcome] ?? "";
  const kind = sort(event);
  return FAILURE.test(event.kind) || kind === "error" ? "failure" : kind === "warning" ? "warning" : "";
}

export class Events {
  constructor(box, filterBox, go) {
    this.box = box;
    this.go = go;
    this.events = [];
    this.until = Infinity;
    this.filter = "news";
    this.found = null;
    this.open = new Set();
    this.stale = false;
    this.filterBox = filterBox;
    filterBox.addEventListener("change", (event) => {
      this.filter = event.target.value;
      this.stale = true;
    });
  }

  /** Chooses what is listed, as a person does. */
  choose(filter) {
    const radio = this.filterBox.querySelector(`[value="${CSS.escape(filter)}"]`);
    if (radio && !radio.checked) radio.click();
  }

  /** Lists only events that a search finds; null: all. */
  search(found) {
    this.found = found;
    this.stale = true;
  }

  forget() {
    this.events = [];
    this.open.clear();
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

  /** Returns the moments between two to mark: of migrations, warnings and errors. */
  marks(from, to) {
    const found = [];
    for (const event of this.events) {
      const kind = event.t >= from && event.t <= to ? markOf(event) : "";
      if (kind) found.push({ t: event.t, kind, text: event.text });
    }
    return found;
  }

  #wanted(event) {
    if (event.t > this.until) return false;
    if (this.found && !this.found(event.text, event.agent, event.kind)) return false;
    const kind = sort(event);
    if (this.filter === "moves") return MOVES.has(event.kind);
    if (this.filter === "warnings") return kind === "warning" || kind === "error" || kind === "refused";
    return this.filter === "all" || !event.quiet || MOVES.has(event.kind);
  }

  render() {
    if (!this.stale) return;
    this.stale = false;
    const shown = [];
    for (let index = this.events.length - 1; index >= 0; index -= 1) {
      if (this.#wanted(this.events[index])) shown.push(this.events[index]);
      if (shown.length >= LOOKED_AT) break;
    }
    const known = new Map([...this.box.children].map((row) => [row.dataset.key, row]));
    const rows = grouped(shown, SHOWN).flatMap((group) => this.#rows(group, known));
    if (!rows.length) rows.push(h("li.nothing.dim", {}, this.found ? "no event is found" : "nothing yet"));
    // A row with the focus stays in the document, so it keeps the focus.
    this.box.replaceChildren(...rows);
  }

  #rows(group, known) {
    const first = group.events.at(-1).n;
    const isOpen = this.open.has(first);
    const key = `${group.event.n} ${group.events.length} ${isOpen}`;
    const head = known.get(key) || this.#row(group.event, key, group.events.length > 1 ? this.#count(group, first, isOpen) : null);
    const rest = isOpen ? group.events.slice(1) : [];
    return [head, ...rest.map((event) => known.get(`in ${event.n}`) || this.#row(event, `in ${event.n}`, null))];
  }

  #count(group, first, isOpen) {
    const times = group.events.length;
    const since = clock(group.events.at(-1).m);
    const toggle = () => {
      if (!this.open.delete(first)) this.open.add(first);
      this.stale = true;
    };
    const text = isOpen ? `Show only the newest of ${times}` : `Show all ${times} since ${since}`;
    return h("button.count", { type: "button", title: text, "aria-label": text, "aria-expanded": String(isOpen), onclick: toggle }, `×${times}`);
  }

  #row(event, key, count) {
    const row = h(
      "li",
      { "data-key": key, "data-n": String(event.n), "data-kind": sort(event) },
      h(
        "button",
        { type: "button", onclick: () => this.go(event.t), title: "To this moment on the timeline" },
        h("time", {}, clock(event.m)),
        h("span.text", {}, tidy(event.text)),
      ),
      ...(count ? [count] : []),
    );
    row.style.setProperty("--tint", colour(event.agent));
    return row;
  }
}
