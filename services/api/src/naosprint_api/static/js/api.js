/** Client of the HTTP API of the same origin: bearer token, problem+json errors, downloads. */

// This module lives in <root>/ui/js/, so the API's root is two levels up, behind any path prefix of a proxy.
const ROOT = new URL("../../", import.meta.url);
const KEY = "naosprint.token";

function stores() {
  const found = [];
  for (const name of ["sessionStorage", "localStorage"]) {
    try {
      found.push(window[name]);
    } catch {
      /* storage refused by the browser */
    }
  }
  return found;
}

let memory = null;
/** Return the stored token or null. */
export function token() {
  for (const store of stores()) if (store.getItem(KEY)) return store.getItem(KEY);
  return memory;
}

/** Keep the token for this tab, or for this browser when `remember`. */
export function setToken(value, remember) {
  clearToken();
  if (!remember) return useToken(value);
  memory = value;
  try {
    localStorage.setItem(KEY, value);
  } catch {
    /* memory only */
  }
}

/** Use a token in this tab; the one that the browser keeps for others stays. */
export function useToken(value) {
  memory = value;
  try {
    sessionStorage.setItem(KEY, value);
  } catch {
    /* memory only */
  }
}

/** Forget the token in this tab, or in all tabs of this browser; with `only`, where it is that one. */
export function clearToken({ everywhere = false, only = null } = {}) {
  memory = null;
  for (const store of stores()) if (!only || store.getItem(KEY) === only) store.removeItem(KEY);
  if (everywhere) channel?.postMessage({ type: "sign-out" });
}

const BORROW_MS = 250;
const channel = typeof BroadcastChannel === "undefined" ? null : new BroadcastChannel(KEY);
let signedOut = () => {};
/** Set what happens when another tab signs out. */
export function onSignOut(handler) {
  signedOut = handler;
}

channel?.addEventListener("message", ({ data }) => {
  if (data.type === "ask" && token()) channel.postMessage({ type: "token", token: token() });
  else if (data.type === "sign-out" && token()) {
    clearToken();
    signedOut();
  }
});

/** Request the token from another open tab of this browser; resolves to whether there was one. */
export function borrowToken() {
  if (!channel) return Promise.resolve(false);
  return new Promise((resolve) => {
    const done = (found) => {
      clearTimeout(timer);
      channel.removeEventListener("message", take);
      resolve(found);
    };
    const take = ({ data }) => {
      if (data.type !== "token") return;
      setToken(data.token, false);
      done(true);
    };
    const timer = setTimeout(done, BORROW_MS, false);
    channel.addEventListener("message", take);
    channel.postMessage({ type: "ask" });
  });
}

let scopes = null;
/** Set what the token allows; without a list, everything is offered and the service refuses. */
export function setScopes(found) {
  scopes = found ?? null;
}

/** Whether the token has a scope. */
export const may = (scope) => scopes === null || scopes.includes(scope);

/** Response with an error status. `fields` maps field names to messages. */
export class ApiError extends Error {
  constructor(status, problem, requestId) {
    super(problem.detail || problem.title || `The service answered ${status}`);
    this.status = status;
    this.problem = problem;
    this.requestId = requestId;
    this.fields = new Map((problem.errors ?? []).map((e) => [e.field, e.message]));
  }
}

/** The service could not be reached at all. */
export class OfflineError extends Error {}

let unauthorised = () => {};
/** Set what happens, given the refused token and the method, on a 401 from any call but the sign-in's own. */
export function onUnauthorised(handler) {
  unauthorised = handler;
}

export const url = (path) => new URL(path.replace(/^\//, ""), ROOT);

/** Fetch with the token; raise ApiError or OfflineError. Returns the Response. */
export async function request(
  path,
  { method = "GET", body, headers = {}, signal, quiet401 = false, as = token() } = {},
) {
  const all = { Accept: "application/json", ...headers };
  if (as) all.Authorization = `Bearer ${as}`;
  if (body !== undefined) all["Content-Type"] = "application/json";
  let response;
  try {
    response = await fetch(url(path), {
      method,
      headers: all,
      body: body === undefined ? undefined : JSON.stringify(body),
      signal,
      cache: "no-store",
      credentials: "omit",
    });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new OfflineError("The service does not answer.");
  }
  if (response.ok) return response;
  let problem = {};
  try {
    problem = await response.json();
  } catch {
    /* no JSON body: only the status is known */
  }
  const error = new ApiError(response.status, problem, response.headers.get("x-request-id"));
  if (response.status === 401 && !quiet401 && as === token()) unauthorised(as, method);
  throw error;
}

/** Fetch JSON. */
export async function call(path, options) {
  const response = await request(path, options);
  return response.status === 204 ? null : response.json();
}

/**
 * A function that posts a request which makes something. What was pressed twice, or again after a lost answer, has the
 * same key, so that it is made once.
 */
export function submission() {
  let sent;
  let key;
  return async (path, body) => {
    const wanted = JSON.stringify([path, body]);
    if (wanted !== sent) key = crypto.randomUUID?.() ?? String(Math.random());
    sent = wanted;
    const made = await call(path, { method: "POST", body, headers: { "Idempotency-Key": key } });
    sent = null;
    return made;
  };
}

/** Fetch the first `most` items of a list that has pages, and whether there are `more`. */
export async function first(most, path, { params, ...options } = {}) {
  const items = [];
  for (let cursor = null; ; ) {
    const limit = Math.min(200, most - items.length);
    const page = await call(`${path}${query({ ...params, limit, cursor })}`, options);
    items.push(...page.items);
    cursor = page.next_cursor;
    if (!cursor || items.length >= most) return { items, more: Boolean(cursor) };
  }
}

/** Fetch all items of a list that has pages. */
export const every = async (path, options) => (await first(Infinity, path, options)).items;

/** Return "?a=1&b=2" leaving out empty values; arrays repeat the key. */
export function query(params) {
  const q = new URLSearchParams();
  for (const [key, value] of Object.entries(params)) {
    for (const v of Array.isArray(value) ? value : [value])
      if (v !== null && v !== undefined && v !== "") q.append(key, v);
  }
  const text = q.toString();
  return text ? `?${text}` : "";
}

/** Download a file that needs the token: the browser saves it under `name`. */
export async function download(path, name) {
  const response = await request(path, { headers: { Accept: "*/*" } });
  save(await response.blob(), name);
}

/** Save a blob as a download. */
export function save(blob, name) {
  const href = URL.createObjectURL(blob);
  const a = document.createElement("a");
  a.href = href;
  a.download = name;
  a.click();
  setTimeout(() => URL.revokeObjectURL(href), 10_000);
}
