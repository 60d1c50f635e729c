// Draws the arena: robots, headings, trails, sensor rays, circles, sensor nodes; and messages about a migration.

import { Labels, around } from "./labels.js";
import { colour, dark, still } from "./words.js";

const MARGIN = 14;
const LEAST_RADIUS = 7;
const GLIDE_MS = 130;
const CROWD = 14;
const LINE = 14;

export class Arena {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.glides = new Map();
    this.bounds = null;
    this.layers = { trails: true, rays: true, circles: true, names: true };
    this.selected = "";
    this.labels = new Labels();
  }

  /** Remembers where bodies come from, so that they glide from one frame to the next. */
  moved(picture, now, jump) {
    for (const [name, body] of picture.table("body")) {
      const glide = this.glides.get(name);
      if (!glide || jump || still.matches) {
        this.glides.set(name, { from: body, to: body, since: now });
      } else if (glide.to !== body) {
        glide.from = this.#place(name, now);
        glide.to = body;
        glide.since = now;
      }
    }
  }

  #place(name, now) {
    const { from, to, since } = this.glides.get(name);
    const share = Math.min(1, (now - since) / GLIDE_MS);
    const turn = Math.atan2(Math.sin(to[2] - from[2]), Math.cos(to[2] - from[2]));
    return [from[0] + (to[0] - from[0]) * share, from[1] + (to[1] - from[1]) * share, from[2] + turn * share, to[3]];
  }

  draw(picture, effects, now) {
    const { pen } = this;
    const { width, height } = this.#fit(picture);
    const ink = dark.matches ? "255 255 255" : "30 34 42";
    this.ink = (alpha) => `rgb(${ink} / ${alpha})`;
    pen.clearRect(0, 0, width, height);
    this.labels.begin(width, height);
    this.#floor(picture);
    pen.save();
    this.#clip(picture);
    this.#motion(picture, now);
    if (this.layers.trails) this.#trails(picture);
    if (this.layers.rays) this.#rays(picture, now);
    pen.restore();
    if (this.layers.circles) this.#circles(picture);
    const names = [...picture.table("body").keys()].filter((name) => this.glides.has(name));
    for (const name of picture.table("dock").keys()) this.#dock(picture, name);
    for (const name of names) this.#body(picture, name, now);
    if (this.layers.names) {
      // The selected body comes first, so that its label always finds room.
      names.sort((one, other) => (other === this.selected) - (one === this.selected));
      for (const name of names) this.#name(picture, name, names.length > CROWD, now);
      if (this.layers.circles) this.#circleNames(picture);
    }
    this.labels.keep(new Set([...names, ...picture.table("circle").keys(), ...effects.map(keyOf)]));
    this.#effects(picture, effects, now);
  }

  /** Returns the body at a place of the canvas. */
  bodyAt(picture, x, y, now) {
    let found = "";
    let nearest = 22;
    for (const [name] of picture.table("body")) {
      const [bx, by] = this.#pixel(this.#place(name, now));
      const off = Math.hypot(bx - x, by - y);
      if (off < nearest) [found, nearest] = [name, off];
    }
    return found;
  }

  #fit(picture) {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const [x0, y0, x1, y1] = this.#extent(picture);
    this.scale = Math.max(1e-3, Math.min((width - 2 * MARGIN) / (x1 - x0), (height - 2 * MARGIN) / (y1 - y0)));
    this.middle = [width / 2 - (this.scale * (x0 + x1)) / 2, height / 2 + (this.scale * (y0 + y1)) / 2];
    return { width, height };
  }

  #extent(picture) {
    const arena = picture.get("arena");
    if (arena) {
      this.bounds = null;
      return [-arena[0] / 2, -arena[1] / 2, arena[0] / 2, arena[1] / 2];
    }
    let [x0, y0, x1, y1] = this.bounds || [-1, -1, 1, 1];
    for (const [x, y] of picture.table("body").values()) {
      [x0, y0, x1, y1] = [Math.min(x0, x - 0.5), Math.min(y0, y - 0.5), Math.max(x1, x + 0.5), Math.max(y1, y + 0.5)];
    }
    return (this.bounds = [x0, y0, x1, y1]);
  }

  #pixel([x, y]) {
    return [this.middle[0] + x * this.scale, this.middle[1] - y * this.scale];
  }

  #box(picture) {
    const [x0, y0, x1, y1] = this.#extent(picture);
    return [...this.#pixel([x0, y1]), ...this.#pixel([x1, y0])];
  }

  #clip(picture) {
    const [left, top, right, bottom] = this.#box(picture);
    this.pen.beginPath();
    this.pen.roundRect(left, top, right - left, bottom - top, 6);
    this.pen.clip();
  }

  #floor(picture) {
    const { pen } = this;
    const [x0, y0, x1, y1] = this.#extent(picture);
    const [left, top, right, bottom] = this.#box(picture);
    pen.fillStyle = this.ink(dark.matches ? 0.03 : 0.02);
    pen.beginPath();
    pen.roundRect(left, top, right - left, bottom - top, 6);
    pen.fill();
    const step = this.scale > 60 ? 0.5 : this.scale > 20 ? 1 : 5;
    pen.lineWidth = 1;
    pen.strokeStyle = this.ink(0.07);
    pen.beginPath();
    for (let x = Math.ceil(x0 / step) * step; x < x1; x += step) {
      const [px] = this.#pixel([x, 0]);
      pen.moveTo(px, top);
      pen.lineTo(px, bottom);
    }
    for (let y = Math.ceil(y0 / step) * step; y < y1; y += step) {
      const [, py] = this.#pixel([0, y]);
      pen.moveTo(left, py);
      pen.lineTo(right, py);
    }
    pen.stroke();
    if (picture.get("arena")) {
      pen.strokeStyle = this.ink(0.55);
      pen.lineWidth = 2;
      pen.beginPath();
      pen.roundRect(left, top, right - left, bottom - top, 6);
      pen.stroke();
    }
    this.#text(`${step} m`, left + 8, bottom - 8, this.ink(0.75), "11px system-ui", "left");
    this.labels.take(left + 8, bottom - 20, left + 44, bottom - 4);
  }

  #trails(picture) {
    const { pen } = this;
    pen.lineJoin = pen.lineCap = "round";
    pen.lineWidth = 2;
    for (const [name, points] of picture.trails) {
      if (points.length < 2) continue;
      const mover = picture.get("shape", name)?.kind === "mover";
      // Older parts are paler: three strokes, not one for each point.
      for (let part = 0; part < 3; part += 1) {
        const first = Math.floor((points.length * part) / 3);
        const last = Math.floor((points.length * (part + 1)) / 3);
        pen.strokeStyle = mover ? this.ink(0.1 + 0.08 * part) : colour(name, 0.3 + 0.25 * part);
        pen.beginPath();
        points.slice(Math.max(0, first - 1), last).forEach((point, index) => {
          const [x, y] = this.#pixel(point);
          if (index) pen.lineTo(x, y);
          else pen.moveTo(x, y);
        });
        pen.stroke();
      }
    }
  }

  #circles(picture) {
    const { pen } = this;
    for (const [name, [x, y, radius]] of picture.table("circle")) {
      const [agent, task] = name.split("/");
      const [px, py] = this.#pixel([x, y]);
      pen.setLineDash([5, 5]);
      pen.lineWidth = 1.5;
      pen.strokeStyle = colour(agent);
      pen.beginPath();
      pen.arc(px, py, radius * this.scale, 0, 2 * Math.PI);
      pen.stroke();
      pen.setLineDash([]);
    }
  }

  #circleNames(picture) {
    for (const [name, [x, y, radius]] of picture.table("circle")) {
      const [agent, task] = name.split("/");
      const [px, py] = this.#pixel([x, y]);
      const rows = [{ text: `${task} · ${radius} m`, style: colour(agent), font: "11px system-ui" }];
      const width = this.#widthOf(rows);
      const off = radius * this.scale;
      const above = [0, LINE, 2 * LINE].map((more) => [px, py - off - LINE / 2 - more]);
      const below = [0, LINE, 2 * LINE].map((more) => [px, py + off + LINE / 2 + more]);
      const beside = [[px + off + width / 2 + 4, py], [px - off - width / 2 - 4, py]];
      const inside = [[px, py - off + LINE / 2 + 2], [px, py + off - LINE / 2 - 2]];
      this.#label(name, rows, width, [above[0], below[0], ...above, ...below, ...beside, ...inside]);
    }
  }

  #motion(picture, now) {
    const { pen } = this;
    for (const [name, [detected, bearing, range]] of picture.table("motion")) {
      if (!this.glides.has(name) || !picture.get("body", name)) continue;
      const body = this.#place(name, now);
      const [x, y] = this.#pixel(body);
      const reach = (picture.get("shape", name)?.range_m || 1) * this.scale;
      const glow = pen.createRadialGradient(x, y, 0, x, y, reach);
      glow.addColorStop(0, colour(name, detected ? 0.16 : 0.05));
      glow.addColorStop(1, colour(name, 0));
      pen.fillStyle = glow;
      pen.beginPath();
      pen.arc(x, y, reach, 0, 2 * Math.PI);
      pen.fill();
      if (!detected) continue;
      const wave = still.matches ? 0.5 : (now / 1600) % 1;
      pen.strokeStyle = colour(name, 0.5 * (1 - wave));
      pen.lineWidth = 1.5;
      pen.beginPath();
      pen.arc(x, y, 12 + wave * 34, 0, 2 * Math.PI);
      pen.stroke();
      if (bearing === null || range === null) continue;
      const seen = [body[0] + range * Math.cos(body[2] + bearing), body[1] + range * Math.sin(body[2] + bearing)];
      this.#line([x, y], this.#pixel(seen), colour(name, 0.6), 1.5);
    }
  }

  #rays(picture, now) {
    for (const [key, ranges] of picture.table("rays")) {
      const [agent, type] = key.split("/");
      const ring = picture.get("ring", key);
      if (!ring || !picture.get("body", agent)) continue;
      const body = this.#place(agent, now);
      // Rings measure from the edge of the body. Where a laser scanner stands, is known of simulated robots.
      const shape = picture.get("shape", agent);
      const [edge, ahead] = type === "laser_scan" ? [0, shape?.laser_m || 0] : [shape?.radius_m || 0.07, 0];
      const middle = [body[0] + ahead * Math.cos(body[2]), body[1] + ahead * Math.sin(body[2])];
      ranges.forEach((range, index) => {
        const angle = body[2] + ring.bearings_rad[index];
        const hit = range < ring.max_m * 0.97;
        const from = this.#pixel([middle[0] + edge * Math.cos(angle), middle[1] + edge * Math.sin(angle)]);
        const end = this.#pixel([
          middle[0] + (edge + range) * Math.cos(angle),
          middle[1] + (edge + range) * Math.sin(angle),
        ]);
        const near = type === "ir";
        this.#line(from, end, colour(agent, near ? (hit ? 0.95 : 0.4) : hit ? 0.24 : 0.1), near ? 1.6 : 1);
        if (!hit) return;
        this.pen.fillStyle = colour(agent, near ? 1 : 0.55);
        this.pen.beginPath();
        this.pen.arc(end[0], end[1], near ? 2.4 : 1.8, 0, 2 * Math.PI);
        this.pen.fill();
      });
    }
  }

  /** A dock is a frame, full while it charges a robot, dashed while it is free. */
  #dock(picture, name) {
    const { pen } = this;
    const [x_m, y_m, state, robot] = picture.get("dock", name);
    const [x, y] = this.#pixel([x_m, y_m]);
    const half = Math.max(LEAST_RADIUS, 0.1 * this.scale);
    pen.save();
    pen.lineWidth = 2;
    pen.strokeStyle = robot ? colour(robot) : this.ink(0.5);
    pen.setLineDash(state === "free" ? [4, 3] : []);
    pen.beginPath();
    pen.roundRect(x - half, y - half, 2 * half, 2 * half, 4);
    if (state === "charging") {
      pen.fillStyle = colour(robot, 0.25);
      pen.fill();
    }
    pen.stroke();
    pen.restore();
    if (this.layers.names) this.#text(name, x, y - half - 6, this.ink(0.75), "11px system-ui");
  }

  #body(picture, name, now) {
    const { pen } = this;
    const body = this.#place(name, now);
    const shape = picture.get("shape", name) || { kind: "robot" };
    const [x, y] = this.#pixel(body);
    const radius = Math.max(LEAST_RADIUS, (shape.radius_m || 0.07) * this.scale);
    pen.save();
    pen.translate(x, y);
    if (name === this.selected) {
      pen.strokeStyle = this.ink(0.8);
      pen.lineWidth = 1.5;
      pen.beginPath();
      pen.arc(0, 0, radius + 6, 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.rotate(-body[2]);
    pen.fillStyle = shape.kind === "mover" ? this.ink(0.55) : colour(name);
    pen.strokeStyle = dark.matches ? "rgb(14 16 20 / .9)" : "rgb(255 255 255 / .95)";
    pen.lineWidth = 2;
    pen.beginPath();
    if (shape.kind === "sensor") pen.roundRect(-radius, -radius, 2 * radius, 2 * radius, 4);
    else pen.arc(0, 0, radius, 0, 2 * Math.PI);
    pen.fill();
    pen.stroke();
    if (shape.kind === "robot") {
      pen.fillStyle = dark.matches ? "rgb(14 16 20 / .85)" : "rgb(255 255 255 / .95)";
      pen.beginPath();
      pen.moveTo(radius * 0.78, 0);
      pen.lineTo(-radius * 0.42, radius * 0.5);
      pen.lineTo(-radius * 0.16, 0);
      pen.lineTo(-radius * 0.42, -radius * 0.5);
      pen.closePath();
      pen.fill();
    } else if (shape.kind === "sensor") {
      pen.fillStyle = dark.matches ? "rgb(14 16 20 / .85)" : "rgb(255 255 255 / .95)";
      pen.beginPath();
      pen.arc(0, 0, radius * 0.36, 0, 2 * Math.PI);
      pen.fill();
    }
    pen.restore();
    this.labels.avoid(x - radius, y - radius, x + radius, y + radius);
  }

  /** Writes the name of a body, and what drives it. */
  #name(picture, name, crowd, now) {
    const body = this.#place(name, now);
    const shape = picture.get("shape", name) || { kind: "robot" };
    const [x, y] = this.#pixel(body);
    const radius = Math.max(LEAST_RADIUS, (shape.radius_m || 0.07) * this.scale);
    const style = shape.kind === "mover" ? this.ink(0.75) : colour(name);
    const rows = [{ text: name, style, font: crowd ? "10px system-ui" : "600 12px system-ui" }];
    if (body[3] && (!crowd || name === this.selected)) rows.push({ text: body[3], style: this.ink(0.75), font: "11px system-ui" });
    const width = this.#widthOf(rows);
    const middles = around(x, y, radius + 3, width, rows.length * LINE);
    const middle = this.#label(name, rows, width, middles);
    // A label that is further away gets a line to its body.
    const nearest = Math.hypot(width / 2, (rows.length * LINE) / 2) + radius + LINE;
    if (middle && Math.hypot(middle[0] - x, middle[1] - y) > nearest) this.#line([x, y], middle, this.ink(0.12), 1);
  }

  #widthOf(rows) {
    return Math.max(
      ...rows.map(({ text, font }) => {
        this.pen.font = font;
        return this.pen.measureText(text).width;
      }),
    );
  }

  /** Writes rows of text where there is room; returns their middle, or null if there is no room. */
  #label(key, rows, width, middles) {
    const middle = this.labels.place(key, width, rows.length * LINE, middles);
    if (!middle) return null;
    const top = middle[1] - (rows.length * LINE) / 2;
    rows.forEach(({ text, style, font }, row) => this.#text(text, middle[0], top + row * LINE + 11, style, font));
    return middle;
  }

  #effects(picture, effects, now) {
    for (const effect of effects) {
      const age = (now - effect.since) / effect.lasts;
      if (age >= 1 || !this.glides.has(effect.from) || !this.glides.has(effect.to)) continue;
      const from = this.#pixel(this.#place(effect.from, now));
      const to = this.#pixel(this.#place(effect.to, now));
      drawMessage(this.pen, from, to, effect, age, this.labels);
    }
  }

  #line(from, to, style, width) {
    this.pen.strokeStyle = style;
    this.pen.lineWidth = width;
    this.pen.beginPath();
    this.pen.moveTo(...from);
    this.pen.lineTo(...to);
    this.pen.stroke();
  }

  #text(text, x, y, style, font, align = "center") {
    const { pen } = this;
    pen.font = font;
    pen.textAlign = align;
    pen.lineWidth = 3;
    pen.lineJoin = "round";
    pen.strokeStyle = dark.matches ? "rgb(20 22 27 / .8)" : "rgb(255 255 255 / .85)";
    pen.strokeText(text, x, y);
    pen.fillStyle = style;
    pen.fillText(text, x, y);
  }
}

