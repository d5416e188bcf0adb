"use strict";
// What every offline page has: the payload, colours of the style sheet, tables, charts' canvases, commands to copy.
const data = JSON.parse(document.getElementById("payload").textContent);
const $ = (id) => document.getElementById(id);
const dark = window.matchMedia("(prefers-color-scheme: dark)");

// ---- colours of page.css, for canvases ------------------------------------------------------------------------
const ink = {};
function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["ink", "soft", "line", "model", "truth", "base", "bound", "aim", "grid", "faint", "tag"]) {
    ink[name] = style.getPropertyValue(`--${name}`).trim();
  }
}
readColours();
const FONT = "system-ui, sans-serif";

// ---- canvases -------------------------------------------------------------------------------------------------
function sheet(canvas) {
  const dense = Math.min(window.devicePixelRatio || 1, 2), width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * dense) || canvas.height !== Math.round(height * dense)) {
    canvas.width = Math.round(width * dense); canvas.height = Math.round(height * dense);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(dense, 0, 0, dense, 0, 0);
  pen.clearRect(0, 0, width, height);
  return { pen, width, height };
}

// ---- tables and commands --------------------------------------------------------------------------------------
const number = (value, digits, unit = "") => (value === null || value === undefined ? "–" : value.toFixed(digits) + unit);
const percent = (share) => `${(100 * share).toFixed(share > 0.0995 ? 0 : 1)} %`;
function fill(table, rows, head) {
  const row = (cells, kind, top) => {
    const line = document.createElement("tr");
    if (kind) line.className = kind;
    line.setAttribute("role", "row");
    line.append(...cells.map((cell, column) => {
      const heading = top || column === 0, box = document.createElement(heading ? "th" : "td");
      const [text, small] = Array.isArray(cell) ? cell : [cell];
      box.setAttribute("role", top ? "columnheader" : heading ? "rowheader" : "cell");
      if (heading) box.scope = top ? "col" : "row";
      if (!heading && head && text !== "") box.dataset.head = head[column];
      box.textContent = text;
      if (small) { const below = document.createElement("small"); below.textContent = small; box.append(below); }
      return box;
    }));
    return line;
  };
  const body = document.createElement("tbody"), top = document.createElement("thead");
  body.append(...rows.map((each) => row(each.cells || each, each.kind)));
  if (head) top.append(row(head, "", true));
  table.setAttribute("role", "table");
  table.replaceChildren(...(head ? [top] : []), body);
}
function commands(list, lines) {
  list.replaceChildren(...lines.map(([command, why]) => {
    const item = document.createElement("li"), box = document.createElement("div"), code = document.createElement("code");
    const small = document.createElement("small"), copy = document.createElement("button");
    command.split(" ").forEach((word, index) => {  // lines break between words, not at hyphens
      const span = document.createElement("span");
      span.className = "word"; span.textContent = word;
      code.append(index ? " " : "", span);
    });
    small.textContent = why;
    copy.className = "copy"; copy.textContent = "Copy"; copy.setAttribute("aria-label", `copy: ${command}`);
    copy.addEventListener("click", () => {
      getSelection().selectAllChildren(code);
      if (navigator.clipboard) navigator.clipboard.writeText(command).then(() => { copy.textContent = "Copied"; }, () => {});
    });
    box.append(code, small);
    item.append(box, copy);
    return item;
  }));
}

// ---- heading, and the cards of made.html ----------------------------------------------------------------------
function introduce() {
  document.title = $("title").textContent = data.title;
  $("lead").textContent = data.lead;
}
function tellMade(kept) {
  fill($("setup"), data.setup);
  commands($("repeat"), data.repeat);
  commands($("next"), data.next);
  $("kept").textContent = kept;
  $("configuration").textContent = data.configuration;
  $("configurationCard").hidden = !data.configuration;
}
