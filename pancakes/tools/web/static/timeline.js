// The moment that the page shows: the present, or a moment of the past, paused or playing.

import { tidy } from "./units.js";
import { clock, say, set, show } from "./words.js";

const STEP_BACK_S = 5;
/** The knob of a range is about 16 px wide, and its middle marks the value. */
const EDGE_PX = 8;
const MARK_PX = 6;
const LABEL_PX = 64;
const NEAR_S = 0.25;

export class Timeline {
  /**
   * @param {Past} past The past.
   * @param {{present: Function, past: Function, mission: Function}} shows Show the present or a picture of the past;
   *   `mission` returns the mission time that is shown.
   * @param {ClockLine} line Mission time along the timeline.
   * @param {(from: number, to: number) => object[]} marked Returns the marks between two moments: `{t, kind, text}`.
   */
  constructor(past, shows, line, marked) {
    this.past = past;
    this.shows = shows;
    this.line = line;
    this.marked = marked;
    this.begin = 0;
    this.end = 0;
    this.t = 0;
    this.live = true;
    this.playing = true;
    this.over = false;
    this.busy = false;
    this.dirty = false;
    this.drawn = "";
    for (const id of ["scrubber", "play", "back", "live", "when", "pace", "marks", "hint"]) this[id + "Box"] = document.getElementById(id);
    this.scrubberBox.addEventListener("input", () => this.go(Number(this.scrubberBox.value)));
    this.playBox.addEventListener("click", () => this.toggle());
    this.backBox.addEventListener("click", () => this.back());
    this.liveBox.addEventListener("click", () => this.goLive());
    this.scrubberBox.addEventListener("pointermove", (event) => this.#hint(event.offsetX));
    this.scrubberBox.addEventListener("pointerleave", () => show(this.hintBox, false));
  }

  /** Takes a frame of the present. */
  news(frame) {
    this.end = frame.t;
    this.begin = frame.from;
    const over = Boolean(frame.over);
    if (over !== this.over) {
      this.over = over;
      say(this.liveBox, over ? "End" : "Live");
      set(this.liveBox, "title", over ? "To the end (L)" : "Back to live (L)");
    }
    if (this.live) this.t = frame.t;
    this.#label();
  }

  toggle() {
    if (this.live && this.over) {
      this.go(this.begin);
      this.playing = true;
    } else if (this.live) {
      this.go(this.t);
      this.playing = false;
    } else {
      this.playing = !this.playing;
    }
    this.#label();
  }

  back() {
    const playing = this.playing && !this.live;
    this.go(this.t - STEP_BACK_S);
    this.playing = playing;
    this.#label();
  }

  go(t) {
    const wasLive = this.live;
    this.live = false;
    if (wasLive) this.playing = false;
    this.t = Math.min(Math.max(t, this.begin), this.end);
    this.dirty = true;
    this.#label();
  }

  goLive() {
    if (!this.live) {
      this.live = true;
      this.t = this.end;
      this.shows.present();
    }
    this.playing = true;
    this.#label();
  }

  /** Plays on by this many seconds; called before each drawn frame. */
  tick(seconds) {
    if (!this.live && this.playing) {
      this.t += seconds * Number(this.paceBox.value);
      this.dirty = true;
      if (this.t >= this.end - NEAR_S) this.goLive();
      this.#label();
    }
    if (!this.live && this.dirty && !this.busy) this.#fetch();
  }

  async #fetch() {
    this.busy = true;
    this.dirty = false;
    const found = await this.past.at(this.t);
    this.busy = false;
    if (!this.live && found) {
      this.shows.past(found.picture, found.touched, this.t);
      this.#label(found.picture.m);
    }
  }

  #label(mission = null) {
    const box = this.scrubberBox;
    set(box, "min", this.begin.toFixed(1));
    set(box, "max", this.end.toFixed(1));
    const value = this.live ? this.end : this.t;
    if (Math.abs(Number(box.value) - value) > 0.04) box.value = value.toFixed(1);
    const ago = this.end - this.t;
    const when = this.live ? (this.over ? "end" : "live") : `−${clock(ago)}`;
    say(this.whenBox, when);
    const m = mission ?? this.shows.mission();
    set(box, "aria-valuetext", `${when}, mission time ${clock(m)}`);
    const runs = this.live ? !this.over : this.playing;
    say(this.playBox, runs ? "❚❚" : "▶");
    set(this.playBox, "aria-label", runs ? "Pause" : "Play");
    set(this.playBox, "title", `${runs ? "Pause" : "Play"} (space)`);
    set(this.liveBox, "aria-pressed", String(this.live));
    this.#drawMarks();
  }

  /** Draws the axis and the marks again: events or colours have changed. */
  redraw() {
    this.drawn = "";
  }

  #x(t, width) {
    return EDGE_PX + ((t - this.begin) / Math.max(1e-6, this.end - this.begin)) * (width - 2 * EDGE_PX);
  }

  /** Shows the mission time under the pointer, and what happened there. */
  #hint(x) {
    const width = this.scrubberBox.clientWidth;
    const share = Math.min(1, Math.max(0, (x - EDGE_PX) / (width - 2 * EDGE_PX)));
    const t = this.begin + share * (this.end - this.begin);
    const near = this.marked(this.begin, this.end).filter((mark) => Math.abs(this.#x(mark.t, width) - x) <= MARK_PX);
    const more = near.length > 1 ? ` and ${near.length - 1} more` : "";
    say(this.hintBox, clock(this.line.missionAt(t)) + (near.length ? ` · ${tidy(near.at(-1).text)}${more}` : ""));
    show(this.hintBox, true);
    const half = this.hintBox.offsetWidth / 2;
    this.hintBox.style.left = `${Math.min(Math.max(x, half), Math.max(half, width - half))}px`;
  }

  #drawMarks() {
    const canvas = this.marksBox;
    const { clientWidth: width, clientHeight: height } = canvas;
    const state = `${width} ${this.begin.toFixed(0)} ${this.end.toFixed(0)} ${this.over}`;
    if (state === this.drawn || !width) return;
    this.drawn = state;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const style = getComputedStyle(canvas);
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "center";
    const ink = style.getPropertyValue("--dim");
    for (const { t, label } of this.line.ticks(this.begin, this.end, Math.max(2, (width - 2 * EDGE_PX) / LABEL_PX))) {
      const x = this.#x(t, width);
      pen.fillStyle = style.getPropertyValue("--edge");
      pen.fillRect(x - 0.5, 0, 1, 5);
      const half = pen.measureText(label).width / 2;
      pen.fillStyle = ink;
      pen.fillText(label, Math.min(Math.max(x, half), width - half), height - 2);
    }
    // Warnings may be many: they are small, and what matters more is drawn over them.
    const found = this.marked(this.begin, this.end);
    for (const drawn of ["warning", "failure", "move"]) {
      pen.fillStyle = style.getPropertyValue(drawn === "failure" ? "--refused" : `--${drawn}`);
      const [wide, high] = drawn === "warning" ? [2, 5] : [3, 10];
      for (const { t, kind } of found) if (kind === drawn) pen.fillRect(this.#x(t, width) - wide / 2, 0, wide, high);
    }
  }
}
