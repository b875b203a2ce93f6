/** Filters, groups and saved views of the list of jobs. */

import { every, query } from "../api.js";
import { nameOf } from "../descriptions.js";
import { fill, h, icon } from "../dom.js";
import { integer } from "../format.js";
import { read, write } from "../kept.js";

const VIEWS_KEY = "naosprint.jobs.views";

/** Ways to group jobs by the name that the address uses. */
export const GROUPS = {
  task: grouping("Task", (job) => nameOf(job.spec, "task")),
  robot: grouping("Robot", (job) => nameOf(job.spec, "robot")),
  owner: grouping("Owner", (job) => job.owner),
  group: grouping("Study or sweep", (job) => job.group_id ?? ""),
};

function grouping(title, value) {
  const heading = (name, jobs, list) => {
    const shown = title.startsWith("Study") ? list.menus.nameOfGroup(name) : name;
    const line = h(
      "tr",
      { class: "group" },
      h("th", { colspan: 99, scope: "rowgroup" }, shown, h("span", { class: "muted" }, ` ${integer(jobs.length)}`)),
    );
    return { element: line };
  };
  return { title, value, heading };
}

/** The menus above the list. */
export class ListMenus {
  constructor(list) {
    this.list = list;
    this.studies = new Map();
    this.selects = new Map();
    const select = (name, label) => {
      const control = h("select", {
        "aria-label": label,
        "data-filter": name,
        onchange: () => list.apply({ [name]: control.value }),
      });
      this.selects.set(name, control);
      return control;
    };
    this.views = h("div", { class: "menu-list" });
    this.viewsMenu = h("details", { class: "menu" }, h("summary", { class: "button" }, "Views"), this.views);
    this.elements = [
      select("task", "Task"),
      select("robot", "Robot"),
      select("owner", "Owner"),
      select("group", "Study or sweep"),
      select("by", "Group by"),
    ];
    this.paintViews();
    this.loadStudies();
  }

  async loadStudies() {
    try {
      const studies = await every("studies", { signal: this.list.signal });
      this.studies = new Map(studies.map((study) => [study.id, study.name]));
      this.paint();
    } catch {
      /* the list works without their names */
    }
  }

  /** Name of a study, or of a sweep by its jobs. */
  nameOfGroup(id) {
    if (!id) return "Single jobs";
    const first = [...this.list.jobs.values()].find((job) => job.group_id === id);
    return this.studies.get(id) ?? `Sweep ${first ? `of ${first.name}` : id.slice(-6)}`;
  }

  /** Offer what the listed jobs have, and what is chosen now. */
  paint() {
    const jobs = [...this.list.jobs.values()];
    for (const [name, { title, value }] of Object.entries(GROUPS)) {
      const chosen = this.list.filter[name];
      const names = new Set(jobs.map(value).filter(Boolean));
      if (name === "group") for (const id of this.studies.keys()) names.add(id);
      if (chosen) names.add(chosen);
      const text = name === "group" ? (id) => this.nameOfGroup(id) : (id) => id;
      const options = [...names].map((id) => [id, text(id)]).sort((a, b) => a[1].localeCompare(b[1]));
      this.offer(name, title, options);
      this.selects.get(name).hidden = !chosen && names.size < 2;
    }
    const ways = Object.entries(GROUPS).map(([name, { title }]) => [name, `By ${title.toLowerCase()}`]);
    this.offer("by", "No groups", ways);
  }

  offer(name, title, options) {
    const control = this.selects.get(name);
    const key = JSON.stringify(options);
    if (this.list.filter[name] === control.value && control.dataset.key === key) return;
    control.dataset.key = key;
    fill(
      control,
      h("option", { value: "" }, title),
      options.map(([value, text]) => h("option", { value }, text)),
    );
    control.value = this.list.filter[name];
  }

  /** Views by name: the address of the list, and its columns. */
  paintViews() {
    const kept = () => read(VIEWS_KEY) ?? {}; // other tabs change them, too
    const views = kept();
    const name = h("input", { id: "view-name", type: "text", required: true, maxlength: 60, autocomplete: "off" });
    const save = (event) => {
      event.preventDefault();
      const { filter, own, hidden } = this.list;
      const view = { address: query(filter), own: [...own], hidden: [...hidden] };
      write(VIEWS_KEY, { ...kept(), [name.value.trim()]: view });
      this.paintViews();
    };
    fill(
      this.views,
      Object.keys(views)
        .sort()
        .map((title) =>
          h(
            "div",
            { class: "row" },
            h("button", { type: "button", class: "ghost grow", onclick: () => this.open(views[title]) }, title),
            h(
              "button",
              {
                type: "button",
                class: "ghost square",
                "aria-label": `Delete view ${title}`,
                onclick: () => {
                  const { [title]: gone, ...left } = kept();
                  write(VIEWS_KEY, left);
                  this.paintViews();
                },
              },
              icon("close"),
            ),
          ),
        ),
      h(
        "form",
        { class: "stack", onsubmit: save },
        h("div", { class: "field" }, h("label", { for: "view-name" }, "Save filters and columns as"), name),
        h("button", { type: "submit" }, "Save view"),
      ),
    );
  }

  open(view) {
    this.viewsMenu.open = false;
    this.list.setView(view.own, view.hidden);
    this.list.go(`/${view.address}`);
  }
}
