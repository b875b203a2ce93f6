/** History of a match and the lines of its log, as they come. */

import { call, query } from "../api.js";
import { h } from "../dom.js";
import { clock, stamp, words } from "../format.js";
import { STATES } from "../states.js";

const PAGE = 200;
const LEVELS = ["info", "warning", "error"];

export class MatchHistory {
  constructor(id, signal) {
    this.path = `matches/${id}/events`;
    this.signal = signal;
    this.box = h("div", { class: "log short", tabindex: 0, role: "log", "aria-label": "History and log" });
    this.element = h(
      "section",
      { class: "card" },
      h("div", { class: "card-head" }, h("h2", null, "History and log")),
      this.box,
    );
  }

  /** Read what is new; the end stays in view unless the reader has scrolled up. */
  async refresh() {
    const atEnd = this.box.scrollHeight - this.box.scrollTop - this.box.clientHeight < 24;
    for (;;) {
      const path = `${this.path}${query({ limit: PAGE, after: this.last })}`;
      const { items: events } = await call(path, { signal: this.signal });
      for (const event of events) this.#add(event);
      if (events.length < PAGE) break;
    }
    if (atEnd) this.box.scrollTop = this.box.scrollHeight;
  }

  #add({ id, at, kind, attempt, message }) {
    if (this.attempt !== undefined && this.attempt !== attempt)
      this.box.append(h("div", { class: "mark" }, `Attempt ${attempt}`));
    this.attempt = attempt;
    this.last = id;
    const label = LEVELS.includes(kind) ? kind : (STATES[kind]?.label ?? words(kind));
    this.box.append(
      h(
        "div",
        { class: "line", "data-level": kind },
        h("time", { datetime: at, title: stamp(at) }, clock(at)),
        h("span", { class: "level" }, label),
        h("span", { class: "msg" }, message),
      ),
    );
  }
}
