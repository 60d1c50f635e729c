// The behaviour tree of a task (see pancakes/trees.py), with the status of each node.

import { h, say, set, show } from "./words.js";

/** What stands before a node, beside its colour. */
const MARKS = { INVALID: "○", RUNNING: "▶", SUCCESS: "✓", FAILURE: "✗" };

export class TreeView {
  constructor() {
    this.list = h("ul.tree", { tabindex: 0, "aria-label": "Nodes of the tree" });
    this.root = h("section", { "aria-label": "Behaviour tree", hidden: true }, h("h3", {}, "Behaviour tree"), this.list);
    this.shape = "";
  }

  /** Shows the nodes, each before its children; only the texts change while the tree has the same shape. */
  show(rows) {
    show(this.root, rows.length > 0);
    const shape = JSON.stringify(rows.map(([depth, name, kind]) => [depth, name, kind]));
    if (shape !== this.shape) {
      this.shape = shape;
      this.list.replaceChildren(...rows.map(node));
    }
    rows.forEach(([, , , status, message], index) => {
      const [mark, , , text] = this.list.children[index].children;
      set(this.list.children[index], "data-status", status);
      say(mark, MARKS[status]);
      set(mark, "aria-label", status.toLowerCase());
      say(text, message);
    });
  }
}

function node([depth, name, kind]) {
  const item = h("li", {}, h("span.mark", { role: "img" }), h("b", {}, name), h("small.dim", {}, kind), h("small.message"));
  item.style.setProperty("--depth", depth);
  return item;
}
