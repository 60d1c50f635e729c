// One task, while a person looks at it: its state as it changes, its rates and its settings.

import { DrivePad } from "./drive_pad.js";
import { FieldForm, changesOf } from "./field_form.js";
import { RUNNING } from "./state.js";
import { TreeView } from "./tree.js";
import { rounded, tidy } from "./units.js";
import { guardians, h, hertz, say, set, show } from "./words.js";

const LOOK_MS = 1000;
/** A task is asked again after this many times the duration of its last answer, so a slow task is asked less often. */
const SHARE = 10;
const FACTS_MS = 250;
const RATE = { kind: "number", type: "number", bounds: "from 0 to 10,000", unit: "Hz", min: 0, nullable: false };

export class TaskPanel {
  /**
   * @param {Link} link Asks the server.
   * @param {HTMLDialogElement} dialog Shows the panel, beside the arena.
   * @param {Orders} orders The other orders for a task.
   * @param {Timeline} timeline Has the moment that the page shows.
   * @param {Function} shown Returns the picture of that moment.
   * @param {Function} plot Plots a series.
   */
  constructor(link, dialog, orders, timeline, shown, plot) {
    this.plot = plot;
    this.link = link;
    this.dialog = dialog;
    this.orders = orders;
    this.timeline = timeline;
    this.shown = shown;
    this.root = null;
  }

  /** Returns the address of the task that is shown; empty if none is. */
  get task() {
    return this.root && this.#isOpen(this.root) ? `${this.agent}/${this.key}` : "";
  }

  /** Shows a task, until the dialog is closed or shows something else. */
  open(agent, key) {
    [this.agent, this.key] = [agent, key];
    this.told = null;
    this.facts = new Rows();
    this.actions = h("div");
    this.pad?.end();
    this.pad = new DrivePad(this.link, agent, key.split("/")[1]);
    this.did = "";
    this.age = h("small.dim");
    this.missing = h("p.dim.missing");
    this.rows = new Rows();
    this.tree = new TreeView();
    this.kept = h("div.state", { tabindex: 0, role: "group", "aria-label": "Fields of the state" }, this.rows.root);
    this.state = h("section", { "aria-label": "State" }, h("h3", {}, "State ", this.age), this.kept, this.missing);
    this.rates = new FieldForm("Rates", (fields, dry) => this.#setRates(fields, dry));
    this.settings = new FieldForm("Settings", (fields, dry) => this.#configure(fields, dry));
    this.said = h("p.said", { role: "status" });
    const close = h("form.closing", { method: "dialog" }, h("h2", { id: "inspector-title" }, `${key.split("/")[1]} on ${agent}`), h("button", {}, "Close"));
    const plots = [["rate", "rate_hz"], ["lateness", "late_ms"]].map(([text, figure]) =>
      h("button.quiet", { type: "button", onclick: () => this.plot(`${agent}/${key} ${figure}`) }, `Plot its ${text}`),
    );
    this.plotted = h("p.plotted", { hidden: true }, ...plots);
    this.root = h("div", {}, this.facts.root, this.plotted, this.actions, this.said, ...(this.orders.control ? [this.pad.root] : []), this.tree.root, this.state, this.rates.root, this.settings.root);
    this.dialog.replaceChildren(close, this.root);
    say(this.missing, "asking …");
    this.#draw();
    if (!this.dialog.open) this.dialog.show();
    this.#follow(this.root);
  }

  #isOpen(root) {
    return this.root === root && this.dialog.open && root.isConnected;
  }

  async #follow(root) {
    const timer = setInterval(() => (this.#isOpen(root) ? this.#draw() : clearInterval(timer)), FACTS_MS);
    while (this.#isOpen(root)) {
      const began = performance.now();
      const moment = this.timeline.live ? {} : { t: this.timeline.t };
      const asked = (this.asked = Symbol());
      const answer = await this.link.ask("task", { agent: this.agent, task: this.key, ...moment });
      // Ignore the answer if the person has changed something since the question.
      if (this.#isOpen(root) && asked === this.asked) this.#take(answer, moment.t === undefined);
      await new Promise((resolve) => setTimeout(resolve, Math.max(LOOK_MS, SHARE * (performance.now() - began))));
    }
  }

  // What is shown -----------------------------------------------------------------------------------------------

  #take({ ok, reason, result }, live) {
    this.told = ok ? result : { state: null, no_state: reason };
    const { state, no_state, settings, timers, left_out } = this.told;
    this.rows.show(state ? state.rows.map(([name, text]) => [name, tidy(text), text]) : []);
    this.tree.show(state ? state.tree : []);
    show(this.kept, Boolean(state && state.rows.length));
    const nothing = state && !state.rows.length && !state.tree.length ? "Its state is empty." : "";
    const cut = state && state.cut ? `Parts are cut. See all: pancakes task info ${this.agent}/${this.key} --state --format json` : "";
    say(this.missing, [no_state, nothing, cut].filter(Boolean).join(" "));
    show(this.missing, Boolean(no_state || nothing || cut));
    if (!live) {
      this.rates.show([], false);
      this.settings.show([], false, "Go back to live to see its settings.");
    } else if (settings) {
      const runs = this.#row()?.state === RUNNING;
      const editable = this.orders.control && runs;
      const still = this.orders.control && !runs ? "It does not run: settings can be changed only while it runs." : "";
      const more = left_out ? `${left_out} more do not fit on a page: pancakes param get ${this.agent}/${this.key}` : "";
      const rates = timers.map((it) => ({ ...RATE, path: [it.timer], name: it.timer, value: it.rate_hz, description: `${it.ticks} ticks, ${it.missed} missed` }));
      this.rates.show(rates, editable);
      this.settings.show(settings, editable, [settings.length ? "" : "It has no settings.", still, more].filter(Boolean).join(" "));
    }
    this.#draw();
  }

  #row() {
    return this.shown().tasksOf(this.agent).get(this.key);
  }

  /** Updates what changes by itself: the facts, the buttons, the age of the state. */
  #draw() {
    const row = this.#row();
    this.facts.show(row ? factsOf(this.agent, this.key, row) : [["agent", this.agent], ["state", "it is not on this agent"]]);
    const { live } = this.timeline;
    show(this.plotted, Boolean(row && row.rate_hz));
    const drivable = row && row.state === RUNNING && row.driven_by !== undefined;
    this.pad.render(Boolean(drivable && this.orders.control && live), row?.driven_by);
    const does = this.orders.control && live && row ? row.state : "";
    if (does !== this.did) {
      const held = this.actions.contains(document.activeElement);
      this.did = does;
      this.actions.replaceChildren(...(does ? [this.orders.actions(this.agent, this.key, row, this.said)] : []));
      if (held) this.actions.querySelector("button")?.focus();
    }
    const seen = this.told?.state;
    if (!seen) say(this.age, "");
    else if (live) say(this.age, `${Math.max(0, this.timeline.end - seen.t).toFixed(1)} s old`);
    else say(this.age, `as seen ${Math.max(0, this.timeline.t - seen.t).toFixed(1)} s before this moment`);
  }

