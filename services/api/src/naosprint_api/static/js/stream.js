/** Server-sent events over fetch: EventSource cannot send an Authorization header. */

import { ApiError, OfflineError, request } from "./api.js";

/** Split a text stream into events after the rules of the HTML standard; feed() returns the complete ones. */
export class EventParser {
  #rest = "";
  #event = { type: "", data: [], id: undefined };

  feed(text) {
    const events = [];
    const lines = (this.#rest + text).split(/\r\n|\n|\r(?!$)/);
    this.#rest = lines.pop();
    for (const line of lines) {
      if (line === "") {
        if (this.#event.data.length)
          events.push({ type: this.#event.type || "message", data: this.#event.data.join("\n"), id: this.#event.id });
        this.#event = { type: "", data: [], id: undefined };
        continue;
      }
      const colon = line.indexOf(":");
      if (colon === 0) continue;
      const field = colon < 0 ? line : line.slice(0, colon);
      const value = colon < 0 ? "" : line.slice(colon + 1).replace(/^ /, "");
      if (field === "data") this.#event.data.push(value);
      else if (field === "event") this.#event.type = value;
      else if (field === "id") this.#event.id = value;
    }
    return events;
  }
}

const HIDDEN_MS = 30_000; // a background tab disconnects: browsers allow six connections to one origin
const SILENCE_MS = 45_000; // the service sends a comment at least every 15 s
const links = new Set();
const watchers = new Set();
/** Whether the browser only keeps this page for its Back button, where a stream would hold a connection. */
let left = false;
addEventListener("pagehide", () => {
  left = true;
});
addEventListener("pageshow", () => {
  left = false;
});

/** Call `listener("idle" | "live" | "connecting" | "offline")` whenever the connection as a whole changes. */
export function onConnection(listener) {
  watchers.add(listener);
  return () => watchers.delete(listener);
}

function publish() {
  const states = [...links].map((l) => l.state);
  const state = !states.length
    ? "idle"
    : states.includes("offline")
      ? "offline"
      : states.includes("connecting")
        ? "connecting"
        : "live";
  for (const w of watchers) w(state);
}

/**
 * Follow a stream until `signal` aborts; reconnects with back-off and Last-Event-ID.
 *
 * @param {string} path
 * @param {{signal: AbortSignal, lastId?: string, onEvent: (type: string, data: any, id?: string) => void, onError?:
 *   (error: Error) => void}} options
 *   onError gets errors that a retry does not fix (401, 403, 404); the stream ends then.
 */
export async function follow(path, { signal, lastId, onEvent, onError }) {
  const link = { state: "connecting" };
  links.add(link);
  publish();
  const set = (state) => {
    if (link.state !== state) {
      link.state = state;
      publish();
    }
  };
  let failures = 0;
  try {
    while (!signal.aborted) {
      await untilVisible(signal);
      if (signal.aborted) return;
      const attempt = new AbortController();
      const stop = () => attempt.abort();
      signal.addEventListener("abort", stop, { once: true });
      let watchdog;
      let rest;
      let resting = false;
      const retire = () => {
        resting = true;
        stop();
      };
      const onVisibility = () => {
        clearTimeout(rest);
        if (document.hidden) rest = setTimeout(retire, HIDDEN_MS);
      };
      document.addEventListener("visibilitychange", onVisibility);
      addEventListener("pagehide", retire);
      try {
        const headers = { Accept: "text/event-stream" };
        if (lastId !== undefined) headers["Last-Event-ID"] = lastId;
        const response = await request(path, { headers, signal: attempt.signal });
        set("live");
        failures = 0;
        const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
        const parser = new EventParser();
        const pet = () => {
          clearTimeout(watchdog);
          watchdog = setTimeout(stop, SILENCE_MS);
        };
        pet();
        for (;;) {
          const { value, done } = await reader.read();
          if (done) break;
          pet();
          for (const event of parser.feed(value)) {
            if (event.id !== undefined) lastId = event.id;
            let data;
            try {
              data = JSON.parse(event.data);
            } catch {
              data = event.data;
            }
            onEvent(event.type, data, event.id);
            if (event.type === "end" || (event.type === "gone" && path.indexOf("jobs/stream") < 0)) return;
          }
        }
        set("connecting");
      } catch (error) {
        if (signal.aborted) return;
        if (resting) continue;
        if (error instanceof ApiError && [400, 401, 403, 404, 422].includes(error.status)) {
          onError?.(error);
          return;
        }
        failures += 1;
        set(error instanceof OfflineError || failures > 1 ? "offline" : "connecting");
      } finally {
        clearTimeout(watchdog);
        clearTimeout(rest);
        document.removeEventListener("visibilitychange", onVisibility);
        removeEventListener("pagehide", retire);
        signal.removeEventListener("abort", stop);
      }
      await pause(Math.min(15_000, 500 * 2 ** Math.min(failures, 5)) * (0.75 + Math.random() / 2), signal);
    }
  } finally {
    links.delete(link);
    publish();
  }
}

function untilVisible(signal) {
  if (!document.hidden && !left) return undefined;
  return new Promise((resolve) => {
    const done = () => {
      if ((document.hidden || left) && !signal.aborted) return;
      document.removeEventListener("visibilitychange", done);
      removeEventListener("pageshow", done);
      signal.removeEventListener("abort", done);
      resolve();
    };
    document.addEventListener("visibilitychange", done);
    addEventListener("pageshow", done);
    signal.addEventListener("abort", done);
  });
}

function pause(ms, signal) {
  return new Promise((resolve) => {
    const done = () => {
      clearTimeout(timer);
      window.removeEventListener("online", done);
      signal.removeEventListener("abort", done);
      resolve();
    };
    const timer = setTimeout(done, ms);
    window.addEventListener("online", done);
    signal.addEventListener("abort", done);
  });
}
