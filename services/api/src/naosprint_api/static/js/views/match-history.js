/** History of a match and the lines of its log, as they come. */

import { call, query } from "../api.js";
import { h } from "../dom.js";
import { words } from "../format.js";
import { STATES } from "../states.js";
import { logLines } from "./log-lines.js";

const PAGE = 200;
const LEVELS = ["info", "warning", "error"];

export class MatchHistory {
  constructor(id, signal) {
    this.path = `matches/${id}/events`;
    this.signal = signal;
    this.lines = logLines();
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

  #add(event) {
    const { id, kind } = event;
    this.last = id;
    this.box.append(...this.lines(event, kind, LEVELS.includes(kind) ? kind : (STATES[kind]?.label ?? words(kind))));
  }
}
