// One plot of numbers over time, with marks of migrations and failures, and a line at the moment that is shown.

import { valueAt } from "./series.js";
import { measured, tidy } from "./units.js";
import { clock, h, say } from "./words.js";

const HEIGHT = 128;
const MARK_PX = 5;
const FONT = "11px system-ui, sans-serif";

export class Plot {
  /**
   * @param {{title: string, unit: string}} about What the plot shows.
   * @param {{series: Series, clock: ClockLine, marks: Function, moment: Function, go: Function, remove: Function}} page
   *   Parts of the page: the points, mission time, the marks between two moments, the moment that is shown; goes to a
   *   moment; removes a series.
   */
  constructor({ title, unit }, page) {
    this.page = page;
    this.lines = [];
    this.drawn = null;
    this.legend = h("ul.legend");
    this.moment = h("span.dim.figure");
    this.title = h("h3", {}, title, unit ? h("small.dim", {}, ` ${unit}`) : "");
    this.box = h("div.plotbox");
    this.root = h("figure.plot", { "aria-label": `${title}${unit ? ` in ${unit}` : ""}` }, h("figcaption", {}, this.title, this.moment, this.legend), this.box);
    this.size = new ResizeObserver(() => this.drawn?.setSize({ width: this.#width(), height: HEIGHT }));
    this.size.observe(this.box);
  }

  /** Shows these lines: `[{name, label, colour}]`. */
  show(lines) {
    const key = JSON.stringify(lines);
    if (key === this.key) return;
    this.key = key;
    this.lines = lines;
    this.values = lines.map(() => h("b.figure"));
    this.legend.replaceChildren(...lines.map((line, index) => this.#entry(line, index)));
    this.drawn?.destroy();
    this.drawn = null;
  }

  #entry({ name, label, colour }, index) {
    const dot = h("i.dot");
    dot.style.background = colour;
    const remove = h("button.quiet", { type: "button", "aria-label": `Remove ${name}`, title: `Remove ${name}`, onclick: () => this.page.remove(name) }, "×");
    return h("li", { title: name }, dot, h("span", {}, label), this.values[index], remove);
  }

  close() {
    this.size.disconnect();
    this.drawn?.destroy();
    this.root.remove();
  }

  /** Draws the points between two moments. */
  draw(from, to) {
    [this.from, this.to] = [from, to];
    const known = this.lines.map(({ name }) => this.page.series.get(name)).map(({ t, v }) => visible(t, v, from, to));
    const data = window.uPlot.join(known.map(([t, v]) => (t.length ? [t, v] : [[to], [null]])));
    if (!this.drawn) {
      if (!this.#width()) return;
      this.drawn = new window.uPlot(this.#options(), data, this.box);
    } else {
      this.drawn.setData(data, false);
    }
    this.drawn.setScale("x", { min: from, max: to });
    this.tell();
  }

  /** Writes the values at the moment under the pointer, else at the moment that is shown. */
  tell() {
    const { left } = this.drawn?.cursor ?? {};
    const hovers = left !== undefined && left >= 0;
    const moment = hovers ? this.drawn.posToVal(left, "x") : this.page.moment();
    this.lines.forEach(({ name }, index) => {
      const series = this.page.series.get(name);
      say(this.values[index], series.t.length ? measured(valueAt(series, moment), series.unit) : "waiting …");
    });
    const near = hovers ? this.#markNear(left) : null;
    say(this.moment, near ? tidy(near.text) : hovers ? clock(this.page.clock.missionAt(moment)) : "");
  }

  #markNear(left) {
    const marks = this.page.marks(this.from, this.to);
    return marks.find(({ t }) => Math.abs(this.drawn.valToPos(t, "x") - left) <= MARK_PX) ?? null;
  }

  #width() {
    return this.box.clientWidth;
  }

  #options() {
    const style = getComputedStyle(this.root);
    const ink = style.getPropertyValue("--dim");
    const line = style.getPropertyValue("--line");
    const axis = { stroke: ink, font: FONT, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1, size: 4 } };
    const ticks = (u, from, to) => this.page.clock.ticks(from, to, Math.max(2, u.width / 90));
    return {
      width: this.#width(),
      height: HEIGHT,
      legend: { show: false },
      padding: [8, 10, 0, 0],
      cursor: { drag: { x: false, y: false }, y: false, points: { size: 6 }, sync: { key: "plots", setSeries: false } },
      scales: { x: { time: false }, y: { range: (u, low, high) => roomy(low, high) } },
      axes: [
        { ...axis, size: 24, gap: 2, splits: (u, _, from, to) => ticks(u, from, to).map(({ t }) => t), values: (u) => ticks(u, u.scales.x.min, u.scales.x.max).map(({ label }) => label) },
        { ...axis, size: 48, gap: 2, space: 26, values: (u, splits) => splits.map((it) => (it === null ? "" : `${Number(it.toPrecision(6))}`)) },
      ],
      series: [{}, ...this.lines.map(({ colour }) => ({ stroke: colour, width: 1.6, points: { show: false } }))],
      hooks: { draw: [(u) => this.#overlay(u)], setCursor: [() => this.drawn && this.tell()], ready: [(u) => this.#listen(u)] },
    };
  }

  #listen(u) {
    u.over.addEventListener("click", () => u.cursor.left >= 0 && this.page.go(u.posToVal(u.cursor.left, "x")));
  }

  #overlay(u) {
    const pen = u.ctx;
    const style = getComputedStyle(this.root);
    const { left, top, width, height } = u.bbox;
    const line = (t, colour, dash, wide) => {
      const x = Math.round(u.valToPos(t, "x", true));
      if (x < left || x > left + width) return;
      pen.strokeStyle = colour;
      pen.lineWidth = wide * devicePixelRatio;
      pen.setLineDash(dash.map((it) => it * devicePixelRatio));
      pen.beginPath();
      pen.moveTo(x, top);
      pen.lineTo(x, top + height);
      pen.stroke();
    };
    pen.save();
    for (const { t, kind } of this.page.marks(this.from, this.to)) line(t, style.getPropertyValue(kind === "move" ? "--move" : "--refused"), kind === "move" ? [] : [4, 3], 1.5);
    const moment = this.page.moment();
    if (moment < this.to - 0.05) line(moment, style.getPropertyValue("--ink"), [], 1.5);
    pen.restore();
  }
}

/** Returns the points between two moments, and one beyond each end, so that lines reach the edges. */
function visible(t, v, from, to) {
  let first = t.findIndex((it) => it >= from);
  if (first < 0) first = t.length;
  let last = first;
  while (last < t.length && t[last] <= to) last += 1;
  [first, last] = [Math.max(0, first - 1), Math.min(t.length, last + 1)];
  return [t.slice(first, last), v.slice(first, last)];
}

/** Returns a range with some room; a line that does not change is in the middle. */
function roomy(low, high) {
  if (low === null || high === null) return [0, 1];
  const room = low === high ? Math.max(Math.abs(low) * 0.05, 0.5) : 0.08 * (high - low);
  // What cannot be less than zero has an axis from zero, unless it is far from there.
  return [low >= 0 && low - room < 0.4 * high ? 0 : low - room, high + room];
}
