// A frame: its layers in the viewer.

const viewer = new Viewer(document.getElementById("viewer"));
layersOf(data.layers).then((layers) => {
  viewer.load(layers, data.scale);
  document.documentElement.dataset.ready = "true";
});
