// Explains why an actuator was commanded: for any command of the last minutes, the chain of packets from the sensor
// reading with the time of each step, and how long all such chains took.

import { tidy } from "./units.js";
import { clock, colour, h, say } from "./words.js";

export class Why {
  /**
   * @param {Link} link Asks the server.
   * @param {HTMLDialogElement} dialog Shows the explanation, beside the arena.
   * @param {Timeline} timeline Has the moment that the page shows, and goes to that of a command.
   */
  constructor(link, dialog, timeline) {
    this.link = link;
    this.dialog = dialog;
    this.timeline = timeline;
    this.shown = null;
    this.asking = 0;
    dialog.addEventListener("keydown", (event) => this.#key(event));
    dialog.addEventListener("close", () => (this.shown = null));
  }

  /** Returns the agent that is explained; empty if none is. */
  get agent() {
    return this.dialog.open && this.chain?.isConnected ? this.name : "";
  }

  /** Shows the command that was in force at the moment that the page shows. */
  async open(agent) {
    this.name = agent;
    const moment = this.timeline.live ? {} : { t: this.timeline.t };
    this.said = h("p.said", { role: "status" }, "asking …");
    const button = (text, label, action) => h("button", { type: "button", "aria-label": label, title: label, onclick: action }, text);
    this.before = button("‹", "Previous command (left arrow)", () => this.#step(-1));
    this.after = button("›", "Next command (right arrow)", () => this.#step(1));
    this.newest = button("Newest", "The newest command (end)", () => this.#ask({ agent }));
    this.there = button("Go there", "To its moment on the timeline", () => this.#goThere());
    this.which = h("select", { "aria-label": "Actuator", onchange: () => this.#ask({ agent, type: this.which.value, ...moment }) });
    this.place = h("span.dim.grow");
    this.chain = h("div");
    this.nav = h("div.whynav", { hidden: true }, this.before, this.after, this.which, this.place, this.there, this.newest);
    const close = h("form.closing", { method: "dialog" }, h("h2", { id: "inspector-title" }, `Why was ${agent} commanded?`), h("button", {}, "Close"));
    this.dialog.replaceChildren(close, this.nav, this.said, this.chain);
    if (!this.dialog.open) this.dialog.show();
    this.shown = null;
    await this.#ask({ agent, ...moment });
  }

  #step(step) {
    const it = this.shown;
    if (it) this.#ask({ agent: it.agent, type: it.type, command: [it.source, it.seq], step });
  }

  #goThere() {
    this.timeline.go(this.shown.t);
    this.dialog.close();
  }

  #key(event) {
    if (!this.shown || !this.chain.isConnected || event.target.closest("select, input")) return;
    if (event.key === "ArrowLeft") this.#step(-1);
    else if (event.key === "ArrowRight") this.#step(1);
    else if (event.key === "End") this.#ask({ agent: this.shown.agent });
    else return;
    event.preventDefault();
  }

  async #ask(what) {
    const number = ++this.asking;
    const { ok, reason, result } = await this.link.ask("explain", what);
    if (number !== this.asking || !this.agent) return;
    if (!ok || !result) {
      say(this.said, ok ? `No command to an actuator of ${what.agent} is known yet.` : reason);
      return;
    }
    this.#show(result);
  }

  #show(it) {
    this.nav.hidden = false;
    // The first button gets the focus; it was hidden when the dialog opened.
    if (!this.shown) this.before.focus();
    this.shown = it;
    this.which.hidden = it.actuators.length < 2;
    this.which.replaceChildren(...it.actuators.map((type) => h("option", { selected: type === it.type }, type)));
    this.which.value = it.type;
    say(this.place, `${it.place} of ${it.count}${it.left_out ? `, ${it.left_out} left out` : ""}`);
    // aria-disabled and not disabled: a disabled button would lose the focus.
    this.before.setAttribute("aria-disabled", String(it.place === 1));
    this.after.setAttribute("aria-disabled", String(it.place === it.count));
    const last = it.steps[it.steps.length - 1];
    const took = it.alike
      ? `${last.at_ms.toFixed(2)} ms from the first cause to the command.`
      : "No packet is known that caused it: a timer led to it, or no agent has reported the cause.";
    say(this.said, `${it.type} at ${clock(it.mission_s)} mission time. ${took}`);
    this.chain.replaceChildren(chain(it.steps, last.at_ms), ...(it.alike ? [alike(it.alike, last.at_ms)] : []));
  }
}

function chain(steps, whole) {
  const list = h("ol.chain");
  steps.forEach((step, index) => {
    const row = h("li", {}, h("div.what", {}, h("b", {}, step.type), h("span", {}, ` ${step.source} #${step.number}`)), h("div.body.dim", {}, tidy(step.body)));
    row.style.setProperty("--tint", colour(step.source.split("/")[0]));
    if (index < steps.length - 1) {
      const bar = h("span.bars", { "aria-hidden": "true" });
      for (const [kind, ms] of [["before", step.at_ms], ["travel", step.travel_ms], ["handling", step.handling_ms]]) {
        const part = h(`i.${kind}`);
        part.style.width = `${((100 * ms) / Math.max(whole, 1e-6)).toFixed(2)}%`;
        bar.append(part);
      }
      const travel = step.travel_ms > 0.005 ? `${step.travel_ms.toFixed(2)} ms on its way, ` : "";
      row.append(h("div.took", {}, bar, h("span.figure", {}, `${travel}${step.handling_ms.toFixed(2)} ms until the next`)));
    }
    list.append(row);
  });
  return list;
}

/** Shows how long all commands with the same kind of chain took, and where this one is among them. */
function alike(figures, whole) {
  const most = Math.max(1, ...figures.bars);
  const width = (figures.to_ms - figures.from_ms) / figures.bars.length;
  const here = Math.min(figures.bars.length - 1, Math.floor((whole - figures.from_ms) / Math.max(width, 1e-9)));
  const bars = figures.bars.map((count, index) => {
    const bar = h("i", index === here ? { "data-here": true } : {});
    bar.style.height = count ? `${Math.max(4, (100 * count) / most)}%` : "0";
    return bar;
  });
  const ms = (value) => `${value.toFixed(2)} ms`;
  return h(
    "figure.alike",
    {},
    h("div.bars", { role: "img", "aria-label": `Histogram from ${ms(figures.from_ms)} to ${ms(figures.to_ms)}` }, ...bars),
    h("div.ends.dim", { "aria-hidden": "true" }, h("span", {}, ms(figures.from_ms)), h("span", {}, `${ms(figures.to_ms)}${figures.max_ms > figures.to_ms ? " and more" : ""}`)),
    h(
      "figcaption.dim",
      {},
      `${figures.count} commands came about like this so far: half took no more than ${ms(figures.p50_ms)}, nine of ten ` +
        `${ms(figures.p90_ms)}, 99 of 100 ${ms(figures.p99_ms)}, the longest ${ms(figures.max_ms)}.`,
    ),
  );
}
