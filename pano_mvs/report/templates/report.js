"use strict";
(function () {
  document.documentElement.classList.add("scripted");

  // Views: one picture over the other, cut where the slider stands.
  for (const view of document.querySelectorAll("figure.view")) {
    const stack = view.querySelector(".stack");
    const panes = stack ? Array.from(stack.children) : [];
    if (panes.length < 2 || !panes[0].classList.contains("panorama")) continue;
    const name = view.querySelector("figcaption b").textContent;
    const slider = Object.assign(document.createElement("input"), {type: "range", min: "0", max: "100", step: "1", value: "50", className: "slider"});
    const line = Object.assign(document.createElement("div"), {className: "line"});
    const tabs = Object.assign(document.createElement("div"), {className: "tabs"});
    tabs.setAttribute("role", "group");
    tabs.setAttribute("aria-label", name + ": what is shown over the panorama");
    const others = panes.slice(1).map(function (pane) {
      const what = pane.querySelector(".tag").textContent;
      const tab = Object.assign(document.createElement("button"), {type: "button", textContent: what});
      tab.addEventListener("click", function () { show(what); });
      tabs.append(tab);
      return {pane: pane, what: what, tab: tab};
    });
    const cut = function () {
      stack.style.setProperty("--cut", slider.value + "%");
      slider.setAttribute("aria-valuetext", slider.value + " % panorama");
    };
    const show = function (what) {
      for (const other of others) {
        other.pane.classList.toggle("off", other.what !== what);
        other.tab.setAttribute("aria-pressed", String(other.what === what));
      }
      slider.setAttribute("aria-label", name + ": panorama left of the line, " + what + " right of it");
    };
    slider.addEventListener("input", cut);
    stack.classList.add("laid");
    stack.append(line, slider);
    stack.after(tabs);
    show(others[0].what);
    cut();
  }

  // The table of all panoramas: some at a time, in an order, those that match.
  const body = document.getElementById("rows");
  if (!body) return;
  const size = 25;
  const all = Array.from(body.children).map(function (row, place) {
    return {row: row, place: place, doubt: Number(row.dataset.doubt), text: row.firstElementChild.textContent.toLowerCase()};
  });
  const find = document.getElementById("find");
  const order = document.getElementById("order");
  const back = document.getElementById("back");
  const next = document.getElementById("next");
  let page = 0;
  const draw = function () {
    const wanted = find.value.trim().toLowerCase();
    const found = all.filter(function (entry) { return entry.text.includes(wanted); });
    if (order.value === "doubt") found.sort(function (a, b) { return b.doubt - a.doubt || a.place - b.place; });
    const pages = Math.max(1, Math.ceil(found.length / size));
    page = Math.min(Math.max(page, 0), pages - 1);
    const shown = found.slice(page * size, (page + 1) * size);
    body.replaceChildren.apply(body, shown.map(function (entry) { return entry.row; }));
    document.getElementById("page").textContent = found.length ? (page * size + 1) + "–" + (page * size + shown.length) + " of " + found.length : "none found";
    back.disabled = page === 0;
    next.disabled = page === pages - 1;
  };
  find.addEventListener("input", function () { page = 0; draw(); });
  order.addEventListener("change", function () { page = 0; draw(); });
  back.addEventListener("click", function () { page -= 1; draw(); });
  next.addEventListener("click", function () { page += 1; draw(); });
  if (all.length > 8) document.querySelector("#panoramas .tools").hidden = false;
  draw();
})();
