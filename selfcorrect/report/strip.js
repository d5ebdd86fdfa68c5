// A shot: its frames in a row, the gain of each, and a row of pixels through time.

const viewerPlace = document.getElementById("viewer");
const shown = data.frames.filter((frame) => frame.layers.length);
const viewer = shown.length ? new Viewer(viewerPlace) : null;
if (!viewer) viewerPlace.remove();
const strip = document.getElementById("strip");
const buttons = new Map();
const cache = new Map();
const toned = []; // pictures outside the viewer, shown with its exposure

const gainOf = (frame) => (frame.change === null ? frame.outcome : frame.change < 0 ? percent(frame.change) : "kept");

let wanted; // the frame asked for last: one that takes longer to unpack must not come in its place
function select(frame) {
  wanted = frame;
  for (const [number, button] of buttons) button.setAttribute("aria-pressed", number === frame.number);
  if (!cache.has(frame.number)) cache.set(frame.number, layersOf(frame.layers));
  return cache.get(frame.number).then((layers) => {
    if (frame === wanted) viewer.load(layers, frame.scale);
  });
}

async function drawStrip() {
  const list = make("ol", { class: "frames" });
  for (const frame of data.frames) {
    const children = [];
    if (frame.thumbnail) {
      const { width, height } = frame.thumbnail;
      const picture = new Picture("", width, height, await unpacked(frame.thumbnail));
      toned.push(picture);
      children.push(picture.painted());
    }
    const start = frame.warm === null ? "" : frame.warm ? "warm" : "cold";
    children.push(make("span", {}, `Frame ${frame.number}`), make("span", { class: "gain" }, [gainOf(frame), start].filter(Boolean).join(" · ")));
    const open = frame.layers.length > 0;
    const button = make("button", { type: "button", disabled: !open, "aria-pressed": "false", title: open ? "Look at this frame" : "Only some frames of a long shot are kept in full", onclick: () => select(frame) }, ...children);
    buttons.set(frame.number, button);
    list.append(make("li", {}, button));
  }
  return list;
}

/** Bars of the gain per frame, drawn for the width there is. */
function gainChart() {
  const place = make("div");
  const draw = () => {
    const width = Math.max(200, place.clientWidth), height = 120, left = 46, bottom = 18, top = 6;
    const known = data.frames.filter((frame) => frame.change !== null);
    const most = Math.max(0.05, ...known.map((frame) => -frame.change + (frame.error ?? 0)));
    const y = (gain) => top + (1 - gain / most) * (height - top - bottom);
    const step = Math.min(128, (width - left) / data.frames.length), every = Math.ceil(data.frames.length / ((width - left) / 44));
    const svg = make("svg:svg", { height, viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `Gain of each frame, from ${known.map((f) => `${f.number}: ${gainOf(f)}`).join(", ")}` });
    for (const gain of [0, most / 2, most]) {
      svg.append(make("svg:line", { class: "axis", x1: left, x2: width, y1: y(gain), y2: y(gain) }), make("svg:text", { class: "quiet", x: left - 6, y: y(gain) + 4, "text-anchor": "end" }, gain ? percent(-gain, most < 0.2 ? 1 : 0) : "0"));
    }
    data.frames.forEach((frame, i) => {
      const gain = Math.max(0, -(frame.change ?? 0)), x = left + i * step, bar = Math.max(1, Math.min(40, step - 2));
      const kind = frame.outcome === "failed" ? "failed" : gain ? "" : "none";
      const tall = Math.max(2, y(0) - y(gain));
      const group = make("svg:g", {}, make("svg:title", {}, `Frame ${frame.number}: ${gainOf(frame)}`), make("svg:rect", { class: `gainbar ${kind}`, x: x + (step - bar) / 2, y: y(0) - tall, width: bar, height: tall }));
      if (frame.error && gain) group.append(make("svg:line", { class: "whisker", x1: x + step / 2, x2: x + step / 2, y1: y(gain - frame.error), y2: y(Math.min(most, gain + frame.error)) }));
      svg.append(group);
      if (i % every === 0) svg.append(make("svg:text", { class: "quiet", x: x + step / 2, y: height - 3, "text-anchor": "middle" }, String(frame.number)));
    });
    place.replaceChildren(svg);
  };
  new ResizeObserver(draw).observe(place);
  return place;
}

async function drawSlices(place) {
  const row = make("div", { class: "slices" });
  for (const [name, packed] of Object.entries(data.slices)) {
    const { width, height } = packed;
    const picture = new Picture("", width, height, await unpacked(packed));
    toned.push(picture);
    const canvas = picture.painted();
    canvas.style.height = `${Math.min(320, Math.max(72, 6 * height))}px`;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${data.labels[name]}: the middle row of every frame, the first frame at the top`);
    row.append(make("figure", {}, canvas, make("figcaption", {}, data.labels[name])));
  }
  if (row.children.length) place.append(make("h2", {}, "A row through time"), make("p", { class: "note" }, "The middle row of every frame, the first frame at the top: what flickers shows as stripes across, what stays as lines down."), row);
}

(async () => {
  strip.append(make("h2", {}, "Gain per frame"), gainChart(), await drawStrip());
  await drawSlices(document.getElementById("slice"));
  if (viewer) {
    viewer.listeners.push(() => toned.forEach((picture) => picture.painted()));
    await select(shown[0]);
  }
  document.documentElement.dataset.ready = "true";
})();
