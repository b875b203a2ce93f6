/** The log of a job, following its end unless the reader has scrolled up. */

import { save } from "../api.js";
import { fill, h, icon, toast } from "../dom.js";
import { logLines } from "./log-lines.js";

const LEVELS = { debug: 10, info: 20, warning: 30, error: 40, critical: 50 };

export class LogTab {
  constructor(root, store) {
    this.store = store;
    this.shown = 0;
    this.minimum = 0;
    this.needle = "";
    this.follow = true;
    this.box = h("div", {
      class: "log",
      tabindex: 0,
      role: "log",
      "aria-label": "Log lines",
      onscroll: () => this.onScroll(),
    });
    this.jump = h(
      "button",
      {
        class: "small",
        hidden: true,
        onclick: () => {
          this.follow = true;
          this.toEnd();
        },
      },
      "Follow",
    );
    const level = h(
      "select",
      {
        "aria-label": "Show from level",
        style: { width: "auto" },
        onchange: () => {
          this.minimum = Number(level.value);
          this.rebuild();
        },
      },
      h("option", { value: 0 }, "All levels"),
      h("option", { value: 20 }, "Info and up"),
      h("option", { value: 30 }, "Warnings and errors"),
      h("option", { value: 40 }, "Errors"),
    );
    const search = h("input", {
      type: "search",
      placeholder: "Filter lines",
      "aria-label": "Filter log lines",
      style: { width: "14rem", "min-width": "6rem" },
      oninput: () => {
        this.needle = search.value.toLowerCase();
        this.rebuild();
      },
    });
    fill(
      root,
      h(
        "section",
        { class: "card" },
        h(
          "div",
          { class: "card-head" },
          h("h2", null, "Log"),
          this.jump,
          search,
          level,
          h(
            "button",
            {
              class: "ghost square",
              "aria-label": "Save these lines as a file",
              title: "Save these lines",
              onclick: () => this.save(),
            },
            icon("download"),
          ),
        ),
        this.box,
      ),
    );
    store.on("logs", () => this.append());
    this.rebuild();
  }

  rebuild() {
    this.shown = 0;
    this.last = 0;
    this.lines = logLines();
    this.box.replaceChildren();
    if (this.store.logsBefore) {
      const more = h(
        "button",
        { class: "small", "data-action": "earlier", onclick: () => this.earlier(more) },
        "Show earlier lines",
      );
      this.box.append(h("div", { class: "mark" }, more));
    }
    this.append();
  }

  /** Show the page of lines before the first one; what is in view stays where it is. */
  async earlier(button) {
    button.disabled = true;
    try {
      await this.store.earlierLogs();
    } catch (error) {
      toast(error.message, "error");
      button.disabled = false;
      return;
    }
    const below = this.box.scrollHeight - this.box.scrollTop;
    this.follow = false;
    this.rebuild();
    this.box.scrollTop = this.box.scrollHeight - below;
  }

  append() {
    if (this.gone) return;
    const fresh = this.store.logs.filter((line) => line.id > this.last);
    const rows = document.createDocumentFragment();
    for (const line of fresh) {
      this.last = line.id;
      if (
        (LEVELS[line.level] ?? 20) < this.minimum ||
        (this.needle && !line.message.toLowerCase().includes(this.needle))
      )
        continue;
      rows.append(...this.lines(line, line.level));
      this.shown += 1;
    }
    this.box.querySelector(".nothing")?.remove();
    this.box.append(rows);
    if (!this.shown)
      this.box.append(
        h(
          "div",
          { class: "mark nothing" },
          this.store.logs.length
            ? "No line matches this filter."
            : "Nothing logged yet. Lines appear here as the worker writes them.",
        ),
      );
    if (this.follow) this.toEnd();
  }

  toEnd() {
    this.box.scrollTop = this.box.scrollHeight;
  }

  onScroll() {
    this.follow = this.box.scrollHeight - this.box.scrollTop - this.box.clientHeight < 24;
    this.jump.hidden = this.follow;
  }

  save() {
    save(
      new Blob(
        [this.store.logs.map((l) => `${l.at} ${l.level.toUpperCase()} [attempt ${l.attempt}] ${l.message}\n`).join("")],
        { type: "text/plain" },
      ),
      `${this.store.job.name}.log`,
    );
  }

  destroy() {
    this.gone = true;
  }
}
