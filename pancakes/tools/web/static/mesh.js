// Draws the mesh: agents as dots on a ring, and their links with the round-trip times.

import { drawMessage } from "./arena.js";
import { colour, dark } from "./words.js";

const LABELLED = 14;
const LINKS_LABELLED = 7;
const AGAIN_MS = 250;
const NEAR_PX = 24;
const DOT_PX = 14;
const CROWDED_DOT_PX = 8;
const NAME_PX = 84;
const ROUND_TRIP_PX = 44;

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
    // Drawing a thousand links is slow, so an unchanged picture is drawn only every AGAIN_MS.
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
    const few = agents.length <= LABELLED;
    this.#lay(agents, width, height, few);
    const links = [...picture.table("link")];
    if (few) this.#lines(links, false, `rgb(${ink} / 0.55)`, 1.5);
    else for (const name of agents) this.#lines(links.filter(([pair]) => pair.startsWith(`${name}/`)), false, `rgb(${ink} / 0.07)`, 0.7);
    this.#lines(links, true, `rgb(${ink} / ${few ? 0.85 : 0.6})`, few ? 2.5 : 1);
    pen.font = "11px system-ui";
    pen.textAlign = "center";
    for (const [pair, ms] of links) {
      const names = pair.split("/");
      const [one, other] = names.map((name) => this.places.get(name));
      const labelled = agents.length <= LINKS_LABELLED || (few && names.includes(this.selected));
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
    // With many agents, the round trips of the selected one stand beside the names of the others.
    const trips = few ? new Map() : new Map(links.filter(([pair, ms]) => ms >= 0 && pair.split("/").includes(this.selected)).map(([pair, ms]) => [pair.split("/").find((name) => name !== this.selected), ms]));
    for (const name of agents) this.#agent(picture, name, ink, few, [width / 2, height / 2], trips.get(name));
    for (const effect of effects) {
      const age = (now - effect.since) / effect.lasts;
      const [from, to] = [this.places.get(effect.from), this.places.get(effect.to)];
      if (age < 1 && from && to) drawMessage(pen, from, to, effect, age);
    }
  }

  bodyAt(picture, x, y) {
    let [found, nearest] = ["", NEAR_PX];
    for (const [name, [px, py]] of this.places) {
      const away = Math.hypot(px - x, py - y);
      if (away < nearest) [found, nearest] = [name, away];
    }
    return found;
  }

  #lay(agents, width, height, few) {
    this.places.clear();
    let [beside, above] = [70, 42];
    this.radius = DOT_PX;
    if (!few) {
      // Names point outward, so that there is room for many, and for a round trip behind each.
      this.pen.font = "11px system-ui";
      this.texts = new Map(agents.map((name) => [name, this.#short(name)]));
      const widest = Math.max(...[...this.texts.values()].map((text) => this.pen.measureText(text).width));
      beside = above = Math.min(widest + ROUND_TRIP_PX + 20, 0.34 * Math.min(width, height));
    }
    const [rx, ry] = [Math.max(30, width / 2 - beside), Math.max(30, height / 2 - above)];
    if (!few) this.radius = Math.min(CROWDED_DOT_PX, Math.max(3, (Math.PI * Math.min(rx, ry)) / agents.length));
    agents.forEach((name, index) => {
      const angle = (2 * Math.PI * index) / agents.length - Math.PI / 2;
      const off = agents.length === 1 ? 0 : 1;
      this.places.set(name, [width / 2 + off * rx * Math.cos(angle), height / 2 + off * ry * Math.sin(angle)]);
    });
  }

  /** Shortens a name to the room for it. */
  #short(name) {
    let text = name;
    while (text.length > 2 && this.pen.measureText(text).width > NAME_PX) text = `${text.slice(0, -2)}…`;
    return text;
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

  #agent(picture, name, ink, few, middle, trip) {
    const { pen, radius } = this;
    const [x, y] = this.places.get(name);
    const row = picture.get("agent", name);
    pen.globalAlpha = row.state === "no answer" ? 0.35 : 1;
    pen.fillStyle = colour(name);
    pen.beginPath();
    if (row.role === "agent") pen.arc(x, y, radius, 0, 2 * Math.PI);
    else pen.roundRect(x - radius, y - radius, 2 * radius, 2 * radius, Math.min(4, radius / 2));
    pen.fill();
    if (name === this.selected) {
      pen.strokeStyle = `rgb(${ink} / .85)`;
      pen.lineWidth = 2;
      pen.beginPath();
      pen.arc(x, y, radius + (few ? 5 : 3), 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.fillStyle = `rgb(${ink} / .85)`;
    if (few) {
      pen.font = "600 13px system-ui";
      pen.textAlign = "center";
      pen.fillText(name, x, y + radius + 17);
    } else this.#outward(name, [x, y], middle, ink, trip);
    pen.globalAlpha = 1;
  }

  /** Writes a name along the line from the middle, never upside down, and the round trip behind it. */
  #outward(name, [x, y], middle, ink, trip) {
    const { pen } = this;
    const angle = Math.atan2(y - middle[1], x - middle[0]);
    const left = Math.cos(angle) < -1e-6;
    const text = this.texts.get(name);
    pen.save();
    pen.translate(x, y);
    pen.rotate(left ? angle + Math.PI : angle);
    pen.textAlign = left ? "right" : "left";
    const side = left ? -1 : 1;
    const from = side * (this.radius + 5);
    pen.font = `${name === this.selected ? "600 " : ""}11px system-ui`;
    pen.fillText(text, from, 4);
    if (trip !== undefined) {
      const wide = pen.measureText(text).width;
      pen.fillStyle = `rgb(${ink} / .75)`;
      pen.font = "10px system-ui";
      pen.fillText(`${trip} ms`, from + side * (wide + 5), 4);
    }
    pen.restore();
  }
}
