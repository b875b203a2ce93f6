/** Start the dashboard: frame, sign-in, routes, keyboard. */

import {
  borrowToken,
  call,
  clearToken,
  may,
  OfflineError,
  onSignOut,
  onUnauthorised,
  setScopes,
  setToken,
  token,
  url,
  useToken,
} from "./api.js";
import { confirmDialog, fill, focusTitle, h, icon, isTyping, toast } from "./dom.js";
import { PAGES, pageAt, SHORTCUTS, shortcut } from "./pages.js";
import { onConnection } from "./stream.js";
import { setTheme, theme } from "./theme.js";
import { problem } from "./views/messages.js";

const main = document.getElementById("main");
const top = document.getElementById("top");
const REOPEN_MS = 3000;
let current = null;
let turn = 0;

const ANOTHER_TOKEN = {
  title: "Use the token of this link?",
  body: "You are signed in already, with another token. The link’s token would replace it in this tab only.",
  action: "Use the link’s token",
};

/** A path with its escapes resolved; as it is where they are none. */
function decoded(path) {
  try {
    return decodeURI(path);
  } catch {
    return path;
  }
}

/** Split "#/jobs/x?tab=1" into path and parameters. */
function place() {
  const [path, search] = (location.hash.slice(1) || "/").split(/\?(.*)/s);
  return { path: decoded(path), params: new URLSearchParams(search) };
}

/** Open a page of the dashboard. */
function go(path, { replace = false } = {}) {
  if (replace) {
    history.replaceState(null, "", `#${path}`);
    show();
  } else location.hash = path;
}

async function show() {
  const mine = ++turn;
  const { path, params } = place();
  if (params.has("token")) {
    const given = params.get("token");
    params.delete("token");
    history.replaceState(null, "", `#${path === "/sign-in" ? "/" : path}${params.size ? `?${params}` : ""}`);
    // A link from somebody else must not change unnoticed as whom one submits.
    const stored = token() ?? ((await borrowToken()) ? token() : null);
    if (!stored || stored === given || (await confirmDialog(ANOTHER_TOKEN))) useToken(given);
    if (token() !== stored) leave(); // the page shows what the other token sees
    return show();
  }
  if (!token() && !(await borrowToken())) return mine === turn ? signIn() : undefined;
  await identify();
  if (mine !== turn) return;
  top.hidden = false;
  const found = pageAt(path);
  // A view may handle a change of address within itself (another tab, another filter) without a rebuild.
  const where = { path, params, ...(found?.parts ?? {}) };
  if (found && current?.update && current.name === found.name && current.update(where)) {
    frame(found);
    return;
  }
  leave();
  frame(found);
  if (!found) {
    document.title = "Not found · naosprint";
    fill(
      main,
      h(
        "div",
        { class: "card empty" },
        h("h1", null, "There is no such page"),
        h("p", null, `There is nothing at ${path}.`),
        h("a", { class: "button primary", href: "#/" }, "Show all jobs"),
      ),
    );
    return;
  }
  const controller = new AbortController();
  // A view that was left opens no other page when an answer comes that it waited for.
  const goFromHere = (to, how) => controller.signal.aborted || go(to, how);
  current = { name: found.name, page: found, controller };
  try {
    const module = await found.load().catch(() => {
      throw new OfflineError("A part of this page could not be loaded.");
    });
    if (mine !== turn) return;
    // A view that was left while it was loading paints into an element that is no longer shown.
    const root = h("div");
    fill(main, root);
    const view = await module.mount(root, { ...where, signal: controller.signal, go: goFromHere });
    if (mine !== turn) {
      view?.destroy?.();
      return;
    }
    current = { name: found.name, page: found, controller, destroy: view?.destroy, update: view?.update };
  } catch (error) {
    if (error.name === "AbortError" || mine !== turn) return;
    fill(main, problem(error, error instanceof OfflineError ? reopen : show));
    if (error instanceof OfflineError) {
      const timer = setInterval(reopen, REOPEN_MS);
      controller.signal.addEventListener("abort", () => clearInterval(timer));
    }
  }
  if (document.activeElement?.closest?.("main")) return;
  focusTitle();
  scrollTo(0, 0);
}

/** Load the page again if the service answers: a module that failed to load stays failed until then. */
const reopen = () =>
  call("whoami").then(
    () => location.reload(),
    () => {},
  );

