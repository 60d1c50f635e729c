// Mission time along the timeline: the server sends the knots of a line, between which its speed stayed the same.

import { clock } from "./words.js";

const STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400];

export class ClockLine {
  constructor() {
    this.knots = [];
    this.now = [0, 0];
  }

  /** Takes the knots of a frame, if it has any, and its moment. */
  news(frame) {
    if (frame.knots) this.knots = frame.knots;
    this.now = [frame.t, frame.m];
  }

  #points() {
    const points = this.knots.filter(([t]) => t < this.now[0]);
    return [...points, this.now];
  }

  /** Returns the mission time at a moment of the timeline. */
  missionAt(t) {
    return Math.max(0, along(this.#points(), t, 0, 1));
  }

  /** Returns a moment of the timeline with this mission time. */
  momentOf(mission) {
    return along(this.#points(), mission, 1, 0);
  }

  /**
   * Returns round mission times for an axis, as moments with labels. Mission time may jump, as when agents are found that
   * have run for long: the labels of the jump would stand on one spot, so only one of them is returned.
   * @param {number} from The moment at its beginning.
   * @param {number} to The moment at its end.
   * @param {number} most There is room for this many: none are nearer to each other than that allows.
   */
  ticks(from, to, most) {
    if (!this.knots.length) return [];
    const moments = [from, ...this.#points().map(([t]) => t).filter((t) => t > from && t < to), to];
    const pieces = moments.slice(1).map((end, index) => this.#piece(moments[index], end));
    const step = STEPS.find((it) => (usual(pieces) * (to - from)) / it <= most) ?? STEPS[STEPS.length - 1];
    const apart = ((to - from) / most) * (1 - 1e-6);
    const found = [];
    let latest = to;
    for (const { begin, end, mission, speed } of pieces.reverse()) {
      while (speed > 0) {
        const m = Math.floor((mission + speed * (Math.min(end, latest) - begin)) / step + 1e-6) * step;
        if (m < mission - 1e-6) break;
        const t = begin + (m - mission) / speed;
        found.unshift({ t, label: step < 1 ? clock(m) : clock(m).replace(/\.\d$/, "") });
        latest = t - apart;
      }
    }
    return found;
  }

  #piece(begin, end) {
    const mission = this.missionAt(begin);
    return { begin, end, mission, speed: end > begin ? (this.missionAt(end) - mission) / (end - begin) : 0 };
  }
}

/** Returns the speed of mission time in the middle of the moments in which it goes on, so that no jump counts. */
function usual(pieces) {
  const going = pieces.filter((it) => it.speed > 0).sort((a, b) => a.speed - b.speed);
  let left = going.reduce((sum, it) => sum + it.end - it.begin, 0) / 2;
  return going.find((it) => (left -= it.end - it.begin) <= 0)?.speed ?? 0;
}

/** Follows a line of points: from a value in one column to the value in another; beyond the ends it goes straight on. */
function along(points, value, from, to) {
  if (points.length < 2) return points[0][to] + (value - points[0][from]);
  let index = 1;
  while (index < points.length - 1 && points[index][from] < value) index += 1;
  const [one, other] = [points[index - 1], points[index]];
  const run = other[from] - one[from];
  if (run <= 0) return one[to];
  return one[to] + ((value - one[from]) / run) * (other[to] - one[to]);
}
