// What the page shows stands in its address, after the #, so that a person can come back to it and pass it on.

const PAUSE_MS = 250;

export class Address {
  /** @param {Function} changed Called when a person has changed the address. */
  constructor(changed) {
    this.changed = changed;
    this.#read();
    window.addEventListener("hashchange", () => {
      clearTimeout(this.timer);
      this.#read();
      this.changed();
    });
  }

  #read() {
    this.values = new URLSearchParams(location.hash.slice(1));
  }

  /** Returns a part of the address; empty if it is missing. */
  get(name) {
    return this.values.get(name) ?? "";
  }

  /** Returns a part of the address that is a list. */
  list(name) {
    return this.get(name).split(",").filter(Boolean);
  }

  /** Sets a part of the address; an empty one is left out. */
  set(name, value) {
    if (this.get(name) === value) return;
    if (value) this.values.set(name, value);
    else this.values.delete(name);
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.#write(), PAUSE_MS);
  }

  #write() {
    const text = this.values.toString().replaceAll("%2F", "/").replaceAll("%2C", ",").replaceAll("%7E", "~");
    history.replaceState(null, "", `#${text}`);
  }
}
