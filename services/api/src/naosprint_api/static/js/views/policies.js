/** The policies, bundled and registered, as a table of robots and skills: watch, filter, compare. */

import { every, query } from "../api.js";
import { descriptions } from "../descriptions.js";
import { fill, h, heading, icon, scroller, table } from "../dom.js";
import { headline } from "../evaluation.js";
import { compact, duration, integer, withUnit, words } from "../format.js";
import { open } from "./dialog.js";
import { loading, problem } from "./messages.js";
import { Player } from "./player.js";
import { headlineStats, stat } from "./results.js";

/** Results in a cell of the table. */
const MOST_RESULTS = 2;

/** Headline of a policy's card as a block. */
export function headlineBlock(card) {
  const jobs = card.lineage.length > 1 ? `${card.lineage.length} jobs` : "1 job";
  const trained = stat(
    "Trained",
    compact(card.steps),
    "steps",
    `${jobs}, ${duration(card.training_s)}`,
    `${integer(card.steps)} environment steps`,
  );
  return h("div", { class: "stats six" }, headlineStats(card), trained);
}

/** A policy's aliases, robot and task as tags. */
export const tags = (card) => [...card.aliases, card.task, card.robot].map((text) => h("span", { class: "tag" }, text));

const ownerQuery = (card) => (card.owner ? query({ owner: card.owner }) : "");

/** The address of a policy's page. */
export const pageOf = (card) => `#/policies/${card.reference}${ownerQuery(card)}`;

/** Play an episode of a policy in a dialog. */
function watch(card) {
  const stage = h("div", { class: "card" });
  const close = h("button", { onclick: () => dialog.close() }, "Close");
  const dialog = open(
    card.reference,
    h("p", { class: "soft" }, card.sentence),
    stage,
    h("div", { class: "row end" }, close),
  );
  dialog.classList.add("wide");
  const stopped = new AbortController();
  const path = `policies/${encodeURIComponent(card.reference)}/replay${ownerQuery(card)}`;
  const player = new Player(stage, { path, task: card.task, signal: stopped.signal });
  dialog.addEventListener("close", () => {
    stopped.abort();
    player.destroy();
  });
}

const filterOf = (params) => Object.fromEntries(["q", "robot", "skill"].map((name) => [name, params.get(name) ?? ""]));

class PoliciesView {
  constructor(root, { params, signal, go }) {
    this.root = root;
    this.signal = signal;
    this.go = go;
    this.chosen = new Set();
    this.filter = filterOf(params);
  }

  start() {
    document.title = "Policies · naosprint";
    this.bar = h("div", { class: "select-bar", hidden: true });
    this.box = h("div", { class: "card" }, loading("Loading policies"));
    this.search = h("input", {
      type: "search",
      placeholder: "Search name, sentence, task or owner",
      "aria-label": "Search policies",
      value: this.filter.q,
      oninput: () => this.apply({ q: this.search.value.trim() }),
    });
    this.selects = Object.fromEntries(
      [
        ["robot", "Robot"],
        ["skill", "Skill"],
      ].map(([name, title]) => {
        const control = h("select", {
          "aria-label": title,
          "data-filter": name,
          onchange: () => this.apply({ [name]: control.value }),
        });
        return [name, control];
      }),
    );
    fill(
      this.root,
      h(
        "div",
        { class: "page-head" },
        h(
          "div",
          { class: "grow" },
          h("h1", null, "Policies"),
          h("p", { class: "soft" }, "Bundled policies, and the newest version of each that you have registered."),
        ),
      ),
      h(
        "div",
        { class: "filters" },
        h("div", { class: "search" }, icon("search"), this.search),
        Object.values(this.selects),
      ),
      this.box,
      this.bar,
    );
    this.load();
  }

  async load() {
    try {
      [this.known, this.cards] = await Promise.all([descriptions(), every("policies", { signal: this.signal })]);
      this.offer("robot", "Robot", new Map(this.cards.map((card) => [card.robot, this.robotOf(card)])));
      this.offer("skill", "Skill", new Map(this.cards.map((card) => [this.skillOf(card), this.skillOf(card)])));
      this.paint();
    } catch (error) {
      if (error.name !== "AbortError")
        fill(
          this.box,
          problem(error, () => this.load()),
        );
    }
  }

  skillOf(card) {
    return this.known.task(card.task)?.skill || words(card.task);
  }

  robotOf(card) {
    return this.known.robot(card.robot)?.title ?? card.robot;
  }

  offer(name, title, options) {
    const control = this.selects[name];
    const entries = [...options].sort((a, b) => a[1].localeCompare(b[1]));
    fill(
      control,
      h("option", { value: "" }, `Any ${title.toLowerCase()}`),
      entries.map(([value, text]) => h("option", { value }, text)),
    );
    control.value = options.has(this.filter[name]) ? this.filter[name] : "";
  }

