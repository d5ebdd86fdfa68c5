// Half floats from the page's text, and from there to what a display shows.

const data = JSON.parse(document.getElementById("data").textContent);

/** A DOM element with attributes and children; texts are never parsed as HTML. */
function make(tag, attributes = {}, ...children) {
  const element = tag.startsWith("svg:")
    ? document.createElementNS("http://www.w3.org/2000/svg", tag.slice(4))
    : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== null && value !== false) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

/** The numbers behind every half float from 0 to 65504. */
const FLOATS = Float32Array.from({ length: 0x7c00 }, (_, bits) => {
  const exponent = bits >> 10, mantissa = bits & 1023;
  return exponent ? 2 ** (exponent - 15) * (1 + mantissa / 1024) : 2 ** -24 * mantissa;
});

async function inflated(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Planes of half floats' bits; undoes selfcorrect.report.pack. */
async function unpacked({ width, height, channels, bits, data: text }) {
  const bytes = await inflated(text), size = width * height, all = channels * size;
  const planes = [];
  for (let c = 0; c < channels; c++) {
    const plane = new Int16Array(size);
    for (let y = 0, i = 0; y < height; y++) {
      for (let x = 0; x < width; x++, i++) {
        const above = y ? plane[i - width] : 0;
        const left = x ? plane[i - 1] : above;
        const corner = x ? (y ? plane[i - width - 1] : 0) : above;
        const low = Math.min(left, above), high = Math.max(left, above);
        const folded = bytes[c * size + i] | (bytes[all + c * size + i] << 8);
        plane[i] = Math.max(low, Math.min(high, left + above - corner)) + ((folded >>> 1) ^ -(folded & 1));
      }
    }
    planes.push(plane);
  }
  if (channels === 3) {
    const [green, red, blue] = planes;
    for (let i = 0; i < size; i++) {
      red[i] += green[i];
      blue[i] += green[i];
    }
    planes.splice(0, 3, red, green, blue);
  }
  for (const plane of planes) for (let i = 0; i < size; i++) plane[i] <<= 10 - bits;
  return planes;
}

const encoded = (v) => (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055);

/** Radiance to what is encoded as sRGB, each channel on its own. */
const CURVES = {
  sRGB: (v) => v,
  // Narkowicz 2016, a fit to the ACES reference transform
  Filmic: (v) => (v * (2.51 * v + 0.03)) / (v * (2.43 * v + 0.59) + 0.14),
  Reinhard: (v) => v / (1 + v),
};

/** How images are shown: a byte for every half float, made anew when exposure or curve change. */
const tone = {
  stops: 0,
  curve: "sRGB",
  version: 0,
  bytes: new Uint8Array(FLOATS.length),
  set(stops, curve) {
    this.stops = stops;
    this.curve = curve;
    const gain = 2 ** stops, map = CURVES[curve];
    for (let i = 0; i < FLOATS.length; i++) {
      this.bytes[i] = Math.round(255 * Math.min(1, Math.max(0, encoded(map(FLOATS[i] * gain)))));
    }
    this.version++;
  },
};
tone.set(0, "sRGB");

const COLOURS = {
  // dark to bright; perceptually even, after matplotlib's inferno and viridis
  heat: ["#000004", "#280b54", "#65156e", "#9f2a63", "#d44842", "#f57d15", "#fac127", "#fcffa4"],
  weight: ["#440154", "#443983", "#31688e", "#21918c", "#35b779", "#90d743", "#fde725"],
  // darker than before, unchanged, brighter
  signed: ["#7fd0ff", "#1f7fd0", "#0d3a6b", "#101012", "#6b3405", "#d97a12", "#ffd27a"],
};

function ramp(name) {
  const stops = COLOURS[name].map((c) => [1, 3, 5].map((at) => parseInt(c.slice(at, at + 2), 16)));
  return Array.from({ length: 256 }, (_, i) => {
    const at = (i / 255) * (stops.length - 1), k = Math.min(Math.floor(at), stops.length - 2);
    return stops[k].map((v, c) => Math.round(v + (stops[k + 1][c] - v) * (at - k)));
  });
}

const gradient = (name) => `linear-gradient(90deg, ${COLOURS[name].join(", ")})`;

/** An image of linear radiance on a canvas of its own size. */
class Picture {
  constructor(label, width, height, planes) {
    Object.assign(this, { label, width, height, planes, version: -1 });
    this.canvas = make("canvas", { width, height });
  }
  values(x, y) {
    return this.planes.map((plane) => FLOATS[plane[y * this.width + x]]);
  }
  painted() {
    if (this.version === tone.version) return this.canvas;
    const context = this.canvas.getContext("2d"), image = context.createImageData(this.width, this.height);
    const [red, green, blue] = this.planes, { bytes } = tone;
    for (let i = 0, o = 0; i < red.length; i++) {
      image.data[o++] = bytes[red[i]];
      image.data[o++] = bytes[green[i]];
      image.data[o++] = bytes[blue[i]];
      image.data[o++] = 255;
    }
    context.putImageData(image, 0, 0);
    this.version = tone.version;
    return this.canvas;
  }
}

/** Values in false colours between ``from`` and ``to``. */
class Falsecolour {
  constructor(label, width, height, plane, { colours, from, to, told }) {
    Object.assign(this, { label, width, height, plane, colours, from, to, told });
    this.canvas = null;
  }
  values(x, y) {
    return [this.plane[y * this.width + x]];
  }
  painted() {
    if (this.canvas) return this.canvas;
    this.canvas = make("canvas", { width: this.width, height: this.height });
    const context = this.canvas.getContext("2d"), image = context.createImageData(this.width, this.height);
    const table = ramp(this.colours), scale = 255 / (this.to - this.from);
    this.plane.forEach((value, i) => {
      const step = Math.round(Math.min(255, Math.max(0, (value - this.from) * scale)));
      image.data.set(table[step], 4 * i);
      image.data[4 * i + 3] = 255;
    });
    context.putImageData(image, 0, 0);
    return this.canvas;
  }
}

/** The value that this share of all values lies below. */
function quantile(values, share) {
  const step = Math.max(1, Math.floor(values.length / 50000));
  const sorted = Float32Array.from({ length: Math.ceil(values.length / step) }, (_, i) => values[i * step]).sort();
  return sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
}

const percent = (v, digits = 0) => `${v > 0 ? "+" : ""}${(100 * v).toFixed(digits)} %`.replace("-", "−");
const short = (v) => (v === 0 ? "0" : Math.abs(v) >= 0.01 && Math.abs(v) < 1e4 ? v.toPrecision(3) : v.toExponential(1));

/** A row of a slider with its name and what it stands at. */
function range(name, attributes, told, act) {
  const input = make("input", { type: "range", "aria-label": name, ...attributes });
  const output = make("output");
  const update = () => {
    output.textContent = told(Number(input.value));
    input.setAttribute("aria-valuetext", output.textContent);
  };
  input.addEventListener("input", () => {
    update();
    act(Number(input.value));
  });
  update();
  const group = make("div", { class: "group" }, make("span", { class: "name" }, name), input, output);
  return { group, input, update };
}
