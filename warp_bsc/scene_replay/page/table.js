// A table of any number of rows; the document contains only the visible ones.
"use strict";

const isNarrow = matchMedia("(max-width: 760px)").matches; // on which buttons are below texts

class LongTable {
  // columns: {title, width, number, fill(cell, row), key(row)}; key returns a number or a text to sort by. Rows are shown
  // in the order in which they are given, which is that of the column `natural.index`, -1 for none; `natural.way` is -1 if it descends.
  constructor(parent, columns, rowHeight, select, natural = { index: 0, way: 1 }) {
    Object.assign(this, { parent, columns, rowHeight, select, natural, rows: [], sorted: natural, selected: -1, drawn: null, given: [], isPrinting: false });
    const table = add(parent, "table");
    const head = add(add(table, "thead"), "tr");
    this.heads = columns.map((column, index) => {
      const cell = add(head, "th", { scope: "col", class: `${column.class || ""} ${column.number ? "number" : ""}` });
      add(cell, "button", { type: "button" }, column.title).addEventListener("click", () => this.sort(index));
      return cell;
    });
    this.body = add(table, "tbody");
    this.table = table;
    this.markOrder();
    this.note = add(parent, "p", { class: "muted small print-only" });
    addEventListener("beforeprint", () => this.drawForPrint());
    addEventListener("afterprint", () => { this.isPrinting = false; this.refresh(); });
    parent.addEventListener("scroll", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(parent);
    this.body.addEventListener("click", (event) => {
      const line = event.target.closest("tr[data-at]");
      if (line && !event.target.closest("a")) this.choose(Number(line.dataset.at));
    });
    parent.addEventListener("keydown", (event) => {
      const step = { ArrowUp: -1, ArrowDown: 1 }[event.key];
      if (!step || event.shiftKey || !this.rows.length) return;
      event.preventDefault();
      const at = this.rows.indexOf(this.selected);
      this.choose(Math.max(0, Math.min(this.rows.length - 1, at + step)));
    });
  }

  // Shows other rows, numbers that the columns understand.
  show(rows) {
    this.given = rows;
    this.table.setAttribute("aria-rowcount", rows.length + 1);
    this.order();
    this.parent.scrollTop = 0;
    this.draw();
  }

  sort(index) {
    this.sorted = { index, way: this.sorted.index === index ? -this.sorted.way : 1 };
    this.markOrder();
    this.order();
    this.parent.scrollTop = 0;
    this.draw();
  }

  markOrder() {
    this.heads.forEach((head) => head.removeAttribute("aria-sort"));
    this.heads[this.sorted.index]?.setAttribute("aria-sort", this.sorted.way > 0 ? "ascending" : "descending");
  }

  order() {
    const { index, way } = this.sorted, { natural } = this;
    if (index === natural.index && way === natural.way) {
      this.rows = this.given;
      return;
    }
    const keys = new Map();
    for (const row of this.given) keys.set(row, this.columns[index].key(row));
    const compare = (a, b) => (a < b ? -1 : a > b ? 1 : 0);
    this.rows = this.given.slice().sort((a, b) => way * compare(keys.get(a), keys.get(b)) || a - b);
  }

  // Selects the row at an index, and scrolls to it.
  choose(at) {
    this.selected = this.rows[at];
    const top = at * this.rowHeight, seen = this.parent.clientHeight - 2 * this.rowHeight;
    if (top < this.parent.scrollTop) this.parent.scrollTop = top;
    else if (top > this.parent.scrollTop + seen) this.parent.scrollTop = top - seen;
    this.draw();
    this.select(this.selected);
  }

  // Draws the visible rows again, as what they show has changed.
  refresh() {
    this.drawn = null;
    this.draw();
  }

  // A print has the first rows only, and says so.
  drawForPrint() {
    this.isPrinting = true;
    const shown = Math.min(this.rows.length, 50);
    this.body.replaceChildren(this.lines(0, shown));
    this.note.textContent = shown < this.rows.length ? `The first ${count(shown)} of ${count(this.rows.length)} rows.` : "";
  }

  draw() {
    if (this.isPrinting) return; // which changes sizes
    const { parent, rows, rowHeight } = this;
    const top = Math.floor(parent.scrollTop / rowHeight), seen = Math.ceil(parent.clientHeight / rowHeight);
    // Visible rows stay in the document: a click needs its row until it ends.
    const { drawn } = this;
    if (drawn && drawn.rows === rows && drawn.selected === this.selected && drawn.first <= Math.max(0, top - 1) && drawn.last >= Math.min(rows.length, top + seen + 1)) return;
    const first = Math.max(0, top - 20), last = Math.min(rows.length, top + seen + 20);
    this.drawn = { rows, selected: this.selected, first, last };
    const space = (number) => {
      const line = document.createElement("tr");
      if (number) add(line, "td").style.height = `${number * rowHeight}px`;
      return line;
    };
    this.body.replaceChildren(space(first), this.lines(first, last), space(rows.length - last));
  }

  lines(first, last) {
    const { rows, rowHeight } = this, lines = document.createDocumentFragment();
    for (let at = first; at < last; at += 1) {
      const line = add(lines, "tr", { "data-at": at, "aria-rowindex": at + 2, class: rows[at] === this.selected ? "chosen" : "" });
      line.style.height = `${rowHeight}px`;
      for (const column of this.columns)
        column.fill(add(line, "td", { class: `${column.class || ""} ${column.number ? "number" : ""}` }), rows[at]);
    }
    return lines;
  }
}
