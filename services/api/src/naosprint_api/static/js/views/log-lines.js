/** Lines of logs: each has the time of its day, below a mark for each day and attempt. */

import { h } from "../dom.js";
import { clock, day, stamp } from "../format.js";

const mark = (text) => h("div", { class: "mark" }, text);

/**
 * A function that returns the elements of the next line of a log.
 *
 * @returns {(line: {at: string, attempt: number, message: string}, level: string, label?: string) => Element[]}
 */
export function logLines() {
  let last = null;
  return (line, level, label = level) => {
    const { at, attempt, message } = line;
    const marks = [
      last && last.attempt !== attempt ? mark(`Attempt ${attempt}`) : null,
      !last || day(last.at) !== day(at) ? mark(day(at)) : null,
    ];
    last = line;
    const row = h(
      "div",
      { class: "line", "data-level": level },
      h("time", { datetime: at, title: stamp(at) }, clock(at)),
      h("span", { class: "level" }, label),
      h("span", { class: "msg" }, message),
    );
    return [...marks.filter(Boolean), row];
  };
}
