// The mesh: agents as dots on a ring, their links with the round trips.

import { drawMessage } from "./arena.js";
import { colour, dark } from "./words.js";

const LABELLED = 14;
const LINKS_LABELLED = 7;
const AGAIN_MS = 250;

export class Mesh {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.selected = "";
    this.places = new Map();
    this.drawn = "";
    this.drawnAt = 0;
  }

  draw(picture, effects, now) {
    const { canvas, pen } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    // A thousand links are not drawn more often than they change.
    const drawn = `${width} ${height} ${ratio} ${this.selected} ${dark.matches}`;
    if (!effects.length && drawn === this.drawn && now - this.drawnAt < AGAIN_MS) return;
    [this.drawn, this.drawnAt] = [effects.length ? "" : drawn, now];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const ink = dark.matches ? "255 255 255" : "30 34 42";
    const agents = picture.agents();
    this.#lay(agents, width, height);
    const few = agents.length <= LABELLED;
    const links = [...picture.table("link")];
    if (few) this.#lines(links, false, `rgb(${ink} / 0.22)`, 2);
    else for (const name of agents) this.#lines(links.filter(([pair]) => pair.startsWith(`${name}/`)), false, `rgb(${ink} / 0.07)`, 0.7);
    this.#lines(links, true, `rgb(${ink} / 0.7)`, 2);
    pen.font = "11px system-ui";
    pen.textAlign = "center";
    for (const [pair, ms] of links) {
      const names = pair.split("/");
      const [one, other] = names.map((name) => this.places.get(name));
      const labelled = agents.length <= LINKS_LABELLED || names.includes(this.selected);
      if (!one || !other || ms < 0 || !labelled) continue;
      // Not in the middle, where all links cross.
      const [x, y] = [one[0] * 0.64 + other[0] * 0.36, one[1] * 0.64 + other[1] * 0.36];
      const text = `${ms} ms`;
      pen.fillStyle = dark.matches ? "#16181d" : "#fff";
      const wide = pen.measureText(text).width + 8;
      pen.fillRect(x - wide / 2, y - 8, wide, 16);
      pen.fillStyle = `rgb(${ink} / .75)`;
      pen.fillText(text, x, y + 4);
    }
    for (const name of agents) this.#agent(picture, name, ink, few, [width / 2, height / 2]);
    for (const effect of effects) {
      const age = (now - effect.since) / effect.lasts;
      const [from, to] = [this.places.get(effect.from), this.places.get(effect.to)];
      if (age < 1 && from && to) drawMessage(pen, from, to, effect, age);
    }
  }

  bodyAt(picture, x, y) {
    for (const [name, [px, py]] of this.places) if (Math.hypot(px - x, py - y) < 24) return name;
    return "";
  }

  #lay(agents, width, height) {
    this.places.clear();
    const [rx, ry] = [Math.max(30, width / 2 - 70), Math.max(30, height / 2 - 42)];
    agents.forEach((name, index) => {
      const angle = (2 * Math.PI * index) / agents.length - Math.PI / 2;
      const off = agents.length === 1 ? 0 : 1;
      this.places.set(name, [width / 2 + off * rx * Math.cos(angle), height / 2 + off * ry * Math.sin(angle)]);
    });
  }

  #lines(links, picked, style, width) {
    const { pen } = this;
    pen.strokeStyle = style;
    pen.lineWidth = width;
    pen.beginPath();
    for (const [pair] of links) {
      const names = pair.split("/");
      const [one, other] = names.map((name) => this.places.get(name));
      if (!one || !other || names.includes(this.selected) !== picked) continue;
      pen.moveTo(...one);
      pen.lineTo(...other);
    }
    pen.stroke();
  }

  #agent(picture, name, ink, few, middle) {
    const { pen } = this;
    const [x, y] = this.places.get(name);
    const row = picture.get("agent", name);
    const radius = few ? 14 : 8;
    pen.globalAlpha = row.state === "no answer" ? 0.35 : 1;
    pen.fillStyle = colour(name);
    pen.beginPath();
    if (row.role === "agent") pen.arc(x, y, radius, 0, 2 * Math.PI);
    else pen.roundRect(x - radius, y - radius, 2 * radius, 2 * radius, 4);
    pen.fill();
    if (name === this.selected) {
      pen.strokeStyle = `rgb(${ink} / .85)`;
      pen.lineWidth = 2;
      pen.beginPath();
      pen.arc(x, y, radius + 5, 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.fillStyle = `rgb(${ink} / .85)`;
    pen.font = few ? "600 13px system-ui" : "11px system-ui";
    const outward = Math.atan2(y - middle[1], x - middle[0]);
    pen.textAlign = few || Math.abs(Math.cos(outward)) < 0.35 ? "center" : Math.cos(outward) > 0 ? "left" : "right";
    const side = pen.textAlign === "center" ? 0 : Math.cos(outward) > 0 ? radius + 5 : -radius - 5;
    const below = few ? radius + 17 : pen.textAlign === "center" ? (y < middle[1] ? -radius - 5 : radius + 13) : 4;
    pen.fillText(name, x + side, y + below);
    pen.globalAlpha = 1;
  }
}
