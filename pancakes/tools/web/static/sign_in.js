// Asks for the password of the page. The server answers with a cookie that scripts cannot read.

import { h, say } from "./words.js";

export class SignIn {
  /**
   * @param {HTMLDialogElement} dialog Asks the person.
   * @param {Function} done Called when the server has accepted the password.
   */
  constructor(dialog, done) {
    this.dialog = dialog;
    this.done = done;
    this.asks = false;
    // Nothing is shown without the password, so escape does not close it.
    dialog.addEventListener("cancel", (event) => this.asks && event.preventDefault());
  }

  /** Asks for the password; does nothing while it asks already. */
  ask() {
    if (this.asks) return;
    this.asks = true;
    this.field = h("input", { type: "password", name: "password", autocomplete: "current-password", required: true, "aria-label": "Password" });
    this.said = h("p.said", { role: "status" });
    this.button = h("button.primary", {}, "Sign in");
    const form = h("form.signin", { onsubmit: (event) => this.#submit(event) }, this.field, this.button);
    this.dialog.replaceChildren(h("h2", { id: "dialog-title" }, "This page needs its password"), h("p.dim", {}, "The person who started the page with pancakes view --host knows it."), form, this.said);
    if (!this.dialog.open) this.dialog.showModal();
    this.field.focus();
  }

  async #submit(event) {
    event.preventDefault();
    this.button.disabled = true;
    say(this.said, "asking …");
    // A header can have no other letters; and another site cannot set it without asking this server first.
    const password = btoa(String.fromCharCode(...new TextEncoder().encode(this.field.value)));
    let answer;
    try {
      answer = await fetch("login", { headers: { "X-Page-Password": password } });
    } catch {
      say(this.said, "The server cannot be reached.");
    }
    this.button.disabled = false;
    if (!answer) return;
    if (!answer.ok) {
      say(this.said, (await answer.text()).trim());
      this.field.select();
      return;
    }
    this.asks = false;
    this.dialog.close();
    this.done();
  }
}

/** Forgets the password in this browser. */
export async function signOut() {
  await fetch("logout", { headers: { "X-Page-Password": "" } });
  location.reload();
}
