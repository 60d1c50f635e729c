// The moment that the page shows: the present, or a moment of the past, paused or playing.

import { clock, say, set } from "./words.js";

const STEP_BACK_S = 5;
const NEAR_S = 0.25;

export class Timeline {
  /**
   * @param {Past} past The past.
   * @param {{present: Function, past: Function, mission: Function}} shows Show the present or a picture of the past;
   *   `mission` returns the mission time that is shown.
   */
  constructor(past, shows) {
    this.past = past;
    this.shows = shows;
    this.begin = 0;
    this.end = 0;
    this.t = 0;
    this.live = true;
    this.playing = true;
    this.over = false;
    this.marks = [];
    this.busy = false;
    this.dirty = false;
    this.drawn = "";
    for (const id of ["scrubber", "play", "back", "live", "when", "pace", "marks"]) this[id + "Box"] = document.getElementById(id);
    this.scrubberBox.addEventListener("input", () => this.go(Number(this.scrubberBox.value)));
    this.playBox.addEventListener("click", () => this.toggle());
    this.backBox.addEventListener("click", () => this.back());
    this.liveBox.addEventListener("click", () => this.goLive());
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

  /** Marks an event on the timeline. */
  mark(t, kind) {
    this.marks.push([t, kind]);
    this.drawn = "";
  }

  #drawMarks() {
    const canvas = this.marksBox;
    const { clientWidth: width, clientHeight: height } = canvas;
    const state = `${width} ${this.begin.toFixed(0)} ${this.end.toFixed(0)} ${this.marks.length}`;
    if (state === this.drawn || !width) return;
    this.drawn = state;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const style = getComputedStyle(canvas);
    const span = Math.max(1e-6, this.end - this.begin);
    this.marks = this.marks.filter(([t]) => t >= this.begin);
    for (const [t, kind] of this.marks) {
      pen.fillStyle = style.getPropertyValue(`--${kind}`);
      // The knob of a range is about 16 px wide, and its middle marks the value.
      const x = 8 + ((t - this.begin) / span) * (width - 16);
      pen.beginPath();
      pen.roundRect(x - 1.5, 0, 3, height, 1.5);
      pen.fill();
    }
  }
}
