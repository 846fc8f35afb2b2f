// A list (or table) of rows that the pointer and the keyboard reach alike. Every text is set as text, never as HTML.
//   rows: [{id, group, cells: [{text, bar, kind, title}], actions: [{id, label, title}], kind, current, note}]
//   Pointing at a row, or moving the focus into it, sets `pointed` after a moment; a press sends {row, action}.
const MOMENT = 30; // ms that the pointer rests before a row counts as pointed at; a preview takes ten

function element(tag, kind, text) {
  const made = document.createElement(tag);
  if (kind) made.className = kind;
  if (text !== undefined && text !== null) made.textContent = text;
  return made;
}

function cellOf(cell, tag) {
  const made = element(tag, "cell " + (cell.kind || ""));
  if (cell.title) made.title = cell.title;
  if (cell.bar !== undefined && cell.bar !== null) {
    const bar = element("span", "bar");
    const part = element("span", "part");
    part.style.width = `${Math.round(1000 * Math.max(0, Math.min(1, cell.bar))) / 10}%`;
    bar.append(part);
    bar.setAttribute("aria-hidden", "true");
    made.append(bar);
  }
  made.append(element("span", "text", cell.text));
  return made;
}

export function render({ model, el }) {
  const table = element(model.table ? "table" : "div", "rows " + model.kind);
  let timer = null, waiting = "", last = "", rested = "";

  function point(id, wait) {
    if (waiting === id && timer) return;
    clearTimeout(timer);
    waiting = id;
    timer = setTimeout(() => { timer = null; if (last !== id) { last = id; model.pointed = id; } }, wait);
  }
  function press(row, action) { model.send_msg({ row, action }); }

  function rowOf(row) {
    const made = element(model.table ? "tr" : "div", "row " + (row.kind || ""));
    made.dataset.row = row.id;
    if (!model.table) made.setAttribute("role", "listitem");
    if (model.pointing) {
      made.tabIndex = 0;
      made.addEventListener("mousemove", (event) => {  // moved, not: rows that scroll under a resting pointer
        const at = `${event.screenX} ${event.screenY}`;
        if (at !== rested) point(row.id, MOMENT);
        rested = at;
      });
      made.addEventListener("focusin", () => point(row.id, 0));
      made.addEventListener("click", () => point(row.id, 0));
    }
    if (row.current) made.setAttribute("aria-current", "true");
    for (const cell of row.cells) made.append(cellOf(cell, model.table ? "td" : "span"));
    const actions = element(model.table ? "td" : "span", "actions");
    for (const action of row.actions || []) {
      const button = element("button", "action", action.label);
      button.type = "button";
      button.dataset.action = action.id;
      button.disabled = model.busy;
      button.setAttribute("aria-label", `${action.label} ${row.id}`);
      if (action.title) button.title = action.title;
      button.addEventListener("click", (event) => { event.stopPropagation(); press(row.id, action.id); });
      actions.append(button);
    }
    if ((row.actions || []).length || model.table) made.append(actions);
    if (row.note) made.append(element("span", "note", row.note));
    return made;
  }

  function draw() {
    const root = table.getRootNode();
    const active = root.activeElement;
    const at = active && table.contains(active) ? active : null;
    const row = at && at.closest("[data-row]");
    const kept = row && [row.dataset.row, at.dataset.action];
    const scrolled = el.scrollTop;
    table.replaceChildren();
    if (model.label) table.setAttribute("aria-label", model.label);
    if (model.table) {
      const head = element("tr", "head");
      for (const title of model.head) {
        const cell = element(title ? "th" : "td", "", title);
        if (title) cell.scope = "col";
        head.append(cell);
      }
      table.append(head);
    } else table.setAttribute("role", "list");
    let group = null;
    for (const one of model.rows) {
      if (one.group && one.group !== group) table.append(element("div", "group", one.group));
      group = one.group;
      table.append(rowOf(one));
    }
    last = model.pointed;
    mark();
    el.scrollTop = scrolled;
    if (kept) {
      const again = [...table.querySelectorAll("[data-row]")].find((r) => r.dataset.row === kept[0]);
      const button = again && kept[1] && [...again.querySelectorAll("button")].find((b) => b.dataset.action === kept[1]);
      (button && !button.disabled ? button : again)?.focus({ preventScroll: true });
    }
  }
  function mark() {
    for (const row of table.querySelectorAll("[data-row]"))
      row.classList.toggle("pointed", row.dataset.row === model.pointed);
  }
  table.addEventListener("mouseleave", () => { clearTimeout(timer); timer = null; rested = ""; });
  table.addEventListener("keydown", (event) => {
    const rows = [...table.querySelectorAll("[data-row]")];
    const at = rows.findIndex((row) => row.contains(table.getRootNode().activeElement));
    const to = { ArrowDown: at + 1, ArrowUp: at - 1, Home: 0, End: rows.length - 1 }[event.key];
    if (to !== undefined && rows[to]) { rows[to].focus(); event.preventDefault(); }
    if (event.key === "Enter" && at >= 0 && event.target === rows[at]) {
      const first = rows[at].querySelector("button:not(:disabled)");
      if (first) first.click();
    }
  });
  for (const name of ["rows", "head", "busy"]) model.on(name, draw);
  model.on("pointed", () => { last = model.pointed; mark(); });
  draw();
  return table;
}
