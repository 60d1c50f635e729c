// Groups events that repeat, so that a noisy task does not fill the list: the newest is shown, with how often it came.

/** Repeats are further apart than this, in seconds of the timeline, only if they are not one group. */
const SAME_S = 90;
/** The same for texts that differ only in their numbers. */
const ALIKE_S = 10;
/** A repeat is looked for among this many rows, so that two agents that take turns are grouped too. */
const ROWS = 6;

/**
 * Groups events.
 * @param {object[]} events The newest first.
 * @param {number} most At most this many groups.
 * @returns {{event: object, events: object[]}[]} The newest event of each group, and all, the newest first.
 */
export function grouped(events, most) {
  const groups = [];
  for (const event of events) {
    const alike = skeleton(event);
    const recent = groups.slice(-ROWS);
    const group = recent.find((it) => it.alike === alike && repeats(it.last, event));
    if (group) {
      group.events.push(event);
      group.last = event;
    } else {
      if (groups.length >= most) break;
      groups.push({ event, events: [event], last: event, alike });
    }
  }
  return groups;
}

function repeats(newer, older) {
  return newer.t - older.t <= (newer.text === older.text ? SAME_S : ALIKE_S);
}

const skeletons = new WeakMap();

function skeleton(event) {
  let found = skeletons.get(event);
  if (found === undefined) skeletons.set(event, (found = `${event.agent} ${event.kind} ${event.text.replace(/(?<![\w-])\d+(\.\d+)?/g, "#")}`));
  return found;
}
