// A card for each agent: its name and role, its figures, its tasks.

import { Spark } from "./spark.js";
import { OWN_SERVICES, RUNNING } from "./state.js";
import { measured, rounded } from "./units.js";
import { colour, guardians, h, hertz, percent, permit, say, set, show, still } from "./words.js";

const FLIGHT_MS = 1100;
const SLOW = 0.8;
/** On this many cards there is no room for more than one small line each. */
const MANY = 8;

export class Cards {
  /**
   * @param {HTMLElement} box Contains the cards.
   * @param {{select: Function, why: Function, act: Function, plot: Function}} asks Called when a person clicks something.
   */
  constructor(box, asks) {
    this.box = box;
    this.asks = asks;
    this.found = null;
    this.selected = "";
    this.cards = new Map();
    this.control = false;
  }

  /** Shows a picture; `touched` names the agents that may have changed, null: all. */
  render(picture, touched) {
    const agents = picture.agents();
    const there = new Set(agents);
    for (const [name, card] of this.cards) {
      if (there.has(name)) continue;
      card.root.remove();
      this.cards.delete(name);
    }
    let changed = this.cards.size !== agents.length;
    for (const name of agents) {
      if (!this.cards.has(name)) {
        this.cards.set(name, new Card(name, this));
        this.cards.get(name).root.classList.toggle("selected", name === this.selected);
        changed = true;
        this.cards.get(name).render(picture);
      } else if (!touched || touched.has(name)) {
        this.cards.get(name).render(picture);
      }
    }
    if (changed) agents.forEach((name) => this.box.append(this.cards.get(name).root));
    this.box.classList.toggle("many", this.#many());
    document.body.classList.toggle("crowd", this.#many());
  }

  #many() {
    return this.cards.size > MANY;
  }

  /** Shows only what a search finds (null: everything); returns how many agents and tasks it finds. */
  search(found) {
    this.found = found;
    let [agents, tasks] = [0, 0];
    for (const card of this.cards.values()) {
      tasks += card.search(found);
      if (!card.root.hidden) agents += 1;
    }
    return { agents, tasks };
  }

  /** Returns the names of the series that cards show now. */
  series() {
    const seen = [...this.cards.values()].filter((card) => !card.root.hidden);
    return seen.flatMap((card) => card.sparks.map((spark) => spark.name).filter((name) => !this.#many() || name.endsWith(" late_ms")));
  }

  /** Draws the small lines as far as a moment. */
  drawSparks(series, moment) {
    for (const card of this.cards.values()) {
      if (card.root.hidden) continue;
      for (const spark of card.sparks) {
        const points = series.get(spark.name);
        show(spark.root, points.t.length > 1);
        if (points.t.length > 1) spark.draw(points, moment);
      }
    }
  }

  allow(control) {
    this.control = control;
    document.body.classList.toggle("control", control);
    for (const card of this.cards.values()) card.allow(control);
  }

  select(name) {
    this.selected = name;
    for (const [other, card] of this.cards) card.root.classList.toggle("selected", other === name);
  }

  scrollTo(name) {
    this.cards.get(name)?.root.scrollIntoView({ block: "nearest", behavior: still.matches ? "auto" : "smooth" });
  }

  /** Returns the rectangle of the chip of a task, or null if there is no chip. */
  rectOf(agent, task) {
    return this.cards.get(agent)?.chipOf(task)?.root.getBoundingClientRect() ?? null;
  }

  /** Animates a task from its former place to its chip on another card; returns whether that chip exists. */
  fly(task, from, agent) {
    const chip = this.cards.get(agent)?.chipOf(task)?.root;
    if (!chip || chip.dataset.state !== RUNNING) return false;
    chip.classList.add("arrived");
    setTimeout(() => chip.classList.remove("arrived"), 4000);
    if (still.matches || !from) return true;
    const to = chip.getBoundingClientRect();
    const flyer = h("div.flyer", { "aria-hidden": "true" }, task);
    flyer.style.left = `${to.left}px`;
    flyer.style.top = `${to.top}px`;
    flyer.style.width = `${to.width}px`;
    flyer.style.setProperty("--tint", colour(agent));
    document.body.append(flyer);
    const [dx, dy] = [from.left - to.left, from.top - to.top];
    const motion = flyer.animate(
      [
        { transform: `translate(${dx}px, ${dy}px) scale(1)`, opacity: 1 },
        { transform: `translate(${dx * 0.5}px, ${dy * 0.5 - 46}px) scale(1.12)`, opacity: 1, offset: 0.5 },
        { transform: "translate(0, 0) scale(1)", opacity: 1 },
      ],
      { duration: FLIGHT_MS, easing: "cubic-bezier(.45, .05, .3, 1)" },
    );
    motion.onfinish = motion.oncancel = () => flyer.remove();
    return true;
  }
}

class Card {
  constructor(name, cards) {
    this.name = name;
    this.cards = cards;
    this.chips = new Map();
    this.whyButton = h("button.quiet", { type: "button", onclick: () => cards.asks.why(name), title: "What led to the command to its actuators at this moment?" }, "Why?");
    this.driven = "";
    this.driveButton = h("button.quiet", { type: "button", hidden: true, onclick: () => cards.asks.act(name, this.driven), title: "Drive it by hand" }, "Drive …");
    this.state = h("span.badge");
    this.bar = h("meter", { min: 0, max: 1, low: 0.35, high: 0.65, optimum: 1 });
    this.level = h("span.figure");
    const spark = (figure, about, top) => new Spark(`${name} ${figure}`, `${about} of ${name}`, top, cards.asks.plot);
    const [charge, processor, late] = [
      spark("battery_percent", "battery", () => 100),
      spark("processor_percent", "processor", (most) => Math.max(100, most)),
      spark("late_ms", "lateness", (most) => Math.max(1, most)),
    ];
    this.sparks = [charge, processor, late];
    for (const it of this.sparks) it.root.hidden = true;
    this.battery = h("div.battery", {}, h("span.dim", {}, "battery"), this.bar, this.level, charge.root);
    this.figures = h("dl.figures");
    this.values = new Map();
    this.beside = new Map([["processor", processor], ["late", late]]);
    this.links = h("p.links.dim");
    this.tasks = h("ul.tasks", { "aria-label": `Tasks of ${name}` });
    this.nothing = h("p.nothing.dim", {}, "runs no task of its own");
    this.own = h("ul.tasks");
    this.summary = h("summary.dim");
    this.services = h("p.services.dim");
    this.root = h(
      "article.card.panel",
      { "aria-label": `Agent ${name}`, "data-agent": name, onclick: (event) => this.#click(event) },
      h("div.top", {}, h("i.dot"), h("h3", {}, name), this.state, h("span.grow"), this.driveButton, this.whyButton),
      this.battery,
      this.tasks,
      this.nothing,
      this.figures,
      this.links,
      (this.details = h("details", {}, this.summary, this.services, this.own)),
    );
  }

  #click(event) {
    if (!event.target.closest("button, summary, a")) this.cards.asks.select(this.name);
  }

  chipOf(task) {
    for (const [key, chip] of this.chips) if (key.endsWith(`/${task}`)) return chip;
    return null;
  }

  allow(control) {
    for (const chip of this.chips.values()) chip.allow(control);
  }

  /** Shows the card if a search finds the agent or a task of it; returns how many tasks it finds. */
  search(found) {
    const whole = !found || found(this.name, this.role);
    let tasks = 0;
    let own = false;
    for (const chip of this.chips.values()) {
      const fits = Boolean(found) && found(this.name, chip.task, chip.row.type ?? "", chip.row.state);
      chip.root.hidden = !whole && !fits;
      chip.root.classList.toggle("found", fits && !found(this.name, this.role));
      if (fits) tasks += 1;
      own = own || (fits && !whole && chip.isOwn);
    }
    this.root.hidden = !whole && !tasks;
    // A task that is found must be seen, also among those of the agent's services.
    if (own) this.details.open = this.opened = true;
    else if (!found && this.opened) this.details.open = this.opened = false;
    return tasks;
  }

  render(picture) {
    const row = picture.get("agent", this.name);
    this.role = row.role;
    this.root.style.setProperty("--tint", colour(this.name));
    set(this.root, "data-state", row.state);
    set(this.root, "data-role", row.role);
    say(this.state, row.state === "ready" ? (row.role === "agent" ? "ready" : row.role) : row.state);
    const battery = picture.get("battery", this.name);
    show(this.battery, Boolean(battery));
    if (battery) {
      this.bar.value = battery[1];
      set(this.bar, "aria-label", `battery of ${this.name}`);
      const volts = battery[0] === null ? "" : ` · ${battery[0].toFixed(2)} V`;
      say(this.level, `${percent(battery[1])}${volts}${battery[2] ? " · charging" : ""}`);
    }
    show(this.whyButton, Boolean(picture.get("commands", this.name)));
    const dock = picture.get("dock", this.name);
    this.#figure("dock", dock ? `${dock[2]} ${dock[3]}`.trim() : null);
    this.#figure("reserve", row.reserve_s === undefined ? null : `${row.reserve_s} s`);
    this.#figure("charging", row.charge_trouble || null, true);
    this.#figure("processor", row.processor === null || row.processor === undefined ? null : percent(row.processor));
    this.#figure("memory", row.memory_mib ? `${Math.round(row.memory_mib)} MiB` : null);
    this.#figure("late", row.late_ms === null || row.late_ms === undefined ? null : measured(row.late_ms, "ms"));
    this.#figure("missed ticks", row.missed || null);
    this.#figure("dropped", row.dropped || null);
    this.#figure("dead letters", row.dead_letters || null, true);
    this.#figure("not encrypted", row.insecure || null, true);
    this.#figure("version", picture.versions().size > 1 ? row.version : null, true);
    const links = picture.linksOf(this.name);
    const few = links.slice(0, 6).map(([peer, ms]) => (ms < 0 ? peer : `${peer} ${measured(ms, "ms")}`));
    say(this.links, links.length ? `links: ${few.join(" · ")}${links.length > 6 ? ` and ${links.length - 6} more` : ""}` : "no links");
    this.#renderTasks(picture);
    if (this.cards.found) this.search(this.cards.found);
  }

  #renderTasks(picture) {
    const rows = picture.tasksOf(this.name);
    let [own, users, running] = [0, 0, 0];
    this.driven = "";
    for (const [key, chip] of this.chips) {
      if (rows.has(key)) continue;
      chip.root.remove();
      this.chips.delete(key);
    }
    for (const [key, row] of rows) {
      const service = key.slice(0, key.indexOf("/"));
      const isOwn = OWN_SERVICES.has(service);
      if (isOwn) own += 1;
      else users += 1;
      if (isOwn && row.state === RUNNING) running += 1;
      if (row.driven_by !== undefined && row.state === RUNNING) this.driven ||= key;
      let chip = this.chips.get(key);
      if (!chip) {
        chip = new Chip(this.name, key, this.cards, picture.get("agent", this.name).role);
        this.chips.set(key, chip);
      }
      chip.render(row);
    }
    this.#order(this.tasks, false);
    this.#order(this.own, true);
    show(this.nothing, users === 0);
    show(this.driveButton, Boolean(this.cards.control && this.driven));
    const services = [...(picture.services.get(this.name) || new Map())].sort(([one], [other]) => (one < other ? -1 : 1));
    say(this.services, `services: ${services.map(([name, [state]]) => (state === RUNNING ? name : `${name} (${state})`)).join(", ")}`);
    const stopped = services.filter(([, [state]]) => state !== RUNNING);
    const trouble = stopped.map(([name, [state]]) => ` · ${name} ${state}`).join("");
    say(this.summary, `${running} of ${own} tasks of its services run${trouble}`);
    this.summary.classList.toggle("warn", stopped.length > 0);
  }

  /** Sorts running tasks first, then by name; moves only the elements that are out of order. */
  #order(box, own) {
    const rank = (chip) => `${chip.row.state === RUNNING ? 0 : 1} ${chip.task}`;
    const chips = [...this.chips.values()].filter((chip) => chip.isOwn === own);
    chips.sort((a, b) => (rank(a) < rank(b) ? -1 : 1));
    chips.forEach((chip, index) => {
      if (box.children[index] !== chip.root) box.insertBefore(chip.root, box.children[index] || null);
    });
  }

  #figure(name, text, warn = false) {
    let value = this.values.get(name);
    if (!value) {
      value = { term: h("dt", {}, name), text: h("dd") };
      this.values.set(name, value);
      this.figures.append(h("div", {}, value.term, value.text, ...(this.beside.has(name) ? [this.beside.get(name).root] : [])));
    }
    show(value.term.parentElement, text !== null);
    say(value.text, String(text ?? ""));
    value.text.classList.toggle("warn", warn);
  }
}

