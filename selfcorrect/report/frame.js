// A frame: its layers in the viewer, and where it is shown reduced, the region that was changed most in detail.

const viewer = new Viewer(document.getElementById("viewer"));
const regions = [{ label: "Whole frame, reduced", left: 0, top: 0, ...data }];
if (data.detail) regions.push(data.detail);
const buttons = regions.map((region) => make("button", { type: "button", onclick: () => open(region) }, region.label));
if (regions.length > 1) {
  const group = make("div", { class: "group", role: "group", "aria-label": "Region" }, make("span", { class: "name" }, "Region"), ...buttons);
  document.getElementById("viewer").prepend(make("div", { class: "bar" }, group));
}

let wanted; // the region asked for last: one that takes longer to unpack must not come in its place
async function open(region) {
  wanted = region;
  region.unpacked ??= layersOf(region.layers);
  const layers = await region.unpacked;
  if (region !== wanted) return;
  viewer.load(layers, region.scale, [region.left, region.top]);
  buttons.forEach((button, i) => button.setAttribute("aria-pressed", regions[i] === region));
}

open(regions[0]).then(() => {
  document.documentElement.dataset.ready = "true";
});
