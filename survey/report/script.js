"use strict";
// What a reader may do with the page: sort and filter tables, page through all observations, turn the survey around.
// Without this script the page shows the same numbers, the worst observations first.
(() => {
  const words = JSON.parse(document.getElementById("words").textContent);
  const decimal = words.decimal;
  document.documentElement.classList.add("ready"); // first: what is drawn needs its place on the page
  const number = (text) => {
    const clean = text.replace(/[\u2009\s]/g, "").replace("−", "-").replace(decimal, ".");
    const found = clean.match(/^[<±]?(-?\d+(\.\d+)?(e-?\d+)?)/);
    return found ? parseFloat(found[1]) : NaN;
  };
  const make = (tag, className, text) => {
    const element = document.createElement(tag);
    if (className) element.className = className;
    if (text !== undefined) element.textContent = text;
    return element;
  };
  const compare = (a, b) => {
    if (typeof a === "number" && typeof b === "number") {
      if (Number.isNaN(a)) return Number.isNaN(b) ? 0 : 1;
      return Number.isNaN(b) ? -1 : a - b;
    }
    return String(a).localeCompare(String(b), undefined, { numeric: true });
  };
  const mark = (cell, up) => {
    for (const other of cell.parentNode.children) other.removeAttribute("aria-sort");
    cell.setAttribute("aria-sort", up ? "ascending" : "descending");
  };

  // small tables: their own rows are moved and hidden
  for (const table of document.querySelectorAll("table")) {
    if (table.id === "all" || table.tBodies[0].rows.length < 2) continue;
    const body = table.tBodies[0];
    [...table.tHead.rows[0].cells].forEach((head, k) => {
      if (!head.textContent) return;
      head.classList.add("sorts");
      head.tabIndex = 0;
      const sort = () => {
        const up = head.getAttribute("aria-sort") !== "ascending";
        const key = (row) => {
          const cell = row.cells[k].firstChild;
          const text = cell ? cell.textContent : "";
          return head.classList.contains("r") ? number(text) : text;
        };
        const rows = [...body.rows].map((row) => [key(row), row]);
        rows.sort((a, b) => (up ? 1 : -1) * compare(a[0], b[0]));
        for (const [, row] of rows) body.append(row);
        mark(head, up);
      };
      head.addEventListener("click", sort);
      head.addEventListener("keydown", (event) => { if (event.key === "Enter") sort(); });
    });
    if (body.rows.length > 14) {
      const field = make("input", "filter screen");
      field.type = "search";
      field.placeholder = words.filter;
      field.setAttribute("aria-label", words.filter);
      field.addEventListener("input", () => {
        const wanted = field.value.toLowerCase();
        for (const row of body.rows) row.hidden = !row.textContent.toLowerCase().includes(wanted);
      });
      table.parentNode.before(field);
    }
  }

  // places: "#image=X/hX05", "#obs=...", "#reading=...", "#point=B07" lead here as in the workbench
  const escaped = (text) => encodeURIComponent(text).replaceAll("%2F", "/").replaceAll("%3A", ":").replaceAll("%2C", ",");
  const named = (id) => [...document.querySelectorAll("tbody tr")].find((row) => row.cells[0] && row.cells[0].textContent.trim() === id);
  const goTo = () => {
    const [, kind, said] = location.hash.match(/^#(\w+)=([^&]*)/) || [];
    if (!kind) return;
    let id = said;
    try { id = decodeURIComponent(said); } catch { /* as it stands */ }
    const found = (goTo.all && ["image", "obs", "reading"].includes(kind) ? goTo.all(kind, id) : null) || named(id) || named(id.split("/").pop());
    for (const old of document.querySelectorAll("tr.here")) old.classList.remove("here");
    if (!found) return;
    if (found.tagName === "TR") found.classList.add("here");
    found.scrollIntoView({ block: "center" });
  };

  // all observations: columns of values, a page of rows at a time
  const holder = document.getElementById("all-data");
  if (holder) {
    const data = JSON.parse(holder.textContent);
    const table = document.getElementById("all");
    const n = data.rows;
    const column = data.columns.map((c) => {
      if (c.names) return { ...c, value: (i) => c.names[c.codes[i]], text: (i) => c.names[c.codes[i]] };
      const text = (i) => (c.values[i] === null ? "–" : String(c.values[i]).replace("-", "−").replace(".", decimal));
      return { ...c, value: (i) => (c.values[i] === null ? NaN : Number(c.values[i])), text };
    });
    let order = Array.from({ length: n }, (_, i) => i);
    let shown = order;
    let page = 0;
    const size = 50;
    const field = document.getElementById("all-filter");
    const only = document.getElementById("all-only");
    const where = document.getElementById("all-where");
    // the places of the workbench: an image point by its image, target and name, a reading by its table and id
    const at = { where: data.at[0], point: data.at[1] };
    const placeOf = (i) => {
      const reading = data.places.names[data.places.codes[i]];
      if (reading) return "reading=" + reading;
      return "obs=image_point:" + [...column[at.where].text(i).split(" · ").filter((x, k) => k < 2 || x !== "points"), column[at.point].text(i)].join("/");
    };
    goTo.all = (kind, id) => {
      if (kind === "image") {
        field.value = id.replace("/", " ");
        filter();
        return table;
      }
      const i = order.find((k) => placeOf(k) === kind + "=" + id);
      if (i === undefined) return null;
      field.value = "";
      only.checked = false;
      filter();
      page = Math.floor(shown.indexOf(i) / size);
      draw();
      return [...table.tBodies[0].rows].find((row) => row.dataset.place === kind + "=" + id);
    };
    const draw = () => {
      const pages = Math.max(1, Math.ceil(shown.length / size));
      page = Math.min(Math.max(page, 0), pages - 1);
      const rows = shown.slice(page * size, (page + 1) * size).map((i) => {
        const row = make("tr", ["", "suspect", "off"][data.flags[i]]);
        for (const c of column) row.append(make("td", c.names ? "l" : "r", c.text(i)));
        row.dataset.place = placeOf(i);
        const link = make("a", "", row.cells[0].textContent);
        link.href = "#" + placeOf(i).split("=").map(escaped).join("=");
        row.cells[0].replaceChildren(link);
        const flag = make("td", "l");
        if (data.flags[i]) flag.append(make("span", "pill " + ["", "bad", "soft"][data.flags[i]], words.flags[data.flags[i]]));
        row.append(flag);
        return row;
      });
      table.tBodies[0].replaceChildren(...rows);
      where.textContent = words.where.replace("{page}", page + 1).replace("{pages}", pages)
        .replace("{n}", shown.length.toLocaleString(document.documentElement.lang));
    };
    const filter = () => {
      const wanted = field.value.toLowerCase().split(/\s+/).filter(Boolean);
      shown = order.filter((i) => {
        if (only.checked && !data.flags[i]) return false;
        if (!wanted.length) return true;
        const text = column.filter((c) => c.names).map((c) => c.text(i)).join(" ").toLowerCase();
        return wanted.every((word) => text.includes(word));
      });
      page = 0;
      draw();
    };
    [...table.tHead.rows[0].cells].forEach((head, k) => {
      if (k >= column.length) return;
      head.classList.add("sorts");
      head.tabIndex = 0;
      const sort = () => {
        // large residuals are of interest whatever their sign
        const size = column[k].size ? Math.abs : (x) => x;
        const up = head.getAttribute("aria-sort") === "descending";
        const keys = order.map((i) => column[k].value(i));
        const keyed = order.map((i, j) => [typeof keys[j] === "number" ? size(keys[j]) : keys[j], i]);
        keyed.sort((a, b) => (Number.isNaN(a[0]) || Number.isNaN(b[0]) ? 1 : up ? 1 : -1) * compare(a[0], b[0]));
        order = keyed.map((pair) => pair[1]);
        mark(head, up);
        filter();
      };
      head.addEventListener("click", sort);
      head.addEventListener("keydown", (event) => { if (event.key === "Enter") sort(); });
    });
    field.addEventListener("input", filter);
    only.addEventListener("change", filter);
    const step = { "all-first": () => 0, "all-back": () => page - 1, "all-next": () => page + 1, "all-last": () => 1e9 };
    for (const [id, to] of Object.entries(step)) {
      document.getElementById(id).addEventListener("click", () => { page = to(); draw(); });
    }
    draw();
  }

  // the survey in space: lines, points, ellipsoids as their three principal ellipses
  const view = document.getElementById("space");
  if (view) {
    const scene = JSON.parse(document.getElementById("space-data").textContent);
    const context = view.getContext("2d");
    let azimuth = -1.08, elevation = 0.47, zoom = 1;
    const enlarge = document.getElementById("space-enlarge");
    const circle = Array.from({ length: 37 }, (_, k) => [Math.cos((k * Math.PI) / 18), Math.sin((k * Math.PI) / 18)]);
    const middle = scene.middle, reach = scene.reach;
    const project = (x) => {
      const d = [x[0] - middle[0], x[1] - middle[1], x[2] - middle[2]];
      const ca = Math.cos(azimuth), sa = Math.sin(azimuth), ce = Math.cos(elevation), se = Math.sin(elevation);
      const right = -sa * d[0] + ca * d[1];
      const up = -se * (ca * d[0] + sa * d[1]) + ce * d[2];
      const near = ce * (ca * d[0] + sa * d[1]) + se * d[2];
      const scale = ((zoom * Math.min(view.width, view.height) * 0.8) / reach) * (2.4 * reach) / Math.max(2.4 * reach - near, 0.3 * reach);
      return [view.width / 2 + scale * right, view.height / 2 - scale * up];
    };
    const night = window.matchMedia("(prefers-color-scheme: dark)");
    const seen = (colour) => (night.matches && words.dark[colour]) || colour;
    const path = (points, colour, width, alpha = 1) => {
      context.globalAlpha = alpha;
      context.strokeStyle = seen(colour);
      context.lineWidth = width * (window.devicePixelRatio || 1);
      context.beginPath();
      points.forEach((x, k) => { const [u, v] = project(x); if (k) context.lineTo(u, v); else context.moveTo(u, v); });
      context.stroke();
      context.globalAlpha = 1;
    };
    const draw = () => {
      const ratio = window.devicePixelRatio || 1;
      view.width = view.clientWidth * ratio;
      view.height = view.clientHeight * ratio;
      context.clearRect(0, 0, view.width, view.height);
      for (const line of scene.lines) path(line.x, line.colour, line.width, line.alpha);
      const grow = scene.enlarged * Math.pow(10, Number(enlarge.value));
      document.getElementById("space-factor").textContent = Math.round(grow).toLocaleString(document.documentElement.lang);
      for (const spot of scene.spots) {
        for (const [a, b] of [[0, 1], [0, 2], [1, 2]]) {
          const ring = circle.map(([c, s]) => spot.x.map((x, k) => x + grow * (c * spot.axes[a][k] + s * spot.axes[b][k])));
          path(ring, spot.colour, 0.9, 0.75);
        }
        const [u, v] = project(spot.x);
        context.fillStyle = seen(spot.colour);
        context.beginPath();
        context.arc(u, v, 2.4 * ratio, 0, 7);
        context.fill();
      }
      context.font = 11 * ratio + "px sans-serif";
      for (const label of scene.labels) {
        const [u, v] = project(label.x);
        context.lineWidth = 3 * ratio;
        context.strokeStyle = seen("#ffffff");
        context.strokeText(label.text, u + 5 * ratio, v - 4 * ratio);
        context.fillStyle = seen(label.colour);
        context.fillText(label.text, u + 5 * ratio, v - 4 * ratio);
      }
    };
    view.addEventListener("pointerdown", (event) => view.setPointerCapture(event.pointerId));
    view.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      azimuth -= event.movementX * 0.008;
      elevation = Math.min(1.55, Math.max(-1.55, elevation + event.movementY * 0.008));
      draw();
    });
    const nearer = (factor) => {
      zoom = Math.min(40, Math.max(0.2, zoom * factor));
      draw();
    };
    // the bare wheel scrolls the page, here as everywhere
    view.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      nearer(Math.exp(-event.deltaY * 0.0012));
    }, { passive: false });
    document.getElementById("space-in").addEventListener("click", () => nearer(1.25));
    document.getElementById("space-out").addEventListener("click", () => nearer(0.8));
    view.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "+" || event.key === "-") nearer(event.key === "+" ? 1.25 : 0.8);
      const turn = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (!turn) return;
      event.preventDefault();
      azimuth += turn[0];
      elevation = Math.min(1.55, Math.max(-1.55, elevation + turn[1]));
      draw();
    });
    enlarge.addEventListener("input", draw);
    night.addEventListener("change", draw);
    new ResizeObserver(draw).observe(view); // also when the page is first laid out
  }
  addEventListener("hashchange", goTo);
  goTo();
})();
