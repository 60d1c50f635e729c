// The orders of a person on a page with control: migrate a task, stop, start and restart it.

import { OWN_SERVICES, RUNNING } from "./state.js";
import { h, hertz } from "./words.js";

const FAR_PX = 6;
const EDGE_PX = 56;
const SCROLL_PX = 14;

export class Orders {
  /**
   * @param {Link} link Asks the server.
   * @param {HTMLDialogElement} dialog Asks the person.
   * @param {Function} agents Returns the names of the agents that could take a task.
   */
  constructor(link, dialog, agents) {
    this.link = link;
    this.dialog = dialog;
    this.agents = agents;
    this.control = false;
    document.addEventListener("pointerdown", (event) => this.#begin(event));
  }

  #ask(agent, task, what, fields = {}) {
    return this.link.ask("order", { do: what, agent, task, ...fields });
  }

  // Dragging ----------------------------------------------------------------------------------------------------

  #begin(event) {
    const chip = event.button === 0 && this.control ? event.target.closest("li.movable") : null;
    if (!chip || chip.dataset.state !== RUNNING) return;
    // A finger scrolls the page, unless it takes hold of the grip.
    if (event.pointerType === "touch" && !event.target.closest(".grip")) return;
    const agent = chip.closest(".card").dataset.agent;
    const drag = { chip, agent, list: chip.closest(".agents"), x: event.clientX, y: event.clientY, ghost: null, target: null };
    const move = (it) => this.#move(drag, it);
    const end = (it) => {
      if (it.type === "keydown" && it.key !== "Escape") return;
      document.removeEventListener("pointermove", move);
      document.removeEventListener("pointerup", end);
      document.removeEventListener("pointercancel", end);
      document.removeEventListener("keydown", end);
      this.#drop(drag, it.type === "pointerup");
    };
    document.addEventListener("pointermove", move);
    document.addEventListener("pointerup", end);
    document.addEventListener("pointercancel", end);
    document.addEventListener("keydown", end);
  }

  #move(drag, event) {
    if (!drag.ghost) {
      if (Math.hypot(event.clientX - drag.x, event.clientY - drag.y) < FAR_PX) return;
      drag.ghost = h("div.flyer.ghost", { "aria-hidden": "true" }, drag.chip.dataset.task);
      document.body.append(drag.ghost);
      document.body.classList.add("dragging");
      drag.chip.classList.add("dragged");
      requestAnimationFrame(() => this.#scroll(drag));
    }
    event.preventDefault();
    [drag.x, drag.y] = [event.clientX, event.clientY];
    drag.ghost.style.left = `${event.clientX + 10}px`;
    drag.ghost.style.top = `${event.clientY + 8}px`;
    this.#aim(drag);
  }

  /** Scrolls towards agents that are out of sight, while a task is held near the edge of the page or of their list. */
  #scroll(drag) {
    if (!drag.ghost) return;
    const { list } = drag;
    const own = list.scrollHeight > list.clientHeight + 1 && getComputedStyle(list).overflowY === "auto";
    const { top, bottom } = list.getBoundingClientRect();
    const [first, last] = own ? [Math.max(0, top), Math.min(bottom, window.innerHeight)] : [0, window.innerHeight];
    // The page scrolls only as far as the ends of the list.
    const [before, after] = own ? [Infinity, Infinity] : [Math.max(0, first - top), Math.max(0, bottom - last)];
    const step = (px) => (SCROLL_PX * Math.min(EDGE_PX, px)) / EDGE_PX;
    const by = Math.min(after, step(Math.max(0, drag.y - last + EDGE_PX))) - Math.min(before, step(Math.max(0, first + EDGE_PX - drag.y)));
    if (by) {
      (own ? list : window).scrollBy({ top: by, behavior: "instant" });
      this.#aim(drag);
    }
    requestAnimationFrame(() => this.#scroll(drag));
  }

  #aim(drag) {
    const card = document.elementFromPoint(drag.x, drag.y)?.closest(".card");
    const target = card && card.dataset.agent !== drag.agent && card.dataset.role === "agent" ? card : null;
    if (target === drag.target) return;
    drag.target?.classList.remove("target");
    target?.classList.add("target");
    drag.target = target;
  }

  #drop(drag, dropped) {
    if (!drag.ghost) return;
    // The end of a drag also causes a click, which must do nothing.
    window.addEventListener("click", stop, { capture: true, once: true });
    setTimeout(() => window.removeEventListener("click", stop, { capture: true }), 0);
    drag.ghost.remove();
    drag.ghost = null;
    drag.chip.classList.remove("dragged");
    document.body.classList.remove("dragging");
    drag.target?.classList.remove("target");
    if (dropped && drag.target) this.move(drag.agent, drag.chip.dataset.key, drag.target.dataset.agent);
  }

  // Dialogs -----------------------------------------------------------------------------------------------------

  /** Returns the buttons that migrate, stop and start a task; `said` shows the answers. */
  actions(agent, key, row, said) {
    const runs = row.state === RUNNING;
    const box = h("div.actions");
    const button = (text, action) => h("button", { type: "button", onclick: action }, text);
    const tell = async (what, done) => {
      said.textContent = "asking …";
      const { ok, reason } = await this.#ask(agent, key, what);
      said.textContent = ok ? done : reason;
      said.classList.toggle("warn", !ok);
    };
    const service = key.split("/")[0];
    const others = this.agents().filter((name) => name !== agent);
    if (runs && others.length && !OWN_SERVICES.has(service)) {
      const where = h("select", { "aria-label": "Agent to move it to" }, ...others.map((name) => h("option", {}, name)));
      box.append(h("div.action", {}, h("span", {}, "Move to"), where, button("Move …", () => this.move(agent, key, where.value))));
    }
    const life = h("div.action", {}, h("span", {}, runs ? "It runs" : `It is ${row.rest || row.state}`));
    if (runs) life.append(button("Restart", () => tell("restart", "it runs again")), button("Stop", () => tell("stop", "it has stopped")));
    else life.append(button("Start", () => tell("start", "it runs")));
    box.append(life);
    return box;
  }

  /** Asks for a bid, shows it, and migrates the task if the person confirms. */
  async move(agent, key, to) {
    const task = key.split("/")[1];
    const said = h("p.said", { role: "status" }, `asking only ${to} for a bid …`);
    const bids = h("div");
    const confirm = h("button.primary", { type: "button", disabled: true }, `Move it to ${to}`);
    const cancel = h("button", { type: "button", onclick: () => this.dialog.close() }, "Cancel");
    this.dialog.replaceChildren(h("h2", { id: "dialog-title" }, `Move ${task} from ${agent} to ${to}?`), said, bids, h("div.buttons", {}, cancel, confirm));
    if (!this.dialog.open) this.dialog.showModal();
    const dry = await this.#ask(agent, key, "migrate", { to, dry_run: true });
    if (dry.result && dry.result.lines) bids.append(ledger(dry.result.lines));
    said.textContent = dry.ok ? `${to} would take it; no other agent was asked. Nothing has been moved yet.` : dry.reason;
    said.classList.toggle("warn", !dry.ok);
    if (!dry.ok) {
      cancel.textContent = "Close";
      confirm.remove();
      cancel.focus();
      return;
    }
    confirm.disabled = false;
    confirm.focus();
    confirm.addEventListener("click", async () => {
      confirm.disabled = true;
      said.textContent = `${task} moves …`;
      const { ok, reason } = await this.#ask(agent, key, "migrate", { to });
      if (ok) {
        this.dialog.close();
        return;
      }
      said.textContent = reason;
      said.classList.add("warn");
      cancel.textContent = "Close";
    });
  }
}

function stop(event) {
  event.stopPropagation();
  event.preventDefault();
}

/** Makes a table of the answers of the neighbours. */
export function ledger(lines) {
  const rows = lines.map((line) =>
    h(
      "tr",
      { "data-answer": line.answer },
      h("td", {}, line.peer),
      h("td", {}, line.answer === "bid" ? "bids" : line.answer === "refused" ? "refuses" : "is silent"),
      h("td.figure", {}, line.cost === null || line.cost === undefined ? "" : hertz(line.cost)),
      h("td", {}, line.reason || Object.entries(line.terms || {}).map(([name, value]) => `${name} ${hertz(value)}`).join(", ")),
    ),
  );
  const head = h("tr", {}, ...["agent", "answer", "cost", ""].map((text) => h("th", { scope: "col" }, text)));
  return h("table.ledger", {}, h("thead", {}, head), h("tbody", {}, ...rows));
}
