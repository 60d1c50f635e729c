// One setting or rate of a task: its description, and its control if the page may change it.

import { h, say, set, show } from "./words.js";

const LONG = 60;
/** The number of steps of a slider. */
const STEPS = 200;
let made = 0;

export class SettingField {
  /**
   * @param {object} field The field from the server, see `fields_of` in pancakes/tools/web/orders.py.
   * @param {boolean} editable Whether the page may change it.
   */
  constructor(field, editable) {
    this.field = field;
    this.editable = editable && !field.fixed;
    const id = `field-${++made}`;
    this.help = h("p.help.dim", { id: `${id}-help` });
    this.refusal = h("p.refusal.warn", { id: `${id}-refusal`, hidden: true });
    this.control = this.editable ? this.#control(id) : h("span.figure.value");
    this.touched = false;
    this.control.addEventListener("input", () => (this.touched = true));
    const name = [field.name, ...(field.unit ? [h("span.dim", {}, ` ${field.unit}`)] : [])];
    // A slider only repeats the number beside it: keyboards and screen readers use the number.
    this.slider = this.editable && this.#slides() ? this.#slider() : null;
    this.root = h(
      "div.field",
      { "data-setting": field.name, "data-kind": field.kind },
      this.editable ? h("label", { for: id }, ...name) : h("span.label", {}, ...name),
      h("div.inputs", {}, ...(this.slider ? [this.slider] : []), this.control),
      this.help,
      this.refusal,
    );
    set(this.control, "aria-describedby", `${id}-help ${id}-refusal`);
    this.#explain();
    this.reset();
  }

  /** Returns whether the person has changed it. */
  get changed() {
    if (!this.editable || !this.touched) return false;
    try {
      return JSON.stringify(this.value()) !== JSON.stringify(this.field.value);
    } catch {
      return true;
    }
  }

  /** Returns the value that the person entered; throws a sentence if it is not a value. */
  value() {
    const { kind, nullable, choices } = this.field;
    if (kind === "boolean") return this.control.checked;
    if (kind === "choice") return choices[Number(this.control.value)];
    const text = this.control.value;
    const isNumber = kind === "number" || kind === "integer";
    if (isNumber && (this.control.validity.badInput || (text === "" && !nullable))) throw "enter a number";
    if (text === "" && nullable) return null;
    if (kind === "number") return Number(text);
    if (kind === "text") return text;
    const value = kind === "integer" ? Number(text) : parsed(text);
    if (inexact(value)) throw "a browser cannot represent this integer exactly: use pancakes param set";
    return value;
  }

  /** Takes the agent's present value, but keeps what the person has changed. */
  update(field) {
    const keep = this.changed;
    this.field = field;
    this.#explain();
    if (!keep) this.reset();
  }

  /** Shows the present value. */
  reset() {
    const { kind, value, choices } = this.field;
    this.refuse("");
    this.touched = false;
    if (!this.editable) say(this.control, this.field.fixed ? value : words(value));
    else if (kind === "boolean") this.control.checked = value;
    else if (kind === "choice") this.control.value = String(choices.findIndex((it) => it === value));
    else put(this.control, value === null ? "" : kind === "json" ? JSON.stringify(value) : String(value));
    this.#follow();
  }

  /** Shows beside the control what is wrong with its value; empty: nothing. */
  refuse(text) {
    say(this.refusal, text);
    show(this.refusal, Boolean(text));
    if (text) set(this.control, "aria-invalid", "true");
    else this.control.removeAttribute("aria-invalid");
  }

  #control(id) {
    const { kind, value, min, max, choices, nullable } = this.field;
    const other = nullable ? "nothing" : null;
    if (kind === "boolean") return h("input", { id, type: "checkbox" });
    if (kind === "choice") return h("select", { id }, ...choices.map((it, index) => h("option", { value: index }, words(it))));
    if (kind === "number" || kind === "integer") {
      const step = kind === "integer" ? 1 : "any";
      const box = h("input", { id, type: "number", min, max, step, inputmode: kind === "integer" ? "numeric" : "decimal", placeholder: other });
      box.addEventListener("input", () => this.#follow());
      return box;
    }
    const text = kind === "json" ? JSON.stringify(value) : value || "";
    if (kind === "text" && text.length <= LONG && !text.includes("\n")) return h("input", { id, type: "text", placeholder: other });
    const rows = Math.min(8, Math.max(1, Math.ceil(text.length / LONG)));
    return h("textarea", { id, rows, placeholder: other, spellcheck: "false" });
  }

  #slides() {
    const { kind, min, max, nullable } = this.field;
    return (kind === "number" || kind === "integer") && min !== undefined && max !== undefined && max > min && !nullable;
  }

  #slider() {
    const { kind, min, max } = this.field;
    const digits = Math.max(0, Math.ceil(-Math.log10((max - min) / STEPS)));
    const slider = h("input", { type: "range", min, max, step: kind === "integer" ? 1 : "any", tabindex: -1, "aria-hidden": "true" });
    slider.addEventListener("input", () => {
      this.touched = true;
      this.control.value = String(Number(Number(slider.value).toFixed(kind === "integer" ? 0 : digits)));
    });
    return slider;
  }

  #follow() {
    if (this.slider && this.control.value !== "") this.slider.value = this.control.value;
  }

  #explain() {
    const { description, type, bounds, fixed, kind } = this.field;
    const within = bounds.replaceAll(">=", "≥").replaceAll("<=", "≤");
    const what = `${type}${within ? `, ${within}` : ""}${kind === "json" && this.editable ? ", as JSON" : ""}`;
    const usual = this.field.default === undefined ? "" : `default ${words(this.field.default)}`;
    const stays = fixed ? `not changed here: ${fixed}` : "";
    say(this.help, [description.replace(/\.$/, ""), what, usual, stays].filter(Boolean).join(" · "));
  }
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch (error) {
    throw `this is not JSON: ${error.message}`;
  }
}

/** Returns whether a value contains an integer that the browser may have rounded. */
function inexact(value) {
  if (typeof value === "number") return Number.isInteger(value) && !Number.isSafeInteger(value);
  return value !== null && typeof value === "object" && Object.values(value).some(inexact);
}

function put(control, text) {
  if (control.value !== text) control.value = text;
}

/** Formats a value for people. */
function words(value) {
  if (value === null || value === undefined) return "nothing";
  return typeof value === "string" ? value || "(empty)" : JSON.stringify(value);
}
