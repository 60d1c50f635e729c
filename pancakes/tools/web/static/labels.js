// Places the labels of the arena: each near its body, none over another.

const GAP = 2;
/** A label stays at one of its first NEAR places; from a place further away it comes back as soon as it can. */
const NEAR = 8;

export class Labels {
  constructor() {
    this.choices = new Map();
    this.begin(0, 0);
  }

  /** Begins a frame on a canvas of this size. */
  begin(width, height) {
    [this.width, this.height] = [width, height];
    this.taken = [];
    this.avoided = [];
  }

  /** Keeps labels out of an area. */
  take(left, top, right, bottom) {
    this.taken.push([left, top, right, bottom]);
  }

  /** Keeps labels out of an area, unless there is no other place. */
  avoid(left, top, right, bottom) {
    this.avoided.push([left, top, right, bottom]);
  }

  /**
   * Finds a place for a label, and takes it.
   * @param {string} key Identifies the label: in the next frame it keeps its side if it can.
   * @param {number} width Its width.
   * @param {number} height Its height.
   * @param {number[][]} middles Possible middles of the label, the best first.
   * @returns {number[] | null} Its middle, or null if there is no room.
   */
  place(key, width, height, middles) {
    const chosen = this.choices.get(key) ?? 0;
    const last = chosen < NEAR ? chosen : 0;
    const order = [last, ...middles.keys()].filter((choice) => choice < middles.length);
    for (const blocked of [[...this.taken, ...this.avoided], this.taken]) {
      for (const choice of order) {
        const [x, y] = middles[choice];
        const box = [x - width / 2 - GAP, y - height / 2 - GAP, x + width / 2 + GAP, y + height / 2 + GAP];
        if (!this.#fits(box) || blocked.some((other) => overlap(box, other))) continue;
        this.choices.set(key, choice);
        this.taken.push(box);
        return [x, y];
      }
    }
    return null;
  }

  /** Forgets all labels except these. */
  keep(keys) {
    for (const key of this.choices.keys()) if (!keys.has(key)) this.choices.delete(key);
  }

  #fits([left, top, right, bottom]) {
    return left >= 0 && top >= 0 && right <= this.width && bottom <= this.height;
  }
}

/** Returns the middles of labels around a point, the nearest first: below, above, beside, and then further away. */
export function around(x, y, radius, width, height) {
  const middles = [];
  for (const away of [0, 1, 2, 3]) {
    const [down, aside] = [radius + height / 2 + away * height, radius + width / 2 + (away * width) / 2];
    for (const [right, below] of [[0, 1], [0, -1], [1, 0], [-1, 0], [1, 1], [-1, 1], [1, -1], [-1, -1]]) {
      middles.push([x + right * aside, y + below * down]);
    }
  }
  return middles;
}

function overlap(one, other) {
  return one[0] < other[2] && other[0] < one[2] && one[1] < other[3] && other[1] < one[3];
}
