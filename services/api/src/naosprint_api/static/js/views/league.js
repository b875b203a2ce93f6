/** The league: teams by Elo over all games, and the matches. */

import { call, may } from "../api.js";
import { fill, h, heading, icon, scroller, table } from "../dom.js";
import { ago, fixed, stamp } from "../format.js";
import { stateBadge, stateNote } from "../states.js";
import { newMatch } from "./match-new.js";
import { listed, loading } from "./messages.js";

const REFRESH_MS = 10_000;

const NONE = h(
  "div",
  { class: "empty" },
  h("h2", null, "No matches yet"),
  h("p", null, "Let two teams play: ", h("code", null, "naoctl match example example:walk=t1-run-robust")),
);

const number = (text) => h("td", { class: "num" }, text);

const standing = (team, i) =>
  h(
    "tr",
    null,
    number(String(i + 1)),
    h("td", null, team.name),
    number(fixed(team.rating, 0)),
    [team.wins, team.draws, team.losses].map((count) => number(String(count))),
    number(team.goals.join(" : ")),
  );

const row = (match) =>
  h(
    "tr",
    null,
    h("td", null, h("a", { href: `#/matches/${match.id}` }, match.teams.join(" – "))),
    h("td", null, stateBadge(match.state, stateNote(match))),
    number(`${match.played} of ${match.games}`),
    [match.wins, match.draws, match.losses].map((count) => number(String(count))),
    h("td", { class: "num", title: stamp(match.created_at) }, ago(match.created_at)),
  );

const card = (title, headings, texts, rows) =>
  h(
    "section",
    { class: "card" },
    h("div", { class: "card-head" }, h("h2", null, title)),
    scroller(
      title,
      table(
        headings.map((name) => heading(name, !texts.includes(name))),
        rows,
      ),
    ),
  );

/** Show the page in `root`. */
export async function mount(root, { signal, go }) {
  document.title = "League · naosprint";
  const box = h("div", { class: "stack" }, loading("Loading the league"));
  const add = may("submit")
    ? h("button", { class: "primary", onclick: () => newMatch(signal, go) }, icon("plus"), "New match")
    : null;
  fill(root, h("div", { class: "page-head" }, h("h1", { class: "grow" }, "League"), add), box);
  const draw = async (items) => {
    const teams = await call("league", { signal });
    if (!items.length) return h("div", { class: "card" }, NONE);
    return [
      teams.length
        ? card("Teams", ["Place", "Team", "Elo", "Won", "Drawn", "Lost", "Goals"], ["Team"], teams.map(standing))
        : null,
      card(
        "Matches",
        ["Match", "State", "Games", "Won", "Drawn", "Lost", "Submitted"],
        ["Match", "State"],
        items.map(row),
      ),
    ];
  };
  await listed(box, "matches", draw, REFRESH_MS, signal);
}