function leave() {
  for (const dialog of document.querySelectorAll("dialog[open]")) dialog.close();
  current?.controller?.abort();
  current?.destroy?.();
  current = null;
}

const THEMES = {
  auto: ["light", "auto", "System theme"],
  light: ["dark", "sun", "Light theme"],
  dark: ["auto", "moon", "Dark theme"],
};

function themeButton() {
  const button = h("button", {
    class: "ghost square",
    onclick: () => {
      setTheme(THEMES[theme()][0]);
      paint();
    },
  });
  const paint = () => {
    const [, glyph, label] = THEMES[theme()];
    fill(button, icon(glyph));
    button.setAttribute("aria-label", `${label}; switch`);
    button.title = label;
  };
  paint();
  return button;
}

const linkState = h("span", { class: "link-state", "data-state": "idle", hidden: true });
onConnection((state) => {
  linkState.dataset.state = state;
  const words = { idle: "", live: "Live", connecting: "Connecting", offline: "No connection" };
  fill(linkState, h("span", null, words[state]));
  linkState.title = {
    idle: "This page has no live data",
    live: "New data is shown as it arrives",
    connecting: "Connecting to the service",
    offline: "The service does not answer; trying again",
  }[state];
  linkState.hidden = state === "idle";
});

let identity = null;

/** Request, once per token, who is signed in and where the documentation is. */
async function identify() {
  const mine = token();
  if (identity?.token === mine) return;
  identity = null;
  try {
    identity = { token: mine, ...(await call("whoami", { quiet401: true })) };
  } catch {
    /* the page itself shows what is wrong */
  }
  setScopes(identity?.scopes);
}

function frame(page) {
  const documents = identity?.docs_url;
  const logo = new URL("../favicon.svg", import.meta.url).href;
  fill(
    top,
    h(
      "a",
      { class: "brand", href: "#/", "aria-label": "naosprint: all jobs" },
      h("img", { src: logo, alt: "" }),
      h("span", null, "naosprint"),
    ),
    h(
      "nav",
      { "aria-label": "Main" },
      PAGES.filter((p) => p.nav).map((p) =>
        h("a", { href: `#${p.path}`, "aria-current": p.name === page?.name ? "page" : null }, p.nav),
      ),
    ),
    h("span", { class: "space" }),
    linkState,
    documents
      ? h(
          "a",
          {
            class: "button ghost wide-only",
            href: new URL(page?.docs ?? "index.html", documents).href,
            target: "_blank",
            rel: "noreferrer",
          },
          "Docs",
        )
      : null,
    themeButton(),
    h(
      "button",
      {
        class: "ghost square wide-only",
        "aria-label": "Keyboard shortcuts",
        title: "Keyboard shortcuts (?)",
        onclick: showKeys,
      },
      "?",
    ),
    h(
      "button",
      {
        class: "ghost square",
        "aria-label": "Sign out",
        title: "Sign out",
        onclick: () => {
          clearToken({ everywhere: true });
          leave();
          signIn();
        },
      },
      icon("out"),
    ),
    may("submit")
      ? h("a", { class: "button primary", href: "#/submit" }, icon("plus"), h("span", null, "New job"))
      : null,
  );
}

/** Whether a read of the page below the dialog of the sign-in was refused. */
let stale = false;
const signInDialog = () => document.querySelector("dialog[data-part=sign-in]");

