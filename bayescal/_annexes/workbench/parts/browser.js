// What is stale is dimmed; a banner while the server is gone.
export function render({ model, view }) {
  document.body.style.margin = "0";

  let top = view;  // of the page, which only one property of reaches all: a class more would have all of it laid out anew
  while (top.parent) top = top.parent;
  top.el.setAttribute("role", "main");
  model.on("stale", () => top.el.style.setProperty("--shown", model.stale ? "0.45" : "1"));

  const banner = document.createElement("div");
  banner.setAttribute("role", "alert");
  banner.hidden = true;
  banner.style.cssText = "position: fixed; inset: 0 0 auto; z-index: 99; padding: 8px 14px; background: #b23c00; color: #fff; font: 14px/1.4 system-ui, sans-serif";
  banner.textContent = `The workbench has ended or cannot be reached: nothing that is pressed here is done. ` +
    `Every step is kept in ${model.folder}; the same command goes on with it.`;
  document.body.append(banner);
  const page = view.model.document;
  page.on_event("connection_lost", () => { banner.hidden = false; });
  page.on_event("client_reconnected", () => { banner.hidden = true; });
  return document.createElement("span");
}