class Chip {
  constructor(agent, key, cards, role) {
    this.agent = agent;
    this.key = key;
    this.role = role;
    this.isOwn = OWN_SERVICES.has(key.slice(0, key.indexOf("/")));
    this.cards = cards;
    this.task = key.slice(key.indexOf("/") + 1);
    this.rate = h("span.figure.dim");
    this.notes = h("span.notes.warn");
    this.name = h("span.name", {}, this.task);
    this.button = h("button.task", { type: "button", onclick: () => cards.asks.act(agent, key) }, h("i.state"), this.name, this.notes, this.rate, h("span.grip", { "aria-hidden": "true" }, "⠿"));
    this.guards = h("p.guards.dim");
    this.root = h("li", { "data-task": this.task, "data-key": key }, this.button, this.guards);
    this.allow(cards.control);
  }

  allow(control) {
    const movable = control && this.role === "agent" && !this.isOwn;
    this.root.classList.toggle("movable", movable);
  }

  render(row) {
    this.row = row;
    set(this.root, "data-state", row.state);
    const wanted = row.rate_hz;
    const reached = row.achieved_hz;
    let rate = "";
    if (row.state !== RUNNING) rate = row.rest || row.state;
    else if (wanted) rate = reached === null || reached === undefined ? `${hertz(wanted)} Hz` : `${hertz(reached)} of ${hertz(wanted)} Hz`;
    say(this.rate, rate);
    this.rate.classList.toggle("warn", row.rest === "disputed" || Boolean(wanted) && reached !== null && reached < SLOW * wanted);
    const held = (row.filters || []).find(({ doing }) => doing === "holds");
    const stands = row.state === RUNNING && (row.rest || (row.driven_by && `driven by ${row.driven_by}`) || (held && `held by ${held.filter}`));
    const trouble = stands || (row.unplaced && "not allocated");
    say(this.notes, trouble || (row.restarts ? `${row.restarts}× restarted` : ""));
    show(this.guards, Boolean(row.guards));
    if (row.guards) {
      const troubled = stands || row.guards.by.length < row.guards.wanted || row.guards.by.some(([, , answers]) => !answers);
      say(this.guards, `${guardians(row.guards)}${permit(row.guards)}`);
      this.guards.classList.toggle("warn", troubled);
    }
    const late = row.late_ms === null || row.late_ms === undefined ? "" : `, ${rounded(row.late_ms)} ms late in the mean`;
    set(this.button, "title", `${row.type || this.task}: ${row.rest || row.state}${row.reason ? `, ${row.reason}` : ""}${row.unplaced ? `, not allocated: ${row.unplaced}` : ""}${late}${row.missed ? `, ${row.missed} ticks missed` : ""}${row.dropped ? `, ${row.dropped} packets dropped` : ""}`);
    set(this.button, "aria-label", `${this.task} on ${this.agent}, ${row.rest || row.state}${rate && row.state === RUNNING ? `, ${rate}` : ""}`);
  }
}
