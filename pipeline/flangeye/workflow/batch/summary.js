(() => {
  "use strict";
  // Numbers by size, "0.2 mm" and "pose 10" by the numbers in them; empty cells always last.
  function compare(a, b) {
    if (a.dataset.number && b.dataset.number) return a.dataset.number - b.dataset.number;
    return a.textContent.localeCompare(b.textContent, "en", { numeric: true });
  }

  function sort(table, column, heading) {
    const down = heading.getAttribute("aria-sort") === "ascending";
    for (const other of heading.parentNode.cells) other.removeAttribute("aria-sort");
    heading.setAttribute("aria-sort", down ? "descending" : "ascending");
    const body = table.tBodies[0];
    const rows = [...body.rows].sort((first, second) => {
      const [a, b] = [first.cells[column], second.cells[column]];
      const empty = (a.textContent === "") - (b.textContent === "");
      return empty || (down ? -compare(a, b) : compare(a, b));
    });
    body.append(...rows);
  }

  for (const input of document.querySelectorAll("input[data-filters]"))
    input.addEventListener("input", () => {
      const words = input.value.toLowerCase().split(/\s+/);
      for (const row of document.getElementById(input.dataset.filters).tBodies[0].rows)
        row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
    });

  for (const table of document.querySelectorAll("table.sortable"))
    [...table.tHead.rows[0].cells].forEach((heading, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...heading.childNodes);
      button.addEventListener("click", () => sort(table, column, heading));
      heading.append(button);
    });
})();
