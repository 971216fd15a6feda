// The fleet page: a table of any length of which only the rows in view exist, and charts when somebody asks for them.
(function () {
"use strict";
const fleet = JSON.parse(document.getElementById("fleet").textContent);
// Columns of fleet.rows, as pipeline/report/fleet.py writes them.
const NAME = 0, STATUS = 1, SENSOR = 2, SINCE = 3, SENTENCE = 4, DAYS = 5, LAST = 6, STEM = 7, OLDER = 8, CHANGE = 9;
const FEW = 50;  // rows that are shown all at once, as high as their words are
const BEYOND = 15;  // rows above and below those in view
const COLOURS = { RED: "#d64550", YELLOW: "#c8920f", UNKNOWN: "#8a8f98", GREEN: "#2f9e6a" }, MUTED = "#8a8f98";
const byName = new Map(fleet.rows.map((row, i) => [row[NAME], i]));
const list = document.getElementById("list"), body = list && list.querySelector("tbody");

function escape(text) {
  return String(text).replace(/[&<>"']/g, c => "&#" + c.charCodeAt(0) + ";");
}

function commands(text) {  // as the filter of this name in pipeline/report/page.py
  const copy = '<button type="button" class="copy">Copy</button>';
  return escape(text).replace(/`([^`]*)`/g, (_, code) => `<code>${code}</code>${code.startsWith("boresight ") ? copy : ""}`);
}

// ---------------------------------------------------------------- the table
function chip(row, day, letter, label) {
  const word = fleet.words[letter.toLowerCase()], text = label ? day + " " + word[1] : word[1];
  const said = `class="c ${word[0]}" title="${day}: ${word[2]}"`;
  if (letter === letter.toLowerCase()) return `<span ${said}>${text}</span>`;
  const page = fleet.folder + "/" + day + "/" + encodeURIComponent(row[STEM] || row[NAME]) + ".html";
  return `<a ${said} href="${escape(page)}">${text}</a>`;
}

function rowHtml(row, place) {
  const status = fleet.statuses[row[STATUS]], sentence = fleet.sentences[row[SENTENCE]];
  const days = fleet.days.map((day, i) => chip(row, day, row[DAYS][i])).join("");
  return `<tr aria-rowindex="${place + 2}"><td><a href="#charts-${escape(row[NAME])}">${escape(row[NAME])}</a></td>` +
    `<td class="status ${status}">${status}</td><td>${escape(row[SENSOR])}</td><td class="w">${row[SINCE]}</td>` +
    `<td class="days">${days}</td><td class="words" title="${escape(sentence)}">${commands(sentence)}</td></tr>`;
}

const haystack = [];  // what a row is searched by, made when it is searched first
function text(i) {
  const row = fleet.rows[i];
  return haystack[i] || (haystack[i] = [row[NAME], row[SENSOR], row[SINCE], row[LAST], fleet.sentences[row[SENTENCE]],
    row[CHANGE] ? row[CHANGE].flat().join(" ") : ""].join(" ").toLowerCase());
}

const names = new Intl.Collator(undefined, { numeric: true });
const notDone = row => row[DAYS].replace(/[dD.]/g, "").length;
const orders = {
  attention: (a, b) => a - b,  // as the rows come
  name: (a, b) => names.compare(fleet.rows[a][NAME], fleet.rows[b][NAME]),
  since: (a, b) => fleet.rows[b][SINCE].localeCompare(fleet.rows[a][SINCE]) || a - b,
  seen: (a, b) => fleet.rows[a][LAST].localeCompare(fleet.rows[b][LAST]) || a - b,
  bad: (a, b) => notDone(fleet.rows[b]) - notDone(fleet.rows[a]) || a - b,
};

let shown = [], rowHeight = 0, drawn = "";
function choose() {
  const words = document.getElementById("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const pressed = [...document.querySelectorAll("#tools [aria-pressed=true]")].map(b => +b.dataset.status);
  shown = [];
  fleet.rows.forEach((row, i) => {
    if (pressed.length && !pressed.includes(row[STATUS])) return;
    if (words.every(word => text(i).includes(word))) shown.push(i);
  });
  const order = document.getElementById("order").value;
  if (order !== "attention") shown.sort(orders[order]);
  const all = fleet.rows.length.toLocaleString("en"), of = shown.length.toLocaleString("en");
  document.getElementById("count").textContent =
    shown.length === fleet.rows.length ? `${all} vehicle${all === "1" ? "" : "s"}` : `${of} of ${all} vehicles`;
  list.classList.toggle("many", fleet.rows.length > FEW);
  list.scrollTop = 0;
  drawn = "";
  draw();
}

function draw() {
  let from = 0, to = shown.length;
  if (fleet.rows.length > FEW) {
    if (!rowHeight) {
      body.innerHTML = rowHtml(fleet.rows[0], 0);
      rowHeight = body.firstChild.getBoundingClientRect().height || 30;
    }
    from = Math.max(0, Math.floor(list.scrollTop / rowHeight) - BEYOND);
    to = Math.min(shown.length, Math.ceil((list.scrollTop + list.clientHeight) / rowHeight) + BEYOND);
  }
  if (drawn === from + " " + to) return;
  drawn = from + " " + to;
  const gap = rows => rows ? `<tr class="gap" aria-hidden="true" style="height:${rows * rowHeight}px"><td colspan="6"></td></tr>` : "";
  const rows = shown.slice(from, to).map((i, k) => rowHtml(fleet.rows[i], from + k)).join("");
  body.innerHTML = gap(from) + rows + gap(shown.length - to) ||
    `<tr><td colspan="6" class="soft">No vehicle is like that.</td></tr>`;
}

if (list) {
  const tools = document.getElementById("tools");
  tools.hidden = false;
  tools.addEventListener("submit", event => event.preventDefault());
  tools.addEventListener("input", choose);
  tools.addEventListener("click", event => {
    const button = event.target.closest("[data-status]");
    if (!button) return;
    button.setAttribute("aria-pressed", button.getAttribute("aria-pressed") !== "true");
    choose();
  });
  list.addEventListener("scroll", () => requestAnimationFrame(draw));
  addEventListener("resize", draw);
  choose();
}

// ---------------------------------------------------------------- charts
const waiting = {};  // file beside the page: those who wait for it
const numbers = fleet.charts.inside || {};
window.boresightCharts = part => Object.assign(numbers, part);

function withNumbers(i, then) {
  const name = fleet.rows[i][NAME];
  if (name in numbers || fleet.charts.inside) return then(numbers[name]);
  const file = fleet.charts.folder + "/" + fleet.charts.of[i];
  if (waiting[file]) return waiting[file].push(() => then(numbers[name]));
  waiting[file] = [() => then(numbers[name])];
  const script = document.createElement("script");
  const end = () => waiting[file].splice(0).forEach(f => f());
  script.onload = () => { end(); delete waiting[file]; };
  script.onerror = () => { end(); delete waiting[file]; };
  script.src = file;
  document.head.append(script);
}

function iso(ordinal) {  // Python's ordinal of a day
  return new Date((ordinal - 719163) * 86400000).toISOString().slice(0, 10);
}

function niceStep(span) {
  const power = 10 ** Math.floor(Math.log10(Math.max(span, 1e-12)));
  return power * [0.2, 0.5, 1, 2].find(m => span / (power * m) <= 5);
}

function panel(chart, days, letters, row, events) {
  const [pair, dof, statusAt, limit, start, values, sigmas] = chart, status = fleet.statuses[statusAt];
  const colour = COLOURS[status], alarmed = status === "RED" || status === "YELLOW", unit = dof < 3 ? "deg" : "m";
  const left = dof * 206 + 40, top = row * 150 + 36, width = 158, height = 84;
  const first = days[0] - 0.6, last = days[days.length - 1] + 0.6;
  const reach = 1.15 * Math.max(limit, ...values.map((v, i) => v === null ? 0 : Math.abs(v) + sigmas[i]));
  const x = day => (left + (day - first) / (last - first) * width).toFixed(1);
  const y = v => (top + (1 - (v + reach) / (2 * reach)) * height).toFixed(1);
  const line = (x0, y0, x1, y1, c, w, dash) =>
    `<line x1="${x0}" y1="${y0}" x2="${x1}" y2="${y1}" stroke="${c}" stroke-width="${w}"${dash ? ' stroke-dasharray="4 3"' : ""}/>`;
  const box = (x0, y0, x1, y1, opacity, c) =>
    `<rect x="${x0}" y="${y0}" width="${Math.max(x1 - x0, 0.5)}" height="${Math.max(y1 - y0, 0.5)}" fill="${c}" fill-opacity="${opacity}"/>`;
  const label = (u, v, words, anchor, size, c, bold) =>
    `<text x="${u}" y="${v}" text-anchor="${anchor}" font-size="${size}" fill="${c}"${bold ? ' font-weight="600"' : ""}>${escape(words)}</text>`;
  const title = `${fleet.dofs[pair][dof]} [${unit}]` + (alarmed ? " " + status : "");
  const parts = [label(left, top - 6, title, "start", 11, alarmed ? colour : "currentColor", alarmed)];
  const band = Math.min(limit, reach);
  parts.push(box(x(first), y(band), x(last), y(-band), 0.14, COLOURS.GREEN));
  const ticks = days.length <= 4 ? days : [days[0], days[days.length >> 1], days[days.length - 1]];
  for (const day of ticks) {
    parts.push(line(x(day), y(-reach), x(day), y(reach), MUTED, 0.3));
    parts.push(label(x(day), top + height + 13, iso(day).slice(5), "middle", 10, "currentColor"));
  }
  const step = niceStep(reach * 1.6);
  for (const level of [-step, 0, step]) {
    parts.push(line(x(first), y(level), x(last), y(level), MUTED, 0.3));
    parts.push(label(left - 5, +y(level) + 3.5, +(level / 1e4).toPrecision(3), "end", 10, "currentColor"));
  }
  const width_ = alarmed ? 2 : 1;
  parts.push(line(x(first), y(-reach), x(last), y(-reach), colour, width_), line(x(first), y(-reach), x(first), y(reach), colour, width_));
  if (start) {
    const [begin, earliest, latest] = start.map(day => Math.max(day, first + 0.5));
    parts.push(box(x(earliest - 0.5), y(reach), x(Math.max(latest - 0.5, earliest - 0.45)), y(-reach), 0.22, colour));
    parts.push(line(x(begin - 0.5), y(-reach), x(begin - 0.5), y(reach), colour, 1.2, true));
  }
  for (const [day, words] of events.filter(event => event[2].includes(pair) && event[0] >= first && event[0] <= last)) {
    parts.push(`<g><title>${escape(words)}</title>${line(x(day), y(-reach), x(day), y(reach), "currentColor", 1.4)}` +
      `<path d="M${x(day) - 4} ${top}h8l-4 6z"/></g>`);
  }
  let seen = 0;
  days.forEach((day, i) => {
    if (letters[i] === ".") return;
    if (values[i] === null) {
      parts.push(`<g stroke="${MUTED}" stroke-width="1.3"><title>${iso(day)}: refused or not determined</title><path d="M${x(day) - 3} ${y(0) - 3}l6 6m0 -6l-6 6" fill="none"/></g>`);
      return;
    }
    seen += 1;
    const held = letters[i] === "h", v = (values[i] / 1e4).toFixed(3), s = (sigmas[i] / 1e4).toFixed(3);
    parts.push(`<g opacity="${held ? 0.45 : 1}"><title>${iso(day)}: ${v < 0 ? "" : "+"}${v} ± ${s} ${unit}${held ? " (held)" : ""}</title>` +
      line(x(day), y(values[i] - sigmas[i]), x(day), y(values[i] + sigmas[i]), colour, 1.4) +
      `<circle cx="${x(day)}" cy="${y(values[i])}" r="${days.length > 14 ? 2.2 : 3}" fill="${colour}"/></g>`);
  });
  if (!seen) parts.push(label(left + width / 2, top + 26, "not determined", "middle", 11, MUTED));
  return parts.join("");
}

function figure(name, found) {
  if (!found || !found.days.length) return `<p class="soft">No record in the window.</p>`;
  const own = [...new Set(found.charts.map(chart => chart[0]))];  // edges of this vehicle
  const pairs = own.map((p, row) => `<text x="0" y="${row * 150 + 12}" font-weight="600" font-size="12.5">${escape(fleet.pairs[p])}</text>`);
  const panels = found.charts.map(chart => panel(chart, found.days, found.pairs[chart[0]], own.indexOf(chart[0]), found.events));
  return `<figure><svg viewBox="0 0 1246 ${own.length * 150 - 4}" font-size="11" fill="currentColor" role="img" aria-label="Control charts of ${escape(name)}">` +
    pairs.join("") + panels.join("") + "</svg></figure>";
}

function told(row) {
  const days = (row[OLDER] || []).concat(fleet.days.map((day, i) => [day, row[DAYS][i]])).filter(d => d[1] !== ".");
  const change = row[CHANGE], parts = [`<p>${commands(fleet.sentences[row[SENTENCE]])}</p>`];
  if (change) parts.push(`<p class="soft">${escape([change[0], change[2], "charts: " + change[3].join("; ")].join(" · "))}</p>`);
  parts.push(`<p class="days">${days.map(d => chip(row, d[0], d[1], true)).join(" ") || "No record in the window."}</p>`);
  return parts.join("");
}

function fill(details) {
  if (details.dataset.filled) return;
  details.dataset.filled = "yes";
  const i = +details.dataset.row, row = fleet.rows[i], inside = document.createElement("div");
  inside.innerHTML = told(row) + `<p class="soft">Reading the charts …</p>`;
  details.append(inside);
  withNumbers(i, found => {
    inside.lastChild.remove();
    if (!found && !fleet.charts.inside && !row[LAST]) found = { days: [] };
    inside.insertAdjacentHTML("beforeend", found || fleet.charts.inside ? figure(row[NAME], found) :
      `<p class="soft">No charts of this vehicle in ${escape(decodeURIComponent(fleet.charts.folder))}/${fleet.charts.of[i]}, which belongs beside this page.</p>`);
  });
}

function show(name) {
  const i = byName.get(name);
  if (i === undefined) return;
  let details = document.getElementById("charts-" + name);
  if (!details) {
    const row = fleet.rows[i], status = fleet.statuses[row[STATUS]];
    details = document.createElement("details");
    details.id = "charts-" + name;
    details.dataset.row = i;
    details.innerHTML = `<summary>${escape(name)} <span class="pill ${status}">${status}</span></summary>`;
    details.addEventListener("toggle", () => details.open && fill(details));
    document.getElementById("charts").prepend(details);
  }
  details.open = true;
  fill(details);
  details.scrollIntoView();
  details.querySelector("summary").focus({ preventScroll: true });
}

document.querySelectorAll("#charts details").forEach(details => {
  details.addEventListener("toggle", () => details.open && fill(details));
  if (details.open) fill(details);
});
document.addEventListener("click", event => {
  const link = event.target.closest('a[href^="#charts-"]');
  if (!link) return;
  event.preventDefault();
  const name = link.getAttribute("href").slice("#charts-".length);
  history.replaceState(null, "", "#charts-" + encodeURIComponent(name));
  show(name);
});
const asked = decodeURIComponent(location.hash);
if (asked.startsWith("#charts-")) show(asked.slice("#charts-".length));
})();
