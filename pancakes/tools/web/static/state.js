// The picture of one moment: named values (see pancakes/tools/web/fleet_model.py) and the trails.

export const RUNNING = "running";
/** The services that every agent has; their tasks are not the user's. */
export const OWN_SERVICES = new Set(["device", "network", "log"]);
const TRAIL = 400;

export class Picture {
  constructor() {
    this.clear();
  }

  clear() {
    this.t = 0;
    this.m = 0;
    this.tables = new Map();
    this.tasks = new Map();
    this.services = new Map();
    this.trails = new Map();
  }

  /** Returns all values of one kind, by the rest of their names. */
  table(kind) {
    let table = this.tables.get(kind);
    if (!table) this.tables.set(kind, (table = new Map()));
    return table;
  }

  get(kind, name = "") {
    return this.table(kind).get(name);
  }

  /** Takes a frame; returns the names of the agents whose cards it changes, or null for all. */
  apply(frame) {
    if (frame.all) this.clear();
    this.t = frame.t;
    this.m = frame.m;
    for (const [name, points] of Object.entries(frame.trails || {})) this.trails.set(name, points.slice());
    const touched = new Set();
    for (const [key, value] of Object.entries(frame.set || {})) this.#set(key, value, touched);
    return frame.all ? null : touched;
  }

  #set(key, value, touched) {
    const slash = key.indexOf("/");
    const kind = slash < 0 ? key : key.slice(0, slash);
    const rest = slash < 0 ? "" : key.slice(slash + 1);
    if (kind === "task" || kind === "service") {
      const owner = rest.slice(0, rest.indexOf("/"));
      const all = kind === "task" ? this.tasks : this.services;
      if (!all.has(owner)) all.set(owner, new Map());
      put(all.get(owner), rest.slice(owner.length + 1), value);
      touched.add(owner);
      return;
    }
    put(this.table(kind), rest, value);
    if (kind === "agent" || kind === "battery" || kind === "dock" || kind === "commands") touched.add(rest);
    else if (kind === "link") for (const name of rest.split("/")) touched.add(name);
    else if (kind === "body" && value) this.#extend(rest, value);
  }

  #extend(name, [x, y]) {
    const shape = this.get("shape", name);
    if (shape && shape.kind === "sensor") return;
    let trail = this.trails.get(name);
    if (!trail) this.trails.set(name, (trail = []));
    const last = trail[trail.length - 1];
    const arena = this.get("arena");
    const step = arena ? Math.max(0.01, arena[0] / 200) : 0.02;
    if (last && Math.hypot(last[0] - x, last[1] - y) < step) return;
    trail.push([x, y]);
    if (trail.length > TRAIL) trail.shift();
  }

  agents() {
    return [...this.table("agent").keys()].sort(byRole(this));
  }

  /** Returns the versions that agents run. */
  versions() {
    return new Set([...this.table("agent").values()].map((row) => row.version).filter(Boolean));
  }

  tasksOf(agent) {
    return this.tasks.get(agent) || new Map();
  }

  /** Returns how many tasks an agent runs for its users. */
  runs(agent) {
    const rows = [...this.tasksOf(agent)];
    return rows.filter(([key, row]) => row.state === RUNNING && !OWN_SERVICES.has(key.slice(0, key.indexOf("/")))).length;
  }

  linksOf(agent) {
    const found = [];
    for (const [pair, ms] of this.table("link")) {
      const [one, other] = pair.split("/");
      if (one === agent) found.push([other, ms]);
      else if (other === agent) found.push([one, ms]);
    }
    return found.sort((a, b) => (a[0] < b[0] ? -1 : 1));
  }
}

function put(table, name, value) {
  if (value === null) table.delete(name);
  else table.set(name, value);
}

// Robots come first, worlds and others last.
function byRole(picture) {
  const rank = (name) => (picture.get("agent", name).role === "agent" ? 0 : 1);
  return (a, b) => rank(a) - rank(b) || a.localeCompare(b, undefined, { numeric: true });
}
