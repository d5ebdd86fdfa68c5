// Seconds against error: points to point at, and what a budget of seconds buys.

const place = document.getElementById("pareto");
const points = [...data.points].sort((a, b) => a.seconds - b.seconds);
const rows = new Map([...document.querySelectorAll(".points tbody tr")].map((row) => [row.cells[0].textContent, row]));
const least = Math.max(1e-3, Math.min(...points.map((p) => p.seconds))), most = Math.max(least, ...points.map((p) => p.seconds));
let chosen = points.find((p) => p.recommended) ?? points[0];
let budget = most;

const logs = (share) => least * (most / least) ** share;
const seconds = (s) => `${s.toFixed(s < 10 ? 2 : s < 100 ? 1 : 0)} s`;
const told = make("p", { class: "told", role: "status" });
const plot = make("div");

function choose(point) {
  chosen = point;
  const gain = point.ratio < 1 ? `error ${percent(point.ratio - 1)}` : "no gain";
  const marks = [point.recommended && "recommended", point.preset && "preset", point.front && "on the Pareto front"].filter(Boolean);
  told.textContent = `${point.name}: ${gain} ± ${(100 * point.error).toFixed(1)} % in ${seconds(point.seconds)}${marks.length ? ` (${marks.join(", ")})` : ""}`;
  for (const [name, row] of rows) row.classList.toggle("chosen", name === point.name);
  for (const dot of plot.querySelectorAll(".dot")) dot.classList.toggle("chosen", dot.dataset.name === point.name);
}

function within(limit) {
  const there = points.filter((p) => p.seconds <= limit * 1.0001);
  return there.reduce((best, p) => (p.ratio < best.ratio ? p : best), there[0] ?? points[0]);
}

function ticks(low, high) {
  const found = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++) {
    for (const digit of high / low < 8 ? [1, 1.5, 2, 3, 4, 5, 7] : [1, 2, 5]) {
      const value = digit * 10 ** power;
      if (value >= low && value <= high) found.push(value);
    }
  }
  return found;
}

function draw() {
  const width = Math.max(260, plot.clientWidth), height = Math.round(Math.min(520, Math.max(280, width * 0.42)));
  const [left, right, top, bottom] = [44, 16, 16, 38];
  const [low, high] = [least / 1.25, most * 1.4];
  const ends = points.flatMap((p) => [p.ratio - p.error, p.ratio + p.error]);
  const bottomRatio = Math.max(0, Math.min(...ends) - 0.02), topRatio = Math.max(1.02, ...ends);
  const x = (s) => left + (Math.log(Math.max(s, low) / low) / Math.log(high / low)) * (width - left - right);
  const y = (r) => top + ((topRatio - r) / (topRatio - bottomRatio)) * (height - top - bottom);
  const line = (name, x1, y1, x2, y2) => make("svg:line", { class: name, x1, y1, x2, y2 });
  const text = (content, at) => make("svg:text", { class: "quiet", ...at }, content);
  const svg = make("svg:svg", { height, viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": "Points: seconds to the right, error upwards" });
  const step = topRatio - bottomRatio > 0.5 ? 0.2 : topRatio - bottomRatio > 0.2 ? 0.1 : 0.05;
  for (let r = Math.ceil(bottomRatio / step) * step; r <= topRatio; r += step) {
    svg.append(line("axis", left, y(r), width - right, y(r)), text(r.toFixed(2), { x: left - 6, y: y(r) + 4, "text-anchor": "end" }));
  }
  let last = -100;
  for (const s of ticks(low, high)) {
    if (x(s) - last < 40) continue;
    last = x(s);
    svg.append(line("axis", x(s), height - bottom, x(s), height - bottom + 5), text(String(Number(s.toPrecision(2))), { x: x(s), y: height - bottom + 19, "text-anchor": "middle" }));
  }
  svg.append(text("seconds of the correction", { x: width - right, y: height - 4, "text-anchor": "end" }), text("error over that of the denoised image", { x: left, y: 10 }));
  svg.append(line("one", left, y(1), width - right, y(1)), line("budget", x(budget), top, x(budget), height - bottom));
  const front = points.filter((p) => p.front);
  svg.append(make("svg:path", { class: "front", d: front.map((p, i) => (i ? `H${x(p.seconds)}V${y(p.ratio)}` : `M${x(p.seconds)},${y(p.ratio)}`)).join("") }));
  const labels = points.map((p) => [x(p.seconds) - 5, y(p.ratio) - 5, 10, 10]);
  for (const p of points) svg.append(...mark(p, x, y, labels, width - right));
  plot.replaceChildren(svg);
  choose(chosen);
}

function mark(p, x, y, labels, end) {
  const beyond = p.seconds > budget * 1.0001 ? " beyond" : "";
  const dot = make("svg:circle", {
    class: `dot${p.preset ? " preset" : ""}${beyond}`, cx: x(p.seconds), cy: y(p.ratio), r: p.preset ? 7 : 5, tabindex: "0", role: "button",
    "aria-label": `${p.name}: error ${p.ratio.toFixed(3)} in ${seconds(p.seconds)}`, "data-name": p.name,
    onpointerenter: () => choose(p), onfocus: () => choose(p), onclick: () => choose(p),
  });
  const found = [make("svg:line", { class: `whisker${beyond}`, x1: x(p.seconds), x2: x(p.seconds), y1: y(p.ratio + p.error), y2: y(p.ratio - p.error) }), dot];
  const wide = 7 * p.name.length, back = x(p.seconds) + 10 + wide > end;
  const box = [x(p.seconds) + (back ? -10 - wide : 10), y(p.ratio) - 18, wide, 12];
  const free = labels.every(([bx, by, bw, bh]) => box[0] > bx + bw || box[0] + box[2] < bx || box[1] > by + bh || box[1] + box[3] < by);
  if ((p.preset || p.front) && (free || p.preset)) {
    labels.push(box);
    found.push(make("svg:text", { class: beyond.trim(), x: back ? box[0] + wide : box[0], y: y(p.ratio) - 8, "text-anchor": back ? "end" : "start" }, p.name));
  }
  return found;
}

const slider = range("Budget", { min: 0, max: 1, step: 0.01, value: 1 }, (share) => seconds(logs(share)), (share) => {
  budget = logs(share);
  choose(within(budget));
  draw();
});
place.append(plot, make("div", { class: "bar" }, slider.group, make("span", { class: "hint" }, "The best point within so many seconds is chosen; Tab and pointer choose others.")), told);
for (const [name, row] of rows) row.addEventListener("pointerenter", () => choose(points.find((p) => p.name === name) ?? chosen));
new ResizeObserver(draw).observe(plot);
draw();
document.documentElement.dataset.ready = "true";
