// The page: takes frames from the server, and draws them.

import { Arena, inWords } from "./arena.js";
import { Cards } from "./cards.js";
import { ClockLine } from "./clock_line.js";
import { Events, markOf } from "./events.js";
import { Halt } from "./halt.js";
import { listenToKeys } from "./keys.js";
import { Link } from "./link.js";
import { Mesh } from "./mesh.js";
import { Orders } from "./orders.js";
import { Past } from "./past.js";
import { Plots } from "./plots.js";
import { Search } from "./search.js";
import { Series } from "./series.js";
import { SeriesPicker } from "./series_picker.js";
import { SignIn, signOut } from "./sign_in.js";
import { Picture } from "./state.js";
import { TaskPanel } from "./task_panel.js";
import { Timeline } from "./timeline.js";
import { ViewAddress } from "./view_address.js";
import { Why } from "./why.js";
import { clock, dark, say, set, show, still } from "./words.js";

const DESCRIBED_MS = 5000;
const EFFECT_MS = 2600;
const DEPARTED_MS = 4000;
/** How often plots follow the timeline at most, while the past is played. */
const SKETCH_MS = 120;
/** How often the first plots are chosen again, as agents come. */
const OFFER_MS = 1000;

const find = (id) => document.getElementById(id);
const canvas = find("canvas");
document.body.dataset.stage = "arena";
const dialog = find("dialog");
const inspector = find("inspector");

const present = new Picture();
let shown = present;
let touched = null;
let effects = [];
let flights = [];
let stage = "arena";
let chosen = false;
let selected = "";
let control = false;
let closedFor = "";
let describedAt = 0;
let described = 0;
let jump = true;
let played = 0;
let lastFrame = { over: "" };
let sketchedAt = 0;
let stale = false;
let offeredAt = -OFFER_MS;
const departed = new Map();

const link = new Link(new URLSearchParams(location.hash.slice(1)).get("token") || "", { frame, state });
const line = new ClockLine();
const arena = new Arena(canvas);
const mesh = new Mesh(canvas);
const past = new Past(link);
const events = new Events(find("events"), find("filter"), (t) => timeline.go(t));
const marks = (from, to) => events.marks(from, to);
const timeline = new Timeline(past, { present: showPresent, past: showPast, mission: () => shown.m }, line, marks);
const series = new Series(link, () => timeline.begin);
const plots = new Plots(
  { box: find("plots"), empty: find("no-plots"), span: find("span") },
  { series, clock: line, marks: (from, to) => marks(from, to).filter(({ kind }) => kind !== "warning"), timeline, moment: () => timeline.t, go: (t) => timeline.go(t) },
  () => address.note(),
);
const orders = new Orders(link, dialog, () => present.agents().filter((name) => present.get("agent", name).role === "agent"));
const halt = new Halt(
  link,
  dialog,
  { button: find("halt"), line: find("halted"), said: find("halted-said"), end: find("end-halt") },
  () => present,
);
const plot = (name) => {
  const added = plots.add(name);
  if (added) find("plots").scrollIntoView({ block: "nearest", behavior: still.matches ? "auto" : "smooth" });
  return added;
};
const panel = new TaskPanel(link, inspector, orders, timeline, () => shown, plot);
const why = new Why(link, inspector, timeline);
const cards = new Cards(find("agents"), {
  select,
  why: (agent) => inspect(() => why.open(agent)),
  act: (agent, key) => inspect(() => panel.open(agent, key)),
  plot,
});
const search = new Search(find("find"), find("found"), cards, events);
const address = new ViewAddress({
  search, events, plots, panel, why, timeline, line, inspector, inspect, select,
  span: find("span"),
  stage: () => (chosen ? stage : ""),
  choose: chooseStage,
  selected: () => selected,
  ready: () => present.agents().length > 0,
});
const signIn = new SignIn(dialog, () => link.retry());
new SeriesPicker(find("pick"), find("found-series"), link, (name) => plots.add(name));
series.want(() => cards.series());
series.onNews(() => (stale = true));

// News -----------------------------------------------------------------------------------------------------------

function frame(news) {
  if (news.all) {
    events.forget();
    past.forget();
    series.forget();
    jump = true;
    if (!timeline.live) timeline.goLive();
  }
  if (shown === present) rememberPlaces(news);
  const changed = present.apply(news);
  if (shown === present) touch(changed);
  const fresh = news.events || [];
  if (fresh.length) {
    events.add(fresh);
    for (const event of fresh) {
      if (markOf(event)) timeline.redraw();
    }
  }
  lastFrame = news;
  line.news(news);
  timeline.news(news);
  if (performance.now() - offeredAt > OFFER_MS) {
    offeredAt = performance.now();
    plots.offer(present);
  }
  if (news.all) address.restore();
  if (shown === present) {
    arena.moved(present, performance.now(), jump);
    jump = false;
    if (!news.all) for (const event of fresh) happen(event);
  }
}

