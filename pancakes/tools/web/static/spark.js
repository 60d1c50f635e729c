// A small line beside a figure on a card: the last minute of it.

import { h, set } from "./words.js";

const SPAN_S = 60;
const [WIDTH, HEIGHT, EDGE] = [64, 18, 2];
const SVG = "http://www.w3.org/2000/svg";

export class Spark {
  /**
   * @param {string} name The name of the series.
   * @param {string} about What it is, for people.
   * @param {(top: number) => number} top Returns the top of the scale from the largest value; the bottom is 0.
   * @param {Function} plot Plots the series.
   */
  constructor(name, about, top, plot) {
    this.name = name;
    this.top = top;
    this.path = document.createElementNS(SVG, "path");
    const svg = document.createElementNS(SVG, "svg");
    for (const [key, value] of Object.entries({ viewBox: `0 0 ${WIDTH} ${HEIGHT}`, width: WIDTH, height: HEIGHT, "aria-hidden": "true" })) svg.setAttribute(key, value);
    svg.append(this.path);
    this.root = h("button.spark", { type: "button", title: `Plot ${about}`, "aria-label": `Plot ${about}`, onclick: () => plot(name) }, svg);
  }

  /** Draws the minute before a moment. */
  draw({ t, v }, moment) {
    const from = moment - SPAN_S;
    let first = t.length;
    while (first > 0 && t[first - 1] >= from) first -= 1;
    let most = 0;
    for (let index = first; index < t.length && t[index] <= moment; index += 1) most = Math.max(most, v[index] ?? 0);
    const top = this.top(most);
    let [path, draws] = ["", false];
    for (let index = first; index < t.length && t[index] <= moment; index += 1) {
      const value = v[index];
      if (value === null) {
        draws = false;
        continue;
      }
      const x = EDGE + ((t[index] - from) / SPAN_S) * (WIDTH - 2 * EDGE);
      const y = HEIGHT - EDGE - (value / top) * (HEIGHT - 2 * EDGE);
      path += `${draws ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
      draws = true;
    }
    set(this.path, "d", path || "M0 0");
  }
}