/** Draws a message between two agents about a migration: a line, a dot that travels, and the text if there is room. */
export function drawMessage(pen, from, to, effect, age, labels) {
  const fade = age < 0.75 ? 1 : (1 - age) / 0.25;
  // Labels of messages avoid the labels drawn before them.
  const middle = [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2 + (effect.strong ? 56 : -32)];
  const at = bow(from, middle, to, Math.min(1, age * 3));
  pen.globalAlpha = fade;
  pen.strokeStyle = pen.fillStyle = effect.colour;
  pen.lineWidth = effect.strong ? 3 : 1.8;
  pen.setLineDash(effect.strong ? [] : [6, 4]);
  pen.beginPath();
  pen.moveTo(...from);
  pen.quadraticCurveTo(...middle, ...to);
  pen.stroke();
  pen.setLineDash([]);
  pen.beginPath();
  pen.arc(at[0], at[1], effect.strong ? 7 : 5, 0, 2 * Math.PI);
  pen.fill();
  if (effect.text) {
    pen.font = "600 12px system-ui";
    pen.textAlign = "center";
    const width = pen.measureText(effect.text).width + 14;
    // A message stands near its sender.
    const first = effect.strong ? 0.36 : 0.3;
    const shares = [first, 0.45, 0.15, 0.6, 0.75, 0];
    const middles = shares.flatMap((share) => {
      const [left, top] = bow(from, middle, to, share);
      return [0, -24, 24, -48, 48].map((more) => [left, top + more]);
    });
    middles.push(...around(...bow(from, middle, to, first), 6, width, 20));
    const place = labels ? labels.place(keyOf(effect), width, 22, middles) : middles[0];
    if (place) bubble(pen, effect.text, place, width);
  }
  pen.globalAlpha = 1;
}

