(() => {
  const seen = (e) => e.checkVisibility({ visibilityProperty: true }) && !e.closest("[aria-hidden=true]");
  const text = (e) => [...e.childNodes].map((n) => n.nodeType === 3 ? n.textContent : n.nodeType === 1 &&
    n.getAttribute("aria-hidden") !== "true" ? n.getAttribute("aria-label") ?? n.getAttribute("alt") ?? text(n) : "").join("").trim();
  const named = (e) => e.getAttribute("aria-label")?.trim() || [...(e.getAttribute("aria-labelledby") ?? "").split(" ")]
    .map((id) => id && document.getElementById(id)?.textContent.trim()).join("") || [...(e.labels ?? [])].map(text).join("") ||
    e.getAttribute("alt") || e.getAttribute("title") || e.querySelector?.(":scope > title")?.textContent ||
    (e.matches("input, select, textarea, canvas, svg, img, [role=grid], [role=listbox], [role=tablist], [role=toolbar]") ? "" : text(e));
  const said = (e) => `${e.tagName.toLowerCase()}${e.id ? "#" + e.id : ""}.${e.getAttribute("class") ?? ""} ${e.textContent.slice(0, 30)}`;
  const out = [], must = (right, what, e) => { if (!right) out.push(`${what}: ${said(e)}`); };
  const NEED = "button, a[href], input, select, textarea, canvas, img, summary, th, svg[role=img], [role=button], [role=link], " +
    "[role=grid], [role=listbox], [role=option], [role=tab], [role=tablist], [role=toolbar], [role=columnheader], dialog, progress, nav, aside";
  const INSIDE = { option: "listbox", tab: "tablist", gridcell: "row", columnheader: "row", rowgroup: "grid", row: "grid", treeitem: "tree" };
  const ROLES = new Set(["alert", "status", "toolbar", "img", "grid", "row", "rowgroup", "gridcell", "columnheader", "listbox", "option",
    "tab", "tablist", "group", "presentation", "note", "log", "dialog", "region", "list", "listitem", "table", "none", "button", "link"]);
  for (const e of document.body.querySelectorAll("*")) {
    if (!seen(e)) continue;
    if (e.matches(NEED)) must(named(e), "no name", e);
    const role = e.getAttribute("role");
    if (role) must(ROLES.has(role), "unknown role", e);
    if (INSIDE[role]) must(e.parentElement.closest(`[role=${INSIDE[role]}]`), `not in a ${INSIDE[role]}`, e);
    must(!(e.tabIndex > 0), "an order of its own", e);
    must(!(e.closest("button, a") !== e && e.matches("button, a[href], input, select") && e.parentElement.closest("button, a[href]")), "one control in another", e);
    for (const name of e.getAttributeNames()) if (/^aria-(selected|expanded|checked|current|busy|hidden|sort)$/.test(name))
      must(/^(true|false|page|ascending|descending|none)$/.test(e.getAttribute(name)), `${name} is ${e.getAttribute(name)}`, e);
  }
  for (const e of document.querySelectorAll("[aria-hidden=true] button, [aria-hidden=true] a[href], [aria-hidden=true] input")) must(e.tabIndex < 0, "hidden, but takes the focus", e);
  const ids = [...document.querySelectorAll("[id]")].filter((e) => !e.closest("svg")).map((e) => e.id);
  for (const id of new Set(ids)) if (ids.indexOf(id) !== ids.lastIndexOf(id)) out.push(`twice: #${id}`);
  if (!document.documentElement.lang || !document.title) out.push("no language or title");
  if (document.querySelectorAll("main").length !== 1 || document.querySelectorAll("h1").length !== 1) out.push("not one main, one h1");
  return [...new Set(out)];
})()
