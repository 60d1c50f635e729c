// A form for settings or rates of a task: the agent checks all changes, and takes all of them or none.

import { SettingField } from "./setting_field.js";
import { h, say, show } from "./words.js";

export class FieldForm {
  /**
   * @param {string} title The title of the form.
   * @param {Function} order Asks the agent, given the fields and whether to check them only. The promise resolves to
   *   `{ok, reason, problems}`: problems are `[name, text]` of the fields with bad values.
   */
  constructor(title, order) {
    this.order = order;
    this.fields = new Map();
    this.shape = "";
    this.box = h("div.fields");
    this.note = h("p.dim", { hidden: true });
    this.said = h("p.said", { role: "status" });
    const button = (text, action) => h("button", { type: "button", onclick: action }, text);
    this.buttons = h(
      "div.buttons",
      { hidden: true },
      button("Undo", () => this.#undo()),
      button("Check", () => this.#ask(true)),
      h("button.primary", { type: "submit" }, "Apply"),
    );
    this.root = h("form.changes", { novalidate: true, hidden: true, "aria-label": title }, h("h3", {}, title), this.note, this.box, this.buttons, this.said);
    this.root.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#ask(false);
    });
  }

  /**
   * Shows fields with the agent's present values.
   * @param {object[]} fields See `SettingField`.
   * @param {boolean} editable Whether the page may change them.
   * @param {string} note A note above the fields.
   */
  show(fields, editable, note = "") {
    show(this.root, fields.length > 0 || Boolean(note));
    say(this.note, note);
    show(this.note, Boolean(note));
    const shape = JSON.stringify([editable, fields.map(({ name, kind, min, max, choices, fixed }) => [name, kind, min, max, choices, fixed])]);
    if (shape !== this.shape) {
      this.shape = shape;
      this.fields = new Map(fields.map((field) => [field.name, new SettingField(field, editable)]));
      this.box.replaceChildren(...[...this.fields.values()].map((it) => it.root));
      show(this.buttons, [...this.fields.values()].some((it) => it.editable));
    } else {
      for (const field of fields) this.fields.get(field.name).update(field);
    }
  }

  #undo() {
    for (const field of this.fields.values()) field.reset();
    this.#say("");
  }

  async #ask(dry) {
    const changed = [...this.fields.values()].filter((it) => it.changed);
    for (const field of this.fields.values()) field.refuse("");
    const wrong = changed.filter((field) => !isValue(field));
    if (!changed.length || wrong.length) {
      this.#say(wrong.length ? "not sent: see above" : "nothing to apply: no field was changed", wrong.length > 0);
      wrong[0]?.control.focus();
      return;
    }
    this.#say(dry ? "checking …" : "asking …");
    const { ok, reason, problems } = await this.order([...this.fields.values()], dry);
    if (!ok) {
      const beside = problems.filter(([name]) => this.fields.has(name));
      for (const [name, text] of beside) this.fields.get(name).refuse(text);
      this.#say(beside.length && beside.length === problems.length ? "refused, and nothing has changed: see above" : reason, true);
      if (beside.length) this.fields.get(beside[0][0]).control.focus();
      return;
    }
    const names = changed.map((it) => it.field.name).join(", ");
    if (dry) {
      this.#say(`the agent would take ${names}; nothing has changed yet`);
      return;
    }
    for (const field of changed) field.update({ ...field.field, value: field.value() });
    this.#say(`set: ${names}`);
  }

  #say(text, warn = false) {
    this.said.textContent = text;
    this.said.classList.toggle("warn", warn);
    this.said.scrollIntoView({ block: "nearest" });
  }
}

/** Returns whether a field has a valid value; otherwise shows beside it what is wrong. */
function isValue(field) {
  try {
    field.value();
    return true;
  } catch (sentence) {
    field.refuse(String(sentence));
    return false;
  }
}

/** Returns the settings to change so that the changed fields get their values: a table is set as a whole. */
export function changesOf(fields) {
  const changes = {};
  for (const top of new Set(fields.filter((it) => it.changed).map((it) => it.field.path[0]))) {
    for (const field of fields) {
      const [first, ...path] = field.field.path;
      if (first !== top) continue;
      const value = field.changed ? field.value() : field.field.value;
      if (!path.length) {
        changes[top] = value;
        continue;
      }
      let table = (changes[top] ??= {});
      for (const key of path.slice(0, -1)) table = table[key] ??= {};
      table[path.at(-1)] = value;
    }
  }
  return changes;
}
