"use strict";
// Sort a table by the column of a heading that is clicked; again: the other way round. Cells without a value stay last.
const key = (row, column) => {
  const cell = row.cells[column];
  return (cell.dataset.value ?? cell.textContent).trim();
};
const sort = (table, column) => {
  const headings = [...table.tHead.rows[0].cells];
  const sign = headings[column].ariaSort === "ascending" ? -1 : 1;
  const rows = [...table.tBodies[0].rows];
  const known = (text) => text !== "" && text !== "nan";
  const numeric = rows.every((row) => !known(key(row, column)) || !Number.isNaN(toNumber(key(row, column))));
  rows.sort((first, second) => {
    const [a, b] = [key(first, column), key(second, column)];
    if (!known(a) || !known(b)) return known(b) - known(a);
    return sign * (numeric ? toNumber(a) - toNumber(b) || 0 : a.localeCompare(b, "en", { numeric: true }));
  });
  table.tBodies[0].append(...rows);
  headings.forEach((heading) => heading.removeAttribute("aria-sort"));
  headings[column].setAttribute("aria-sort", sign === 1 ? "ascending" : "descending");
};
const toNumber = (text) => Number(text.replace(/^(-?)inf$/, "$1Infinity"));
for (const table of document.querySelectorAll("table.sortable")) {
  [...table.tHead.rows[0].cells].forEach((heading, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...heading.childNodes);
    button.addEventListener("click", () => sort(table, column));
    heading.append(button);
  });
}
// A link to something inside closed details opens them.
const reveal = () => {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  for (let element = target; element; element = element.parentElement) if (element.tagName === "DETAILS") element.open = true;
  target?.scrollIntoView();
};
addEventListener("hashchange", reveal);
reveal();