function state(what, greeting) {
  document.body.dataset.link = what;
  if (what === "password") signIn.ask();
  if (what !== "open") {
    jump = true;
    closedFor = what === "closed" ? greeting : "";
    return;
  }
  show(find("sign-out"), greeting.password);
  control = greeting.control;
  orders.control = control;
  cards.allow(control);
  say(find("subtitle"), greeting.title);
  say(
    find("help-control"),
    control
      ? "This page may change what the agents do: drag a task onto another agent (by its ⠿ with a finger; escape lets go), or open it to change its rates and settings. You are asked before it moves. Halt makes all actuators stand at once. Open the motors of an agent to drive it by hand."
      : "This page is read-only. Start it with --control to move tasks between agents, change rates and settings, stop and start tasks.",
  );
}

function touch(changed) {
  if (changed === null || touched === null) touched = null;
  else for (const name of changed) touched.add(name);
}

/** Remembers where on the page a task was, if it leaves its agent in this frame: it will fly from there. */
function rememberPlaces(news) {
  for (const event of news.events || []) {
    if (!["migration_asked", "task_stopped", "task_frozen", "task_handed_over"].includes(event.kind)) continue;
    remember(event.agent, event.task);
  }
}

function remember(agent, task) {
  const rect = cards.rectOf(agent, task);
  if (rect && rect.width) departed.set(`${agent}/${task}`, { rect, at: performance.now() });
}

/** Shows an event, of the present or of the past that is played. */
function happen(event) {
  const now = performance.now();
  const effect = (from, to, colour, text, strong = false) =>
    effects.push({ from, to, colour, text, strong, since: now, lasts: strong ? EFFECT_MS * 1.3 : EFFECT_MS });
  const style = getComputedStyle(document.body);
  const tint = (name) => style.getPropertyValue(`--${name}`);
  if (event.kind === "migration_asked") {
    for (const name of shown.agents()) {
      const asked = event.to ? name === event.to : name !== event.agent && shown.get("agent", name).role === "agent";
      if (asked) effect(event.agent, name, tint("move"), event.to ? `asks only ${name}` : "");
    }
    say(find("announcer"), event.text);
  } else if (event.kind === "migration_bid" && event.source_agent) {
    effect(event.agent, event.source_agent, tint("bid"), `bid ${Number(event.cost?.toPrecision?.(3) ?? 0)}`);
  } else if (event.kind === "migration_refused" && event.source_agent) {
    effect(event.agent, event.source_agent, tint("refused"), "refuses");
  } else if (event.kind === "task_arrived" && event.source_agent) {
    effect(event.source_agent, event.agent, tint("move"), event.task, true);
    const from = departed.get(`${event.source_agent}/${event.task}`);
    const left = from && now - from.at < DEPARTED_MS ? from.rect : cards.rectOf(event.source_agent, event.task);
    flights.push({ task: event.task, to: event.agent, from: left, until: now + DEPARTED_MS });
    say(find("announcer"), event.text);
  } else if (event.kind === "migration") {
    say(find("announcer"), event.text);
  }
}
// Past and present -----------------------------------------------------------------------------------------------

function showPresent() {
  shown = present;
  touched = null;
  jump = true;
  [effects, flights] = [[], []];
  arena.moved(present, performance.now(), true);
  stale = true;
}

function showPast(picture, changed, t) {
  const plays = shown === picture && timeline.playing && t > played && t - played < 2;
  const news = plays ? events.between(played, t) : [];
  for (const event of news) if (event.task) remember(event.agent, event.task);
  if (shown !== picture) touched = null;
  shown = picture;
  touch(changed);
  arena.moved(picture, performance.now(), !plays);
  if (!plays) [effects, flights] = [[], []];
  for (const event of news) happen(event);
  played = t;
  stale = true;
}

// Drawing --------------------------------------------------------------------------------------------------------

let before = performance.now();

