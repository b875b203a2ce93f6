/** One match: its results, its games, the one that runs, and replays. */

import { call, download, may } from "../api.js";
import { descriptions } from "../descriptions.js";
import { fill, h, heading, icon, scroller, table, toast } from "../dom.js";
import { bytes, stamp } from "../format.js";
import { isEnded, stateBadge, stateNote } from "../states.js";
import { action } from "./dialog.js";
import { GameFilm, GameReplay, LiveGame } from "./game.js";
import { MatchHistory } from "./match-history.js";
import { live, loading, notice, waiting } from "./messages.js";

const REFRESH_MS = 1000;
const ROBOT = "t1";

const card = (title, ...kids) =>
  h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, title)), ...kids);

function results(match) {
  if (!match.table.length) return null;
  const headings = ["Measured", ...match.teams].map((title, i) => heading(title, i > 0));
  const rows = match.table.map(([what, ...values]) =>
    h(
      "tr",
      null,
      h("th", { scope: "row" }, what),
      values.map((value) => h("td", { class: "num" }, value)),
    ),
  );
  return card(
    "Results, means of a game",
    scroller("Results", table(headings, rows)),
    h(
      "div",
      { class: "pad soft" },
      match.sums.map((text) => h("p", null, text)),
    ),
  );
}

/** A button that downloads the log or the film of a game. */
function file(game, kind) {
  const found = game[kind];
  if (!found) return h("span", { class: "muted" }, "none");
  return h(
    "button",
    {
      class: "small",
      "aria-label": `Download the ${kind} of game ${game.number}, ${bytes(found.size)}`,
      onclick: () => download(found.url, found.name).catch((error) => toast(error.message, "error")),
    },
    icon("download"),
    bytes(found.size),
  );
}

function games(match, shown) {
  if (!match.finished.length) return null;
  const row = (game) =>
    h(
      "tr",
      { "aria-current": game.number === shown ? "true" : null },
      h("td", null, h("a", { href: `#/matches/${match.id}/${game.number}` }, `Watch game ${game.number}`)),
      h("td", { class: "num" }, game.goals.join(" : ")),
      h(
        "td",
        null,
        game.lost.map((each) => h("div", null, `${match.teams[each.team]} ${each.number}: ${each.reason}`)),
      ),
      h("td", { class: "num", title: stamp(game.finished_at) }, stamp(game.finished_at)),
      h("td", { class: "num" }, file(game, "log")),
      h("td", { class: "num" }, file(game, "film")),
    );
  const headings = ["Game", "Goals", "Lost players", "Ended", "Log", "Film"];
  return card(
    "Games",
    scroller(
      "Games",
      table(
        headings.map((title, i) => heading(title, i !== 0 && i !== 2)),
        match.finished.map(row),
      ),
    ),
  );
}

/** Show the page in `root`. */
export async function mount(root, { id, sub, signal, go }) {
  document.title = "Match · naosprint";
  const head = h("div", { class: "page-head" }, loading("Loading the match"));
  const running = h("section", { class: "card", hidden: true });
  const replay = h("section", { class: "card", hidden: true });
  const film = h("section", { class: "card", hidden: true });
  const details = h("div", { class: "stack" });
  const history = new MatchHistory(id, signal);
  history.element.hidden = true;
  fill(root, head, h("div", { class: "stack" }, running, replay, film, details, history.element));
  const known = await descriptions();
  let match = null;
  let game = null;
  let recording = null;
  let playing = null;
  let watched = Number(sub) || null;
  let shown = "";

  const gone = () => {
    toast(`${match.teams.join(" – ")} was deleted.`);
    go("/league");
  };

  function buttons() {
    const title = match.teams.join(" – ");
    const path = `matches/${id}`;
    const after = () => again();
    const question =
      match.state === "queued"
        ? null
        : {
            title: `Cancel ${title}?`,
            body: "Games that run stop. Those that are over are kept, and the match can be retried.",
            action: "Cancel match",
          };
    if (!isEnded(match.state))
      return match.cancel_requested ? null : action("cancel", "Cancel", "close", `${path}/cancel`, { question, after });
    return [
      match.state === "succeeded" ? null : action("retry", "Retry", "retry", `${path}/retry`, { after }),
      action("delete", "Delete", "trash", path, {
        method: "DELETE",
        question: {
          title: `Delete ${title}?`,
          body: "Its games, their logs and films are deleted and no longer count in the league. This cannot be undone.",
          action: "Delete match",
        },
        after: (done) => (done ? gone() : again()),
      }),
    ];
  }

  function paint() {
    document.title = `${match.teams.join(" – ")} · naosprint`;
    const about = `${match.played} of ${match.games} games, ${match.players} ${match.players === 1 ? "player" : "players"}, 2 × ${match.half_s} s`;
    fill(
      head,
      h("div", { class: "grow" }, h("h1", null, match.teams.join(" – ")), h("p", { class: "soft" }, about)),
      stateBadge(match.state, stateNote(match)),
      may("submit") ? buttons() : null,
    );
    fill(
      details,
      waiting(match),
      match.error
        ? notice("error", match.state === "failed" ? "The match failed." : "The last attempt was lost.", match.error)
        : null,
      results(match),
      games(match, watched),
    );
  }

  function watch() {
    const over = match.finished.find((each) => each.number === watched);
    if (over && !recording) recording = new GameReplay(replay, over.log.url, known.field(ROBOT), signal);
    if (over?.film && !playing) playing = new GameFilm(film, over.film, signal);
    replay.hidden = !over;
    film.hidden = !over?.film;
    running.hidden = !match.live || Boolean(over);
    if (running.hidden) return;
    game ??= new LiveGame(running, match.teams, known.field(ROBOT));
    game.show(match.live).catch((error) => toast(`The running game cannot be shown: ${error.message}`, "error"));
  }

  async function read() {
    match = await call(`matches/${id}`, { signal });
    history.element.hidden = false;
    await history.refresh();
    watch();
    const text = JSON.stringify({ ...match, live: null, watched });
    if (text !== shown) paint();
    shown = text;
    return !isEnded(match.state);
  }

  const again = await live(head, read, REFRESH_MS, signal, gone);
  return {
    update(where) {
      if (where.id !== id) return false;
      recording?.destroy();
      playing?.destroy();
      recording = playing = null;
      watched = Number(where.sub) || null;
      again();
      return true;
    },
    destroy() {
      game?.destroy();
      recording?.destroy();
      playing?.destroy();
    },
  };
}
