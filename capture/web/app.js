"use strict";
// The token stands behind the '#', which browsers never send to anyone.
const token = location.hash.slice(1);
const byId = (id) => document.getElementById(id);

function element(name, text, className) {
  const node = document.createElement(name);
  if (text !== undefined) node.textContent = text;
  if (className) node.className = className;
  return node;
}

function showMessage(text) {
  byId("message").textContent = text;
  byId("message").hidden = !text;
}

async function command(path, body) {
  const answer = await fetch(path, {
    method: "POST",
    headers: { "Content-Type": "application/json", "X-Token": token },
    body: JSON.stringify(body),
  });
  if (!answer.ok) showMessage((await answer.json()).error);
}

function coverageMap(coverage) {
  const ns = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(ns, "svg");
  const [columns, rows] = coverage.cells;
  svg.setAttribute("class", "map");
  svg.setAttribute("viewBox", `0 0 ${columns} ${rows}`);
  const hit = new Set(coverage.hit.map((cell) => cell.join()));
  for (let j = 0; j < rows; j++) {
    for (let i = 0; i < columns; i++) {
      const cell = document.createElementNS(ns, "rect");
      for (const [name, value] of Object.entries({ x: i, y: j, width: 1, height: 1 })) cell.setAttribute(name, value);
      if (hit.has(`${i},${j}`)) cell.setAttribute("class", "hit");
      svg.append(cell);
    }
  }
  return svg;
}

function facts(quality, coverage) {
  const box = element("div", undefined, "facts");
  const list = element("dl");
  const row = (name, text, bad) => list.append(element("dt", name), element("dd", text, bad ? "bad" : ""));
  if (quality) {
    row("blur", quality.blur_px === null ? "no edges" : `${quality.blur_px.toFixed(2)} px`, quality.blur_px === null);
    row("brightness", `${(100 * quality.brightness).toFixed(0)} %`);
    row("saturated", `${(100 * quality.saturated).toFixed(2)} %`, quality.saturated > 0.001);
    for (const [name, n] of Object.entries(quality.targets)) row(name, n ? `${n} points` : "not found", !n);
  }
  if (coverage) row("covered", `${(100 * coverage.share).toFixed(0)} %`);
  box.append(list);
  if (coverage) box.append(coverageMap(coverage));
  return box;
}

function showCamera(name, status) {
  let box = document.getElementById(`camera-${name}`);
  if (!box) {
    box = element("section", undefined, "camera");
    box.id = `camera-${name}`;
    const image = element("img");
    image.alt = `last image of camera ${name}`;
    box.append(element("h2"), image, element("div"));
    byId("cameras").append(box);
  }
  const [title, image, old] = box.children;
  title.textContent = name + (status.epoch_id ? `, ${status.epoch_id}` : "");
  const key = status.live ? String(status.time) : status.epoch_id;
  if (key && image.dataset.key !== key) {
    image.dataset.key = key;
    image.src = `/image/${encodeURIComponent(name)}.png?${encodeURIComponent(key)}`;
  }
  old.replaceWith(facts((status.quality || {})[name], (status.coverage || {})[name]));
}

function showTable(table) {
  byId("table").hidden = !table;
  if (!table || document.activeElement?.closest("#axes")) return; // somebody is typing
  byId("table-id").textContent = table.table;
  byId("axes").replaceChildren(...table.axes.map((axis) => {
    const row = element("tr");
    const move = element("td", undefined, "move");
    const form = element("form"), input = element("input");
    input.type = "number"; input.step = "any"; input.value = axis.readback_deg.toFixed(3);
    [input.min, input.max] = axis.limits_deg;
    form.append(input, element("button", "Turn"));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      document.activeElement?.blur();
      command("/jog", { jog: [`${axis.name}=${input.value}`] });
    });
    move.append(form);
    row.append(element("td", axis.name), element("td", `${axis.readback_deg.toFixed(4)} deg`),
      element("td", `${axis.limits_deg[0]} to ${axis.limits_deg[1]} deg`),
      element("td", axis.fault || (axis.moving ? "moving" : "at rest"), axis.fault ? "bad" : ""), move);
    return row;
  }));
}

function show(status) {
  const state = byId("state");
  state.textContent = status.state;
  state.className = `state ${status.state.split(" ")[0]}`;
  document.body.classList.toggle("may-move", status.may_move && token !== "");
  byId("bar").hidden = status.live;
  if (!status.live) {
    byId("bar").value = status.total ? status.done / status.total : 0;
    const left = status.seconds_left && status.state === "running" ? `, about ${Math.ceil(status.seconds_left)} s left` : "";
    byId("count").textContent = `${status.done} of ${status.total} epochs${left}`;
  }
  showMessage(status.message || "");
  showTable(status.table);
  for (const name of status.cameras) showCamera(name, status);
}

async function refresh() {
  try {
    show(await (await fetch("/status.json")).json());
  } catch (error) {
    byId("state").textContent = "no connection";
    byId("state").className = "state stopped";
  }
  setTimeout(refresh, 700);
}

byId("stop").addEventListener("click", () => command("/stop", {}));
refresh();
