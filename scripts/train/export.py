"""Make what ships out of a run: weights as safetensors, or the denoiser as an ONNX model.

    .venv/bin/python scripts/train/export.py RUN [--out FILE] [--frame A.exr B.exr]

By default the file goes into the package: ``selfcorrect/weights/NETWORK.safetensors`` in half floats, or
``denoisers/weights/denoiser.onnx`` in single precision. Its metadata hold the settings, the checksum of the data, hours
of training and whose scenes those were. The model is compared with torch, on a frame where one is given.
"""

import argparse
import json
import os
import warnings
from pathlib import Path
from typing import Any

import onnx
import torch
from denoiser import MULTIPLE, Denoiser
from tasks import task_of
from torch import Tensor

import denoisers
from selfcorrect import files
from selfcorrect.frame import mean
from selfcorrect.stages import weights

PACKAGES = Path(__file__).resolve().parent.parent.parent
ATTRIBUTION = (
    "Trained on renders, as they are or with changed cameras, materials and lights, of the Mitsuba versions "
    "(Benedikt Bitterli, https://benedikt-bitterli.me/resources/) of 'Contemporary Bathroom' by Mareck (CC0), "
    "'Japanese Classroom' by NovaZeeke (CC-BY 3.0), 'The Breakfast Room' by Wig42 (CC-BY 3.0), "
    "'The White Room' by Jay-Artist (CC-BY 3.0) and 'The Wooden Staircase' by Wig42 (CC-BY 3.0), "
    "and of scenes of this project"
)
OPSET = 18
LARGEST = 256  # halvings: what export has to be told about sizes, times MULTIPLE
INPUTS = ("color", "albedo", "normal")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--frame", type=Path, nargs=2, metavar=("A.exr", "B.exr"))
    options = parser.parse_args(arguments)
    saved = torch.load(options.run / "checkpoint.pt", weights_only=True)
    settings, run = saved["settings"], saved["run"]
    network = task_of(settings["network"], settings["architecture"], settings["seed"], settings["crop"]).build()
    network.load_state_dict(run["mean"])
    facts = {**settings, "hours": round(run["seconds"] / 3600, 3), "steps": run["step"]}
    path = options.out or default_path(settings["network"])
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(network, Denoiser):
        write_onnx(network.eval().to(memory_format=torch.contiguous_format), path, facts)
        print(f"largest difference between onnxruntime and torch: {difference(network, path, options.frame):.3g}")
    else:
        weights.save(path, network, settings=facts, data=settings["data"], attribution=ATTRIBUTION)
        weights.load(path, type(network))
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB, {facts['hours']} h, {facts['steps']} steps")


def default_path(network: str) -> Path:
    """Where a network's weights are in the package."""
    if network == "denoiser":
        return PACKAGES / "denoisers" / "weights" / "denoiser.onnx"
    stage = "deep-combiner" if network == "bilateral-combiner" else network
    return PACKAGES / "selfcorrect" / "weights" / f"{stage}.safetensors"


def write_onnx(network: Denoiser, path: Path, facts: dict[str, Any]) -> None:
    """Export to ONNX with dynamic height and width, both multiples of :data:`denoiser.MULTIPLE`."""
    example = tuple(torch.rand(1, 3, side * MULTIPLE, 3 * MULTIPLE) for side in (4, 4, 4))
    size = {2 + i: MULTIPLE * torch.export.Dim(name, min=1, max=LARGEST) for i, name in enumerate(("height", "width"))}
    with torch.no_grad(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="# The axis name", category=UserWarning)  # three inputs of one size
        warnings.filterwarnings("ignore", message=".*LeafSpec", category=FutureWarning)  # within torch
        program = torch.onnx.export(
            network,
            example,
            input_names=INPUTS,
            output_names=["denoised"],
            dynamic_shapes=(size, size, size),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None  # as always where no file is named
    model = program.model_proto
    metadata = {
        "multiple": str(MULTIPLE),
        "optional": "albedo normal",
        "architecture": json.dumps(network.architecture),
        "settings": json.dumps(facts),
        "data": facts["data"],
        "attribution": ATTRIBUTION,
    }
    onnx.helper.set_model_props(model, metadata)
    del model.graph.value_info[:]  # shapes of the example's names, a tenth of the file
    for node in model.graph.node:  # where each node came from, in this machine's paths
        del node.metadata_props[:]
        node.doc_string = ""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    onnx.save(model, temporary)
    os.replace(temporary, path)


def difference(network: Denoiser, path: Path, frame: list[Path] | None) -> float:
    """The largest difference of the model from torch, over the largest radiance."""
    if frame:
        loaded = files.load(files.Sources(*map(str, frame))).frame
        if loaded.albedo is None or loaded.normal is None:
            raise SystemExit(f"{frame[0]}: expected albedo and normal, but got a frame without")
        images = [mean(pair) for pair in (loaded.color, loaded.albedo, loaded.normal)]
    else:
        generator = torch.Generator().manual_seed(0)
        images = [torch.rand(7 * MULTIPLE, 5 * MULTIPLE, 3, generator=generator) for _ in INPUTS]
    height, width = (side // MULTIPLE * MULTIPLE for side in images[0].shape[:2])
    images = [image[:height, :width].contiguous() for image in images]
    with torch.no_grad():
        expected = network(*(planes(image) for image in images))[0].permute(1, 2, 0)
    found: Tensor = denoisers.create(f"onnx:{path}")(images[0], albedo=images[1], normal=images[2])
    return float((found - expected).abs().max() / expected.max())


def planes(image: Tensor) -> Tensor:
    return image.permute(2, 0, 1)[None]


if __name__ == "__main__":
    main()
