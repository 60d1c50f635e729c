// Keeps what the page shows in its address, and shows what the address says.

import { Address } from "./address.js";

const DEFAULT_SPAN = "120";
const DEFAULT_LIST = "news";

export class ViewAddress {
  /**
   * @param {object} page Parts of the page: `search`, `events`, `plots`, `panel`, `why`, `timeline`, `line`, `span`
   *   (chooses how much the plots show), `inspector`; `stage` and `selected` return what is chosen; `choose` and `select`
   *   choose; `inspect` opens something beside the arena; `ready` returns whether there is something to show.
   */
  constructor(page) {
    this.page = page;
    this.address = new Address(() => this.restore());
    this.restored = false;
  }

  /** Shows what the address says; called again when a person changes it, or the server shows something else. */
  restore() {
    const { page, address } = this;
    if (!page.ready() && !this.restored) return;
    const again = this.restored;
    this.restored = true;
    if (address.get("stage")) page.choose(address.get("stage"));
    page.search.look(address.get("find"));
    page.events.choose(address.get("show") || DEFAULT_LIST);
    const span = address.get("span") || DEFAULT_SPAN;
    page.span.value = span === "all" ? "" : span;
    if (page.span.selectedIndex < 0) page.span.value = DEFAULT_SPAN;
    if (address.list("plot").length) page.plots.choose(address.list("plot"));
    if (address.get("agent") && address.get("agent") !== page.selected()) page.select(address.get("agent"));
    this.#inspect(again);
    const at = Number.parseFloat(address.get("at"));
    if (Number.isFinite(at)) page.timeline.go(page.line.momentOf(at));
    else if (again) page.timeline.goLive();
  }

  #inspect(again) {
    const { page, address } = this;
    const [task, why] = [address.get("task"), address.get("why")];
    const [agent, ...key] = task.split("/");
    if (key.length === 2) {
      if (page.panel.task !== task) page.inspect(() => page.panel.open(agent, key.join("/")));
    } else if (why) {
      if (page.why.agent !== why) page.inspect(() => page.why.open(why));
    } else if (again) page.inspector.close();
  }

  /** Writes into the address what is shown now. */
  note() {
    if (!this.restored) {
      this.restore();
      return;
    }
    const { page, address } = this;
    address.set("stage", page.stage());
    address.set("find", page.search.text);
    address.set("show", page.events.filter === DEFAULT_LIST ? "" : page.events.filter);
    address.set("span", page.span.value === DEFAULT_SPAN ? "" : page.span.value || "all");
    address.set("plot", page.plots.chosen ? page.plots.names.join(",") : "");
    address.set("agent", page.selected());
    address.set("task", page.panel.task);
    address.set("why", page.why.agent);
    address.set("at", page.timeline.live ? "" : page.line.missionAt(page.timeline.t).toFixed(1));
  }
}
