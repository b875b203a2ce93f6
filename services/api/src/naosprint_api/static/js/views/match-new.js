/** Form that submits a match of two teams. */

import { every, submission } from "../api.js";
import { h } from "../dom.js";
import { complain, field, open } from "./dialog.js";

const EXAMPLE = "example";
/** Skill of the example player by the task of its policy. */
const SKILLS = { velocity: "walk", kick: "kick", block: "keep", getup: "getup" };
const ROBOT = "t1";

/** Teams that the user can name: the example player, also with other policies, and uploaded ones. */
async function knownTeams(signal) {
  const [teams, policies] = await Promise.all([every("teams", { signal }), every("policies", { signal })]);
  const fitting = policies.filter((card) => card.robot === ROBOT && SKILLS[card.task]);
  return [
    EXAMPLE,
    ...teams.map((team) => team.name),
    ...fitting.map((card) => `${EXAMPLE}:${SKILLS[card.task]}=${card.reference}`),
  ];
}

/** Ask for a match and submit it; opens the page of the match. */
export async function newMatch(signal, go) {
  const list = h("datalist", { id: "match-teams" });
  const team = (side, value) =>
    h("input", {
      id: `match-team-${side}`,
      name: `match-team-${side}`,
      list: list.id,
      value,
      required: true,
      maxlength: 200,
      spellcheck: "false",
      autocomplete: "off",
    });
  const number = (name, value, min, max) =>
    h("input", { id: `match-${name}`, name: `match-${name}`, type: "number", min, max, value, required: true });
  const teams = [team("a", EXAMPLE), team("b", "")];
  const games = number("games", 20, 1, 1000);
  const players = number("players", 3, 1, 7);
  const seconds = number("seconds", 300, 1, 300);
  const film = h(
    "select",
    { id: "match-film", name: "match-film" },
    [
      ["goals", "What led to goals"],
      ["all", "Whole games"],
      ["off", "Nothing"],
    ].map(([value, text]) => h("option", { value }, text)),
  );
  const gate = h("input", { id: "match-gate", name: "match-gate", type: "checkbox" });
  const trouble = h("p", { class: "problem", role: "alert" });
  const send = submission();
  const submit = async (event) => {
    event.preventDefault();
    const body = {
      teams: teams.map((input) => input.value.trim()),
      games: Number(games.value),
      players: Number(players.value),
      half_s: Number(seconds.value),
      film: film.value,
      gate: gate.checked,
    };
    try {
      const match = await send("matches", body);
      dialog.close();
      go(`/matches/${match.id}`);
    } catch (error) {
      complain(trouble, error);
    }
  };
  const dialog = open(
    "New match",
    h(
      "form",
      { class: "stack", onsubmit: submit },
      list,
      field(
        "Team A",
        teams[0],
        "example, example:walk=POLICY,kick=POLICY,keep=POLICY,getup=POLICY, or an uploaded team.",
      ),
      field("Team B", teams[1]),
      h(
        "div",
        { class: "thirds" },
        field("Games", games),
        field("Players of a team", players),
        field("Seconds of a half", seconds),
      ),
      field("Film", film),
      h(
        "div",
        { class: "field check" },
        h(
          "label",
          { for: gate.id },
          gate,
          h("span", null, "End as soon as a test has decided whether team A does not lose"),
        ),
      ),
      trouble,
      h(
        "div",
        { class: "row end" },
        h("button", { type: "button", onclick: () => dialog.close() }, "Back"),
        h("button", { class: "primary", type: "submit" }, "Submit"),
      ),
    ),
  );
  try {
    list.append(...(await knownTeams(signal)).map((value) => h("option", { value })));
  } catch (error) {
    if (error.name !== "AbortError") complain(trouble, error);
  }
}