  apply(change) {
    this.filter = { ...this.filter, ...change };
    this.go(`/policies${query(this.filter)}`, { replace: true });
  }

  /** The address changes with the filter only. */
  update({ path, params }) {
    if (path !== "/policies") return false;
    this.filter = filterOf(params);
    if (this.search.value.trim() !== this.filter.q) this.search.value = this.filter.q;
    for (const [name, control] of Object.entries(this.selects)) control.value = this.filter[name];
    this.paint();
    return true;
  }

  fits(card) {
    const { q, robot, skill } = this.filter;
    const text = [card.reference, card.sentence, card.task, card.owner, ...card.aliases].join(" ").toLowerCase();
    return (
      (!robot || robot === card.robot) &&
      (!skill || skill === this.skillOf(card)) &&
      q
        .toLowerCase()
        .split(/\s+/)
        .every((word) => text.includes(word))
    );
  }

  choose(card, on) {
    if (on) this.chosen.add(card.reference);
    else this.chosen.delete(card.reference);
    this.paintBar();
  }

  paintBar() {
    const { size } = this.chosen;
    this.bar.hidden = size === 0;
    const clear = () => {
      this.chosen.clear();
      this.paintBar();
      this.paint();
    };
    const href = `#/policies-compared?of=${[...this.chosen].join(",")}`;
    fill(
      this.bar,
      h("span", null, `${size} selected`),
      size > 1 ? h("a", { class: "button primary small", href }, "Compare") : null,
      h("button", { class: "ghost small", onclick: clear }, "Clear"),
    );
  }

  entry(card) {
    const href = pageOf(card);
    const box = h("input", {
      type: "checkbox",
      checked: this.chosen.has(card.reference),
      "aria-label": `Compare ${card.reference}`,
      onchange: () => this.choose(card, box.checked),
    });
    const results = card.results.length ? headline(card).slice(0, MOST_RESULTS) : [];
    return h(
      "div",
      { class: "policy", "data-policy": card.name },
      h(
        "div",
        { class: "row" },
        box,
        h("a", { class: "name", href }, card.reference),
        card.aliases.map((a) => h("span", { class: "tag" }, a)),
      ),
      h("p", { class: "soft" }, card.sentence),
      results.length
        ? h("p", { class: "num" }, results.map((r) => `${r.title} ${withUnit(r, r.value)}`).join(", "))
        : h("p", { class: "muted" }, "Not evaluated yet"),
      card.episodes
        ? h(
            "button",
            { class: "small", "aria-label": `Watch ${card.reference}`, onclick: () => watch(card) },
            icon("play"),
            "Watch",
          )
        : null,
    );
  }

  paint() {
    if (!this.cards) return;
    const cards = this.cards.filter((card) => this.fits(card));
    if (!cards.length) {
      fill(
        this.box,
        h(
          "div",
          { class: "empty" },
          h("h2", null, this.cards.length ? "No matching policies" : "No policies are bundled with this version"),
          h(
            "p",
            null,
            this.cards.length ? "No policy matches this filter." : "Train one, and register a checkpoint of its job.",
          ),
        ),
      );
      return;
    }
    const skillOf = (card) => this.skillOf(card);
    const robotOf = (card) => this.robotOf(card);
    const robots = Map.groupBy(cards, robotOf);
    const rows = this.ranked(robotOf, skillOf).filter((robot) => robots.has(robot));
    const shown = new Set(cards.map(skillOf));
    const skills = this.ranked(skillOf, robotOf).filter((skill) => shown.has(skill));
    fill(
      this.box,
      this.table(
        rows.map((robot) => [robot, robots.get(robot)]),
        skills,
      ),
    );
  }

  /** The robots by their number of skills, or the skills by that of robots, the most first, whatever the filter. */
  ranked(of, counted) {
    const groups = Map.groupBy(this.cards, of);
    const count = (name) => new Set(groups.get(name).map(counted)).size;
    return [...groups.keys()].sort((a, b) => count(b) - count(a) || a.localeCompare(b));
  }

  /** The table; `rows` are pairs of a robot and its cards. */
  table(rows, skills) {
    const cell = (own, skill) => {
      const found = own.filter((card) => this.skillOf(card) === skill);
      return h(
        "td",
        { "data-label": found.length ? skill : null },
        found.map((card) => this.entry(card)),
      );
    };
    const row = ([robot, own]) =>
      h(
        "tr",
        null,
        h("th", { scope: "row" }, robot),
        skills.map((skill) => cell(own, skill)),
      );
    const headings = ["Robot", ...skills].map((title) => heading(title));
    return scroller("Policies by robot and skill", table(headings, rows.map(row), { class: "policies" }));
  }
}

/** Show the page in `root`. */
export async function mount(root, context) {
  const view = new PoliciesView(root, context);
  view.start();
  return { update: (where) => view.update(where), destroy: () => {} };
}
