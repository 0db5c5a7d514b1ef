"""Style and script of a page: small enough to be read, and all that it has."""

POLICY = (
    "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "base-uri 'none'; form-action 'none'"
)
"""What a page may load: what it holds itself, and nothing from anywhere else."""

STYLE = """
:root { color-scheme: light; --line: #d0d5da; --soft: #f4f6f8; --ink: #1b1f24; --quiet: #57606a; --link: #0b5cad; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", Roboto, Arial, sans-serif; }
main { max-width: 1560px; margin: 0 auto; padding: 16px clamp(12px, 2vw, 32px) 48px; }
h1 { font-size: 1.5rem; margin: .4em 0; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 1.8em 0 .6em; border-bottom: 1px solid var(--line); padding-bottom: .2em; }
p { max-width: 100ch; overflow-wrap: anywhere; }
a { color: var(--link); }
code, pre { font: .87em/1.45 ui-monospace, "SF Mono", Menlo, Consolas, monospace; }
.scroll { overflow-x: auto; max-width: 100%; }
table { border-collapse: collapse; font-size: .92em; }
th, td { border-bottom: 1px solid var(--line); padding: 4px 10px; text-align: left; vertical-align: top; }
th { background: var(--soft); }
td { max-width: 56ch; overflow-wrap: break-word; }
td.long { min-width: min(26em, 60vw); }
td.short { white-space: nowrap; }
.n { text-align: right; font-variant-numeric: tabular-nums; }
td.n { white-space: nowrap; }
th button { all: unset; cursor: pointer; font-weight: inherit; }
th button:focus-visible { outline: 2px solid var(--link); }
th[aria-sort=ascending] button::after { content: " \\2191"; }
th[aria-sort=descending] button::after { content: " \\2193"; }
input[type=search] { font: inherit; padding: 4px 8px; width: min(28em, 100%); border: 1px solid #8c959f; border-radius: 4px; }
.count { color: var(--quiet); }
.badge { display: inline-block; padding: 0 .6em; border-radius: 1em; border: 1.5px solid #57606a; font-weight: 600; }
.badge.finished { background: #d7ecfb; border-color: #0072b2; }
.badge.running { background: #e8f5ff; border-color: #56b4e9; }
.badge.interrupted { background: #fdf3d0; border-color: #b07d00; }
.badge.crashed, .badge.killed { background: #fbe3d4; border-color: #d55e00; }
.figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 440px), 1fr)); gap: 12px; }
figure { margin: 0; border: 1px solid var(--line); border-radius: 6px; padding: 6px; background: #fff; }
figure svg { display: block; width: 100%; height: auto; touch-action: pan-y; }
.film { max-width: 100%; height: auto; border: 1px solid var(--line); border-radius: 6px; }
.scroll + .figures { margin-top: 12px; }
@media (min-width: 900px) { .film { float: right; max-width: 38%; margin: 0 0 12px 24px; } h2 { overflow: hidden; } }
details { border: 1px solid var(--line); border-radius: 6px; padding: 6px 12px; }
pre { overflow-x: auto; max-height: 70vh; }
#tip { position: fixed; z-index: 9; pointer-events: none; background: #fff; border: 1px solid #57606a; border-radius: 4px;
  padding: 4px 8px; font-size: 13px; line-height: 1.35; box-shadow: 0 2px 8px #0003; white-space: pre; max-width: 95vw; }
#tip i { display: inline-block; width: 10px; height: 10px; margin-right: 6px; }
@media (max-width: 600px) { body { font-size: 14px; } th, td { padding: 3px 6px; } }
"""

SCRIPT = """
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
    const words = input.value.toLowerCase().split(/\\s+/).filter(Boolean);
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
"""
