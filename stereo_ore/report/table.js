"use strict";
// Elements, numbers as text, tables that sort, bars.

const at = id => document.getElementById(id);

function make(tag, text = "", className = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  if (className) element.className = className;
  return element;
}

const fixed = (value, digits, scale = 1) =>
  value === null || value === undefined ? "" : (scale * value).toFixed(digits);
const vector = values => (values ? values.map(value => value.toFixed(3)).join("  ") : "");
const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;

// A column: [heading, value for sorting, text to show (default: the value), "text" for left alignment].
// A row is found again by `key`, and may be the one that is chosen.
function sortable(table, columns, rows, { key = (row, place) => place, onRow, chosen = () => false } = {}) {
  const head = make("thead"),
    body = make("tbody"),
    top = head.appendChild(make("tr"));
  let order = rows.map((row, place) => place),
    sorted = null,
    falling = false;
  const line = place => tableRow(columns, rows[place], key(rows[place], place), { onRow, chosen });
  const show = () => body.replaceChildren(...order.map(line));
  columns.forEach(([heading, value, , kind], number) => {
    const cell = top.appendChild(make("th", "", kind || ""));
    const button = cell.appendChild(make("button", heading));
    button.addEventListener("click", () => {
      falling = sorted === number ? !falling : false;
      sorted = number;
      order.sort((a, b) => compare(value(rows[a]), value(rows[b]), falling) || a - b);
      for (const other of top.children) other.removeAttribute("aria-sort");
      cell.setAttribute("aria-sort", falling ? "descending" : "ascending");
      show();
    });
  });
  show();
  table.replaceChildren(head, body);
}

function compare(a, b, falling) {
  const missing = value => value === null || value === undefined || value === "";
  if (missing(a) || missing(b)) return missing(a) - missing(b); // what is missing comes last either way
  const result =
    typeof a === "number" && typeof b === "number"
      ? a - b
      : String(a).localeCompare(String(b), "en", { numeric: true });
  return falling ? -result : result;
}

function tableRow(columns, row, place, { onRow, chosen }) {
  const line = make("tr", "", chosen(place) ? "chosen" : "");
  line.dataset.place = place;
  for (const [, value, text, kind] of columns) line.append(make("td", (text || value)(row) ?? "", kind || ""));
  if (onRow) line.addEventListener("click", () => onRow(place));
  return line;
}

function bars(table, entries) {
  const top = Math.max(...entries.map(([, value]) => value), 1e-9);
  table.replaceChildren(
    ...entries.map(([name, value, text]) => {
      const line = make("tr"),
        bar = make("div", "", "bar");
      bar.style.width = `${(100 * value) / top}%`;
      line.append(make("td", name, "text"), make("td", text), make("td"));
      line.lastChild.append(bar);
      return line;
    }),
  );
}
