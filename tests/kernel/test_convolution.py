"""The compiled convolutions against torch: values and every gradient, on every instruction set."""

import pytest
import torch
from helpers.kernel import TOLERANCE
from helpers.tolerances import near
from torch import Tensor, nn

from selfcorrect import Settings
from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.kernel import convolution
from selfcorrect.kernel.convolution import cpu, gpu
from selfcorrect.kernel.convolution import reference as in_torch
from selfcorrect.kernel.convolution.cpu import convolutions
from selfcorrect.stages.core.network import Network

VARIANTS = cpu.instruction_sets()
FORMS = [*VARIANTS, "gpu"]
"""The CPU's compiled variants, and the form for CUDA, which is torch's and runs on the CPU where there is no device."""

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
SIZES = [(1, 1), (1, 17), (16, 1), (5, 7), (19, 19), (3, 130), (33, 65), (64, 64)]


def make_network(inputs: int, heads: int, *, log_radiance: bool = False, filters: int = 16, layers: int = 9) -> Network:
    settings = Settings.preset("paper", log_radiance=log_radiance, filters=filters, layers=layers)
    network = Network(inputs, heads, settings, torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for bias in list(network.parameters())[1::2]:
            bias.uniform_(-0.3, 0.3, generator=generator)
    return network


def random(*shape: int, seed: int = 2) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def rounded(x: Tensor) -> Tensor:
    """To bfloat16 and back."""
    return x.float().bfloat16().to(x.dtype)


def reference(network: Network, images: Tensor, upstream: Tensor) -> list[Tensor]:
    """Heads and the gradients of all parameters, in float64."""
    parameters = [p.detach().double().requires_grad_() for p in network.parameters()]
    raw = in_torch.convolutions(images.double(), parameters, log_radiance=network.log_radiance)
    return [raw.detach(), *torch.autograd.grad(raw, parameters, upstream.double())]


def rounded_reference(network: Network, images: Tensor, upstream: Tensor) -> list[Tensor]:
    """The same with activations, weights and upstream gradients rounded to bfloat16, and nothing else."""
    parameters = [p.detach().double() for p in network.parameters()]
    weights, biases = [rounded(w) for w in parameters[::2]], parameters[1::2]
    images = images.double()
    if network.log_radiance:
        images = torch.cat([images[:, :3].log1p(), images[:, 3:-3], images[:, -3:].log1p()], 1)
    kept, x = [], rounded(images)
    for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        kept.append(x)
        x = nn.functional.conv2d(x, weight, bias, padding=1)
        if i < len(weights) - 1:
            x = rounded(x.relu())
    gradients: list[Tensor] = []
    gradient = upstream.double()
    for activation, weight in zip(kept[::-1], weights[::-1], strict=True):
        of_bias = gradient.sum((0, 2, 3))
        gradient = rounded(gradient)
        of_weight = nn.grad.conv2d_weight(activation, weight.shape, gradient, padding=1)
        gradients = [of_weight, of_bias, *gradients]
        gradient = nn.grad.conv2d_input(activation.shape, weight, gradient, padding=1) * (activation > 0)
    return [x, *gradients]


def compiled(network: Network, images: Tensor, upstream: Tensor, isa: str, threads: int = 2) -> list[Tensor]:
    parameters = list(network.parameters())
    if isa == "gpu":
        there = [p.detach().to(DEVICE).requires_grad_() for p in parameters]
        raw = gpu.convolutions(list(images.to(DEVICE)), there, log_radiance=network.log_radiance)
        return [x.cpu() for x in (raw.detach(), *torch.autograd.grad(raw, there, upstream.to(DEVICE)))]
    raw = convolutions(list(images), parameters, log_radiance=network.log_radiance, isa=isa, threads=threads)
    return [raw.detach(), *torch.autograd.grad(raw, parameters, upstream)]


def assert_close(got: list[Tensor], expected: list[Tensor], dtype: torch.dtype) -> None:
    size, order = torch.linalg.vector_norm, torch.inf if dtype == torch.float32 else 2
    for i, (a, b) in enumerate(zip(got, expected, strict=True)):
        assert a.shape == b.shape
        assert a.isfinite().all()
        worst = float(size(a.double() - b, order) / size(b, order).clamp(min=1e-9))
        name = "heads" if i == 0 else f"gradient of {'weight' if i % 2 else 'bias'} {(i - 1) // 2}"
        kind = "convolution gradients" if i else "convolution"
        assert worst < TOLERANCE[dtype][kind], f"{name}: off by {worst:.2e}"


def compare(network: Network, images: Tensor, isa: str) -> None:
    # of one sign, so that sums over pixels do not cancel and leave their rounding only
    upstream = random(images.shape[0], len(list(network.parameters())[-1]), *images.shape[2:], seed=3)
    exact = rounded_reference if isa in cpu.BF16 else reference
    dtype = torch.bfloat16 if isa in cpu.BF16 else torch.float32
    assert_close(compiled(network, images, upstream, isa), exact(network, images, upstream), dtype)


@pytest.mark.parametrize("isa", FORMS)
@pytest.mark.parametrize("size", SIZES)
def test_sizes(size: tuple[int, int], isa: str) -> None:
    compare(make_network(13, 15), random(3, 13, *size), isa)


@pytest.mark.parametrize("isa", FORMS)
@pytest.mark.parametrize(("inputs", "heads"), [(3, 4), (6, 6), (7, 7), (10, 11), (13, 15), (16, 16)])
def test_inputs_and_heads(inputs: int, heads: int, isa: str) -> None:
    compare(make_network(inputs, heads), random(2, inputs, 9, 21), isa)


@pytest.mark.parametrize("isa", FORMS)
@pytest.mark.parametrize(("filters", "layers"), [(1, 2), (5, 3), (16, 12)])
def test_filters_and_layers(filters: int, layers: int, isa: str) -> None:
    compare(make_network(6, 6, filters=filters, layers=layers), random(1, 6, 12, 10), isa)


@pytest.mark.parametrize("isa", VARIANTS)
def test_log_radiance(isa: str) -> None:
    images = random(2, 13, 8, 20)
    images[:, :3] = 10 ** (17 * images[:, :3] - 2)  # to 1e15, as bright as guides can be
    images[:, -3:, :4] = 0
    compare(make_network(13, 15, log_radiance=True), images, isa)


@pytest.mark.parametrize("isa", VARIANTS)
def test_memory_layouts(isa: str) -> None:
    """Views into larger planes, turned images and upstream gradients of any strides give the same bits."""
    network = make_network(6, 6)
    planes = random(6, 40, 50)
    view = planes[:, 3:24, 5:36]
    upstream = random(1, 6, 21, 31, seed=3) - 0.5
    expected = compiled(network, view.contiguous()[None], upstream, isa)
    turned = view.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    last = upstream.contiguous(memory_format=torch.channels_last)
    for image, gradient in (
        (view, upstream),
        (turned, upstream),
        (view, last),
        (view, upstream[:, :1].expand(1, 6, 21, 31)),
    ):
        got = compiled(network, image[None], gradient, isa)
        wanted = (
            expected
            if gradient is upstream or gradient is last
            else compiled(network, view[None].contiguous(), gradient.contiguous(), isa)
        )
        assert all(torch.equal(a, b) for a, b in zip(got, wanted, strict=True))


@pytest.mark.parametrize("isa", VARIANTS)
def test_same_bits_each_time_and_with_any_number_of_threads(isa: str) -> None:
    network = make_network(13, 15)
    images, upstream = random(5, 13, 33, 40), random(5, 15, 33, 40, seed=3) - 0.5
    first = compiled(network, images, upstream, isa, threads=1)
    for threads in (1, 2, 3, 8):
        again = compiled(network, images, upstream, isa, threads=threads)
        assert all(torch.equal(a, b) for a, b in zip(again, first, strict=True))


@pytest.mark.parametrize("isa", VARIANTS)
def test_tiles_are_the_whole(isa: str) -> None:
    """Bit for bit: with gradients or without, with any threads, and from any piece with nine pixels around it."""
    network = make_network(13, 15)
    parameters = list(network.parameters())
    image = random(13, 150, 500)  # several tasks
    with_gradients = convolutions([image], parameters, isa=isa)
    with torch.no_grad():
        for threads in (1, 4):
            assert torch.equal(convolutions([image], parameters, isa=isa, threads=threads), with_gradients)
        for top, left, bottom, right in ((0, 0, 150, 500), (0, 0, 1, 1), (37, 61, 90, 133), (149, 490, 150, 500)):
            whole = with_gradients[:, :, top:bottom, left:right]
            y, x = max(0, top - 9), max(0, left - 9)
            piece = image[:, y : bottom + 9, x : right + 9]
            for view, (dy, dx) in ((image, (0, 0)), (piece, (y, x))):
                region = (top - dy, left - dx, bottom - dy, right - dx)
                assert torch.equal(convolutions([view], parameters, isa=isa, region=region), whole)


@pytest.mark.parametrize("isa", VARIANTS)
def test_a_firefly_stays_in_its_neighbourhood(isa: str) -> None:
    """What one pixel holds, an infinity included, reaches nine pixels and no further."""
    network = make_network(6, 6)
    image = random(6, 30, 60)
    broken = image.clone()
    broken[:, 14, 30] = torch.inf
    with torch.no_grad():
        expected, got = (convolutions([x], list(network.parameters()), isa=isa) for x in (image, broken))
    far = torch.ones(30, 60, dtype=torch.bool)
    far[5:24, 21:40] = False
    assert torch.equal(got[..., far], expected[..., far])


def test_precision_chooses_the_variant() -> None:
    assert cpu.best_instruction_set("fp32") not in cpu.BF16
    assert (cpu.best_instruction_set("bf16") in cpu.BF16) == (not {*cpu.BF16}.isdisjoint(VARIANTS))
    with pytest.raises(SettingsError, match=r"expected an instruction set out of .*, but got sse9"):
        convolutions([random(3, 4, 4)], list(make_network(3, 4).parameters()), isa="sse9")


@pytest.mark.parametrize("change", [{"filters": 17}, {}])
def test_what_the_kernel_does_not_do_torch_does(change: dict[str, int]) -> None:
    """More than sixteen channels, or double precision."""
    network = make_network(6, 6, **change)
    if not change:
        network.double()
    image = random(6, 9, 9).to(next(network.parameters()).dtype)
    expected = in_torch.convolutions([image], list(network.parameters()))
    assert torch.equal(network([image]), expected)
    assert torch.equal(network([image], region=(1, 2, 4, 9)), expected[:, :, 1:4, 2:9])


def test_regions_are_checked() -> None:
    network, image = make_network(6, 6), random(6, 9, 9)
    with pytest.raises(FrameError, match=r"expected the whole image .*, but got the region"):
        network([image], region=(0, 0, 5, 5))
    with torch.no_grad():
        assert network([image], region=(2, 3, 5, 9)).shape == (1, 6, 3, 6)
        for region in ((0, 0, 10, 9), (-1, 0, 9, 9), (3, 3, 3, 5)):
            with pytest.raises(FrameError, match="expected a region inside"):
                network([image], region=region)


def test_every_backend_gives_the_same() -> None:
    parameters = list(make_network(6, 6).parameters())
    images = [random(6, 9, 9), random(6, 9, 9, seed=4)]
    region = (1, 2, 4, 9)
    with torch.no_grad():
        expected = convolution.convolutions(images, parameters, region=region, backend="reference")
        got = convolution.convolutions(images, parameters, region=region)
        assert torch.equal(got, convolution.convolutions(images, parameters, region=region, backend="cpu"))
    torch.testing.assert_close(got, expected, **near("convolution views"))
    with pytest.raises(SettingsError, match="at most 16 channels for the backend cpu"):
        convolution.convolutions(images, list(make_network(6, 6, filters=17).parameters()), backend="cpu")
    with pytest.raises(FrameError, match="expected images of one shape"):
        convolution.convolutions([random(6, 9, 9), random(6, 9, 8)], parameters)


def test_the_form_for_cuda_in_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hidden layers are rounded, weights and bias of the last layer are not; heads and gradients come in float32."""
    monkeypatch.setattr(gpu, "has_fast_bf16", lambda device: True)
    network, images = make_network(13, 15), random(2, 13, 17, 21)
    upstream = random(2, 15, 17, 21, seed=3)
    parameters = [p.detach().to(DEVICE).requires_grad_() for p in network.parameters()]
    raw = gpu.convolutions(list(images.to(DEVICE)), parameters, precision="bf16")
    got = [raw.detach(), *torch.autograd.grad(raw, parameters, upstream.to(DEVICE))]
    assert all(x.dtype == torch.float32 for x in got)
    for i, (x, expected) in enumerate(zip(got, reference(network, images, upstream), strict=True)):
        norm, kind = torch.linalg.vector_norm, "convolution for CUDA" + " gradients" * bool(i)
        difference = float(norm(x.cpu().double() - expected) / norm(expected))
        assert 1e-4 < difference < TOLERANCE[torch.bfloat16][kind] or i == len(got) - 1, f"{kind} {i}: {difference:.2e}"
