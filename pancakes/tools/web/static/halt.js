// Halts: the button that makes all actuators stand, and the line that says that they do.

import { h, say, show } from "./words.js";

export class Halt {
  /**
   * @param {Link} link Asks the server.
   * @param {HTMLDialogElement} dialog Asks the person.
   * @param {{button: HTMLElement, line: HTMLElement, said: HTMLElement, end: HTMLElement}} parts The button, and the line.
   * @param {Function} picture Returns the picture of the present.
   */
  constructor(link, dialog, { button, line, said, end }, picture) {
    this.link = link;
    this.dialog = dialog;
    this.picture = picture;
    [this.button, this.line, this.said, this.end] = [button, line, said, end];
    this.failed = "";
    button.addEventListener("click", () => this.#all("halt"));
    end.addEventListener("click", () => this.#askToEnd());
  }

  /** Shows whether agents are halted; only a page with control has buttons. */
  render(control, open) {
    const picture = this.picture();
    const agents = picture.agents();
    const halted = agents.filter((name) => picture.get("agent", name).halt);
    const all = halted.length > 0 && agents.every((name) => picture.get("agent", name).role !== "agent" || halted.includes(name));
    show(this.button, control && open && agents.length > 0 && !all);
    const why = halted.length ? picture.get("agent", halted[0]).halt : "";
    const who = halted.length && !all ? `${halted.join(", ")}: ` : "";
    say(this.said, [halted.length ? `${who}${why}. All actuators are stopped.` : "", this.failed].filter(Boolean).join(" "));
    show(this.line, Boolean(halted.length || this.failed));
    show(this.end, control && open && halted.length > 0);
  }

  /** Sends an order to all agents at once, so that none waits for another. */
  async #all(what, names = this.picture().agents()) {
    this.failed = "";
    const asked = names.map(async (agent) => ({ agent, ...(await this.link.ask("order", { do: what, agent })) }));
    const answers = await Promise.all(asked);
    this.failed = answers
      .filter(({ ok }) => !ok)
      .map(({ agent, reason }) => (reason.includes(agent) ? reason : `${agent}: ${reason}`))
      .join("; ");
  }

  #askToEnd() {
    const picture = this.picture();
    const names = picture.agents().filter((name) => picture.get("agent", name).halt);
    const cancel = h("button", { type: "button", onclick: () => this.dialog.close() }, "Cancel");
    const confirm = h("button.primary", { type: "button" }, "Let them move");
    confirm.addEventListener("click", () => {
      this.dialog.close();
      this.#all("end_halt", names);
    });
    this.dialog.replaceChildren(
      h("h2", { id: "dialog-title" }, "End the halt?"),
      h("p", {}, `The actuators of ${names.join(", ")} may move at once.`),
      h("div.buttons", {}, cancel, confirm),
    );
    if (!this.dialog.open) this.dialog.showModal();
    cancel.focus();
  }
}