  // What is changed ---------------------------------------------------------------------------------------------

  #order(what, fields) {
    this.asked = null;
    return this.link.ask("order", { do: what, agent: this.agent, task: this.key, ...fields });
  }

  async #configure(fields, dry) {
    const { ok, reason, result } = await this.#order("configure", { settings: changesOf(fields), dry_run: dry });
    const problems = ((!ok && result && result.problems) || []).map(({ path, text }) => [nameAt(fields, path), text]);
    return { ok, reason, problems };
  }

  /** Changes rates one after the other, after the agent has checked all of them. */
  async #setRates(fields, dry) {
    const changed = fields.filter((it) => it.changed).map((it) => ({ timer: it.field.name, rate_hz: it.value() }));
    for (const dry_run of dry ? [true] : [true, false]) {
      for (const change of changed) {
        const { ok, reason } = await this.#order("rate", { ...change, dry_run });
        if (!ok) return { ok, reason, problems: [[change.timer, reason]] };
      }
    }
    return { ok: true, reason: "", problems: [] };
  }
}

/** A list of names with texts, which updates only the texts that change. */
class Rows {
  constructor() {
    this.root = h("dl.facts");
    this.names = "";
  }

  show(rows) {
    const names = JSON.stringify(rows.map(([name]) => name));
    if (names !== this.names) {
      this.names = names;
      this.root.replaceChildren(...rows.flatMap(([name]) => [h("dt", {}, name), h("dd")]));
    }
    rows.forEach(([, text, whole], index) => {
      const value = this.root.children[2 * index + 1];
      say(value, text);
      if (whole !== undefined) set(value, "title", whole);
    });
  }
}

/** Returns the name of the field with a bad value: the field of the value itself, or of the table around it. */
function nameAt(fields, path) {
  const beginsWith = (keys) => keys.length <= path.length && keys.every((key, index) => key === path[index]);
  return fields.find((it) => beginsWith(it.field.path))?.field.name ?? path.join(".");
}

function factsOf(agent, key, row) {
  const known = (value) => value !== null && value !== undefined;
  const facts = [
    ["agent", agent],
    ["service", key.split("/")[0]],
    ["type", row.type],
    ["state", `${row.rest || row.state}${row.reason ? `: ${row.reason}` : ""}`],
    ["driven by", row.driven_by],
    ["needs", (row.requires || []).join(", ")],
  ];
  for (const { filter, doing, why } of row.filters || []) facts.push([`filter ${filter}`, why ? `${doing}: ${why}` : doing]);
  if (row.guards) {
    facts.push(["guardians", guardians(row.guards).replace("guarded by ", "")]);
    facts.push(["permit", row.guards.permit_s > 0 ? `${row.guards.permit_s.toFixed(1)} s` : "none: the task is paused"]);
    facts.push(["checkpoint", row.guards.age_s === null ? null : `${row.guards.age_s} s old at more than half of them`]);
  }
  facts.push(
    ["rate wanted", known(row.rate_hz) ? `${hertz(row.rate_hz)} Hz` : null],
    ["rate reached", known(row.achieved_hz) ? `${hertz(row.achieved_hz)} Hz` : null],
    ["late in the mean", known(row.late_ms) ? `${rounded(row.late_ms)} ms` : null],
    ["ticks missed", row.missed],
    ["packets dropped", row.dropped],
    ["restarts", row.restarts],
  );
  return facts.filter(([, text]) => known(text) && text !== "").map(([name, text]) => [name, String(text)]);
}
