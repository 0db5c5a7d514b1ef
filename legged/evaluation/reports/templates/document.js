"use strict";
for (const table of document.querySelectorAll("table.wide")) {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells], rows = [...body.rows];
  const search = table.closest(".scroll").previousElementSibling;
  const input = search.querySelector("input"), count = search.querySelector(".count");
  const key = (row, i) => {
    const cell = row.cells[i];
    if (!("sort" in cell.dataset)) return cell.textContent.toLowerCase();
    return cell.dataset.sort === "" ? null : Number(cell.dataset.sort);
  };
  const order = (a, b) => (typeof a === "number" && typeof b === "number") ? a - b : String(a).localeCompare(String(b));
  heads.forEach((head, i) => head.querySelector("button").addEventListener("click", () => {
    const numbers = rows.some(row => typeof key(row, i) === "number");
    const now = head.getAttribute("aria-sort");
    const sign = (now ? now === "descending" : !numbers) ? 1 : -1;
    heads.forEach(other => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    const keyed = rows.map((row, n) => [key(row, i), n, row]);
    const last = (a, b) => (a === null) - (b === null);
    keyed.sort(([a, m], [b, n]) => last(a, b) || (a === null ? 0 : sign * order(a, b)) || m - n);
    body.append(...keyed.map(one => one[2]));
  }));
  const filter = () => {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every(word => text.includes(word));
      shown += !row.hidden;
    }
    count.textContent = `${shown} of ${rows.length}`;
  };
  input.addEventListener("input", filter);
  filter();
}
const tip = document.createElement("div");
tip.id = "tip";
tip.hidden = true;
document.body.append(tip);
const lines = svg => [...svg.querySelectorAll("[data-name]")].map(line => ({
  name: line.dataset.name, color: line.dataset.color,
  text: line.dataset.v.split(" "), at: line.dataset.x.split(" ").map(Number)}));
const nearest = (all, x) => all.reduce((best, value, i) => Math.abs(value - x) < Math.abs(all[best] - x) ? i : best, 0);
for (const svg of document.querySelectorAll("svg[data-box]")) {
  const [left, right, from, to] = svg.dataset.box.split(" ").map(Number), unit = svg.dataset.unit, all = lines(svg);
  const cursor = svg.querySelector(".cursor");
  const leave = () => { tip.hidden = true; cursor.setAttribute("visibility", "hidden"); };
  svg.addEventListener("pointermove", event => {
    const box = svg.getBoundingClientRect(), width = svg.viewBox.baseVal.width;
    const x = from + ((event.clientX - box.left) * width / box.width - left) / (right - left) * (to - from);
    if (!all.length || Math.abs(2 * x - from - to) > 1.1 * (to - from)) return leave();
    const picked = all.filter(line => line.at.length).map(line => [line, nearest(line.at, x)]);
    const first = picked[0], at = first[0].at[first[1]];
    tip.replaceChildren(`${unit} ${Number(at.toPrecision(6))}`);
    for (const [line, i] of picked) {
      const row = document.createElement("div"), mark = document.createElement("i");
      mark.style.background = line.color;
      row.append(mark, `${line.name} ${line.text[i]}`);
      tip.append(row);
    }
    tip.hidden = false;
    tip.style.left = Math.max(4, Math.min(event.clientX + 14, innerWidth - tip.offsetWidth - 8)) + "px";
    tip.style.top = Math.max(4, Math.min(event.clientY + 14, innerHeight - tip.offsetHeight - 8)) + "px";
    const place = left + (at - from) / (to - from) * (right - left);
    cursor.setAttribute("x1", place);
    cursor.setAttribute("x2", place);
    cursor.setAttribute("visibility", "visible");
  });
  svg.addEventListener("pointerleave", leave);
}
