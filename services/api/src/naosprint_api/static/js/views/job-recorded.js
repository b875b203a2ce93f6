/** What the tabs of a job share that show one of its evaluations: which one, and the choice of another. */

import { h } from "../dom.js";
import { integer, minute } from "../format.js";

export class RecordedTab {
  constructor(root, store, { sub, go }) {
    this.root = root;
    this.store = store;
    this.go = go;
    this.wanted = sub ?? null;
    for (const topic of ["evaluations", "checkpoints"]) store.on(topic, () => this.draw());
    this.draw();
  }

  /** Show another evaluation of the same job. */
  update({ sub }) {
    this.wanted = sub ?? null;
    this.draw();
    return true;
  }

  /** The row above it: a select that shows another one, and `tools` at the end. */
  head(label, tab, evaluations, chosen, ...tools) {
    const steps = new Map((this.store.checkpoints ?? []).map((c) => [c.id, c.step]));
    const step = (e) =>
      steps.has(e.checkpoint_id) ? `Step ${integer(steps.get(e.checkpoint_id))}` : "Deleted checkpoint";
    const title = (e) => `${step(e)}, ${integer(e.spec.episodes)} episodes, ${minute(e.created_at)}`;
    const select = h(
      "select",
      {
        "aria-label": label,
        style: { width: "auto" },
        onchange: () => this.go(`/jobs/${this.store.id}/${tab}/${select.value}`),
      },
      evaluations.map((e) => h("option", { value: e.id }, title(e))),
    );
    select.value = chosen.id;
    return h(
      "div",
      { class: "row wrap", style: { "margin-bottom": "1rem" } },
      select,
      h("span", { style: { flex: 1 } }),
      tools,
    );
  }

  destroy() {
    this.gone = true;
  }
}