function draw(now) {
  timeline.tick(Math.min(0.5, (now - before) / 1000));
  before = now;
  if (touched === null || touched.size) {
    cards.render(shown, touched);
    touched = new Set();
    if (search.text) search.apply();
  }
  if (stale && now - sketchedAt >= SKETCH_MS) {
    [stale, sketchedAt] = [false, now];
    plots.draw();
    cards.drawSparks(series, timeline.t);
  }
  // A task flies only once it has started on its new agent.
  flights = flights.filter((flight) => now < flight.until && !cards.fly(flight.task, flight.from, flight.to));
  events.show(timeline.live ? Infinity : timeline.t);
  events.render();
  effects = effects.filter((it) => now - it.since < it.lasts);
  const isMesh = stage === "mesh" || (!chosen && !shown.table("body").size);
  if ((document.body.dataset.stage === "mesh") !== isMesh) {
    document.body.dataset.stage = isMesh ? "mesh" : "arena";
    mesh.drawn = "";
  }
  (isMesh ? mesh : arena).draw(shown, effects, now);
  if (!chosen) document.querySelector(`input[name=stage][value=${isMesh ? "mesh" : "arena"}]`).checked = true;
  head();
  address.note();
  // A screen reader should not read each step of a robot, but a new body or agent at once.
  const crowd = shown.table("body").size + shown.table("agent").size;
  if (now - describedAt > DESCRIBED_MS || crowd !== described) {
    [describedAt, described] = [now, crowd];
    set(canvas, "aria-label", inWords(shown));
  }
  requestAnimationFrame(draw);
}

function head() {
  say(find("clock"), clock(shown.m));
  const fleet = shown.get("fleet");
  say(find("title"), fleet ? fleet.name.replace(/-\d+$/, "") : "Pancakes");
  say(find("speed"), fleet ? (fleet.held ? "held" : fleet.speed !== 1 ? `×${fleet.speed}` : "") : "");
  const open = document.body.dataset.link === "open";
  halt.render(control, open && !lastFrame.over);
  const asks = document.body.dataset.link === "password";
  const status = asks ? "signed out" : !open ? "no server" : !timeline.live ? "past" : lastFrame.over ? "ended" : lastFrame.waiting ? "waiting" : "live";
  say(find("status"), status);
  set(find("status"), "data-state", status);
  const closed = closedFor
    ? `The server closed this page: ${closedFor}. The page tries again every second.`
    : "The page has lost its server. It tries again every second.";
  const none = open && !shown.agents().length;
  show(find("none"), none);
  say(find("none-reason"), none ? lastFrame.waiting || "" : "");
  const waiting = !open ? (asks ? "" : closed) : lastFrame.over || (none ? "no agents yet" : lastFrame.waiting) || "";
  show(find("waiting"), Boolean(waiting));
  say(find("waiting"), waiting);
  if (open && !lastFrame.over && lastFrame.lost_events) say(find("announcer"), `${lastFrame.lost_events} events were left out: there were too many`);
}

// What a person does ---------------------------------------------------------------------------------------------

function select(name) {
  selected = selected === name ? "" : name;
  arena.selected = mesh.selected = selected;
  cards.select(selected);
}

/** Shows something in the inspector; events make room beneath it. */
function inspect(open) {
  open();
  document.body.classList.add("inspecting");
}

inspector.addEventListener("close", () => document.body.classList.remove("inspecting"));

canvas.addEventListener("click", (event) => {
  const box = canvas.getBoundingClientRect();
  const drawer = document.body.dataset.stage === "mesh" ? mesh : arena;
  const name = drawer.bodyAt(shown, event.clientX - box.left, event.clientY - box.top, performance.now());
  if (!name) return;
  select(name);
  cards.scrollTo(name);
});

function chooseStage(name) {
  const radio = document.querySelector(`input[name=stage][value="${CSS.escape(name)}"]`);
  if (!radio) return;
  radio.checked = true;
  [stage, chosen] = [name, true];
}

for (const radio of document.querySelectorAll("input[name=stage]")) {
  radio.addEventListener("change", () => chooseStage(radio.value));
}

for (const box of find("layers").querySelectorAll("input")) {
  box.checked = localStorage.getItem(`layer-${box.value}`) !== "off";
  arena.layers[box.value] = box.checked;
  box.addEventListener("change", () => {
    arena.layers[box.value] = box.checked;
    localStorage.setItem(`layer-${box.value}`, box.checked ? "on" : "off");
  });
}

find("help-button").addEventListener("click", () => find("help").showModal());
for (const it of [dialog, find("help")]) {
  it.addEventListener("click", (event) => event.target === it && !signIn.asks && it.close());
}
dark.addEventListener("change", () => {
  touched = null;
  timeline.redraw();
  plots.restyle();
});
find("sign-out").addEventListener("click", signOut);

const focus = (id) => () => find(id).focus();
listenToKeys(
  {
    " ": () => timeline.toggle(),
    j: () => timeline.back(),
    l: () => timeline.goLive(),
    m: () => chooseStage(document.body.dataset.stage === "mesh" ? "arena" : "mesh"),
    "?": () => find("help").showModal(),
    "/": focus("find"),
    p: focus("pick"),
  },
  () => inspector.open && inspector.close(),
);

requestAnimationFrame(draw);
