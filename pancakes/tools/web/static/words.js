// Formats words, figures and colours for people.

import { readable } from "./contrast.js";

const HUES = [212, 22, 152, 282, 48, 332, 186, 98, 252, 0];
const SATURATION = 72;
/** What agents' colours are read on: a panel, tinted a little with the colour itself. */
const LIGHT_PANEL = [0.95, 0.95, 0.95];
const DARK_PANEL = [0.15, 0.16, 0.19];

export const dark = window.matchMedia("(prefers-color-scheme: dark)");
export const still = window.matchMedia("(prefers-reduced-motion: reduce)");

const places = new Map();

const lightness = new Map();

/** Returns a colour of a row of colours that differ; it can be read in light and in dark mode. */
export function hue(place, alpha = 1) {
  const it = HUES[place % HUES.length];
  const key = `${it} ${dark.matches}`;
  if (!lightness.has(key)) {
    lightness.set(key, dark.matches ? readable(it, SATURATION, 66, DARK_PANEL) : readable(it, SATURATION, 45, LIGHT_PANEL));
  }
  return `hsl(${it} ${SATURATION}% ${lightness.get(key)}% / ${alpha})`;
}

/** Gives each agent a colour of its own, which stays the same. */
export function colour(name, alpha = 1) {
  if (!places.has(name)) places.set(name, places.size);
  return hue(places.get(name), alpha);
}

/** Mission time as minutes and seconds. */
export function clock(seconds) {
  const tenths = Math.max(0, Math.round(seconds * 10));
  const minutes = Math.floor(tenths / 600);
  return `${minutes}:${((tenths % 600) / 10).toFixed(1).padStart(4, "0")}`;
}

export function hertz(value) {
  if (value === null || value === undefined) return "–";
  return Number(value.toPrecision(3)).toString();
}

export function percent(share) {
  return `${Math.round(share * 100)} %`;
}

function age(seconds) {
  return seconds === null || seconds === undefined ? "" : ` ${seconds < 10 ? seconds.toFixed(1) : Math.round(seconds)} s`;
}

/** Returns which agents guard a task, and the age of each one's checkpoint. */
export function guardians({ by, wanted }) {
  if (by.length < wanted) return `not guarded: ${wanted} guardians are wanted`;
  return `guarded by ${by.map(([agent, seconds, answers]) => `${agent}${answers ? age(seconds) : " (silent)"}`).join(" · ")}`;
}

/** Returns how long a guarded task may still act. */
export function permit({ permit_s }) {
  return permit_s > 0 ? ` · permit ${permit_s.toFixed(1)} s` : " · no permit";
}

/** Makes an element: `h("p.dim", {title: "x"}, "text", child)`. */
export function h(what, attributes = {}, ...children) {
  const [tag, ...classes] = what.split(".");
  const element = document.createElement(tag || "div");
  if (classes.length) element.className = classes.join(" ");
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

/** Sets a text if it has changed, so that the browser does no layout for nothing. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function show(element, shown) {
  if (element.hidden === shown) element.hidden = !shown;
}

export function set(element, name, value) {
  if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}
