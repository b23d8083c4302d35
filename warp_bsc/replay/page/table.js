// A table of any number of rows; the document contains only the visible ones.
"use strict";

class LongTable {
  // columns: {title, width, number, fill(cell, row), key(row)}; key returns a number or a text to sort by.
  constructor(parent, columns, rowHeight, select) {
    Object.assign(this, { parent, columns, rowHeight, select, rows: [], sorted: null, selected: -1, drawn: null });
    const table = add(parent, "table");
    const head = add(add(table, "thead"), "tr");
    this.heads = columns.map((column, index) => {
      const cell = add(head, "th", { scope: "col", class: `${column.class || ""} ${column.number ? "number" : ""}` });
      add(cell, "button", { type: "button" }, column.title).addEventListener("click", () => this.sort(index));
      return cell;
    });
    this.body = add(table, "tbody");
    this.table = table;
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
    this.rows = rows;
    this.table.setAttribute("aria-rowcount", rows.length + 1);
    if (this.sorted) this.order();
    this.parent.scrollTop = 0;
    this.draw();
  }

  sort(index) {
    this.sorted = { index, way: this.sorted && this.sorted.index === index ? -this.sorted.way : 1 };
    this.heads.forEach((head) => head.removeAttribute("aria-sort"));
    this.heads[index].setAttribute("aria-sort", this.sorted.way > 0 ? "ascending" : "descending");
    this.order();
    this.parent.scrollTop = 0;
    this.draw();
  }

  order() {
    const { index, way } = this.sorted;
    const keys = new Map();
    for (const row of this.rows) keys.set(row, this.columns[index].key(row));
    const compare = (a, b) => (a < b ? -1 : a > b ? 1 : 0);
    this.rows = this.rows.slice().sort((a, b) => way * compare(keys.get(a), keys.get(b)) || a - b);
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

  draw() {
    const { parent, rows, rowHeight } = this;
    const top = Math.floor(parent.scrollTop / rowHeight), seen = Math.ceil(parent.clientHeight / rowHeight);
    // Visible rows stay in the document: a click needs its row until it ends.
    const { drawn } = this;
    if (drawn && drawn.rows === rows && drawn.selected === this.selected && drawn.first <= Math.max(0, top - 1) && drawn.last >= Math.min(rows.length, top + seen + 1)) return;
    const first = Math.max(0, top - 20), last = Math.min(rows.length, top + seen + 20);
    this.drawn = { rows, selected: this.selected, first, last };
    const lines = document.createDocumentFragment();
    const space = (count) => { if (count) add(add(lines, "tr"), "td").style.height = `${count * rowHeight}px`; };
    space(first);
    for (let at = first; at < last; at += 1) {
      const line = add(lines, "tr", { "data-at": at, "aria-rowindex": at + 2, class: rows[at] === this.selected ? "chosen" : "" });
      line.style.height = `${rowHeight}px`;
      for (const column of this.columns)
        column.fill(add(line, "td", { class: `${column.class || ""} ${column.number ? "number" : ""}` }), rows[at]);
    }
    space(rows.length - last);
    this.body.replaceChildren(lines);
  }
}
