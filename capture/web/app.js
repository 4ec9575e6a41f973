// The page of `labcapture view`: what the cameras saw last, how far a session is, the table.

import { button, by, fill, make } from "./dom.js";
import { number, spoken, t } from "./words.js";
import { changeLanguage, speak, wantedLanguage } from "./speech.js";
import { Cameras, progress } from "./cameras.js";

const EVERY_MS = 700;
const token = location.hash.slice(1); // it stands behind the '#', which browsers never send to anyone
const cameras = new Cameras(picture);
let last = null;

function tell(text) {
  by("message").textContent = text;
  by("message").hidden = !text;
}

async function command(path, body) {
  const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json", "X-Token": token }, body: JSON.stringify(body) });
  if (!answer.ok) tell((await answer.json()).error);
}

async function picture(image, size) {
  const [camera, key] = image.split("/"), answer = await fetch(`/image/${encodeURIComponent(camera)}.png?size=${size}&of=${encodeURIComponent(key)}`);
  if (!answer.ok) throw new Error((await answer.json()).error);
  return createImageBitmap(await answer.blob());
}

function showTable(table, mayMove) {
  by("table").hidden = !table;
  if (!table || document.activeElement?.closest("#table form")) return; // somebody is typing
  const rows = table.axes.map((axis) => {
    const input = make("input", { type: "number", step: "any", value: axis.readback_deg.toFixed(3), min: axis.limits_deg[0], max: axis.limits_deg[1], "aria-label": `${axis.name}: ${t("turn to (deg)")}` });
    const turn = (event) => { event.preventDefault(); document.activeElement?.blur(); command("/jog", { jog: [`${axis.name}=${input.value}`] }); };
    return make("tr", {}, make("td", {}, axis.name), make("td", {}, `${number(axis.readback_deg, 4)} deg`), make("td", {}, t("{a} to {b} deg", { a: axis.limits_deg[0], b: axis.limits_deg[1] })),
      make("td", { class: axis.fault ? "bad" : "" }, axis.fault || t(axis.moving ? "moving" : "at rest")), mayMove ? make("td", {}, make("form", { onsubmit: turn }, input, " ", make("button", {}, t("Turn")))) : null);
  });
  const heads = ["axis", "readback", "limits", "state", ...(mayMove ? ["turn to (deg)"] : [])].map((text) => make("th", { scope: "col" }, t(text)));
  fill(by("table"), make("h2", {}, `${t("Table")} ${table.table}`), make("table", {}, make("thead", {}, make("tr", {}, ...heads)), make("tbody", {}, ...rows)), mayMove ? button(t("Stop"), () => command("/stop", {}), "s", { class: "stop" }) : null);
}

function show(status) {
  const mayMove = status.may_move && token !== "";
  const said = progress(status);
  by("state").textContent = said.state;
  by("state").className = said.kind;
  by("bar").hidden = status.live;
  by("bar").value = said.share;
  by("bar").setAttribute("aria-label", said.epochs);
  by("count").textContent = status.live ? "" : said.epochs + said.left;
  tell(status.message || "");
  showTable(status.table, mayMove);
  cameras.show(status);
}

async function refresh() {
  try {
    last = await (await fetch("/status.json")).json();
    show(last);
  } catch {
    by("state").textContent = t("no connection");
    by("state").className = "state broken";
  }
  setTimeout(refresh, EVERY_MS);
}

const KEYS = {
  o: () => cameras.views.forEach((view) => { view.overlay = !view.overlay; view.surface.redraw(); }),
  0: () => cameras.views.forEach((view) => view.whole()),
  g: () => changeLanguage().then(() => { drawDoing(); if (last) show(last); }),
  s: () => { if (document.querySelector(".stop")) command("/stop", {}); },
};

function drawDoing() { fill(by("doing"), button(t("overlay on or off"), KEYS.o, "o"), button(spoken() === "en" ? "DE" : "EN", KEYS.g, "g", { "aria-label": t("language") })); }

async function begin() {
  await speak(wantedLanguage());
  drawDoing();
  by("cameras").append(cameras.element);
  by("state").textContent = t("connecting");
  document.addEventListener("keydown", (event) => { if (!event.target.closest("input") && !event.ctrlKey && !event.metaKey && !event.altKey) KEYS[event.key]?.(); });
  refresh();
}

begin();