/** Show the sign-in form; the address stays and is opened afterwards. A dialog keeps the page and what it holds. */
function signIn(message, { dialog = null } = {}) {
  if (!dialog) {
    turn += 1;
    leave();
    fill(top);
    top.hidden = true;
    document.title = "Sign in · naosprint";
  }
  const input = h("input", {
    id: "token",
    name: "token",
    type: "password",
    autocomplete: "current-password",
    required: true,
    spellcheck: "false",
    "aria-describedby": "token-hint token-problem",
  });
  const remember = h("input", { type: "checkbox", id: "remember" });
  const trouble = h("p", { class: "problem", id: "token-problem", role: "alert" }, message ?? "");
  const button = h("button", { class: "primary", type: "submit" }, "Sign in");
  const submit = async (event) => {
    event.preventDefault();
    const value = input.value.trim();
    if (!value) {
      fill(trouble, "Paste a token first.");
      input.focus();
      return;
    }
    button.disabled = true;
    fill(trouble);
    try {
      await call("whoami", { as: value, quiet401: true });
      setToken(value, remember.checked);
      if (dialog && !stale) {
        dialog.close();
        await identify();
        frame(current?.page);
        return;
      }
      leave();
      top.hidden = false;
      show();
    } catch (error) {
      input.setAttribute("aria-invalid", "true");
      fill(
        trouble,
        error.status === 401
          ? "This token is not valid. Check that it is complete, not expired and not revoked."
          : error.status === 403
            ? "This token may not read jobs. Ask for one with the scope “read”."
            : error.message,
      );
      input.focus();
      input.select();
    } finally {
      button.disabled = false;
    }
  };
  fill(
    dialog ?? main,
    h(
      "div",
      { class: "sign-in" },
      h(
        "form",
        { class: "card", onsubmit: submit, novalidate: true },
        h(
          "div",
          null,
          h(
            "span",
            { class: "brand" },
            h("img", { src: new URL("../favicon.svg", import.meta.url).href, alt: "" }),
            "naosprint",
          ),
          h("h1", { class: "sr" }, "Sign in to naosprint"),
          h("p", { class: "soft" }, "Sign in with an access token to see and submit training jobs."),
        ),
        h("input", {
          type: "text",
          name: "username",
          autocomplete: "username",
          value: "naosprint",
          hidden: true,
          readonly: true,
          tabindex: -1,
        }), // password managers ask for a name
        h(
          "div",
          { class: "field" },
          h("label", { for: "token" }, "Access token"),
          input,
          h(
            "p",
            { class: "hint", id: "token-hint" },
            h("code", null, "naoctl up"),
            " prints one when it starts the service on this machine; elsewhere ask your administrator.",
          ),
          trouble,
        ),
        h("label", { class: "row", for: "remember" }, remember, "Keep me signed in on this device"),
        button,
      ),
    ),
  );
  input.focus();
}

function showKeys() {
  const rows = [...PAGES.filter((page) => page.keys), ...SHORTCUTS];
  const documents = identity?.docs_url;
  const dialog = h(
    "dialog",
    { class: "modal", "aria-labelledby": "keys-title" },
    h(
      "form",
      { method: "dialog" },
      h("h2", { id: "keys-title" }, "Keyboard"),
      h(
        "dl",
        { class: "keys" },
        rows.map(({ keys, about, nav }) => [
          h(
            "dt",
            null,
            keys.map((key) => [h("span", { class: "kbd" }, key), " "]),
          ),
          h("dd", null, about ?? nav),
        ]),
      ),
      h(
        "p",
        null,
        documents ? [h("a", { href: documents, target: "_blank", rel: "noreferrer" }, "Documentation"), " · "] : null,
        h("a", { href: url("openapi.json").href, target: "_blank", rel: "noreferrer" }, "HTTP API (OpenAPI)"),
      ),
      h("div", { class: "row end" }, h("button", { value: "ok" }, "Close")),
    ),
  );
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}

const RUN = {
  help: showKeys,
  theme: () => {
    setTheme(THEMES[theme()][0]);
    toast(THEMES[theme()][2]);
    frame(current?.page);
  },
};

const PREFIX_MS = 1200;
let prefix = { key: undefined, at: 0 };
addEventListener("keydown", (event) => {
  const menu = event.key === "Escape" && document.activeElement?.closest("details.menu[open]");
  if (menu) {
    menu.open = false;
    menu.querySelector("summary").focus();
  }
  const busy = event.ctrlKey || event.metaKey || event.altKey || isTyping(event);
  if (busy || document.querySelector("dialog[open]") || !token()) return;
  const before = Date.now() - prefix.at < PREFIX_MS ? prefix.key : undefined;
  const found = shortcut(event.key, before) ?? shortcut(event.key, undefined);
  prefix = { key: event.key === "g" ? "g" : undefined, at: Date.now() };
  if (!found) return;
  event.preventDefault();
  event.stopImmediatePropagation();
  if (found.run) RUN[found.run]();
  else go(found.path);
});

onSignOut(() => {
  leave();
  signIn();
});
onUnauthorised((refused, method) => {
  clearToken({ only: refused });
  if (signInDialog()) {
    stale = true;
    return;
  }
  const message = "The token is no longer valid. Sign in again.";
  if (method === "GET") {
    leave();
    if (token()) show();
    else signIn(message);
    return;
  }
  stale = false;
  const dialog = h("dialog", { class: "modal", "data-part": "sign-in", "aria-label": "Sign in" });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  signIn(message, { dialog });
});
addEventListener("hashchange", show);
show();
