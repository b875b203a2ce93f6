/** Metrics by column, growing at the end. */

import { csv } from "./format.js";

const NOT_CURVES = new Set(["step", "attempt"]);

export class Columns {
  constructor() {
    this.step = [];
    this.columns = new Map();
  }

  /** Take over a whole answer of the metrics endpoint. */
  load(columns) {
    this.step = columns.step ?? [];
    this.columns = new Map(Object.entries(columns).filter(([name]) => !NOT_CURVES.has(name)));
  }

  get length() {
    return this.step.length;
  }

  /** Return one column, all null when unknown. */
  get(name) {
    return this.columns.get(name) ?? new Array(this.step.length).fill(null);
  }

  has(name) {
    return this.columns.get(name)?.some((v) => v !== null && v !== undefined) ?? false;
  }

  /**
   * Add a row; one whose step is not beyond the last replaces all from there on: the training went back to a
   * checkpoint.
   */
  push(row) {
    while (this.step.length && this.step.at(-1) >= row.step) {
      this.step.pop();
      for (const column of this.columns.values()) column.pop();
    }
    for (const name of Object.keys(row))
      if (!NOT_CURVES.has(name) && !this.columns.has(name))
        this.columns.set(name, new Array(this.step.length).fill(null));
    this.step.push(row.step);
    for (const [name, column] of this.columns) column.push(row[name] ?? null);
  }

  /** Newest value of a column that is one. */
  last(name) {
    const column = this.columns.get(name) ?? [];
    for (let i = column.length - 1; i >= 0; i--) if (column[i] !== null && column[i] !== undefined) return column[i];
    return null;
  }

  /** All columns as CSV text. */
  csv() {
    const names = [...this.columns.keys()];
    return csv([
      ["step", ...names],
      ...this.step.map((step, i) => [step, ...names.map((n) => this.columns.get(n)[i])]),
    ]);
  }
}
