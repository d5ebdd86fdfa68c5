// The viewer with its buttons and keys.

const MODES = { slider: "Slider", whole: "One image", grid: "Side by side" };

class Viewer {
  constructor(root) {
    this.view = new View();
    this.layers = new Map();
    this.mode = "slider";
    this.split = 0.5;
    this.left = this.right = null;
    this.cursor = null;
    this.scale = 1;
    this.origin = [0, 0];
    this.listeners = [];
    this.build(root);
  }
  build(root) {
    this.tabs = make("div", { class: "group", role: "group", "aria-label": "Image" });
    this.beside = make("select", { "aria-label": "Image on the left", onchange: () => this.show(this.beside.value, this.right) });
    this.besideGroup = make("div", { class: "group" }, make("span", { class: "name" }, "Left of the slider"), this.beside);
    this.modes = make("div", { class: "segments", role: "radiogroup", "aria-label": "Layout" });
    for (const [mode, label] of Object.entries(MODES)) {
      const input = make("input", {
        type: "radio", name: "mode", id: `mode-${mode}`, value: mode, checked: mode === this.mode,
        onchange: () => this.setMode(mode),
      });
      this.modes.append(input, make("label", { for: input.id }, label));
    }
    this.exposure = range("Exposure", { min: -10, max: 10, step: 0.25, value: 0 }, (v) => `${v > 0 ? "+" : ""}${v.toFixed(2)} EV`.replace("-", "−"),
      (stops) => this.setTone(stops, tone.curve));
    const curves = make("select", { "aria-label": "Tone mapping", onchange: () => this.setTone(tone.stops, curves.value) },
      ...Object.keys(CURVES).map((name) => make("option", {}, name)));
    const zooms = [["−", "Zoom out", () => this.zoomBy(0.5)], ["+", "Zoom in", () => this.zoomBy(2)], ["1:1", "One pixel for one", () => this.zoomTo(1)], ["Fit", "Whole image", () => this.zoomTo(null)]];
    this.zoomOutput = make("output");
    this.stages = make("div", { class: "stages" });
    this.main = new Stage(this);
    this.divider = this.dividerElement();
    this.legend = make("div", { class: "legend" });
    this.inspector = make("div", { class: "inspector" });
    const keys = [["1 – 9", "images"], ["space", "flips between the last two"], ["s o g", "slider, one image, side by side"], ["[ ]", "exposure"], ["+ −", "zoom, like the wheel after a click"], ["0", "fit"], ["arrows", "move"]];
    const hint = make("p", { class: "hint keys" }, ...keys.flatMap(([key, does]) => [make("kbd", {}, key), ` ${does} `]));
    const remark = [...root.children];
    root.append(
      make("div", { class: "bar" }, this.tabs),
      make("div", { class: "bar tools" }, this.modes, this.besideGroup, this.exposure.group,
        make("div", { class: "group" }, make("span", { class: "name" }, "Tone mapping"), curves),
        make("div", { class: "group" }, make("span", { class: "name" }, "Zoom"), ...zooms.map(([text, label, act]) => make("button", { type: "button", "aria-label": label, title: label, onclick: act }, text)), this.zoomOutput)),
      make("div", { class: "look" }, make("div", { class: "seen" }, this.stages, this.legend), this.inspector), ...remark, hint,
    );
    document.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.draw()).observe(this.stages);
  }
  dividerElement() {
    const divider = make("div", {
      class: "divider", role: "slider", tabindex: "0", "aria-label": "Divider between the images",
      "aria-valuemin": 0, "aria-valuemax": 100,
    });
    const move = (event) => {
      if (event.buttons) this.setSplit((event.clientX - this.main.box.left) / this.main.box.width);
    };
    divider.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      divider.setPointerCapture(event.pointerId);
    });
    divider.addEventListener("pointermove", (event) => {
      move(event);
      if (event.buttons) event.stopPropagation();
    });
    divider.addEventListener("keydown", (event) => {
      const to = { ArrowLeft: this.split - 0.02, ArrowRight: this.split + 0.02, Home: 0, End: 1 }[event.key];
      if (to === undefined) return;
      event.preventDefault();
      event.stopPropagation();
      this.setSplit(to);
    });
    return divider;
  }
  /** Show other images in the same view, as another frame of a shot. */
  load(layers, scale, origin = [0, 0]) {
    const size = (some) => [...some.values()].slice(0, 1).map(({ width, height }) => `${width} ${height}`).join();
    const first = !this.layers.size;
    if (size(layers) !== size(this.layers)) {
      this.view.fit = true;
      this.cursor = null;
    }
    this.layers = layers;
    this.scale = scale;
    this.origin = origin;
    const names = [...layers.keys()];
    if (!layers.has(this.left)) this.left = layers.has("denoised") ? "denoised" : names[0];
    if (!layers.has(this.right)) this.right = layers.has("corrected") ? "corrected" : names[names.length - 1];
    this.tabs.replaceChildren(...names.map((name, i) => make("button", {
      type: "button", "data-layer": name, onclick: () => this.pick(name),
    }, layers.get(name).label, ...(i < 9 ? [make("kbd", { "aria-hidden": true }, String(i + 1))] : []))));
    this.beside.replaceChildren(...names.map((name) => make("option", { value: name }, layers.get(name).label)));
    if (first) this.setTone(this.automaticStops(), tone.curve);
    this.setMode(this.mode);
  }
  /** 0 for a usual exposure; what brings the frame's median to middle grey where it is far from that. */
  automaticStops() {
    const picture = this.layers.get("denoised") ?? this.layers.values().next().value;
    const median = quantile(Float32Array.from(picture.planes[1], (bits) => FLOATS[bits]), 0.5);
    const wanted = Math.round(4 * Math.log2(0.18 / Math.max(median, 1e-6))) / 4;
    return Math.abs(wanted) <= 4 ? 0 : Math.max(-10, Math.min(10, wanted));
  }
  setTone(stops, curve) {
    tone.set(Math.max(-10, Math.min(10, stops)), curve);
    this.exposure.input.value = tone.stops;
    this.exposure.update();
    this.draw();
    for (const act of this.listeners) act();
  }
  setMode(mode) {
    this.mode = mode;
    document.getElementById(`mode-${mode}`).checked = true;
    this.besideGroup.hidden = mode !== "slider";
    this.stages.className = mode === "grid" ? "stages grid" : "stages";
    const { width, height } = this.layers.get(this.right);
    if (mode === "grid") {
      this.grid = [...this.layers].map(([name]) => ({ name, stage: new Stage(this) }));
      for (const { stage } of this.grid) stage.element.style.aspectRatio = `${width} / ${height}`;
      this.stages.replaceChildren(...this.grid.map(({ stage }) => stage.element));
    } else {
      this.main.element.style.aspectRatio = `${width} / ${height}`;
      this.main.element.style.maxHeight = "78vh";
      this.main.element.style.width = "100%";
      if (mode === "slider") this.main.element.append(this.divider);
      else this.divider.remove();
      this.stages.replaceChildren(this.main.element);
    }
    this.draw();
  }
  setSplit(split) {
    this.split = Math.max(0, Math.min(1, split));
    this.draw();
  }
  show(left, right) {
    Object.assign(this, { left, right });
    this.draw();
  }
  /** An image alone; what was shown before is what space flips to. */
  pick(name) {
    if (name !== this.right) this.left = this.right;
    this.right = name;
    if (this.mode === "slider") this.setMode("whole");
    else this.draw();
  }
  zoomTo(zoom, box = this.box, px = box.width / 2, py = box.height / 2) {
    if (zoom === null) this.view.fit = true;
    else this.view.zoomAt(box, px, py, zoom / this.view.zoom);
    this.draw();
  }
  zoomBy(factor) {
    this.view.zoomAt(this.box, this.box.width / 2, this.box.height / 2, factor);
    this.draw();
  }
  zoomTold() {
    return `${Math.round(100 * this.view.zoom * (window.devicePixelRatio || 1))} %`;
  }
  get box() {
    return (this.mode === "grid" ? this.grid[0].stage : this.main).box;
  }
  draw() {
    if (!this.layers.size || !this.stages.isConnected || !this.stages.children.length) return;
    const left = this.layers.get(this.left), right = this.layers.get(this.right);
    this.view.settle(this.box, right);
    if (this.mode === "grid") {
      for (const { name, stage } of this.grid) stage.draw(null, this.layers.get(name), null);
    } else this.main.draw(left, right, this.mode === "slider" ? this.split : null);
    this.divider.style.left = `${100 * this.split}%`;
    this.divider.setAttribute("aria-valuenow", Math.round(100 * this.split));
    this.divider.setAttribute("aria-valuetext", `${Math.round(100 * this.split)} % ${left.label}`);
    for (const tab of this.tabs.children) tab.setAttribute("aria-pressed", tab.dataset.layer === this.right);
    this.beside.value = this.left;
    this.zoomOutput.textContent = this.zoomTold();
    this.drawLegend(this.mode === "grid" ? [...this.layers.values()] : this.mode === "slider" ? [left, right] : [right]);
    this.inspect();
  }
  drawLegend(shown) {
    const maps = [...new Set(shown)].filter((layer) => layer instanceof Falsecolour);
    this.legend.replaceChildren(...maps.map(({ label, colours, from, to, told }) => {
      const bar = make("i", { "aria-hidden": true });
      bar.style.background = gradient(colours);
      const ends = colours === "signed" ? [percent(from), percent(to)] : [short(from), short(to)];
      return make("span", {}, make("span", {}, `${label}: ${told}`), make("span", {}, ends[0]), bar, make("span", {}, ends[1]));
    }));
  }
  /** The pixel under the cursor; without a mouse the one in the middle. */
  look(x, y) {
    this.cursor = [x, y];
    this.inspect();
  }
  inspect() {
    const { width, height } = this.layers.get(this.right);
    let [x, y] = this.cursor ?? [Math.floor(this.view.x), Math.floor(this.view.y)];
    x = Math.max(0, Math.min(width - 1, x));
    y = Math.max(0, Math.min(height - 1, y));
    const rows = [...this.layers.values()].map((layer) => {
      const values = layer.values(x, y), swatch = make("span", { class: "swatch", "aria-hidden": true });
      if (layer instanceof Picture) swatch.style.background = `rgb(${layer.planes.map((plane) => tone.bytes[plane[y * width + x]]).join(" ")})`;
      const told = layer.colours === "signed" ? [percent(values[0], 1)] : values.map(short);
      return make("tr", {}, make("th", { scope: "row" }, ...(layer instanceof Picture ? [swatch] : []), layer.label), ...told.map((v) => make("td", {}, v)));
    });
    const [left, top] = this.origin, at = [[x, left], [y, top]].map(([v, from]) => Math.floor(from + (v + 0.5) * this.scale));
    const where = `Pixel ${this.scale === 1 ? "" : "about "}${at.join(", ")}`;
    const head = ["", "red", "green", "blue"].map((name) => make("th", { scope: "col" }, name));
    this.inspector.replaceChildren(make("table", {},
      make("caption", {}, `${where}${this.cursor ? "" : " (middle)"}, linear`),
      make("thead", {}, make("tr", {}, ...head)), make("tbody", {}, ...rows)));
  }
  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || !this.layers.size) return;
    const on = event.target.closest?.("input, select, textarea, button, summary, a");
    if (on && (event.key === " " || event.key.startsWith("Arrow") || on.matches("select, input:not([type=range], [type=radio])"))) {
      if (!(event.key === " " && on.matches("button[data-layer]"))) return;
    }
    const name = [...this.layers.keys()][Number(event.key) - 1];
    const step = 40;
    const acts = {
      " ": () => this.show(this.right, this.left),
      s: () => this.setMode("slider"), o: () => this.setMode("whole"), g: () => this.setMode("grid"),
      "[": () => this.setTone(tone.stops - 0.5, tone.curve), "]": () => this.setTone(tone.stops + 0.5, tone.curve),
      "+": () => this.zoomBy(2), "=": () => this.zoomBy(2), "-": () => this.zoomBy(0.5), 0: () => this.zoomTo(null),
    };
    const arrows = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (arrows[event.key] && event.target.closest?.(".stage")) {
      acts[event.key] = () => {
        this.cursor = null;
        this.view.pan(...arrows[event.key]);
        this.draw();
      };
    }
    const act = name && event.key !== " " ? () => this.pick(name) : acts[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }
}
