// The connection to the server: it sends frames by itself, and answers questions.

const AGAIN_MS = 1000;
const PATIENCE_MS = 35000;
/** The server closes the connection with this code if it wants the password. */
const NEEDS_PASSWORD = 4401;
/** The longest message that the server takes, in bytes. */
const LONGEST = 16 * 1024;

export class Link {
  /**
   * @param {string} token The token in the address of the page, which the server requires.
   * @param {{frame: Function, state: Function}} listener Takes frames, and "open" (with the greeting), "closed" (with the
   *   server's reason, if it gave one), or "password": the server wants it, and `retry` tries again.
   */
  constructor(token, listener) {
    this.token = token;
    this.listener = listener;
    this.number = 0;
    this.waiting = new Map();
    this.#open();
  }

  /** Asks the server; the promise resolves to the answer `{ok, reason, result}`. */
  ask(what, fields = {}) {
    const id = ++this.number;
    return new Promise((resolve) => {
      if (this.socket.readyState !== WebSocket.OPEN) {
        resolve({ ok: false, reason: "the page has lost its server", result: null });
        return;
      }
      const message = JSON.stringify({ ...fields, id, ask: what });
      if (new Blob([message]).size > LONGEST) {
        resolve({ ok: false, reason: "this is too long for a page: use pancakes param set", result: null });
        return;
      }
      const timer = setTimeout(() => this.#settle(id, "no answer came"), PATIENCE_MS);
      this.waiting.set(id, { resolve, timer });
      this.socket.send(message);
    });
  }

  /** Tries again now, after the person has signed in. */
  retry() {
    this.#open();
  }

  #open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/news`);
    this.socket.onmessage = (event) => this.#take(JSON.parse(event.data));
    this.socket.onopen = async () => {
      const greeting = await this.ask("hello", { token: this.token });
      if (greeting.ok) this.listener.state("open", greeting.result);
    };
    this.socket.onclose = (event) => {
      for (const id of [...this.waiting.keys()]) this.#settle(id, "the page has lost its server");
      if (event.code === NEEDS_PASSWORD) {
        this.listener.state("password", event.reason);
        return;
      }
      this.listener.state("closed", event.reason);
      setTimeout(() => this.#open(), AGAIN_MS);
    };
  }

  #take(message) {
    if (message.answer === undefined) {
      this.listener.frame(message);
      return;
    }
    const waiting = this.waiting.get(message.answer);
    if (!waiting) return;
    clearTimeout(waiting.timer);
    this.waiting.delete(message.answer);
    waiting.resolve(message);
  }

  #settle(id, reason) {
    const waiting = this.waiting.get(id);
    if (!waiting) return;
    clearTimeout(waiting.timer);
    this.waiting.delete(id);
    waiting.resolve({ ok: false, reason, result: null });
  }
}