function bubble(pen, text, [x, y], width) {
  pen.beginPath();
  pen.roundRect(x - width / 2, y - 11, width, 20, 10);
  pen.fill();
  pen.fillStyle = dark.matches ? "#101216" : "#fff";
  pen.fillText(text, x, y + 3.5);
}

function keyOf(effect) {
  return `${effect.from}>${effect.to}>${effect.text}`;
}

/** Returns a point of a quadratic curve, from 0 at its beginning to 1 at its end. */
function bow(from, middle, to, share) {
  const rest = 1 - share;
  return [0, 1].map((axis) => rest ** 2 * from[axis] + 2 * rest * share * middle[axis] + share ** 2 * to[axis]);
}

/** Describes the arena in words, for screen readers. */
export function inWords(picture) {
  const bodies = [...picture.table("body")].map(([name, [x, y, , task]]) => {
    return `${name} at ${x.toFixed(1)}, ${y.toFixed(1)} m${task ? `, driven by ${task}` : ""}`;
  });
  if (bodies.length) return `Arena: ${bodies.slice(0, 12).join("; ")}`;
  const agents = picture.agents();
  const tasks = agents.map((name) => {
    const running = picture.runs(name);
    return `${name} runs ${running === 1 ? "1 task" : `${running} tasks`}`;
  });
  return agents.length ? `Mesh of ${agents.length} agents: ${tasks.slice(0, 12).join("; ")}` : "Nothing is there yet";
}
