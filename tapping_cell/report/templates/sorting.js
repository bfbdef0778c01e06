// A click on a heading sorts the table. Numbers sort by the `data-key` of their cell, words by their text. Unknown
// values stay last in both directions. A screen reader announces `aria-sort`.
for (const table of document.querySelectorAll("table.sorts")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.firstChild.addEventListener("click", () => {
    const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    const key = ({cells}) => cells[column].dataset.key ?? cells[column].textContent;
    const order = (a, b) => a - b || a.localeCompare(b, "en", {numeric: true});
    const compare = (a, b) =>
      key(a) && key(b) ? sign * order(key(a), key(b)) : !key(a) - !key(b);
    table.tBodies[0].append(...[...table.tBodies[0].rows].sort(compare));
    heads.forEach((each) => each.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", sign < 0 ? "descending" : "ascending");
  }));
}
