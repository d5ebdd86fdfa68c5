"""A denoiser that is an ONNX model, run by onnxruntime on the CPU (extra ``onnx``).

A model fits if it has

- inputs named ``color`` and, if it uses them, ``albedo`` and ``normal``, of 3 channels each; or one input
  of any name with 3, 6 or 9 channels, in the order colour, albedo, normal. A model that takes a feature
  needs it: a frame without it is refused, since zeros are not what it was trained on, unless the custom metadata
  key ``optional`` names it (such as ``albedo normal``): then the model was trained with zeros for what lacks;
- for each input the layout NCHW or NHWC with N = 1 (or dynamic): NCHW if the second dimension is the
  number of channels, else NHWC if the fourth is. Height and width are dynamic or fixed;
- float32 or float16 for all inputs and the output (float16 ends at 65504: brighter radiance is clipped);
- one output of 3 channels, of the height and width of the input. If its shape is not declared, it has the
  layout of the colour.

Colour goes in as linear radiance, albedo and normal as the renderer wrote them, and the output is linear
radiance: a model that wants a logarithm or another range holds it in its graph. The custom metadata key
``multiple`` says to what multiple the height and width are padded before (default 1); for a model of fixed
size, the padded image must have that size.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from selfcorrect.errors import DenoiserError, FileError

__all__ = ["Onnx"]

ORDER = ("color", "albedo", "normal")
DTYPES: dict[str, np.dtype[Any]] = {
    "tensor(float)": np.dtype(np.float32),
    "tensor(float16)": np.dtype(np.float16),
}
ERRORS = (
    ort_errors.Fail,
    ort_errors.InvalidArgument,
    ort_errors.InvalidGraph,
    ort_errors.InvalidProtobuf,
    ort_errors.NotImplemented,
    ort_errors.RuntimeException,
)
EXPECTED = (
    "expected inputs color[, albedo][, normal] of 3 channels, or one of 3, 6 or 9, and one output of 3, "
    "NCHW or NHWC, float or float16"
)


class Slot(NamedTuple):
    """One input or output of a model: which images it holds, and how."""

    name: str
    images: tuple[str, ...]
    channels_last: bool
    dtype: np.dtype[Any]
    size: tuple[object, object]  # height and width: numbers where fixed

    def fits(self, height: int, width: int) -> bool:
        """Whether an image of this size goes in."""
        pairs = zip(self.size, (height, width), strict=True)
        return all(not isinstance(fixed, int) or fixed == actual for fixed, actual in pairs)


class Onnx:
    """An ONNX model as a denoiser.

    Raises:
        FileError: there is no such file.
        DenoiserError: the file is no ONNX model, or not one that fits (see above).
    """

    def __init__(self, path: str, threads: int | None = None):
        self.path = path
        self.name = f"onnx {Path(path).name}"
        if not Path(path).is_file():
            raise FileError(f"{path}: expected an ONNX model, but found no such file")
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3  # errors come as exceptions; warnings would go straight to stderr
        if threads is not None:
            options.intra_op_num_threads = threads
        try:
            self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except ERRORS as error:
            raise DenoiserError(f"{path}: expected an ONNX model, but got: {_one_line(error)}") from error
        self.inputs = self._inputs()
        self.output = self._output()
        self.multiple = self._multiple()
        self.optional = frozenset(self.session.get_modelmeta().custom_metadata_map.get("optional", "").split())
        self.features = frozenset(image for slot in self.inputs for image in slot.images) - {"color"}

    def denoise(self, color: torch.Tensor, albedo: torch.Tensor | None, normal: torch.Tensor | None) -> torch.Tensor:
        """Run the model on colour (H, W, 3) and the features that it takes.

        Raises:
            DenoiserError: a feature is missing, the model is of another fixed size, or it failed.
        """
        images = {"color": color, "albedo": albedo, "normal": normal}
        height, width = color.shape[:2]
        feeds = {}
        for slot in self.inputs:
            if not slot.fits(height, width):
                expected = "x".join(str(side) for side in reversed(slot.size))
                raise DenoiserError(f"{self.path}: expected an image of {expected}, but got {width}x{height}")
            stacked = []
            for name in slot.images:
                image = images[name]
                if image is None and name not in self.optional:
                    raise DenoiserError(f"{self.path}: expected a frame with {name}, but got one without")
                stacked.append((torch.zeros_like(color) if image is None else image).numpy())
            feeds[slot.name] = _feed(slot, np.concatenate(stacked, axis=2))
        try:
            result = np.asarray(self.session.run([self.output.name], feeds)[0], dtype=np.float32)
        except ERRORS as error:
            raise DenoiserError(f"{self.path}: {_one_line(error)}") from error
        if result.ndim != 4 or result.shape[0] != 1:
            raise DenoiserError(f"{self.path}: expected an output of one image, but got {result.shape}")
        return torch.from_numpy(result[0] if self.output.channels_last else result[0].transpose(1, 2, 0))

    def _inputs(self) -> list[Slot]:
        nodes = self.session.get_inputs()
        slots: list[Slot | None]
        if len(nodes) == 1:
            slots = [_slot(nodes[0], {3 * count: ORDER[:count] for count in (1, 2, 3)})]
        elif {"color"} <= {node.name for node in nodes} <= set(ORDER):
            slots = [_slot(node, {3: (node.name,)}) for node in nodes]
        else:
            raise self._misfit()
        fitting = [slot for slot in slots if slot is not None]
        if len(fitting) < len(nodes):
            raise self._misfit()
        return fitting

    def _output(self) -> Slot:
        nodes = self.session.get_outputs()
        if len(nodes) != 1:
            raise self._misfit()
        declared = _slot(nodes[0], {3: ("color",)})
        if declared is not None:
            return declared
        undeclared = not any(isinstance(side, int) for side in (nodes[0].shape or [])[1:])
        if undeclared and nodes[0].type in DTYPES:
            return self.inputs[0]._replace(name=nodes[0].name)
        raise self._misfit()

    def _multiple(self) -> int:
        text = self.session.get_modelmeta().custom_metadata_map.get("multiple", "1")
        if not (text.isascii() and text.isdigit() and len(text) < 5 and int(text) > 0):
            raise DenoiserError(
                f"{self.path}: expected the metadata multiple to be an integer from 1 to 9999, but got {text[:40]!r}"
            )
        return int(text)

    def _misfit(self) -> DenoiserError:
        """Say what the model has and what is expected."""
        inputs = ", ".join(_described(node) for node in self.session.get_inputs())
        outputs = ", ".join(_described(node) for node in self.session.get_outputs())
        return DenoiserError(f"{self.path}: {EXPECTED}, but got inputs {inputs} and outputs {outputs}")


def _slot(node: onnxruntime.NodeArg, channels: dict[int, tuple[str, ...]]) -> Slot | None:
    """Read a model's input or output, or None if it has none of these numbers of channels."""
    shape = node.shape
    if node.type not in DTYPES or len(shape) != 4 or (isinstance(shape[0], int) and shape[0] != 1):
        return None
    dtype = DTYPES[node.type]
    if shape[1] in channels:
        return Slot(node.name, channels[shape[1]], False, dtype, (shape[2], shape[3]))
    if shape[3] in channels:
        return Slot(node.name, channels[shape[3]], True, dtype, (shape[1], shape[2]))
    return None


def _described(node: onnxruntime.NodeArg) -> str:
    return f"{node.name} {node.type.removeprefix('tensor')}{node.shape}"


def _feed(slot: Slot, image: NDArray[Any]) -> NDArray[Any]:
    """Bring an image (H, W, C) into a slot's dtype and layout."""
    limit = np.finfo(slot.dtype).max
    batch = image.clip(-limit, limit).astype(slot.dtype)[None]
    return np.ascontiguousarray(batch if slot.channels_last else batch.transpose(0, 3, 1, 2))


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
