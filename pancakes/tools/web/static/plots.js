// The panel with plots: which numbers are plotted, in which plots, over which time.

import { Plot } from "./plot.js";
import { quantity } from "./units.js";
import { colour, hue, show } from "./words.js";

/** The most plotted numbers; a page with more would be slow, and could not be read. */
const MOST = 32;
/** How many agents have a line in the first plot, which nobody asked for. */
const FEW = 8;

export class Plots {
  /**
   * @param {{box: HTMLElement, empty: HTMLElement, span: HTMLSelectElement}} elements Contains the plots; shown without
   *   plots; chooses how many seconds they show.
   * @param {object} page See `Plot`; also `timeline`.
   * @param {Function} changed Called when a person has changed what is plotted.
   */
  constructor({ box, empty, span }, page, changed) {
    this.box = box;
    this.empty = empty;
    this.span = span;
    this.page = { ...page, remove: (name) => this.remove(name) };
    this.changed = changed;
    this.names = [];
    this.chosen = false;
    this.plots = new Map();
    page.series.want(() => this.names);
    span.addEventListener("change", () => {
      this.draw();
      this.changed();
    });
  }

  /** Plots these numbers, as the address of the page says. */
  choose(names) {
    this.names = [...new Set(names)].filter((name) => /^\S+ \S/.test(name)).slice(0, MOST);
    this.chosen = true;
    this.#arrange();
    this.page.series.hurry();
  }

  /** Plots one number more; returns whether there was room. */
  add(name) {
    if (this.names.includes(name)) return true;
    if (this.names.length >= MOST) return false;
    this.choose([...this.names, name]);
    this.changed();
    return true;
  }

  remove(name) {
    this.choose(this.names.filter((it) => it !== name));
    this.changed();
  }

  /** Plots the batteries of a few agents, or how late they are, if nobody has chosen anything. */
  offer(picture) {
    if (this.chosen) return;
    const agents = picture.agents().filter((name) => picture.get("agent", name).role === "agent");
    const powered = agents.filter((name) => picture.get("battery", name));
    const figure = powered.length ? "battery_percent" : "late_ms";
    const names = (powered.length ? powered : agents).slice(0, FEW).map((name) => `${name} ${figure}`);
    if (names.join() === this.names.join()) return;
    this.names = names;
    this.#arrange();
  }

  #arrange() {
    const groups = new Map();
    for (const name of this.names) {
      const key = kindOf(name);
      if (!groups.has(key)) groups.set(key, []);
      groups.get(key).push(name);
    }
    for (const [key, plot] of this.plots) {
      if (groups.has(key)) continue;
      plot.close();
      this.plots.delete(key);
    }
    for (const [key, names] of groups) {
      let plot = this.plots.get(key);
      if (!plot) {
        const [title, unit] = quantity(key.split(" ").at(-1));
        this.plots.set(key, (plot = new Plot({ title, unit }, this.page)));
        this.box.append(plot.root);
      }
      const agents = names.map((name) => name.split(/[ /]/)[0]);
      const differ = new Set(agents).size === names.length;
      plot.show(names.map((name, index) => ({ name, label: labelOf(name), colour: differ ? colour(agents[index]) : hue(index) })));
    }
    show(this.empty, !this.names.length);
    this.draw();
  }

  /** Draws all plots again, in other colours. */
  restyle() {
    for (const plot of this.plots.values()) plot.close();
    this.plots.clear();
    this.#arrange();
  }

  /** Draws the moments that the timeline shows. */
  draw() {
    const { begin, end, t, live } = this.page.timeline;
    const seconds = Number(this.span.value) || Infinity;
    let to = live ? end : Math.min(end, t + seconds / 2);
    if (seconds === Infinity) to = end;
    const from = Math.max(begin, to - seconds);
    for (const plot of this.plots.values()) plot.draw(from, Math.max(to, from + 1));
  }
}

/** Returns what a number is, without whose it is: numbers of one kind share a plot. */
function kindOf(name) {
  const words = name.split(" ");
  return [...words.slice(1, -1), words.at(-1).replace(/\[\d+\]/g, "").split(".").at(-1)].join(" ");
}

/** Returns whose a number is, for the legend. */
function labelOf(name) {
  const [source, ...rest] = name.split(" ");
  const [agent, service, task] = source.split("/");
  const whose = !task ? agent.replace("~", " – ") : service === "device" ? agent : `${agent} ${task}`;
  const field = rest.at(-1);
  const inner = field.split(".").slice(0, -1).concat(field.match(/\[\d+\]/g) ?? []).join(" ").replace(/^bodies /, "");
  return inner ? `${whose} ${inner}` : whose;
}
