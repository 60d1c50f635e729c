// The pad with which a person drives a robot by hand: a pointer, or held keys, become velocities.

import { rounded } from "./units.js";
import { h, say, show } from "./words.js";

/** A command is sent so often, or more often if the robot would stop before. */
const SEND_MS = 100;
/** The answer to a command is awaited this long: the robot has stopped by then. */
const ANSWER_MS = 1000;
/** A pointer that is nearer to the centre than this share of the radius is at the centre. */
const DEAD = 0.1;
const KEYS = {
  arrowup: [1, 0], arrowdown: [-1, 0], arrowleft: [0, 1], arrowright: [0, -1],
  w: [1, 0], s: [-1, 0], a: [0, 1], d: [0, -1],
};
const STILL = [0, 0];

export class DrivePad {
  #leave = null;
  #timer = 0;

  /**
   * @param {Link} link Asks the server.
   * @param {string} agent The agent.
   * @param {string} device The actuator on it.
   */
  constructor(link, agent, device) {
    [this.link, this.agent, this.device] = [link, agent, device];
    this.id = "";
    this.busy = false;
    this.hand = STILL;
    this.held = new Set();
    this.driver = "";
    this.speed = number("Speed", 0.2, "m/s");
    this.turn = number("Turning rate", 1, "rad/s");
    this.button = h("button", { type: "button", onclick: () => (this.id ? this.end() : this.#begin()) });
    this.dot = h("span.dot");
    this.pad = h("div.pad", { tabindex: 0, role: "application", "aria-label": "Drag to drive, or hold arrow keys or W A S D; escape ends it" }, this.dot);
    this.said = h("p.said", { role: "status" });
    this.root = h("section.drive", { "aria-label": "Drive by hand" }, h("h3", {}, "Drive by hand"), h("div.inputs", {}, this.speed.root, this.turn.root, this.button), this.pad, this.said);
    this.#listen();
    this.render(false, "");
  }

  /** Shows the pad if this person may drive, and who does. */
  render(may, driver) {
    this.driver = driver || "";
    if (!may && this.id) this.end();
    show(this.root, may);
    show(this.pad, Boolean(this.id));
    say(this.button, this.id ? "End the drive" : this.driver ? `Take over from ${this.driver}` : "Drive");
  }

  #listen() {
    const { pad } = this;
    const at = (event) => {
      const { left, top, width, height } = pad.getBoundingClientRect();
      return [(event.clientX - left) / (width / 2) - 1, (event.clientY - top) / (height / 2) - 1];
    };
    pad.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      pad.setPointerCapture(event.pointerId);
      this.#hold(at(event));
    });
    pad.addEventListener("pointermove", (event) => pad.hasPointerCapture(event.pointerId) && this.#hold(at(event)));
    pad.addEventListener("lostpointercapture", () => this.#hold(STILL));
    pad.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return; // a key of the browser
      const key = event.key.toLowerCase();
      if (key === "escape") this.end();
      else if (key in KEYS) this.held.add(key);
      else if (key === " ") this.held.clear();
      else return;
      // The page has keys of its own.
      event.preventDefault();
      event.stopPropagation();
    });
    pad.addEventListener("keyup", (event) => this.held.delete(event.key.toLowerCase()));
    pad.addEventListener("blur", () => this.held.clear());
  }

  #hold([x, y]) {
    const length = Math.hypot(x, y);
    const most = length > 1 ? 1 / length : 1;
    this.hand = length < DEAD ? STILL : [0 - y * most, 0 - x * most];
    this.dot.style.translate = length < DEAD ? "" : `${50 * x * most}% ${50 * y * most}%`;
  }

  /** Returns forward speed and turning rate that the hand wants. */
  #velocity() {
    const keys = [...this.held].map((key) => KEYS[key]);
    const [forward, turn] = keys.length ? keys.reduce(([a, b], [c, d]) => [clamped(a + c), clamped(b + d)], STILL) : this.hand;
    return { v_mps: forward * this.speed.value(), omega_radps: turn * this.turn.value() };
  }

  async #begin() {
    const id = [...crypto.getRandomValues(new Uint8Array(8))].map((it) => it.toString(16).padStart(2, "0")).join("");
    this.#tell("asking …");
    this.button.disabled = true;
    const { ok, reason, result } = await this.#order("drive", { drive: id, begin: true, take: this.driver !== "" });
    this.button.disabled = false;
    if (!ok) {
      this.#tell(reason, true);
      return;
    }
    this.id = id;
    this.unanswered = false;
    this.render(true, this.driver);
    this.pad.focus();
    this.paused = result.paused;
    this.#leave = new AbortController();
    const { signal } = this.#leave;
    // A page that nobody sees must not drive, and its timers are slow.
    document.addEventListener("visibilitychange", () => document.hidden && this.end(), { signal });
    window.addEventListener("pagehide", () => this.end(), { signal });
    this.#timer = setInterval(() => this.#send(id), Math.min(SEND_MS, 250 * result.stop_after_s));
    if (document.hidden) this.end();
    else this.#send(id);
  }

  #order(what, fields) {
    return this.link.ask("order", { do: what, agent: this.agent, device: this.device, ...fields });
  }

  /** Sends one command, unless one is on its way: on a slow link none must wait behind another. */
  async #send(id) {
    if (this.busy || this.id !== id) return;
    if (!this.root.closest("dialog")?.open) {
      this.end();
      return;
    }
    this.busy = true;
    // The link may deliver all that were sent without an answer, one after the other, when nobody wants them any more.
    const velocity = this.unanswered ? { v_mps: 0, omega_radps: 0 } : this.#velocity();
    const late = new Promise((resolve) => setTimeout(() => resolve(null), ANSWER_MS));
    const answer = await Promise.race([this.#order("drive", { drive: id, ...velocity }), late]);
    this.busy = false;
    if (this.id !== id) return;
    this.unanswered = answer === null;
    if (answer === null) this.#tell(`${this.agent} does not answer: it stops by itself`, true);
    else if (answer.ok) this.#tell(this.#line(velocity, answer.result));
    else this.#over(answer.reason, true);
  }

  #line({ v_mps, omega_radps }, { paused, filters }) {
    const filtered = filters.filter(({ why }) => why).map(({ filter, doing, why }) => `${filter} ${doing}: ${why}`);
    const moves = `${rounded(v_mps)} m/s, ${rounded(omega_radps)} rad/s`;
    return [moves, paused && `${paused} waits`, ...filtered].filter(Boolean).join(" · ");
  }

  /** Ends the drive, if this page drives. */
  end() {
    if (!this.id) return;
    const id = this.id;
    this.#over(this.paused ? `${this.paused} goes on` : "it stands", false);
    this.#order("end_drive", { drive: id });
  }

  #over(said, warn) {
    this.id = "";
    this.hand = STILL;
    this.held.clear();
    this.dot.style.translate = "";
    clearInterval(this.#timer);
    this.#leave?.abort();
    this.render(true, "");
    this.#tell(said, warn);
  }

  #tell(text, warn = false) {
    say(this.said, text);
    this.said.classList.toggle("warn", warn);
  }
}

function clamped(value) {
  return Math.max(-1, Math.min(1, value));
}

/** Makes a field for a number above 0. */
function number(name, value, unit) {
  const input = h("input", { type: "number", min: 0, step: 0.05, value });
  const root = h("label", {}, `${name} `, input, ` ${unit}`);
  return { root, value: () => (input.valueAsNumber > 0 ? input.valueAsNumber : 0) };
}
