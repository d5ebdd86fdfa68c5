// Images over one another: one view (zoom and centre) for all of them, a divider between two.

/** The pictures and maps of a frame, in the order of the keys 1, 2, 3, … */
async function layersOf(packed) {
  const found = new Map();
  const planes = await Promise.all(packed.map(unpacked));
  packed.forEach((one, i) => {
    if (one.channels === 3) found.set(one.name, new Picture(one.label, one.width, one.height, planes[i]));
  });
  const { denoised, corrected, reference } = Object.fromEntries(found);
  if (denoised && corrected) found.set("change", changeOf(denoised, corrected));
  const maps = new Map(packed.map((one, i) => [one.name, { ...one, plane: planes[i][0] }]));
  const before = maps.get("error.before");
  const top = before ? Math.max(1e-7, quantile(Float32Array.from(before.plane, (bits) => FLOATS[bits]), 0.99)) : 1;
  for (const { name, label, channels, width, height, plane } of maps.values()) {
    if (channels !== 1) continue;
    const values = Float32Array.from(plane, (bits) => FLOATS[bits]);
    const look = name === "blend"
      ? { colours: "weight", from: 0, to: 1, told: "weight of the correction; 0 keeps the denoised image" }
      : { colours: "heat", from: 0, to: top, told: "estimated squared error, relative to the radiance" };
    found.set(name, new Falsecolour(label, width, height, values, look));
  }
  if (reference && denoised && corrected) {
    const errors = [denoised, corrected].map((picture) => squaredError(picture, reference));
    const most = Math.max(1e-7, quantile(errors[0], 0.98));
    const look = { colours: "heat", from: 0, to: most, told: "squared difference from the reference, relative to its radiance" };
    for (const [i, name] of ["denoised", "corrected"].entries()) {
      found.set(`true.${name}`, new Falsecolour(`True error, ${name}`, reference.width, reference.height, errors[i], look));
    }
  }
  return found;
}

function changeOf(before, after) {
  const weights = [0.2126, 0.7152, 0.0722];
  const level = (picture, i) => weights.reduce((sum, w, c) => sum + w * FLOATS[picture.planes[c][i]], 0);
  const values = new Float32Array(before.width * before.height).map((_, i) => {
    const was = level(before, i);
    return (level(after, i) - was) / (was + 1e-3);
  });
  const most = Math.max(0.02, quantile(values.map(Math.abs), 0.98));
  const look = { colours: "signed", from: -most, to: most, told: "darker and brighter than the denoised image" };
  return new Falsecolour("Change", before.width, before.height, values, look);
}

/** relMSE's summand: mean over channels of (x − r)² / (mean(r)² + 0.01). */
function squaredError(picture, reference) {
  return new Float32Array(picture.width * picture.height).map((_, i) => {
    let sum = 0, mean = 0;
    for (let c = 0; c < 3; c++) {
      const r = FLOATS[reference.planes[c][i]];
      sum += (FLOATS[picture.planes[c][i]] - r) ** 2 / 3;
      mean += r / 3;
    }
    return sum / (mean ** 2 + 0.01);
  });
}

const MOST_ZOOM = 64;

/** What is seen of the images, in all stages alike; ``zoom`` is CSS pixels for each of the image's. */
class View {
  constructor() {
    this.fit = true;
    this.zoom = 1;
    this.x = this.y = 0;
  }
  settle(box, { width, height }) {
    const fitting = Math.min(box.width / width, box.height / height);
    if (this.fit) {
      this.zoom = fitting;
      this.x = width / 2;
      this.y = height / 2;
    }
    this.zoom = Math.min(MOST_ZOOM, Math.max(Math.min(fitting, 1), this.zoom));
    this.x = Math.min(width, Math.max(0, this.x));
    this.y = Math.min(height, Math.max(0, this.y));
  }
  at(box, px, py) {
    return [this.x + (px - box.width / 2) / this.zoom, this.y + (py - box.height / 2) / this.zoom];
  }
  zoomAt(box, px, py, factor) {
    const [x, y] = this.at(box, px, py);
    const zoom = Math.min(MOST_ZOOM, this.zoom * factor);
    this.fit = false;
    this.x = x - (px - box.width / 2) / zoom;
    this.y = y - (py - box.height / 2) / zoom;
    this.zoom = zoom;
  }
  pan(dx, dy) {
    this.fit = false;
    this.x -= dx / this.zoom;
    this.y -= dy / this.zoom;
  }
}

