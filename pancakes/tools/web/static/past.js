// The past: pieces of the timeline, fetched from the server when a person looks at them.

import { Picture } from "./state.js";

const KEPT = 12;

export class Past {
  constructor(link) {
    this.link = link;
    this.chunks = [];
    this.picture = new Picture();
    this.chunk = null;
    this.next = 0;
  }

  forget() {
    this.chunks = [];
    this.chunk = null;
  }

  /** Returns the picture at `t`, and the names of the agents whose cards changed since the last one (null: all). */
  async at(t) {
    const chunk = await this.#fetch(t);
    if (!chunk) return null;
    let touched = new Set();
    if (chunk !== this.chunk || t < this.picture.t) {
      this.chunk = chunk;
      this.next = 0;
      this.picture.apply(chunk.key);
      touched = null;
    }
    while (this.next < chunk.frames.length && chunk.frames[this.next].t <= t) {
      const changed = this.picture.apply(chunk.frames[this.next]);
      if (touched) for (const name of changed) touched.add(name);
      this.next += 1;
    }
    return { picture: this.picture, touched };
  }

  async #fetch(t) {
    const known = this.chunks.find((it) => it.begin <= t && (t < it.end || (!it.open && t <= it.end)));
    if (known) return known;
    const { result } = await this.link.ask("chunk", { t });
    if (!result) return null;
    this.chunks = this.chunks.filter((it) => it.begin !== result.begin);
    this.chunks.push(result);
    if (this.chunks.length > KEPT) this.chunks.shift();
    return result;
  }
}
