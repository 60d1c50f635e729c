// The numbers that are plotted: asked of the server once a second, only what is new, and kept as long as the timeline.

const ASK_MS = 1000;
/** The most points of one series that the page keeps. */
const MOST = 4000;
/** The most series in one question. */
const MOST_NAMES = 200;

export class Series {
  /**
   * @param {Link} link Asks the server.
   * @param {() => number} begin Returns the beginning of the timeline; earlier points are dropped.
   */
  constructor(link, begin) {
    this.link = link;
    this.begin = begin;
    this.kept = new Map();
    this.wanting = [];
    this.listeners = [];
    this.timer = 0;
    this.round = 0;
    this.#again(0);
  }

  /** Asks for the series that `names` returns, from now on. */
  want(names) {
    this.wanting.push(names);
  }

  /** Calls a function whenever points have come. */
  onNews(listener) {
    this.listeners.push(listener);
  }

  /** Asks now, because a person wants another series. */
  hurry() {
    this.#again(0);
  }

  /** Forgets all points: the server shows something else. */
  forget() {
    this.kept.clear();
    this.round += 1;
    this.hurry();
  }

  /** Returns a series as `{unit, t, v}`; without points if none are known. */
  get(name) {
    return this.kept.get(name) || { unit: "", t: [], v: [] };
  }

  #again(pause) {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.#ask(), pause);
  }

  async #ask() {
    const names = [...new Set(this.wanting.flatMap((it) => it()))].slice(0, MOST_NAMES);
    for (const name of this.kept.keys()) if (!names.includes(name)) this.kept.delete(name);
    if (names.length && !document.hidden) {
      const { round } = this;
      const since = names.map((name) => this.get(name).t.at(-1) ?? -1e9);
      const { ok, result } = await this.link.ask("series", { names, since });
      if (ok && round === this.round) this.#take(result);
    }
    this.#again(ASK_MS);
  }

  #take(result) {
    for (const [name, [unit, t, v]] of Object.entries(result)) {
      let it = this.kept.get(name);
      if (!it) this.kept.set(name, (it = { unit, t: [], v: [] }));
      const last = it.t.at(-1) ?? -Infinity;
      t.forEach((time, index) => {
        if (time <= last) return;
        it.t.push(time);
        it.v.push(v[index]);
      });
      let drop = Math.max(0, it.t.length - MOST);
      const begin = this.begin();
      while (drop < it.t.length - 1 && it.t[drop + 1] < begin) drop += 1;
      if (drop) {
        it.t.splice(0, drop);
        it.v.splice(0, drop);
      }
    }
    for (const listener of this.listeners) listener();
  }
}

/** Returns the value of a series at a moment: the last one before it. */
export function valueAt({ t, v }, moment) {
  let [low, high] = [0, t.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (t[middle] <= moment) low = middle + 1;
    else high = middle;
  }
  return low ? v[low - 1] : null;
}