/** A canvas that shows one layer, or two with a divider. */
class Stage {
  constructor(viewer) {
    this.viewer = viewer;
    this.canvas = make("canvas");
    this.tags = ["left", "right"].map((side) => make("span", { class: `tag ${side}` }));
    this.element = make("div", { class: "stage", tabindex: "0", role: "img" }, this.canvas, ...this.tags);
    this.pointers = new Map();
    this.listen();
  }
  get box() {
    return this.element.getBoundingClientRect();
  }
  listen() {
    const { element, viewer, pointers } = this;
    const local = (event) => [event.clientX - this.box.left, event.clientY - this.box.top];
    element.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey && viewer.view.fit && !element.matches(":focus, :focus-within")) return;
      event.preventDefault();
      viewer.view.zoomAt(this.box, ...local(event), 2 ** (-event.deltaY / 300));
      viewer.draw();
    }, { passive: false });
    element.addEventListener("dblclick", (event) => viewer.zoomTo(viewer.view.fit ? 4 : null, this.box, ...local(event)));
    element.addEventListener("pointerdown", (event) => {
      pointers.set(event.pointerId, local(event));
      element.setPointerCapture(event.pointerId);
    });
    element.addEventListener("pointermove", (event) => this.moved(event, local(event)));
    for (const end of ["pointerup", "pointercancel"]) element.addEventListener(end, (e) => pointers.delete(e.pointerId));
  }
  moved(event, [px, py]) {
    const { viewer, pointers } = this, last = pointers.get(event.pointerId);
    if (last) {
      if (pointers.size === 2) {
        const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
        const length = (at) => Math.hypot(at[0] - other[0], at[1] - other[1]);
        viewer.view.zoomAt(this.box, ...other, length([px, py]) / Math.max(1, length(last)));
      } else if (!viewer.view.fit || event.pointerType === "mouse") viewer.view.pan(px - last[0], py - last[1]);
      pointers.set(event.pointerId, [px, py]);
      viewer.draw();
    }
    const [x, y] = viewer.view.at(this.box, px, py);
    viewer.look(Math.floor(x), Math.floor(y));
  }
  /** ``split``: where the divider stands, 0 … 1, or null where only ``right`` is shown. */
  draw(left, right, split) {
    const ratio = window.devicePixelRatio || 1, { width, height } = this.box;
    const [w, h] = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
    if (this.canvas.width !== w || this.canvas.height !== h) Object.assign(this.canvas, { width: w, height: h });
    const context = this.canvas.getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, w, h);
    const at = split === null ? 0 : Math.round(split * w);
    if (split !== null) this.paint(context, left, 0, at, ratio);
    this.paint(context, right, at, w, ratio);
    this.element.style.touchAction = this.viewer.view.fit ? "pan-y" : "none"; // a finger scrolls past what is not zoomed
    this.tags[0].textContent = split === null ? right.label : left.label;
    this.tags[1].textContent = split === null ? "" : right.label;
    this.tags[0].hidden = split !== null && split < 0.08;
    this.tags[1].hidden = split === null || split > 0.92;
    const shown = split === null ? right.label : `${left.label} on the left, ${right.label} on the right`;
    this.element.setAttribute("aria-label", `${shown}, at ${this.viewer.zoomTold()}`);
  }
  paint(context, layer, from, to, ratio) {
    const { view } = this.viewer, { width, height } = this.canvas, scale = view.zoom * ratio;
    context.save();
    context.beginPath();
    context.rect(from, 0, to - from, height);
    context.clip();
    context.imageSmoothingEnabled = scale < 1;
    context.imageSmoothingQuality = "high";
    context.setTransform(scale, 0, 0, scale, width / 2 - view.x * scale, height / 2 - view.y * scale);
    context.drawImage(layer.painted(), 0, 0);
    context.restore();
  }
}
